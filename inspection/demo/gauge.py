"""Calibration pairs of the demo rig, measured on its simulated step gauge.

The camera's real scale differs from any nominal figure, on a simulated rig as on a steel one. Heights taken with the
nominal figure would be a percent off and nobody would know.
"""

from __future__ import annotations

import numpy as np

from scanning import Recipe, StackHeader
from scanning.pipeline.stream import ProfileStream
from scanning.rig.simulated.render import Renderer
from scanning.rig.simulated.scenes import GAUGE_HEIGHTS_UM, STEP_UM, scene

ROWS, COLUMNS, STEPS = 1000, 256, 30
EXPOSURES_US = (100.0, 300.0, 500.0, 700.0, 900.0)
#: Of each tread only the middle is used: near its ends the line bends.
MIDDLE = 0.6


def gauge_pairs() -> str:
    """Scan the gauge with the demo rig's optics and return its pairs as CSV text (height_mm, column_px)."""
    part = scene("gauge", seed=1)
    renderer = Renderer(part, rows=ROWS, columns=COLUMNS)
    header = StackHeader(
        rows=ROWS, columns=COLUMNS, steps=STEPS, exposures_us=EXPOSURES_US, step_um=STEP_UM,
        row_pitch_um=part.system.row_pitch_um, mm_per_pixel=0.0142, saturation=renderer.sensor.saturation,
        line_width_px=3.03,
    )  # fmt: skip
    stream = ProfileStream(Recipe.named("PRECISE"), header)
    profiles = []
    for step in range(STEPS):
        light = renderer.irradiance(step * STEP_UM)
        images = [
            renderer.expose(light, exposure, np.random.default_rng((1, step, number)))
            for number, exposure in enumerate(EXPOSURES_US)
        ]
        profiles += stream.push(images)
    profiles += stream.finish()
    columns = np.nanmedian([profile.column_px for profile in profiles], axis=0)
    lines = ["height_mm,column_px"]
    treads = len(GAUGE_HEIGHTS_UM) + 1
    for number, height_um in enumerate((0.0, *GAUGE_HEIGHTS_UM)):
        first, last = number * ROWS / treads, (number + 1) * ROWS / treads
        margin = 0.5 * (1.0 - MIDDLE) * (last - first)
        seen = columns[int(first + margin) : int(last - margin)]
        if height_um > 0:
            lines.append(f"{height_um * 1e-3:.6f},{np.nanmean(seen):.5f}")
    return "\n".join(lines) + "\n"
