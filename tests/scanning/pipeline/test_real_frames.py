"""Recorded frames of a metal plate beside a bright nozzle: the line on the plate is found, the reflections are not.

The true columns were read from the pictures by eye (middle of the bright line), in rows where the line lies on the
plate. Nothing else is known about the frames, so dark level and width are estimated.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from scanning.pipeline.stream import ProfileStream
from scanning.pipeline.whole import extract_profile
from scanning.recipe import Recipe
from tests.scanning.pipeline.agreement import header_for, product

Frames = dict[str, NDArray[np.uint8]]

STEPS = {
    "utframe0007.png": {160: 327, 200: 321, 300: 309, 400: 331, 480: 325, 560: 278, 640: 271, 700: 266},
    "utframe0008.png": {20: 477, 160: 460, 300: 444, 400: 432, 560: 441, 700: 444, 760: 389, 850: 380, 1000: 362},
    "utframe0009.png": {20: 478, 160: 460, 300: 443, 400: 431, 560: 442, 700: 445, 760: 390, 850: 379, 1000: 363},
    "utframe0010.png": {20: 478, 160: 460, 300: 443, 400: 431, 560: 443, 700: 445, 760: 390, 850: 379, 1000: 362},
}
BRACKET = {300: 497, 400: 484, 500: 473, 560: 462, 700: 445, 850: 424, 1000: 408}
PLATE = {"utframe0007.png": slice(145, 715), "utframe0008.png": slice(10, 1015),
         "utframe0009.png": slice(10, 1015), "utframe0010.png": slice(10, 1015)}  # fmt: skip


@pytest.mark.parametrize("name", STEPS)
def test_the_line_on_the_plate_is_found_in_every_frame(metal_line: Frames, name: str) -> None:
    found = extract_profile(metal_line[name])
    for row, column in STEPS[name].items():
        assert found[row] == pytest.approx(column, abs=4.0), f"row {row}"
    on_plate = found[PLATE[name]]
    assert np.isfinite(on_plate).mean() > 0.99
    expected = np.interp(np.arange(1024), list(STEPS[name]), list(STEPS[name].values()))[PLATE[name]]
    assert np.nanmax(np.abs(on_plate - expected)) < 45.0, "a reflection was followed"


@pytest.mark.parametrize("name", STEPS)
def test_the_reflections_of_nozzle_and_hose_are_seen_and_rejected(metal_line: Frames, name: str) -> None:
    frame = metal_line[name]
    stream = ProfileStream(Recipe.named("NF"), header_for([[frame]], dark=None, width=None))
    stream.push([frame])
    stream.finish()
    _, rejected = stream.candidates()
    aside = rejected[(rejected[:, 0] < 700) & (rejected[:, 1] < 260)]
    assert len(aside) >= 10, "the frame shows reflections left of the line"


def test_four_frames_are_a_stack_of_four_steps(metal_line: Frames) -> None:
    steps: list[list[NDArray[np.uint8]]] = [[metal_line[name]] for name in STEPS]
    found = product(steps, header_for(steps, dark=None, width=None), Recipe.named("NF"))
    assert found.shape == (1024, 4)
    for profile, labels in enumerate(STEPS.values()):
        for row, column in labels.items():
            assert found[row, profile] == pytest.approx(column, abs=4.0), f"row {row} of frame {profile}"


@pytest.mark.parametrize(
    "recipe",
    [
        Recipe.named("NF"),
        Recipe.named("HDRE-II").with_settings({"sci.window": "1"}),
        Recipe.named("HDRE-I").with_settings({"sci.window": "1"}),
    ],
    ids=["NF", "HDRE-II", "HDRE-I"],
)
def test_the_line_is_found_in_the_bracket_under_lamp_light(metal_line: Frames, recipe: Recipe) -> None:
    frames = [metal_line[name] for name in ("utest5.png", "utest4.png", "utest3.png")]
    found = extract_profile(frames, recipe, exposures_us=(100.0, 199.0, 359.0))
    # The line is 35 to 80 px wide here and saturated in all three frames.
    near = [abs(found[row] - column) < 25.0 for row, column in BRACKET.items() if np.isfinite(found[row])]
    assert all(near)
    assert len(near) >= len(BRACKET) - 1
    rows = np.arange(300, 1020)
    away = found[rows] - np.interp(rows, list(BRACKET), list(BRACKET.values()))
    assert np.mean(np.abs(away[np.isfinite(away)]) < 25.0) > 0.9
    assert np.isfinite(away).mean() > 0.8
