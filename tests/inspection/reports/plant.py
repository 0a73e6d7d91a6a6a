"""A small plant with a history: one knife, scanned weekly, reground once, its last visit with range images on disk."""

from __future__ import annotations

import datetime as dt
import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from django.conf import settings

from inspection.models import (
    Calibration,
    Damage,
    Event,
    Inspection,
    Limit,
    LimitSet,
    Measurement,
    PrecisionReport,
    RangeImage,
    Recipe,
    Region,
    Rig,
    Role,
    Scan,
    Tool,
    ToolType,
    User,
)  # fmt: skip
from inspection.states import ScanState, Verdict

UTC = dt.UTC
FIRST_VISIT = dt.datetime(2026, 6, 1, 6, 30, tzinfo=UTC)
METRICS = [
    ("ER_max", "Greatest edge recession", "um"),
    ("V-", "Missing volume", "mm3"),
    ("d_max", "Greatest depth", "um"),
]


def person(name: str, role: str = Role.VIEWER) -> User:
    user, _ = User.objects.get_or_create(username=name, defaults={"role": role, "first_name": name.capitalize()})
    return user


def knife(code: str = "K-114", note: str = "") -> Tool:
    """A knife of 90 mm edge with R1-R3, limits, and a calibrated rig."""
    tool_type, made = ToolType.objects.get_or_create(
        name="Chipping knife", defaults={"edge_length_mm": 90.0, "life_unit": "h"}
    )
    if made:
        limits = LimitSet.objects.create(tool_type=tool_type, version=1, reason="First limits", by=person("erik"))
        for metric, watch, replace, unit in [
            ("ER_max", 300.0, 450.0, "um"),
            ("V-", 0.02, 0.05, "mm3"),
            ("d_max", 100.0, 150.0, "um"),
        ]:
            Limit.objects.create(limit_set=limits, metric=metric, watch_above=watch, replace_above=replace, unit=unit)
    tool = Tool.objects.create(code=code, tool_type=tool_type, location="Chipper 2, pocket 5", note=note, life_used=48)
    for i, name in enumerate(["R1", "R2", "R3"]):
        Region.objects.create(tool=tool, name=name, start_mm=10.0 + 25 * i, length_mm=10.0)
    return tool


def rig() -> Rig:
    found, made = Rig.objects.get_or_create(slug="rig-1", defaults={"name": "Rig 1", "exposures_us": [100, 300, 900]})
    if made:
        Calibration.objects.create(
            rig=found,
            done_on=dt.date(2026, 5, 4),
            valid_until=dt.date(2027, 5, 4),
            by=person("erik"),
            artefact="Step gauge SG-7, certificate 4711",
            pairs=[[0.14, 9.5], [0.36, 25.0], [0.745, 52.2]],
            fit={},
            slope_mm_per_px=0.014237376,
            intercept_mm=0.002659733,
            u_slope_mm_per_px=0.0002251273,
            max_residual_um=11.66551,
            residual_sd_um=8.322041,
            leave_one_out_um=14.0,
            low_mm=0.14,
            high_mm=0.745,
        )
    return found


def recipe() -> Recipe:
    definition = {
        "name": "HDRE-I",
        "operations": [{"operation": "sci", "mode": "sliding", "images": 5}, {"operation": "hdre"}],
    }
    found, _ = Recipe.objects.get_or_create(
        sha256=hashlib.sha256(b"HDRE-I").hexdigest(), defaults={"name": "HDRE-I", "definition": definition}
    )
    return found


def surface(shape: tuple[int, int], chips: list[tuple[float, float, float, float]], seed: int = 7) -> np.ndarray:
    """A tilted, noisy bevel in um with Gaussian chips (row, profile, radius, depth_um), a lost strip, holes."""
    rng = np.random.default_rng(seed)
    rows, profiles = np.mgrid[0 : shape[0], 0 : shape[1]]
    height = 900 + 0.35 * rows - 0.05 * profiles + rng.normal(0, 4.2, shape)
    for row, profile, radius, depth in chips:
        height -= depth * np.exp(-((rows - row) ** 2 + ((profiles - profile) * 1.16) ** 2) / (2 * radius**2))
    edge = shape[0] * 0.94 + 6 * np.sin(profiles[0] / 17.0)
    height[rows > edge] = np.nan
    height[rng.random(shape) < 0.004] = np.nan
    return height.astype(np.float32)


def visit(
    tool: Tool,
    number: int,
    *,
    at: dt.datetime | None = None,
    life: float | None = None,
    by: User | None = None,
    reason: str = "Weekly check",
    states: dict[str, str] | None = None,
    values: dict[str, float] | None = None,
    images: bool = False,
    shape: tuple[int, int] = (1000, 241),
    recession: float = 0.0,
) -> Inspection:
    """One visit with a scan per region. ``states`` overrides the state of a region, ``images`` writes range images."""
    at = at or FIRST_VISIT + dt.timedelta(days=7 * number)
    by = by or person("olga", Role.OPERATOR)
    inspection = Inspection.objects.create(
        tool=tool, requested_by=by, requested_at=at, reason=reason, life_used=life if life is not None else 8.0 * number
    )
    calibration, order = rig().calibration_now(), recipe()
    limits = tool.tool_type.limit_sets.first()
    for i, region in enumerate(tool.regions.all()):
        state = (states or {}).get(region.name, ScanState.DONE)
        done = state == ScanState.DONE
        scan = Scan.objects.create(
            inspection=inspection,
            region=region,
            rig=rig(),
            state=state,
            requested_by=by,
            queued_at=at,
            started_at=at + dt.timedelta(minutes=3 * i),
            finished_at=at + dt.timedelta(minutes=3 * i + 2) if state not in ("queued", "running") else None,
            recipe=order,
            calibration=calibration,
            limit_set=limits,
            fault="The camera sent no frame within 2 s at step 17; check its cable and scan again."
            if state == ScanState.FAILED
            else "",
            stack_sha256=hashlib.sha256(f"{inspection.pk}{region.name}".encode()).hexdigest(),
            plan={"start_mm": region.start_mm, "steps": shape[1], "exposures_us": [100, 300, 900]},
        )
        if done:
            result(scan, i, recession, values or {}, images, shape, limits)
    return inspection


def result(
    scan: Scan,
    i: int,
    recession: float,
    values: dict[str, float],
    images: bool,
    shape: tuple[int, int],
    limits: LimitSet,
    later: dt.timedelta = dt.timedelta(0),
    precision: dict[str, Any] | None = None,
) -> RangeImage:
    verdict, reasons = [
        (Verdict.OK, ["All metrics are below their limits."]),
        (Verdict.WATCH, ["Missing volume 0.031 mm³ is above the watch limit of 0.02 mm³."]),
        (Verdict.REPLACE, ["Greatest depth 214 µm is above the replace limit of 150 µm.",
                           "Missing volume 0.142 mm³ is above the replace limit of 0.05 mm³."]),
    ][i]  # fmt: skip
    chips: list[tuple[float, float, float, float]] = [
        [],
        [(880, 60, 16, 92), (610, 150, 13, 71), (300, 200, 7, 38)],
        [(900, 120, 44, 214)],
    ][i]
    name, sha = f"none-{scan.pk}.npz", hashlib.sha256(str(scan.pk).encode()).hexdigest()
    if images:
        name = f"test-{scan.pk}-{later.total_seconds():.0f}.npz"
        path = Path(settings.RANGES) / name
        path.parent.mkdir(parents=True, exist_ok=True)
        scale = shape[0] / 1000
        chips_here = [(r * scale, p * shape[1] / 241, s * scale, d) for r, p, s, d in chips]
        height = surface(shape, chips_here, seed=i)
        np.savez(
            path,
            column_px=(height / 14.3).astype(np.float32),
            height_um=height,
            row_pitch_um=7.150838,
            profile_pitch_um=41.65,
            intensity=np.full(shape, 180, np.float32),
            width_px=np.full(shape, 3.0, np.float32),
        )
        sha = hashlib.sha256(path.read_bytes()).hexdigest()
    image = RangeImage.objects.create(
        scan=scan,
        recipe=scan.recipe,
        calibration=scan.calibration,
        limit_set=limits,
        created_at=scan.finished_at + dt.timedelta(seconds=5) + later,
        file=name,
        sha256=sha,
        rows=shape[0],
        profiles=shape[1],
        row_pitch_um=7.150838,
        profile_pitch_um=41.65,
        provenance={"versions": {"edgewatch": "0.1.0", "numpy": "2.4.1"}, "recipe": scan.recipe.definition},
        surface={"warnings": []},
        verdict=verdict,
        verdict_reasons=reasons,
    )
    measured: dict[str, Any] = {
        "ER_max": (recession + 4.0 * i, 3.1),
        "V-": ([0.0008, 0.031, 0.142][i], [0.0009, 0.0016, 0.0041][i]),
        "d_max": ([9.0, 92.0, 214.0][i], [2.4, 3.2, 4.4][i]),
    }
    for metric, label, unit in METRICS:
        value, u = measured[metric]
        Measurement.objects.create(
            range_image=image, metric=metric, label=label, value=values.get(metric, value), unit=unit, u=u,
            origin="signed sum of the residual inside the dilated mask" if metric == "V-" else "robust plane",
        )  # fmt: skip
    Measurement.objects.create(
        range_image=image, metric="Sq_c", label="Sq without noise", value=None, unit="um", u=None,
        origin="not resolvable: Sq is below 1.5 times the noise",
    )  # fmt: skip
    for number, (row, profile, radius, depth) in enumerate(chips, 1):
        start = 10 + 25 * i + profile * 0.04165 - radius * 0.0085
        Damage.objects.create(
            range_image=image, number=number,
            severity="large" if depth > 150 else "medium" if depth > 50 else "minor",
            volume_mm3=depth * radius**2 * 4.4e-7, u_volume_mm3=0.0012, depth_um=depth, u_depth_um=3.4,
            area_mm2=radius**2 * 2.4e-4, length_mm=radius * 0.017, start_mm=start, end_mm=start + radius * 0.017,
            touches_edge=row > 850, detail={"rows": [row - 2 * radius, row + 2 * radius],
                    "profiles": [profile - 1.7 * radius, profile + 1.7 * radius]},
        )  # fmt: skip
    PrecisionReport.objects.create(
        range_image=image, undefined_count=15300, undefined_share=0.0635, saturated_count=120, saturated_share=2.1e-6,
        sigma_um=4.21, cell_scan_um=41.65, cell_row_um=7.15, ns_per_range_pixel=812.0, cpu_ns_per_range_pixel=1490.0,
        detail=precision or {},
    )  # fmt: skip
    return image


def history(tool: Tool, visits: int = 12, regrind_after: int = 5, **last: Any) -> Inspection:
    """Weekly visits with steady wear, one regrind; the last visit has range images. Returns the last visit."""
    rng = np.random.default_rng(3)
    for number in range(visits - 1):
        since = number if number < regrind_after else number - regrind_after
        visit(tool, number, life=8.0 * since, recession=20 + 54 * since + rng.normal(0, 5))
    Event.objects.create(
        tool=tool, kind=Event.Kind.REGROUND, at=FIRST_VISIT + dt.timedelta(days=7 * regrind_after - 1), removed_mm=0.6,
        by=person("olga", Role.OPERATOR), note="Wet grinder 2",
    )  # fmt: skip
    since = visits - 1 - regrind_after
    Tool.objects.filter(pk=tool.pk).update(life_used=8.0 * since)
    return visit(tool, visits - 1, life=8.0 * since, recession=20 + 54 * since, images=True, **last)
