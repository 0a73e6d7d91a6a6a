"""A tool's history of one metric, ready for a chart, the report and the API.

Everything comes in a fixed number of queries whatever the length of the history: a page that asks the database once
per scan is quick in the demo and dead after a year in the plant.
"""

from __future__ import annotations

import datetime as dt
from collections import defaultdict
from collections.abc import Iterable, Sequence
from math import isfinite
from typing import Any

from django.db.models import F, OuterRef, Subquery
from django.db.models.functions import Coalesce
from django.urls import reverse
from django.utils import timezone

from inspection.models import Event, Limit, LimitSet, Measurement, RangeImage, Region, Tool
from inspection.states import ScanState
from inspection.trends.forecast import Reading, SegmentFit, fit_segment, forecast_sentence, segment_of
from inspection.units import unit_sign

#: Points of the drawn line and its band.
LINE_POINTS = 24

Json = dict[str, Any]


def trend_metrics(tool: Tool) -> list[Json]:
    """Return the metrics this tool has been measured by: ``[{"code", "label", "unit"}, ...]`` in order of first use."""
    rows = (
        Measurement.objects.filter(range_image__scan__inspection__tool=tool, range_image__scan__state=ScanState.DONE)
        .order_by("-range_image_id", "pk")
        .values("metric", "label", "unit")[:200]
    )
    seen: dict[str, Json] = {}
    for row in rows:
        seen.setdefault(row["metric"], {"code": row["metric"], "label": row["label"], "unit": row["unit"]})
    return list(seen.values())


def trend(region: Region, metric: str, *, until: dt.datetime | None = None, now: dt.datetime | None = None) -> Json:
    """Return one region's history of one metric; see `tool_trends` for the shape."""
    return _trends(region.tool, [region], [metric], until, now)[0]


def tool_trends(
    tool: Tool,
    metrics: Sequence[str],
    *,
    until: dt.datetime | None = None,
    now: dt.datetime | None = None,
    limit_set: LimitSet | None = None,
) -> list[Json]:
    """Return the history of every active region by every metric, in that order, as JSON-ready dicts without NaN.

    Each holds ``region``, ``metric`` {code, label, unit}, ``life_unit``, ``points`` [{t, life, value, u, verdict, scan,
    url, segment, used, note}], ``events`` [{t, kind, label, note, life_used, removed_mm, ends_segment}], ``limits``
    {watch, replace, unit, version} or None, ``fit`` of the present segment {axis, unit, rate, u_rate, n,
    low_confidence, line: [{t, life, value, low, high}]} or None, ``segments`` [{first, last, n, rate, u_rate}],
    ``forecast`` {limit_name, limit, at, earliest, latest, at_date, earliest_date, latest_date, remaining} or None, and
    ``sentence``. ``until`` leaves out everything later and ``limit_set`` replaces the
    limits now in force: a report shows what was known and what counted then.
    """
    regions = [region for region in tool.regions.all() if region.active]
    return _trends(tool, regions, list(metrics), until, now, limit_set)


def _trends(
    tool: Tool,
    regions: Sequence[Region],
    metrics: Sequence[str],
    until: dt.datetime | None,
    now: dt.datetime | None,
    limit_set: LimitSet | None = None,
) -> list[Json]:
    now = now or timezone.now()
    newest = RangeImage.objects.filter(scan=OuterRef("range_image__scan")).order_by("-created_at", "-pk").values("pk")
    rows = (
        Measurement.objects.filter(
            range_image__scan__region__in=regions,
            range_image__scan__state=ScanState.DONE,
            metric__in=metrics,
            range_image=Subquery(newest[:1]),
        )
        .annotate(
            at=Coalesce("range_image__scan__finished_at", "range_image__scan__queued_at"),
            region=F("range_image__scan__region"),
            scan=F("range_image__scan"),
            partial=F("range_image__scan__partial"),
            life=F("range_image__scan__inspection__life_used"),
            verdict=F("range_image__verdict"),
        )
        .order_by("at", "scan")
        .values("region", "metric", "label", "unit", "value", "u", "at", "scan", "partial", "life", "verdict")
    )
    events = Event.objects.filter(tool=tool).order_by("at", "pk")
    if until is not None:
        rows, events = rows.filter(at__lte=until), events.filter(at__lte=until)
    by_series: dict[tuple[int, str], list[Json]] = defaultdict(list)
    for row in rows:
        by_series[row["region"], row["metric"]].append(row)
    happened = list(events)
    life_now = tool.life_used if until is None else 0.0  # what the tool did since is not known then
    limits = _limits(tool, metrics, limit_set)
    return [
        _one(tool, region, metric, by_series[region.pk, metric], happened, limits.get(metric), now, life_now)
        for region in regions
        for metric in metrics
    ]


def _limits(tool: Tool, metrics: Iterable[str], limit_set: LimitSet | None) -> dict[str, Limit]:
    newest = LimitSet.objects.filter(tool_type=tool.tool_type_id).order_by("-version").values("pk")[:1]
    wanted = Subquery(newest) if limit_set is None else limit_set.pk
    found = Limit.objects.filter(limit_set=wanted, metric__in=metrics).select_related("limit_set")
    return {limit.metric: limit for limit in found}


def _one(
    tool: Tool,
    region: Region,
    metric: str,
    rows: list[Json],
    events: Sequence[Event],
    limit: Limit | None,
    now: dt.datetime,
    life_now: float,
) -> Json:
    ends = [event.at for event in events if event.kind in Event.SEGMENT_ENDS]
    numbers = segment_of([row["at"] for row in rows], ends)
    label = rows[-1]["label"] if rows else metric
    unit = rows[-1]["unit"] if rows else (limit.unit if limit else "")
    life_unit = tool.tool_type.life_unit
    address = reverse("scan", args=[0])
    points: list[Json] = []
    readings: dict[int, list[Reading]] = defaultdict(list)
    for row, segment in zip(rows, numbers, strict=True):
        value = row["value"] if row["value"] is not None and isfinite(row["value"]) else None
        note = "not measured" if value is None else "finished early, not used for the trend" if row["partial"] else ""
        if value is not None and not row["partial"]:
            readings[segment].append(Reading(row["at"], row["life"], value, row["u"]))
        points.append(
            {
                "t": row["at"].isoformat(),
                "life": row["life"],
                "value": value,
                "u": row["u"],
                "verdict": row["verdict"],
                "scan": row["scan"],
                "url": address.replace("/0/", f"/{row['scan']}/"),
                "segment": segment,
                "used": not note,
                "note": note,
            }
        )
    fits = {segment: fit_segment(found) for segment, found in readings.items()}
    present = len(ends)
    fit = fits.get(present)
    limits = None
    if limit is not None:
        limits = {
            "watch": limit.watch_above,
            "replace": limit.replace_above,
            "unit": limit.unit,
            "version": limit.limit_set.version,
        }
    forecast, sentence = _forecast(tool, label, unit, limit, fit, readings[present], now, life_now)
    return {
        "tool": {"id": tool.pk, "code": tool.code},
        "region": {"id": region.pk, "name": region.name},
        "metric": {"code": metric, "label": label, "unit": unit},
        "life_unit": life_unit,
        "points": points,
        "events": [
            {
                "t": event.at.isoformat(),
                "kind": event.kind,
                "label": event.get_kind_display(),
                "note": event.note,
                "life_used": event.life_used,
                "removed_mm": event.removed_mm,
                "ends_segment": event.kind in Event.SEGMENT_ENDS,
            }
            for event in events
        ],
        "limits": limits,
        "fit": _fit_json(fit, unit, life_unit, forecast) if fit else None,
        "segments": [
            {
                "first": found[0].at.isoformat(),
                "last": found[-1].at.isoformat(),
                "n": len(found),
                "rate": segment_fit.wear.rate if (segment_fit := fits[segment]) else None,
                "u_rate": segment_fit.wear.u_rate if segment_fit else None,
                "axis": segment_fit.axis if segment_fit else None,
            }
            for segment, found in sorted(readings.items())
            if found
        ],
        "forecast": forecast,
        "sentence": sentence,
    }


def _forecast(
    tool: Tool,
    label: str,
    unit: str,
    limit: Limit | None,
    fit: SegmentFit | None,
    readings: Sequence[Reading],
    now: dt.datetime,
    life_now: float,
) -> tuple[Json | None, str]:
    bounds = [("replace", limit.replace_above), ("watch", limit.watch_above)] if limit else []
    name, bound = next(((name, bound) for name, bound in bounds if bound is not None), ("", None))
    if limit is None or bound is None:
        return None, f"No limit is set for {label}, so there is nothing to forecast."
    if unit != limit.unit:
        units = f"is in {unit_sign(limit.unit)} but it is measured in {unit_sign(unit)}"
        return None, f"The limit of {label} {units}, so they are not compared."
    place: float | None = None
    if fit is not None:
        place = fit.position(now) if fit.axis == "date" else max(life_now, fit.wear.last_life)
    sentence, times = forecast_sentence(
        label=label,
        unit=unit,
        limit_name=name,
        limit=bound,
        fit=fit,
        readings=len(readings),
        latest_value=readings[-1].value if readings else None,
        now=place,
        life_unit=tool.tool_type.life_unit,
    )
    if times is None or fit is None:
        return None, sentence

    def date(position: float | None) -> str | None:
        moment = fit.date_of(position) if position is not None else None
        return moment.date().isoformat() if moment else None

    return {
        "limit_name": name,
        "limit": bound,
        "axis": fit.axis,
        "at": times.at,
        "earliest": times.earliest,
        "latest": times.latest,
        "at_date": date(times.at),
        "earliest_date": date(times.earliest),
        "latest_date": date(times.latest),
        "remaining": max(0.0, times.at - place) if times.at is not None and place is not None else None,
    }, sentence


def _fit_json(fit: SegmentFit, unit: str, life_unit: str, forecast: Json | None) -> Json:
    """The line and its band from the first scan to the limit, but never further than twice the time observed."""
    wear = fit.wear
    span = wear.last_life - wear.first_life
    reach = [wear.last_life + 0.25 * span]
    if forecast:
        reach += [value for value in (forecast["at"], forecast["latest"]) if value is not None]
    end = min(max(reach), wear.last_life + span)
    line = []
    for i in range(LINE_POINTS + 1):
        x = wear.first_life + (end - wear.first_life) * i / LINE_POINTS
        value, half = float(wear.value(x)), float(wear.half_width(x))
        moment = fit.date_of(x)
        line.append(
            {
                "t": moment.isoformat() if moment else None,
                "life": x if fit.axis == "life" else None,
                "value": value,
                "low": value - half if isfinite(half) else None,
                "high": value + half if isfinite(half) else None,
            }
        )
    return {
        "axis": fit.axis,
        "unit": f"{unit}/{life_unit if fit.axis == 'life' else 'day'}",
        "rate": wear.rate,
        "u_rate": wear.u_rate,
        "s": wear.s,
        "n": wear.n,
        "low_confidence": wear.low_confidence,
        "line": line,
    }
