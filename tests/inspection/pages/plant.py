"""A small plant to look at: a knife with a history, tools in every state, a queue at work, dates due and overdue.

Surfaces are synthetic, but every number, damage and verdict on them comes from the product's own code, so pages show
what they would show. `python -m tests.inspection.pages.plant` fills an empty installation with it.
"""

from __future__ import annotations

import datetime as dt
import hashlib
import os
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

if __name__ == "__main__":
    import django

    os.environ.setdefault("DJANGO_SETTINGS_MODULE", "inspection.settings")
    django.setup()

from django.conf import settings
from django.utils import timezone

from inspection.models import (
    Damage,
    Event,
    Inspection,
    Measurement,
    PrecisionReport,
    RangeImage,
    Region,
    Rig,
    Role,
    Scan,
    Schedule,
    Tool,
    ToolType,
    User,
)
from inspection.services import plant as services
from inspection.services.calibrations import add_calibration
from inspection.services.queue import enqueue_inspection, pause_queue
from inspection.services.recipes import recipe_named
from inspection.services.verdict import Value, judge
from inspection.states import ScanState
from scanning.calibration import calibrate, read_pairs
from scanning.precision import precision_of
from scanning.range_image import RangeImage as Heights
from scanning.surface import SurfaceReport, inspect_surface

ROW_UM, PROFILE_UM = 7.150838, 8.33
#: A stair of feeler gauges as an imaging system like IS1 sees it.
GAUGE_PAIRS = """height_mm,column_px
0.140,9.5
0.210,15.2
0.285,19.6
0.360,25.0
0.445,30.3
0.545,38.5
0.645,45.6
0.745,52.2
"""
CALIBRATION = calibrate(*read_pairs(GAUGE_PAIRS))
#: Chips of R1, R2, R3 as (row, profile, radius in um, depth in um) in shares of the image: none, two medium and one
#: minor, one large.
CHIPS: dict[str, list[tuple[float, float, float, float]]] = {
    "R1": [],
    "R2": [(0.86, 0.25, 150, 110), (0.60, 0.62, 120, 90), (0.30, 0.83, 60, 38)],
    "R3": [(0.84, 0.45, 420, 240)],
}


def person(name: str, role: Role) -> User:
    """A user whose password is ``<name>-knows-the-word``."""
    found = User.objects.filter(username=name).first()
    return found or User.objects.create_user(
        username=name, password=f"{name}-knows-the-word", first_name=name.capitalize(), role=role
    )


def heights(chips: list[tuple[float, float, float, float]], shape: tuple[int, int], seed: int) -> Heights:
    """A tilted, noisy bevel with spherical chips, a ragged edge beyond which nothing is seen, and stray holes."""
    rng = np.random.default_rng(seed)
    rows, profiles = np.mgrid[0 : shape[0], 0 : shape[1]]
    height = 400.0 + 0.12 * rows - 0.05 * profiles + rng.normal(0, 4.2, shape)
    for row, profile, radius_um, depth_um in chips:
        away = ((rows - row * shape[0]) * ROW_UM) ** 2 + ((profiles - profile * shape[1]) * PROFILE_UM) ** 2
        height -= depth_um * np.clip(1 - away / (radius_um * max(0.35, shape[0] / 1000)) ** 2, 0, None)
    edge = shape[0] * 0.955 + 3 * np.sin(profiles[0] / 17.0)
    height[rows > edge] = np.nan
    height[rng.random(shape) < 0.004] = np.nan
    blind = (rows - 0.1 * shape[0]) ** 2 + (profiles - 0.9 * shape[1]) ** 2 < (0.03 * shape[0]) ** 2
    height[blind] = np.nan
    # As the line's path tells it: doubtful beside a brink and in the mirror of a chip, sure elsewhere.
    doubt = np.clip(1 - (edge - rows) / (0.04 * shape[0]), 0, 1) + 0.6 * (rng.random(shape) < 0.01)
    sure = np.where(np.isfinite(height), np.clip(0.99 - doubt, 0, 1), np.nan)
    grey = np.where(np.isfinite(height), 150 + 40 * rng.random(shape), np.nan)
    return Heights(
        column_px=(height / 14.2).astype(np.float32),
        height_um=height.astype(np.float32),
        row_pitch_um=ROW_UM,
        profile_pitch_um=PROFILE_UM,
        intensity=grey.astype(np.float32),
        width_px=np.where(np.isfinite(height), 3 + 0.3 * rng.random(shape), np.nan).astype(np.float32),
        confidence=sure.astype(np.float32),
        provenance={
            "software": {"edgewatch": "0.1.0", "numpy": np.__version__},
            "seed": seed,
            "calibration": {"calibrated_range_px": [9.5, 52.2]},
        },
    )


def small_plant() -> dict[str, User]:
    """People, one calibrated rig, one tool type: what every test needs."""
    people = {
        name: person(name, role)
        for name, role in [
            ("vera", Role.VIEWER),
            ("olga", Role.OPERATOR),
            ("erik", Role.ENGINEER),
            ("adam", Role.ADMIN),
        ]
    }
    rig, made = Rig.objects.get_or_create(
        slug="rig1", defaults={"name": "Rig 1", "travel_mm": 100.0, "exposures_us": [100, 300, 900]}
    )
    Rig.objects.filter(pk=rig.pk).update(worker_seen_at=timezone.now())
    if made:
        today = timezone.localdate()
        add_calibration(
            rig=rig,
            csv_file=GAUGE_PAIRS,
            by=people["erik"],
            artefact="Feeler-gauge stair FG-8, certificate 4711",
            done_on=today - dt.timedelta(days=90),
            valid_until=today + dt.timedelta(days=21),
        )
    if not ToolType.objects.exists():
        services.create_tool_type(by=people["erik"], name="Chipping knife 55°", edge_length_mm=90.0)
    return people


@lru_cache(maxsize=128)
def inspected(
    chips: tuple[tuple[float, float, float, float], ...], shape: tuple[int, int], seed: int
) -> tuple[Heights, SurfaceReport]:
    """The surface and what the product measures on it. Kept: every full plant has the same ones."""
    image = heights(list(chips), shape, seed)
    return image, inspect_surface(image, calibration=CALIBRATION)


def measured(
    scan: Scan, *, chips: list[tuple[float, float, float, float]], shape: tuple[int, int], seed: int
) -> RangeImage:
    """Give a scan a result: file, numbers, damages, precision and verdict, all by the product's own code."""
    image, report = inspected(tuple(chips), shape, seed)
    name = f"pages/scan-{scan.pk}-{seed}.npz"
    path = Path(settings.RANGES) / name
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(
        path,
        column_px=image.column_px,
        height_um=image.height_um,
        row_pitch_um=ROW_UM,
        profile_pitch_um=PROFILE_UM,
        intensity=image.intensity,
        width_px=image.width_px,
        **({} if image.confidence is None else {"confidence": image.confidence}),
    )
    return _rows(scan, image, report, name, hashlib.sha256(path.read_bytes()).hexdigest())


def _rows(scan: Scan, image: Heights, report: SurfaceReport, name: str, sha256: str) -> RangeImage:
    region = [one for one in report.measurements if one.scope == "region"]
    values = {one.code: Value(one.value, one.u, one.unit, one.label) for one in region}
    if not report.damages:
        values["L_max"] = Value(0.0, None, "mm", "Longest damage along the edge")
    judgement = judge(
        values,
        undefined_share=0.01,
        limit_set=scan.limit_set,
        calibration=scan.calibration,
        on=timezone.localdate(scan.started_at),
    )
    surface = report.to_json()
    details = {one["number"]: one for one in surface.pop("damages")}
    del surface["measurements"]
    row = RangeImage.objects.create(
        scan=scan,
        recipe=scan.recipe,
        calibration=scan.calibration,
        limit_set=scan.limit_set,
        created_at=scan.finished_at or timezone.now(),
        file=name,
        sha256=sha256,
        rows=image.height_um.shape[0],
        profiles=image.height_um.shape[1],
        row_pitch_um=ROW_UM,
        profile_pitch_um=PROFILE_UM,
        provenance=image.provenance,
        surface=surface,
        verdict=judgement.verdict,
        verdict_reasons=judgement.reasons,
    )
    for one in region:
        value = one.value if one.value is not None and np.isfinite(one.value) else None
        u = one.u if one.u is not None and np.isfinite(one.u) else None
        Measurement.objects.create(
            range_image=row, metric=one.code, label=one.label, value=value, unit=one.unit, u=u, origin=one.source[:300]
        )
    for one in report.damages:
        Damage.objects.create(
            range_image=row,
            number=one.number,
            severity=one.severity,
            volume_mm3=one.volume_mm3,
            u_volume_mm3=one.u_volume_mm3,
            depth_um=one.depth_um,
            u_depth_um=one.u_depth_um,
            area_mm2=one.area_mm2,
            length_mm=one.length_mm,
            start_mm=one.s_start_mm,
            end_mm=one.s_end_mm,
            touches_edge=one.touches_edge,
            detail=details[one.number],
        )
    PrecisionReport.objects.create(
        range_image=row,
        undefined_count=image.undefined,
        undefined_share=image.undefined_share,
        saturated_count=1200,
        saturated_share=2.1e-6,
        sigma_um=report.sigma_um,
        cell_scan_um=41.65,
        cell_row_um=7.15,
        ns_per_range_pixel=812.0,
        cpu_ns_per_range_pixel=1490.0,
        detail=precision_of(image).to_json(),
    )
    return row


def scan_row(inspection: Inspection, region: Region, state: str, at: dt.datetime, **more: Any) -> Scan:
    rig = Rig.objects.get(slug="rig1")
    running = state in (ScanState.QUEUED, ScanState.RUNNING, ScanState.PAUSED, ScanState.PROCESSING)
    values: dict[str, Any] = {
        "requested_by": inspection.requested_by,
        "queued_at": at,
        "started_at": None if state == ScanState.QUEUED else at + dt.timedelta(seconds=20),
        "finished_at": None if running else at + dt.timedelta(minutes=3),
        "recipe": recipe_named("HDRE-II"),
        "calibration": rig.calibration_now(),
        "limit_set": inspection.tool.tool_type.limit_sets.first(),
        "plan": {"start_mm": region.start_mm, "steps": 245, "exposures_us": [100, 300, 900]},
        "total": 245,
        "stack_sha256": hashlib.sha256(f"{inspection.pk}{region.pk}".encode()).hexdigest(),
    }
    if state == ScanState.DONE:
        values |= {"done": 245, "stack_file": f"{inspection.pk}.h5", "acquisition": ACQUISITION}
    return Scan.objects.create(inspection=inspection, region=region, rig=rig, state=state, **{**values, **more})


ACQUISITION = {
    "duration_s": 151.0,
    "time": {
        "wall_s": 151.0,
        "setup_s": 1.1,
        "homing_s": 4.0,
        "motion_s": 61.2,
        "settle_s": 12.3,
        "exposure_s": 39.6,
        "readout_s": 27.0,
        "sink_wait_s": 0.9,
        "paused_s": 0.0,
        "parking_s": 1.2,
        "software_s": 3.7,
        "overlapped_s": 18.4,
    },
    "software_share": 0.0245,
    "link": {"lines_sent": 1489, "bad_lines": 0, "retries": 0, "resets": 0},
    "pauses": 0,
    "retaken_frames": 0,
}


def visit(
    tool: Tool,
    at: dt.datetime,
    by: User | None,
    *,
    state: str = ScanState.DONE,
    reason: str = "Weekly check",
    chips: dict[str, list[tuple[float, float, float, float]]] | None = None,
    shape: tuple[int, int] = (160, 90),
    seed: int = 1,
    **more: Any,
) -> Inspection:
    """One visit with a scan per region; done ones have results."""
    inspection = Inspection.objects.create(
        tool=tool, requested_by=by, requested_at=at, reason=reason, life_used=tool.life_used
    )
    for number, region in enumerate(tool.regions.order_by("name")):
        scan = scan_row(inspection, region, state, at + dt.timedelta(minutes=4 * number), **more)
        if state == ScanState.DONE:
            measured(scan, chips=(chips or {}).get(region.name, []), shape=shape, seed=seed + number)
    return inspection


def grown(share: float) -> dict[str, list[tuple[float, float, float, float]]]:
    """The chips of the demo knife when they had only so much of their depth."""
    return {name: [(r, p, radius, depth * share) for r, p, radius, depth in chips] for name, chips in CHIPS.items()}


def whole_plant(*, shape: tuple[int, int] = (1000, 241), visits: int = 8) -> dict[str, User]:
    """Everything `small_plant` has, and a plant in full swing on top."""
    people = small_plant()
    olga, erik = people["olga"], people["erik"]
    now = timezone.now()
    kind = ToolType.objects.get()
    codes = ["K-114", "K-115", "K-116", "K-201", "K-202", "K-203", "K-204"]
    tools = {
        code: services.create_tool(by=erik, code=code, tool_type=kind, location=f"Chipper {code[2]}, pocket {code[-1]}")
        for code in codes
    }
    knife = tools["K-114"]
    for number in range(visits):
        at = now - dt.timedelta(days=7 * (visits - number), hours=2)
        Tool.objects.filter(pk=knife.pk).update(life_used=8.0 * (number + 1))
        knife.refresh_from_db()
        last = number == visits - 1
        visit(
            knife,
            at,
            olga,
            chips=grown(0.3 + 0.7 * number / max(1, visits - 1)),
            seed=10 * number,
            shape=shape if number >= visits - 2 else (160, 90),
            reason="Weekly check" if not last else "After the storm week",
        )
    services.record_event(knife, Event.Kind.INSTALLED, at=now - dt.timedelta(days=7 * visits), by=olga)
    services.record_event(knife, Event.Kind.COLLISION, at=now - dt.timedelta(days=16), by=olga, note="Nail in a log")
    visit(tools["K-115"], now - dt.timedelta(days=2), olga, seed=70)
    visit(tools["K-116"], now - dt.timedelta(days=3), olga, chips=grown(0.6), seed=80)
    visit(tools["K-201"], now - dt.timedelta(days=20), olga, chips=grown(1.0), seed=90)
    services.record_event(tools["K-201"], Event.Kind.REGROUND, at=now - dt.timedelta(days=5), by=olga, removed_mm=0.6)
    failed = visit(
        tools["K-202"],
        now - dt.timedelta(hours=5),
        olga,
        state=ScanState.FAILED,
        done=17,
        fault="The camera sent no frame within 2 s at step 17; check its cable and scan again.",
    )
    failed.scans.filter(region__name="R3").update(state=ScanState.INTERRUPTED, fault="")
    rig = Rig.objects.get(slug="rig1")
    going = Inspection.objects.create(
        tool=tools["K-203"], requested_by=olga, requested_at=now, reason="Before the shift"
    )
    regions = list(tools["K-203"].regions.order_by("name"))
    scan_row(
        going,
        regions[0],
        ScanState.RUNNING,
        now - dt.timedelta(seconds=75),
        done=104,
        phase="scan",
        position=0,
        progress_at=now,
        lease_until=now + dt.timedelta(days=1),
    )
    for place, region in enumerate(regions[1:], 1):
        scan_row(going, region, ScanState.QUEUED, now - dt.timedelta(seconds=70), position=place)
    enqueue_inspection(tool=tools["K-115"], rig=rig, by=olga, reason="Collision this morning")
    for code, days in [("K-114", -5), ("K-115", 0), ("K-116", 4), ("K-201", 30)]:
        Schedule.objects.create(
            tool=tools[code],
            rig=rig,
            every=1,
            unit="weeks",
            next_due=timezone.localdate() + dt.timedelta(days=days),
            queue_after=dt.time(6, 0),
            created_by=erik,
        )
    second = Rig.objects.create(
        slug="rig2",
        name="Rig 2, grinding shop",
        travel_mm=60.0,
        exposures_us=[200],
        worker_seen_at=now - dt.timedelta(minutes=12),
    )
    pause_queue(second, olga, "Waiting for the step gauge")
    recipe_named("HDRE-I")
    return people


if __name__ == "__main__":
    whole_plant()
    print("Filled. Sign in as vera, olga, erik or adam with <name>-knows-the-word.")
