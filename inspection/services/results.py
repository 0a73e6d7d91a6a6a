"""Stores what was computed from a scan: the range image, its numbers, and the verdict. All of it, or nothing.

The file is complete under its final name before any row is written, and the scan's state changes last, inside the same
transaction. A process killed anywhere in between leaves the scan as it was, to be computed again; two that compute the
same scan end with one result.
"""

from __future__ import annotations

import datetime as dt
import hashlib
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from django.conf import settings
from django.db import transaction
from django.utils import timezone

import scanning.range_image
import scanning.surface
from inspection.models import (
    Calibration,
    Damage,
    Event,
    Inspection,
    Measurement,
    PrecisionReport,
    RangeImage,
    Recipe,
    Recomputation,
    Region,
    Scan,
)
from inspection.services.audit import audit
from inspection.services.moves import move
from inspection.services.schedules import note_inspection_done
from inspection.services.verdict import Judgement, Value, judge
from inspection.states import ScanState, Verdict

if TYPE_CHECKING:
    import scanning.precision


def record_result(
    scan: Scan,
    image: scanning.range_image.RangeImage,
    report: scanning.surface.SurfaceReport | None,
    precision: scanning.precision.PrecisionReport,
    *,
    recipe: Recipe | None = None,
    baseline: RangeImage | None = None,
    doubts: Sequence[str] = (),
    recomputation: Recomputation | None = None,
    at: dt.datetime | None = None,
) -> RangeImage | None:
    """Store a scan's result and move it to done; None if somebody else had already stored one.

    ``report`` is None when the surface could not be measured; ``doubts`` then says why, and the verdict is unknown.
    With ``recomputation`` the result is added beside the earlier ones and the scan's state stays. ``at`` is when it was
    measured, for results of another day; default now.
    """
    recipe = recipe or scan.recipe
    now = at or timezone.now()
    place, sha256 = _write_file(scan, image, now)
    try:
        with transaction.atomic():
            # Two regions of one visit that finish at the same moment take turns, so that the later sees the earlier.
            Inspection.objects.select_for_update().get(pk=scan.inspection_id)
            row = _add_rows(scan, image, report, precision, recipe, baseline, doubts, place, sha256, now)
            if recomputation is not None:
                stored = (
                    Recomputation.objects.filter(pk=recomputation.pk, state=Recomputation.State.RUNNING).update(
                        state=Recomputation.State.DONE, finished_at=now, range_image=row, fault=""
                    )
                    == 1
                )
            else:
                stored = move(
                    scan.pk,
                    frm=ScanState.PROCESSING,
                    to=ScanState.DONE,
                    finished_at=now,
                    phase="",
                    message="",
                    lease_token=None,
                    lease_until=None,
                )
            if not stored:
                raise _AlreadyStoredError
            audit(None, "scan.measured", scan, after={"range_image": row.pk, "verdict": row.verdict})
            if recomputation is None and scan.source == Scan.Source.RIG:
                note_inspection_done(scan.inspection, timezone.localdate(now))
    except BaseException as error:
        (settings.RANGES / place).unlink(missing_ok=True)
        if isinstance(error, _AlreadyStoredError):
            return None
        raise
    scan.refresh_from_db()
    return row


class _AlreadyStoredError(Exception):
    """Another process stored this result first; ours is rolled back."""


def _write_file(scan: Scan, image: scanning.range_image.RangeImage, now: dt.datetime) -> tuple[str, str]:
    place = f"{now:%Y/%m}/scan-{scan.pk}-{uuid4().hex[:12]}.npz"
    target = settings.RANGES / place
    save_range_image(image, target)
    return place, hashlib.sha256(target.read_bytes()).hexdigest()


def pending_range_file(scan_id: int) -> Path:
    """Where the rig worker leaves the range image it has ready when the last frame is in."""
    return Path(settings.RANGES) / "pending" / f"scan-{scan_id}.npz"


def save_range_image(image: scanning.range_image.RangeImage, target: Path) -> None:
    """Write the npz whole, and force it to the disk before any row may name it."""
    image.save(target)
    with target.open("rb") as written:
        os.fsync(written.fileno())


def _add_rows(
    scan: Scan,
    image: scanning.range_image.RangeImage,
    report: scanning.surface.SurfaceReport | None,
    precision: scanning.precision.PrecisionReport,
    recipe: Recipe,
    baseline: RangeImage | None,
    doubts: Sequence[str],
    place: str,
    sha256: str,
    now: dt.datetime,
) -> RangeImage:
    measured = measurements(report)
    judgement = _judge(scan, image, measured, scan.calibration, doubts)
    rows, profiles = image.height_um.shape
    row = RangeImage.objects.create(
        scan=scan,
        recipe=recipe,
        calibration=scan.calibration,
        limit_set=scan.limit_set,
        baseline=baseline,
        created_at=now,
        file=place,
        sha256=sha256,
        rows=rows,
        profiles=profiles,
        row_pitch_um=image.row_pitch_um,
        profile_pitch_um=image.profile_pitch_um,
        provenance={**image.provenance, "stack_sha256": scan.stack_sha256},
        surface=_surface(report, doubts),
        verdict=judgement.verdict,
        verdict_reasons=judgement.reasons,
    )
    Measurement.objects.bulk_create(
        Measurement(
            range_image=row,
            metric=code,
            label=one.label,
            value=_finite(one.value),
            unit=one.unit,
            u=_finite(one.u),
            origin=one.source[:300],
        )
        for code, one in measured.items()
    )
    if report is not None:
        _add_damages(row, report)
    _add_precision(row, precision)
    return row


def measurements(report: scanning.surface.SurfaceReport | None) -> dict[str, scanning.surface.Measurement]:
    """The region's numbers by code. A region without damage has a longest damage of 0 mm: that was measured too."""
    if report is None:
        return {}
    found = {one.code: one for one in report.measurements if one.scope == "region"}
    if not report.damages and "L_max" not in found:
        found["L_max"] = scanning.surface.Measurement(
            "L_max", "Longest damage along the edge", 0.0, "mm", None, "No damage was found."
        )
    return found


def _judge(
    scan: Scan,
    image: scanning.range_image.RangeImage,
    measured: dict[str, scanning.surface.Measurement],
    calibration: Calibration | None,
    doubts: Sequence[str],
) -> Judgement:
    values = {code: Value(one.value, one.u, one.unit, one.label) for code, one in measured.items()}
    # Beyond the edge nothing can return light; only what is missing on the tool's side of it counts.
    on_tool = measured.get("q_undef_bevel")
    share = on_tool.value / 100.0 if on_tool is not None and on_tool.value is not None else image.undefined_share
    taken = scan.started_at or scan.queued_at
    judgement = judge(
        values,
        undefined_share=share,
        limit_set=scan.limit_set,
        calibration=calibration,
        on=timezone.localdate(taken),
        partial=scan.partial,
        doubts=doubts,
    )
    if scan.state in (ScanState.CANCELLED, ScanState.INTERRUPTED, ScanState.FAILED):
        reason = f"The scan was {scan.state}; its frames were computed, but it gets no verdict."
        return Judgement(Verdict.UNKNOWN, [reason, *judgement.reasons])
    return judgement


def _surface(report: scanning.surface.SurfaceReport | None, doubts: Sequence[str]) -> dict[str, Any]:
    if report is None:
        return {"warnings": list(doubts)}
    surface = report.to_json()
    # They have rows of their own.
    del surface["measurements"], surface["damages"]
    surface["warnings"] = [*doubts, *surface.get("warnings", [])]
    return surface


def _add_damages(row: RangeImage, report: scanning.surface.SurfaceReport) -> None:
    details = {one["number"]: one for one in report.to_json()["damages"]}
    Damage.objects.bulk_create(
        Damage(
            range_image=row,
            number=one.number,
            severity=one.severity,
            volume_mm3=one.volume_mm3,
            u_volume_mm3=_finite(one.u_volume_mm3),
            depth_um=one.depth_um,
            u_depth_um=_finite(one.u_depth_um),
            area_mm2=one.area_mm2,
            length_mm=one.length_mm,
            start_mm=one.s_start_mm,
            end_mm=one.s_end_mm,
            touches_edge=one.touches_edge,
            detail=details[one.number],
        )
        for one in report.damages
    )


def _add_precision(row: RangeImage, precision: scanning.precision.PrecisionReport) -> None:
    cell_scan_um, cell_row_um = precision.lateral_cell_um
    PrecisionReport.objects.create(
        range_image=row,
        undefined_count=precision.undefined,
        undefined_share=precision.undefined_share,
        saturated_count=precision.saturated,
        saturated_share=precision.saturated_share,
        sigma_um=_finite(precision.sigma_um),
        cell_scan_um=cell_scan_um,
        cell_row_um=cell_row_um,
        ns_per_range_pixel=_finite(precision.ns_per_range_pixel),
        cpu_ns_per_range_pixel=_finite(precision.cpu_ns_per_range_pixel),
        detail=precision.to_json(),
    )


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def baseline_for(scan: Scan, image: scanning.range_image.RangeImage) -> RangeImage | None:
    """The scan that today's heights are held against: the first "ok" one since the edge was last made new.

    Only a scan found ok will do: a damaged first scan as reference would hide its damage from every later one. None
    until there is one of the same size and pitch; the surface is then measured against its own plane.
    """
    region: Region = scan.region
    taken = scan.started_at or scan.queued_at
    made_new = (
        Event.objects.filter(
            tool_id=region.tool_id, kind__in=[*Event.SEGMENT_ENDS, Event.Kind.INSTALLED], at__lte=taken
        )
        .order_by("-at")
        .first()
    )
    earlier = RangeImage.objects.filter(
        scan__region=region,
        scan__source=scan.source,
        scan__state=ScanState.DONE,
        scan__partial=False,
        scan__started_at__lt=taken,
        verdict=Verdict.OK,
        rows=image.height_um.shape[0],
        profiles=image.height_um.shape[1],
    ).exclude(scan=scan)
    if made_new is not None:
        earlier = earlier.filter(scan__started_at__gte=made_new.at)
    for one in earlier.order_by("scan__started_at", "created_at")[:1]:
        same = math.isclose(one.row_pitch_um, image.row_pitch_um, rel_tol=1e-6) and math.isclose(
            one.profile_pitch_um, image.profile_pitch_um, rel_tol=1e-6
        )
        return one if same else None
    return None
