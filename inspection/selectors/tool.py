"""One tool: what each region says now, against which limits, and what happened to it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from django.db.models import Prefetch

from inspection.models import Event, Inspection, Limit, LimitSet, Measurement, RangeImage, Region, Scan, Schedule, Tool
from inspection.selectors.overview import belongs_to_edge, new_edges, newest_results, worst

#: Shown on the tool page when the limits in force name no metric, in this order, as far as they were measured.
KEY_METRICS: Final = ("ER_max", "V-", "d_max", "L_max", "n", "ER_mean", "Sa")
#: More key numbers than this and none of them is key.
MOST_KEY_NUMBERS: Final = 6


@dataclass(frozen=True)
class Number:
    """A measurement beside its limit. ``over`` is "", "watch" or "replace"."""

    measurement: Measurement
    limit: Limit | None

    @property
    def over(self) -> str:
        value = self.measurement.value
        if value is None or self.limit is None:
            return ""
        if self.limit.replace_above is not None and value > self.limit.replace_above:
            return "replace"
        if self.limit.watch_above is not None and value > self.limit.watch_above:
            return "watch"
        return ""


@dataclass(frozen=True)
class RegionState:
    region: Region
    image: RangeImage | None
    numbers: list[Number]
    stale: bool
    """True if there is a result, but of an edge that has been ground away since."""
    live: Scan | None

    @property
    def verdict(self) -> str | None:
        return self.image.verdict if self.image and not self.stale else None


@dataclass(frozen=True)
class ToolState:
    tool: Tool
    regions: list[RegionState]
    edge: Event | None
    events: list[Event]
    inspections: list[Inspection]
    schedules: list[Schedule]
    limit_set: LimitSet | None
    live: list[Scan]

    @property
    def verdict(self) -> str | None:
        return worst(state.verdict for state in self.regions)

    @property
    def reasons(self) -> list[str]:
        """Sentences of the regions that are as bad as the whole, with the region's name before them."""
        found = [
            f"{state.region.name}: {reason}"
            for state in self.regions
            if state.image and not state.stale and state.verdict == self.verdict
            for reason in state.image.verdict_reasons
        ]
        if self.verdict is not None:
            found += [f"{s.region.name} was not scanned yet." for s in self.regions if s.image is None or s.stale]
        return found


def numbers(image: RangeImage) -> list[Number]:
    """All measurements of an image in their order, each with its limit in the set the image was judged by."""
    limits = {limit.metric: limit for limit in image.limit_set.limits.all()} if image.limit_set else {}
    return [Number(measurement, limits.get(measurement.metric)) for measurement in image.measurements.all()]


def key_numbers(all_numbers: list[Number]) -> list[Number]:
    """The few that decide: those with a limit, then the ones every wear discussion starts with."""
    limited = [number for number in all_numbers if number.limit]
    by_metric = {number.measurement.metric: number for number in all_numbers}
    rest = [by_metric[metric] for metric in KEY_METRICS if metric in by_metric and by_metric[metric] not in limited]
    return (limited + rest)[:MOST_KEY_NUMBERS] or all_numbers[:MOST_KEY_NUMBERS]


def tool_state(tool: Tool) -> ToolState:
    """Everything the tool page shows, in a fixed number of queries."""
    regions = list(newest_results(Region.objects.filter(tool=tool, active=True)))
    images = (
        RangeImage.objects.select_related("scan", "limit_set", "calibration")
        .prefetch_related("measurements", "limit_set__limits")
        .defer("provenance", "surface")
        .in_bulk([region.newest_id for region in regions if region.newest_id])  # type: ignore[attr-defined]
    )
    edge = new_edges([tool.pk]).get(tool.pk)
    inspections = list(
        Inspection.objects.filter(tool=tool)
        .select_related("requested_by")
        .prefetch_related(
            Prefetch("scans", Scan.objects.select_related("region").order_by("region__name", "pk")),
            Prefetch("scans__range_images", RangeImage.objects.defer("provenance", "surface")),
        )[:12]
    )
    live = [scan for visit in inspections for scan in visit.scans.all() if scan.is_live]
    states = []
    for region in regions:
        image = images.get(region.newest_id)  # type: ignore[attr-defined]
        states.append(
            RegionState(
                region=region,
                image=image,
                numbers=key_numbers(numbers(image)) if image else [],
                stale=image is not None and not belongs_to_edge(image, edge),
                live=next((scan for scan in live if scan.region_id == region.pk), None),
            )
        )
    return ToolState(
        tool=tool,
        regions=states,
        edge=edge,
        events=list(tool.events.select_related("by")[:30]),
        inspections=inspections,
        schedules=list(tool.schedules.select_related("rig", "recipe")),
        limit_set=LimitSet.objects.filter(tool_type=tool.tool_type_id).prefetch_related("limits").first(),
        live=live,
    )


def trend_metrics(tool: Tool) -> list[tuple[str, str]]:
    """(metric, label) of everything ever measured on this tool's regions, decisive ones first."""
    found = dict(
        Measurement.objects.filter(range_image__scan__region__tool=tool, value__isnull=False)
        .order_by()
        .values_list("metric", "label")
        .distinct()
    )
    limited = list(
        Limit.objects.filter(limit_set__tool_type=tool.tool_type_id)
        .order_by("-limit_set__version", "metric")
        .values_list("metric", flat=True)
    )
    first = [metric for metric in dict.fromkeys([*limited, *KEY_METRICS]) if metric in found]
    return [(metric, found[metric]) for metric in [*first, *sorted(set(found) - set(first))]]
