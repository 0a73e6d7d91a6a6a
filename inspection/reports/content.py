"""What the report of one visit says, as plain data: everything a reader needs to trust the verdict or to question it.

Numbers become words here, once; the layout (`inspection.typ`) only places them. Nothing later than the visit enters, so
the report of last March reads the same in June.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from typing import Any

from django.conf import settings
from django.utils import timezone

from inspection.models import Calibration, Inspection, Limit, LimitSet, PrecisionReport, RangeImage, Recipe, Scan
from inspection.reports import picture
from inspection.reports.chart import draw_trend
from inspection.reports.figures import plain, with_uncertainty
from inspection.reports.rows import verdict_of_visit
from inspection.reports.stored import load
from inspection.selectors.trend import tool_trends
from inspection.states import ScanState, Verdict
from inspection.units import unit_sign, with_unit_signs
from scanning.errors import BadInput

Json = dict[str, Any]
ACTIONS = {
    Verdict.OK: "Keep in service.",
    Verdict.WATCH: "Keep in service and scan again soon.",
    Verdict.REPLACE: "Take out of service: change or regrind.",
    Verdict.UNKNOWN: "No verdict: do not rely on this scan.",
}
#: Charts in a report; more would bury the one that matters.
MOST_CHARTS = 4
#: Damages listed per region; the number of the rest is stated.
MOST_DAMAGES = 25


def inspection_content(inspection: Inspection) -> tuple[Json, dt.datetime]:
    """Return the report's data, JSON-ready, and the moment its newest record was made (the document's date)."""
    tool = inspection.tool
    scans = list(
        inspection.scans.select_related("region", "rig", "recipe", "calibration").order_by("region__name", "pk")
    )
    results = {scan.pk: _newest(scan) for scan in scans}
    found = [result for result in results.values() if result is not None]
    moments = [result.created_at for result in found] + [scan.finished_at for scan in scans if scan.finished_at]
    as_of = max([*moments, inspection.requested_at])
    verdict = verdict_of_visit([result.verdict if (result := results[scan.pk]) else None for scan in scans])
    limit_sets = _once(result.limit_set for result in found)
    labels = {row.metric: row.label for result in found for row in result.measurements.all()}
    content = {
        "plant": getattr(settings, "PLANT_NAME", ""),
        "inspection": str(inspection.pk),
        "tool": tool.code,
        "verdict": verdict,
        "action": _action(verdict, [result.verdict if (result := results[scan.pk]) else None for scan in scans]),
        "date": _day(inspection.requested_at),
        "facts": [
            ["Tool", tool.code],
            ["Type", tool.tool_type.name],
            ["Place", tool.location or "not stated"],
            ["Use since last renewal", _life(inspection)],
            ["Ordered", f"{_moment(inspection.requested_at)} by {_person(inspection.requested_by)}"],
            ["Reason", inspection.reason or "not stated"],
            ["Rig", ", ".join(sorted({scan.rig.name for scan in scans})) or "none"],
            [
                "Finished",
                _moment(max(ended)) if (ended := [s.finished_at for s in scans if s.finished_at]) else "not yet",
            ],
        ],
        "note": tool.note.strip(),
        "regions": [_region(scan, results[scan.pk]) for scan in scans],
        "charts": _charts(inspection, limit_sets, as_of),
        "limits": [_limits(limit_set, labels) for limit_set in limit_sets],
        "calibrations": [_calibration(calibration, as_of) for calibration in _once(r.calibration for r in found)],
        "uncalibrated": any(result.calibration is None for result in found),
        "recipes": [_recipe(recipe) for recipe in _once(result.recipe for result in found)],
        "hashes": [_hashes(scan, results[scan.pk]) for scan in scans if results[scan.pk]],
        "software": _software(found),
        "as_of": _moment(as_of),
        "font_note": "",
    }
    return content, as_of


def _action(verdict: str, of_regions: Sequence[str | None]) -> str:
    """What to do. Where a region has no verdict, "keep in service" would promise what nobody has seen."""
    if verdict == Verdict.WATCH and any(one in (None, Verdict.UNKNOWN) for one in of_regions):
        return "Scan again now: at least one region has no verdict."
    return ACTIONS[Verdict(verdict)]


def _newest(scan: Scan) -> RangeImage | None:
    if scan.state != ScanState.DONE:
        return None
    return (
        scan.range_images.select_related("limit_set", "calibration__by", "recipe", "precision")
        .prefetch_related("measurements", "damages")
        .first()
    )


def _region(scan: Scan, result: RangeImage | None) -> Json:
    name = scan.region.name
    base: Json = {
        "name": name,
        "scan": str(scan.pk),
        "state": scan.state,
        "verdict": result.verdict if result else Verdict.UNKNOWN,
        "partial": scan.partial,
        "reasons": [with_unit_signs(str(reason)) for reason in result.verdict_reasons]
        if result
        else [_no_result(scan)],
        "measured": result is not None,
        "picture": None,
        "caption": "",
        "numbers": [],
        "damages": [],
        "damages_left_out": 0,
        "precision": [],
        "warnings": [],
    }
    if result is None:
        return base
    damages = list(result.damages.all())
    try:
        drawn = picture.draw(
            load(result), picture.outlines(damages), start_mm=float(scan.plan.get("start_mm") or 0.0), name=name
        )
    except BadInput as fault:
        base["caption"] = f"No picture: {fault}"
    else:
        base |= {"picture": drawn.svg, "width": drawn.width_mm, "alt": drawn.alt, "caption": drawn.caption}
    base["numbers"] = [
        {
            "label": row.label,
            "value": with_uncertainty(row.value, row.u),
            "unit": unit_sign(row.unit) if row.value is not None else "",
            "origin": row.origin,
        }
        for row in result.measurements.all()
    ]
    base["damages"] = [
        [
            str(damage.number),
            damage.severity,
            f"{damage.start_mm:.2f} to {damage.end_mm:.2f}",
            plain(damage.length_mm, 3),
            with_uncertainty(damage.depth_um, damage.u_depth_um),
            with_uncertainty(damage.volume_mm3, damage.u_volume_mm3),
            plain(damage.area_mm2, 3),
            "yes" if damage.touches_edge else "no",
        ]
        for damage in damages[:MOST_DAMAGES]
    ]
    base["damages_left_out"] = max(0, len(damages) - MOST_DAMAGES)
    base["damage_count"] = len(damages)
    base["precision"] = _precision(result)
    base["warnings"] = [str(warning) for warning in result.surface.get("warnings", [])]
    return base


def _no_result(scan: Scan) -> str:
    if scan.fault:
        return f"Not measured, the scan is {scan.state}: {scan.fault}"
    return f"Not measured: the scan is {scan.state}."


def _precision(result: RangeImage) -> list[list[str]]:
    precision = getattr(result, "precision", None)
    if precision is None:
        return [["Precision report", "none stored"]]
    cell = f"{precision.cell_row_um:.2f} × {precision.cell_scan_um:.2f} µm"
    sigma = "not measured" if precision.sigma_um is None else f"{precision.sigma_um:.2f} µm in a cell of {cell}"
    pitches = f"{result.row_pitch_um:.3f} × {result.profile_pitch_um:.2f} µm"
    return [
        ["Undefined", f"{100 * precision.undefined_share:.2f} % ({precision.undefined_count})"],
        ["Saturated", f"{100 * precision.saturated_share:.4f} % ({precision.saturated_count})"],
        ["Noise σ, flat part", sigma],
        ["Range image", f"{result.rows} × {result.profiles}, {pitches}"],
        *_trusted(precision),
        [
            "Processing",
            "not timed"
            if precision.ns_per_range_pixel is None
            else f"{precision.ns_per_range_pixel:.0f} ns per range pixel",
        ],
    ]


def _trusted(precision: PrecisionReport) -> list[list[str]]:
    """What is known of how sure the points are and how far the gauge reaches: nothing, in older results."""
    rows = []
    if (share := precision.confident_share) is not None:
        rows.append([f"Confidence above {precision.confident_above}", f"{100 * share:.1f} % of measured points"])
    if (share := precision.outside_calibrated_share) is not None:
        rows.append(["Outside the calibrated range", f"{100 * share:.2f} % of heights"])
    return rows


def _charts(inspection: Inspection, limit_sets: Sequence[LimitSet], as_of: dt.datetime) -> list[Json]:
    """One chart for each limited metric, all regions of the tool together, with what is to be expected."""
    codes = [limit.metric for limit_set in limit_sets[:1] for limit in limit_set.limits.all()][:MOST_CHARTS]
    in_force = limit_sets[0] if limit_sets else None
    trends = tool_trends(inspection.tool, codes, until=as_of, now=as_of, limit_set=in_force) if codes else []
    charts = []
    for code in codes:
        mine = [trend for trend in trends if trend["metric"]["code"] == code]
        if not mine or (svg := draw_trend(mine)) is None:
            continue
        metric = next((trend["metric"] for trend in mine if trend["points"]), mine[0]["metric"])
        scans = sum(len(trend["points"]) for trend in mine)
        charts.append(
            {
                "title": metric["label"],
                "svg": svg,
                "alt": f"{metric['label']} of {inspection.tool.code} over time, {scans} scans.",
                "sentences": [[trend["region"]["name"], trend["sentence"]] for trend in mine if trend["points"]],
            }
        )
    return charts


def _limits(limit_set: LimitSet, labels: dict[str, str]) -> Json:
    return {
        "title": f"{limit_set.tool_type}, version {limit_set.version}, in force since {_day(limit_set.created_at)}",
        "reason": limit_set.reason,
        "rows": [_limit(limit, labels) for limit in limit_set.limits.all()],
    }


def _limit(limit: Limit, labels: dict[str, str]) -> list[str]:
    bounds = [plain(bound) if bound is not None else "none" for bound in (limit.watch_above, limit.replace_above)]
    label = labels.get(limit.metric)
    name = f"{label} ({limit.metric})" if label and label != limit.metric else limit.metric
    return [name, *bounds, unit_sign(limit.unit)]


def _calibration(calibration: Calibration, as_of: dt.datetime) -> list[list[str]]:
    expired = calibration.expired(timezone.localdate(as_of))
    slope, u_slope = calibration.slope_mm_per_px, calibration.u_slope_mm_per_px
    spread = (
        f"standard deviation {calibration.residual_sd_um:.1f} µm, leave-one-out {calibration.leave_one_out_um:.1f} µm"
    )
    return [
        ["Rig", calibration.rig.name],
        ["Done", f"{_date(calibration.done_on)} by {_person(calibration.by)}"],
        ["Valid until", _date(calibration.valid_until) + (" (EXPIRED when this was judged)" if expired else "")],
        ["Artefact", calibration.artefact],
        ["Slope", f"{slope:.7f} mm/px, standard uncertainty {u_slope:.7f} mm/px ({100 * u_slope / abs(slope):.2f} %)"],
        ["Residuals", f"largest {calibration.max_residual_um:.1f} µm, {spread}"],
        ["Range", f"{calibration.low_mm:g} to {calibration.high_mm:g} mm"],
    ]  # fmt: skip


def _recipe(recipe: Recipe) -> Json:
    return {"name": recipe.name, "rows": _flat(recipe.definition), "sha256": recipe.sha256}


def _flat(value: Any, prefix: str = "") -> list[list[str]]:
    """A nested definition as (path, value) rows."""
    if isinstance(value, dict):
        return [row for key, inner in value.items() for row in _flat(inner, f"{prefix}{key} ")]
    if isinstance(value, list) and any(isinstance(inner, dict | list) for inner in value):
        return [row for i, inner in enumerate(value, 1) for row in _flat(*_step(i, inner))]
    shown = ", ".join(str(inner) for inner in value) if isinstance(value, list) else str(value)
    return [[prefix.strip(), "not set" if value is None else shown]]


def _step(i: int, inner: Any) -> tuple[Any, str]:
    """A step of a recipe with its number and name as the path: ``3 sci``."""
    if isinstance(inner, dict) and "operation" in inner:
        rest = {key: value for key, value in inner.items() if key != "operation"}
        return rest or "no parameters", f"{i} {inner['operation']} "
    return inner, f"{i} "


def _hashes(scan: Scan, result: RangeImage | None) -> list[str]:
    return [scan.region.name, scan.stack_sha256 or "none recorded", result.sha256 if result else ""]


def _software(found: Sequence[RangeImage]) -> list[list[str]]:
    versions: dict[str, str] = {}
    for result in found:
        software = result.provenance.get("versions") or {}
        versions |= {str(name): str(version) for name, version in software.items()}
    return [[name, version] for name, version in versions.items()]


def _once(rows: Any) -> list[Any]:
    return list({row.pk: row for row in rows if row is not None}.values())


def _life(inspection: Inspection) -> str:
    if inspection.life_used is None:
        return "not recorded"
    return f"{plain(inspection.life_used)} {inspection.tool.tool_type.life_unit}"


def _person(user: Any) -> str:
    return "the schedule" if user is None else (user.get_full_name() or user.get_username())


def _moment(at: dt.datetime) -> str:
    local = timezone.localtime(at)
    return f"{_date(local.date())} {local:%H:%M %Z}"


def _day(at: dt.datetime) -> str:
    return _date(timezone.localdate(at))


def _date(day: dt.date) -> str:
    return f"{day.day} {day:%B %Y}"
