"""The plant at a glance: every tool with the verdict of its worst region, when it is due, and what is happening to it.

A verdict belongs to an edge. After a regrind or a turned knife the old one says nothing, so a tool whose newest scan is
older than its newest edge counts as not scanned; showing yesterday's "replace" on a fresh edge would send a good knife
back to the grinder.
"""

from __future__ import annotations

import datetime as dt
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field

from django.db.models import OuterRef, Q, QuerySet, Subquery

from inspection.models import Event, RangeImage, Region, Scan, Schedule, Tool
from inspection.selectors.due import colour as due_colour
from inspection.states import LIVE, VERDICT_ORDER, ScanState, Verdict


def newest_results(regions: QuerySet[Region]) -> QuerySet[Region]:
    """Annotate each region with the range image to show (``newest_id``) and how its last scan ended (``last_state``).

    To show is the newest range image of the newest finished scan.
    """
    newest = RangeImage.objects.filter(scan__region=OuterRef("pk"), scan__state=ScanState.DONE)
    ended = Scan.objects.filter(region=OuterRef("pk"), finished_at__isnull=False).order_by("-finished_at", "-pk")
    return regions.annotate(
        newest_id=Subquery(newest.order_by("-scan__finished_at", "-created_at").values("pk")[:1]),
        last_state=Subquery(ended.values("state")[:1]),
    )


def worst(verdicts: Iterable[str | None]) -> str | None:
    """The verdict of the whole: as bad as its worst part. A part not scanned is unknown, unless none was."""
    known = list(verdicts)
    if not any(known):
        return None
    return max((verdict or Verdict.UNKNOWN for verdict in known), key=lambda v: VERDICT_ORDER.index(Verdict(v)))


def new_edges(tools: Iterable[int] | None = None) -> dict[int, Event]:
    """The newest event of each tool that gave it a new edge."""
    events = Event.objects.filter(kind__in=Event.SEGMENT_ENDS).order_by("at", "pk")
    if tools is not None:
        events = events.filter(tool__in=list(tools))
    return {event.tool_id: event for event in events}


def belongs_to_edge(image: RangeImage, edge: Event | None) -> bool:
    """False if the edge this image shows has been ground away or turned since."""
    measured_at = image.scan.started_at or image.scan.finished_at or image.created_at
    return edge is None or measured_at >= edge.at


@dataclass(frozen=True)
class RegionCell:
    """One region of one tool in the overview; ``image`` is None when its present edge was never scanned."""

    region: Region
    image: RangeImage | None

    @property
    def verdict(self) -> str | None:
        return self.image.verdict if self.image else None

    @property
    def went_wrong(self) -> bool:
        """True if the last attempt to scan it gave nothing."""
        return self.region.last_state in (ScanState.FAILED, ScanState.INTERRUPTED)  # type: ignore[attr-defined]


@dataclass(frozen=True)
class ToolRow:
    tool: Tool
    regions: list[RegionCell]
    edge: Event | None
    schedule: Schedule | None
    live: list[Scan] = field(default_factory=list)

    @property
    def verdict(self) -> str | None:
        return worst(cell.verdict for cell in self.regions)

    @property
    def measured_at(self) -> dt.datetime | None:
        return max((c.image.scan.finished_at or c.image.created_at for c in self.regions if c.image), default=None)

    @property
    def reason(self) -> str:
        """Why the verdict is what it is: the first sentence of the worst region, or why there is none."""
        for cell in self.regions:
            if cell.image and cell.verdict == self.verdict and cell.image.verdict_reasons:
                return f"{cell.region.name}: {cell.image.verdict_reasons[0]}"
        wrong = [cell.region.name for cell in self.regions if cell.went_wrong]
        if wrong and not self.verdict:
            return f"The last scan of {', '.join(wrong)} failed."
        unscanned = [cell.region.name for cell in self.regions if cell.image is None]
        if self.edge and unscanned and self.edge.kind in Event.SEGMENT_ENDS:
            return f"Not scanned since it was {self.edge.get_kind_display().lower()}."
        if unscanned and self.verdict:
            return f"{', '.join(unscanned)} not scanned yet."
        return ""


@dataclass(frozen=True)
class Overview:
    rows: list[ToolRow]
    counts: Counter[str]
    total: int
    overdue: int


def overview(*, search: str = "", verdict: str = "", status: str = "", today: dt.date) -> Overview:
    """All tools that match, worst first, then by due date. Counts are over all tools that are not retired."""
    tools = Tool.objects.select_related("tool_type").order_by("code")
    tools = tools.filter(status=status) if status else tools.exclude(status=Tool.Status.RETIRED)
    everyone = list(tools)
    rows = _rows(everyone)
    counts = Counter(row.verdict or "none" for row in rows)
    overdue = sum(1 for row in rows if row.schedule and due_colour(row.schedule, today) == "red")
    if search:
        word = search.lower()
        rows = [
            row
            for row in rows
            if word in row.tool.code.lower()
            or word in row.tool.location.lower()
            or word in row.tool.tool_type.name.lower()
        ]
    if verdict == "overdue":
        rows = [row for row in rows if row.schedule and due_colour(row.schedule, today) == "red"]
    elif verdict:
        rows = [row for row in rows if (row.verdict or "none") == verdict]
    rows.sort(key=lambda row: (-_urgency(row.verdict), row.schedule.next_due if row.schedule else dt.date.max))
    return Overview(rows=rows, counts=counts, total=len(everyone), overdue=overdue)


def _urgency(verdict: str | None) -> float:
    return VERDICT_ORDER.index(Verdict(verdict)) if verdict else 0.5


def _rows(tools: list[Tool]) -> list[ToolRow]:
    ids = [tool.pk for tool in tools]
    regions: dict[int, list[Region]] = defaultdict(list)
    for region in newest_results(Region.objects.filter(tool__in=ids, active=True)):
        regions[region.tool_id].append(region)
    wanted = [region.newest_id for some in regions.values() for region in some if region.newest_id]  # type: ignore[attr-defined]
    images = RangeImage.objects.select_related("scan").defer("provenance", "surface").in_bulk(wanted)
    edges = new_edges(ids)
    schedules: dict[int, Schedule] = {}
    for schedule in Schedule.objects.filter(tool__in=ids, enabled=True).order_by("-next_due"):
        schedules[schedule.tool_id] = schedule  # the earliest comes last and stays
    live: dict[int, list[Scan]] = defaultdict(list)
    for scan in (
        Scan.objects.filter(state__in=LIVE, region__tool__in=ids).select_related("region").order_by("region__name")
    ):
        live[scan.region.tool_id].append(scan)
    return [
        ToolRow(
            tool=tool,
            regions=[RegionCell(region, _current(images, region, edges.get(tool.pk))) for region in regions[tool.pk]],
            edge=edges.get(tool.pk),
            schedule=schedules.get(tool.pk),
            live=live[tool.pk],
        )
        for tool in tools
    ]


def _current(images: dict[int, RangeImage], region: Region, edge: Event | None) -> RangeImage | None:
    image = images.get(region.newest_id)  # type: ignore[attr-defined]
    return image if image and belongs_to_edge(image, edge) else None


def find_tools(code: str) -> list[Tool]:
    """The tool a scanner read: an exact code first, otherwise all whose code contains it."""
    exact = list(Tool.objects.filter(code__iexact=code))
    return exact or list(Tool.objects.filter(Q(code__icontains=code) | Q(location__icontains=code))[:20])
