"""What the exports hold: one generator of rows per table, which the pages, the CSV files and the PDF all read.

Three hand-made versions of the same table disagree sooner or later, and then nobody knows which one was right.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from django.db.models import Count, OuterRef, QuerySet, Subquery
from django.utils import timezone

from inspection.models import Damage, Measurement, RangeImage, Region, Scan, Tool
from inspection.states import VERDICT_ORDER, Verdict

#: A cell: text is a person's words and may hold anything; numbers and moments are ours.
Cell = str | int | float | bool | dt.datetime | dt.date | None

#: Rows fetched from the database at a time, so that an export of years does not sit in memory.
CHUNK = 500


@dataclass(frozen=True)
class Table:
    """Column headings (with units) and the rows below them, made while they are read."""

    title: str
    columns: tuple[str, ...]
    rows: Iterator[tuple[Cell, ...]]


@dataclass(frozen=True)
class Selection:
    """Which scans a table is about. Empty fields do not narrow. Days are local dates, both included."""

    tool: str = ""
    region: str = ""
    state: str = ""
    since: dt.date | None = None
    until: dt.date | None = None

    def scans(self) -> QuerySet[Scan]:
        found = Scan.objects.all()
        if self.tool:
            found = found.filter(inspection__tool__code=self.tool)
        if self.region:
            found = found.filter(region__name=self.region)
        if self.state:
            found = found.filter(state=self.state)
        if self.since:
            found = found.filter(queued_at__gte=_midnight(self.since))
        if self.until:
            found = found.filter(queued_at__lt=_midnight(self.until + dt.timedelta(days=1)))
        return found


def _midnight(day: dt.date) -> dt.datetime:
    return timezone.make_aware(dt.datetime.combine(day, dt.time.min))


def newest_results(scans: QuerySet[Scan]) -> QuerySet[RangeImage]:
    """The newest range image of each scan; older ones stay on record but are not exported."""
    newest = RangeImage.objects.filter(scan=OuterRef("scan")).order_by("-created_at", "-pk").values("pk")[:1]
    return RangeImage.objects.filter(scan__in=scans, pk=Subquery(newest))


def scans_table(selection: Selection) -> Table:
    """One row per scan, newest first."""

    def rows() -> Iterator[tuple[Cell, ...]]:
        newest = RangeImage.objects.filter(scan=OuterRef("pk")).order_by("-created_at", "-pk")
        found = (
            selection.scans()
            .select_related("inspection__tool", "region", "rig", "recipe", "requested_by")
            .annotate(
                verdict=Subquery(newest.values("verdict")[:1]),
                undefined=Subquery(newest.values("precision__undefined_share")[:1]),
                saturated=Subquery(newest.values("precision__saturated_share")[:1]),
                sigma=Subquery(newest.values("precision__sigma_um")[:1]),
                cell_scan=Subquery(newest.values("precision__cell_scan_um")[:1]),
                cell_row=Subquery(newest.values("precision__cell_row_um")[:1]),
            )
            .order_by("-queued_at", "-pk")
        )
        for scan in found.iterator(CHUNK):
            yield (
                scan.pk, scan.inspection_id, scan.inspection.tool.code, scan.region.name, scan.state, scan.verdict,
                scan.partial, scan.rig.name, scan.recipe.name, str(scan.requested_by or "schedule"), scan.queued_at,
                scan.started_at, scan.finished_at, scan.inspection.life_used, _percent(scan.undefined),
                _percent(scan.saturated), scan.sigma, scan.cell_row, scan.cell_scan, scan.fault,
            )  # fmt: skip

    return Table(
        "Scans",
        (
            "scan", "inspection", "tool", "region", "state", "verdict", "partial", "rig", "recipe", "requested by",
            "queued", "started", "finished", "life used", "undefined %", "saturated %", "sigma µm", "cell rows µm",
            "cell scan µm", "fault",
        ),
        rows(),
    )  # fmt: skip


def measurements_table(selection: Selection) -> Table:
    """One row per scan and metric, of each scan's newest result. u is the standard uncertainty (k = 1)."""

    def rows() -> Iterator[tuple[Cell, ...]]:
        found = (
            Measurement.objects.filter(range_image__in=newest_results(selection.scans()))
            .select_related("range_image__scan__inspection__tool", "range_image__scan__region")
            .order_by("-range_image__scan__queued_at", "-range_image__scan_id", "pk")
        )
        for row in found.iterator(CHUNK):
            scan = row.range_image.scan
            yield (
                scan.pk, scan.inspection.tool.code, scan.region.name, scan.finished_at, scan.inspection.life_used,
                row.metric, row.label, row.value, row.unit, row.u, row.origin, row.range_image.verdict,
            )  # fmt: skip

    return Table(
        "Measurements",
        (
            "scan", "tool", "region", "finished", "life used", "metric", "meaning", "value", "unit",
            "standard uncertainty", "origin", "verdict",
        ),
        rows(),
    )  # fmt: skip


def damages_table(selection: Selection) -> Table:
    """One row per damage, of each scan's newest result."""

    def rows() -> Iterator[tuple[Cell, ...]]:
        found = (
            Damage.objects.filter(range_image__in=newest_results(selection.scans()))
            .select_related("range_image__scan__inspection__tool", "range_image__scan__region")
            .order_by("-range_image__scan__queued_at", "-range_image__scan_id", "number")
        )
        for row in found.iterator(CHUNK):
            scan = row.range_image.scan
            yield (
                scan.pk, scan.inspection.tool.code, scan.region.name, scan.finished_at, row.number, row.severity,
                row.volume_mm3, row.u_volume_mm3, row.depth_um, row.u_depth_um, row.area_mm2, row.length_mm,
                row.start_mm, row.end_mm, row.touches_edge,
            )  # fmt: skip

    return Table(
        "Damages",
        (
            "scan", "tool", "region", "finished", "number", "severity", "volume mm³", "u volume mm³", "depth µm",
            "u depth µm", "area mm²", "length along edge mm", "from mm", "to mm", "touches edge",
        ),
        rows(),
    )  # fmt: skip


def tools_table(selection: Selection) -> Table:
    """One row per tool with the verdict of its newest measured visit."""

    def rows() -> Iterator[tuple[Cell, ...]]:
        tools = Tool.objects.select_related("tool_type").annotate(visits=Count("inspections"))
        if selection.tool:
            tools = tools.filter(code=selection.tool)
        verdicts = latest_verdicts(tools)
        for tool in tools.order_by("code"):
            verdict, at = verdicts.get(tool.pk, (None, None))
            yield (
                tool.code, tool.tool_type.name, tool.location, tool.status, tool.life_used, tool.tool_type.life_unit,
                verdict, at, tool.visits, tool.note,
            )  # fmt: skip

    return Table(
        "Tools",
        (
            "tool", "type", "location", "status", "life used", "life unit", "verdict", "last inspected", "inspections",
            "note",
        ),
        rows(),
    )  # fmt: skip


def latest_verdicts(tools: QuerySet[Tool]) -> dict[int, tuple[str, dt.datetime]]:
    """Each tool's worst verdict over the newest result of every region, and when the newest of them was scanned."""
    # One look-up per region, not per range image: the latter grows with the square of a tool's history.
    newest = RangeImage.objects.filter(scan__region=OuterRef("pk")).order_by(
        "-scan__queued_at", "-scan_id", "-created_at", "-pk"
    )
    regions = Region.objects.filter(tool__in=tools.values("pk"), active=True)
    shown = regions.annotate(newest=Subquery(newest.values("pk")[:1])).values_list("newest", flat=True)
    found = RangeImage.objects.filter(pk__in=[pk for pk in shown if pk is not None]).values_list(
        "scan__region__tool_id", "verdict", "scan__queued_at"
    )
    worst: dict[int, tuple[str, dt.datetime]] = {}
    for tool, verdict, at in found:
        before = worst.get(tool, (verdict, at))
        worst[tool] = (worse(before[0], verdict), max(before[1], at))
    return worst


def worse(one: str, other: str) -> str:
    """The more serious of two verdicts."""
    return max(one, other, key=lambda verdict: VERDICT_ORDER.index(Verdict(verdict)))


def verdict_of_visit(verdicts: list[str | None]) -> str:
    """A visit is as bad as its worst region; a region without a result makes it unknown at the least."""
    result: str = Verdict.OK if verdicts else Verdict.UNKNOWN
    for verdict in verdicts:
        result = worse(result, verdict or Verdict.UNKNOWN)
    return result


def _percent(share: Any) -> float | None:
    return None if share is None else 100.0 * float(share)
