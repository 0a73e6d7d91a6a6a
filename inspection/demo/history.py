"""Earlier visits of the demo knives, so that trends have something to show.

A history cannot be scanned in a minute. So the surfaces come from the simulator's closed forms at growing wear, get the
noise the demo rig was measured to have, and go through the same surface measurement, verdict and record as any scan.
No stack was taken; the provenance says so, and these results cannot be recomputed.
"""

from __future__ import annotations

import datetime as dt
import zlib
from collections.abc import Callable

import numpy as np
from django.utils import timezone
from scipy import ndimage

import scanning.range_image
from inspection.models import Inspection, Rig, Scan, Tool, User
from inspection.services.queue import default_recipe, limits_in_force, plan_for
from inspection.services.results import record_result
from inspection.states import ScanState
from scanning.precision import FlatRegion, precision_of
from scanning.rig.simulated.scenes import scene
from scanning.surface import inspect_surface

VISITS = 4
#: A gentle pace: planer knives are worn out at 45-60 um of recession (measuring.md 1.4), after some eighty hours.
RECESSION_UM_PER_HOUR = 0.6
NOISE_UM = 4.4
#: Neighbouring profiles share four of five images under sliding SCI, and speckle grains span about a row.
NOISE_REACH = (0.55, 1.6)


def make_history(
    tool: Tool, rig: Rig, *, hours: float, since: dt.datetime, by: User | None, say: Callable[[str], None]
) -> None:
    """Add ``VISITS`` inspections of ``tool`` between ``since`` and yesterday, worn as ``hours`` of use would."""
    say(f"Making the history of {tool.code} ...")
    yesterday = timezone.now() - dt.timedelta(days=1)
    for visit in range(VISITS):
        share = visit / (VISITS - 1)
        at = since + share * (yesterday - since)
        used = round(hours * share, 1)
        inspection = Inspection.objects.create(
            tool=tool, requested_by=by, requested_at=at, reason="Demo history (simulated surfaces)", life_used=used
        )
        for number, region in enumerate(tool.regions.filter(active=True)):
            started = at + dt.timedelta(minutes=2 * number)
            exposures = [float(e) for e in rig.exposures_us]
            recipe = default_recipe(rig, exposures)
            scan = Scan.objects.create(
                inspection=inspection, region=region, rig=rig, source=Scan.Source.IMPORT, state=ScanState.PROCESSING,
                requested_by=by, queued_at=started, started_at=started,
                plan=plan_for(region, rig, exposures, recipe), recipe=recipe,
                calibration=rig.calibration_now(), limit_set=limits_in_force(tool),
            )  # fmt: skip
            image = simulated_range_image(region.name, tool.code, visit, RECESSION_UM_PER_HOUR * used, rows=region.rows)
            first = region.flat_row
            record_result(
                scan,
                image,
                inspect_surface(image),
                precision_of(image, FlatRegion(first, first + region.flat_rows, 0, image.height_um.shape[1])),
                at=started + dt.timedelta(minutes=1),
            )


def individual(code: str) -> int:
    """The simulator's seed for a knife: its own texture, stains and speckle."""
    return zlib.crc32(code.encode()) % 1_000_000


def simulated_range_image(
    region: str, code: str, visit: int, wear_um: float, *, rows: int
) -> scanning.range_image.RangeImage:
    """The undamaged surface of a knife's region at some wear, seen with the demo rig's noise."""
    seed = individual(code)
    # Damage happens at some moment: the demo knife's is found by the scan that is to come.
    truth = scene(region, seed=seed, wear_um=wear_um, visit=visit + 1, damages=()).truth(rows=rows, steps=245)
    height = truth.height_um[:, 2:-2]
    rng = np.random.default_rng((seed, visit, zlib.crc32(region.encode())))
    noise = ndimage.gaussian_filter(rng.normal(size=height.shape), NOISE_REACH)
    height = (height + NOISE_UM * noise / noise.std()).astype(np.float32)
    known = np.isfinite(height)
    return scanning.range_image.RangeImage(
        column_px=np.where(known, truth.column_px[:, 2:-2], np.nan).astype(np.float32),
        height_um=height,
        row_pitch_um=truth.row_pitch_um,
        profile_pitch_um=truth.step_um,
        intensity=np.where(known, 120.0, np.nan).astype(np.float32),
        width_px=np.where(known, 3.0, np.nan).astype(np.float32),
        provenance={
            "origin": "simulated surface with simulated noise; no frames were taken",
            "scene": {"region": region, "seed": seed, "visit": visit + 1, "wear_um": wear_um},
            "noise_um": NOISE_UM,
        },
    )
