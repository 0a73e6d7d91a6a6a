"""Run one stack through the product and through the reference, and say whether they agree."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanning.frames import StackHeader
from scanning.pipeline.stream import ProfileStream
from scanning.pipeline.tone import broadening
from scanning.recipe import Recipe
from tests.scanning.reference.pipeline import Setting, range_columns

Steps = list[list[NDArray[Any]]]


def header_for(
    steps: Steps,
    exposures: tuple[float, ...] = (100.0,),
    *,
    dark: float | None = 2.0,
    width: float | None = 3.0,
    saturation: int | None = None,
    logarithmic: bool = False,
) -> StackHeader:
    image = steps[0][0]
    bits = 8 * image.dtype.itemsize
    return StackHeader(
        rows=image.shape[0],
        columns=image.shape[1],
        steps=len(steps),
        exposures_us=(0.0,) if logarithmic else exposures,
        step_um=8.33,
        row_pitch_um=7.15,
        mm_per_pixel=0.0142,
        saturation=saturation if saturation is not None else (1 << bits) - 1,
        line_width_px=width,
        dark_level=dark,
        response="logarithmic" if logarithmic else "linear",
        bits=bits,
    )


def product(steps: Steps, header: StackHeader, recipe: Recipe) -> NDArray[np.float64]:
    stream = ProfileStream(recipe, header)
    profiles = [p for images in steps for p in stream.push(images)] + stream.finish()
    columns = [p.column_px for p in profiles]
    return np.stack(columns, axis=1) if columns else np.empty((header.rows, 0))


def reference(steps: Steps, header: StackHeader, recipe: Recipe) -> NDArray[np.float64]:
    line, sci, hdre, glt = recipe.line, recipe.compound, recipe.hdre, recipe.tone
    assert header.dark_level is not None
    compressed = glt is not None or header.response == "logarithmic"
    light_width = line.width_px or header.line_width_px or 3.0
    candidates = line.candidates if line.candidates != "auto" else ("threshold" if light_width > 12 else "noise")
    toned = glt is not None and candidates == "threshold"
    width = line.width_px
    if width is None and header.line_width_px is not None:
        width = header.line_width_px * (broadening(glt.p) if glt is not None and toned else 1.0)
    floor = line.floor
    if floor is None and glt is not None and toned:
        floor = (math.log(0.05 * 64 + 1) / math.log(65)) ** glt.p
    elif floor is None:
        floor = 0.6 if header.response == "logarithmic" else (0.02 if candidates == "noise" else 0.1)
    setting = Setting(
        order=tuple(o.key for o in recipe.operations if o.key in ("sci", "hdre", "glt")),
        exposures=header.exposures_us,
        dark=round(header.dark_level * 1024) / 1024,
        saturation=header.saturation,
        window=sci.window if sci else 1,
        mode=sci.mode if sci else "block",
        saturated=hdre.saturated if hdre else "all",
        p=glt.p if glt else 0.5,
        k=line.k if line.k is not None else (1.5 if compressed else 3.0),
        floor=floor,
        floor_from_row_mean=line.floor_from == "row_mean",
        ceiling=line.ceiling,
        snr=line.snr if line.snr is not None else (3.0 if toned or header.response == "logarithmic" else 4.0),
        grain=line.grain_px
        if line.grain_px is not None
        else max(3.0, (line.width_px or header.line_width_px or 0.0) / 4),
        width=width,
        width_factor=line.width_factor,
        gate=line.gate_px,
        gate_max=line.gate_max_px,
        seed=line.seed,
        candidates=candidates,
        continuity=line.continuity if line.continuity != "auto" else ("nearest" if light_width > 30 else "path"),
        jump=line.jump,
        touched=0.3 if header.response == "linear" else 0.0,
        speed=speed_of(recipe, header, light_width),
        share=recipe.diagonals.share if recipe.diagonals else None,
        direction={"auto": 0, "higher": 1, "lower": -1}[recipe.diagonals.direction] if recipe.diagonals else 0,
        light_width=light_width,
    )
    return range_columns(steps, setting)


def speed_of(recipe: Recipe, header: StackHeader, light_width: float) -> float | None:
    """How far the surface moves on the sensor per step, where space-time analysis can use it."""
    if recipe.diagonals is None:
        return None
    lateral_um = header.mm_per_pixel * 1000.0 / math.tan(math.radians(recipe.diagonals.angle_deg))
    speed = recipe.diagonals.px_per_step or header.step_um / lateral_um
    return speed if 0.18 * light_width <= speed <= 0.6 * light_width else None


def assert_agree(steps: Steps, header: StackHeader, recipe: Recipe) -> NDArray[np.float64]:
    got, expected = product(steps, header, recipe), reference(steps, header, recipe)
    assert got.shape == expected.shape
    assert np.array_equal(np.isnan(got), np.isnan(expected)), "not the same rows are undefined"
    apart = np.abs(got - expected)
    assert not np.any(apart > 1e-4), f"columns differ by up to {np.nanmax(apart)} px"
    return got
