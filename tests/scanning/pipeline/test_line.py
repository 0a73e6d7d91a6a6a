"""MSNN finds the laser line and not what shares the row with it; every rule of it is held by a row one can read."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from scanning.pipeline.whole import extract_profile
from scanning.recipe import Recipe
from tests.scanning.pipeline.scenes import line, shot, speckle

LETTER = Recipe.named("NF").with_settings({"msnn.reading": "literal", "msnn.width_factor": "100", "msnn.k": "0.1"})


def columns(*rows: list[int], recipe: Recipe = LETTER, width: float = 3.0) -> list[float]:
    """The line's column per row; the last row given is the bottom row."""
    return list(extract_profile(np.array(rows, np.uint8), recipe, dark_level=0, line_width_px=width))


def with_line(recipe: Recipe, **settings: str) -> Recipe:
    return recipe.with_settings({f"msnn.{key}": value for key, value in settings.items()})


def test_a_valley_ends_the_peak_and_belongs_to_it() -> None:
    # 8, 4, 9: the valley 4 ends the first peak; alone, the second is 9 only.
    narrow = with_line(LETTER, gate_px="1")
    top = columns([0, 0, 8, 4, 9, 0, 0, 0], [0, 0, 9, 0, 0, 0, 0, 0], recipe=narrow)
    assert top[0] == pytest.approx((2 * 8 + 3 * 4) / 12)


def test_equal_costs_go_to_the_lower_column() -> None:
    assert columns([0, 9, 0, 0, 0, 9, 0], [0, 0, 0, 9, 0, 0, 0])[0] == 1.0


def test_the_nearest_peak_of_the_same_width_continues_the_line() -> None:
    found = columns([0, 9, 0, 0, 0, 0, 5, 9, 9, 9, 5, 0, 0, 0, 0], [0, 0, 0, 0, 9, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0])
    assert found[0] == 1.0


def test_the_seed_is_the_lowest_row_with_a_lone_peak_of_the_right_width() -> None:
    wide = [0, 9, 9, 9, 9, 9, 9, 9, 9, 9, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]
    lone = [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 6, 9, 6, 0]
    checked = with_line(LETTER, width_factor="2", gate_px="2", gate_max_px="2")
    found = columns(lone, wide, recipe=checked)
    assert found[0] == pytest.approx(17.0)
    assert np.isnan(found[1])


def test_without_a_lone_peak_the_best_ratio_is_the_seed() -> None:
    weak = [0, 9, 0, 0, 0, 0, 8, 0, 0]
    strong = [0, 3, 0, 0, 0, 0, 9, 0, 0]
    assert columns(weak, strong)[1] == 6.0
    assert columns(strong, weak)[1] == 6.0


def test_without_a_peak_of_the_right_width_the_frame_is_undefined() -> None:
    strict = with_line(LETTER, width_factor="1.5")
    assert np.isnan(columns([0, 9, 9, 9, 9, 9, 9, 9, 9, 9, 9, 0], recipe=strict)).all()


def test_a_gap_does_not_end_the_line_and_opens_the_gate() -> None:
    dark = [0] * 40
    here = [0] * 40
    here[5] = 9
    there = [0] * 40
    there[25] = 9
    gate = with_line(LETTER, gate_px="6", gate_max_px="30")
    assert np.isnan(columns(there, here, recipe=gate)[0])
    assert columns(there, dark, dark, dark, here, recipe=gate)[0] == 25.0


def test_the_gate_never_opens_further_than_its_maximum() -> None:
    rows = [[0] * 40 for _ in range(12)]
    rows[-1][5] = 9
    rows[0][30] = 9
    gate = with_line(LETTER, gate_px="6", gate_max_px="20")
    assert np.isnan(columns(*rows, recipe=gate)[0])


def test_grains_of_speckle_are_one_line() -> None:
    joined = with_line(LETTER, grain_px="2")
    assert columns([0, 0, 0, 8, 0, 0, 8, 0, 0], recipe=joined) == [4.5]
    assert columns([0, 0, 0, 8, 0, 0, 0, 8, 0], recipe=joined) != [5.0]


def test_noise_is_no_line() -> None:
    rng = np.random.default_rng(3)
    assert np.isnan(extract_profile(shot(np.zeros((300, 256)), rng), dark_level=2, line_width_px=3.03)).mean() > 0.99


ROWS = np.arange(400)
STRAIGHT = 100.0 + 0.05 * ROWS


def wrong_and_lost(light: NDArray[Any], centre: NDArray[Any], width: float = 3.03) -> tuple[float, float]:
    """Shares of all rows: found more than 4 px (or half a width) away, and not found though the line is there."""
    rng = np.random.default_rng(11)
    found = extract_profile(shot(speckle(light, rng), rng), dark_level=2, line_width_px=width)
    far = np.isfinite(found) & ~(np.abs(found - centre) < max(4.0, width / 2.0))
    return float(far.mean()), float((np.isnan(found) & np.isfinite(centre)).mean())


def test_a_tilted_line_is_followed() -> None:
    tilted = 20.0 + 0.5 * ROWS
    wrong, lost = wrong_and_lost(line(tilted, 256, 3.03, 60.0), tilted)
    assert wrong == 0.0
    assert lost < 0.02


def test_gauge_steps_of_forty_pixels_are_taken() -> None:
    steps = 100.0 + 40.0 * (ROWS // 100 % 2)
    wrong, lost = wrong_and_lost(line(steps, 256, 3.03, 60.0), steps)
    assert wrong == 0.0
    assert lost < 0.04


def test_a_ghost_line_brighter_and_wider_over_all_rows_is_not_followed() -> None:
    light = line(STRAIGHT, 256, 3.03, 60.0) + line(STRAIGHT + 60.0, 256, 10.0, 120.0)
    wrong, lost = wrong_and_lost(light, STRAIGHT)
    assert wrong < 0.01
    assert lost < 0.12


def test_a_ghost_where_the_line_has_ended_below_is_not_followed() -> None:
    ended = np.where(ROWS < 280, STRAIGHT, np.nan)
    light = line(STRAIGHT, 256, 3.03, 60.0 * (ROWS < 280)) + line(STRAIGHT + 90.0, 256, 3.5, 120.0 * (ROWS > 310))
    wrong, lost = wrong_and_lost(light, ended)
    assert wrong == 0.0
    assert lost < 0.02


def test_the_literal_seed_would_lose_that_frame() -> None:
    light = line(STRAIGHT, 256, 3.03, 60.0 * (ROWS < 280)) + line(STRAIGHT + 90.0, 256, 3.5, 120.0 * (ROWS > 310))
    rng = np.random.default_rng(11)
    literal = Recipe.named("NF").with_settings(
        {"msnn.candidates": "threshold", "msnn.continuity": "nearest", "msnn.seed": "first"}
    )
    found = extract_profile(shot(speckle(light, rng), rng), literal, dark_level=2, line_width_px=3.03)
    assert np.isnan(found[:280]).all()


def test_nothing_is_made_up_where_the_line_breaks() -> None:
    broken = np.where((ROWS > 150) & (ROWS < 250), np.nan, STRAIGHT)
    wrong, lost = wrong_and_lost(line(STRAIGHT, 256, 3.03, 60.0 * np.isfinite(broken)), broken)
    assert wrong == 0.0
    assert lost < 0.02


@pytest.mark.parametrize("width", [2.0, 3.0, 6.0, 12.0, 20.0, 40.0])
def test_lines_of_2_to_40_px_are_measured(width: float) -> None:
    rng = np.random.default_rng(5)
    frame = shot(line(STRAIGHT, 256, width, 150.0), rng)
    for known in (width, None):
        found = extract_profile(frame, dark_level=2, line_width_px=known)
        assert np.isfinite(found).all()
        assert np.std(found - STRAIGHT) < 0.02 + 0.012 * width
        assert abs(np.mean(found - STRAIGHT)) < 0.05


def test_uneven_light_along_the_line_is_followed() -> None:
    light = line(STRAIGHT, 256, 3.03, 12.0 + 100.0 * np.exp(-(((ROWS - 200) / 80.0) ** 2)))
    wrong, lost = wrong_and_lost(light, STRAIGHT)
    assert wrong == 0.0
    assert lost < 0.02


def test_a_gauge_block_of_any_height_keeps_its_line() -> None:
    block = 40.0 + 150.0 * ((ROWS > 120) & (ROWS < 260))
    wrong, lost = wrong_and_lost(line(block, 256, 3.03, 60.0), block)
    assert wrong < 0.01
    assert lost < 0.01


def test_a_bright_reflection_far_away_is_not_the_line_where_the_line_is_dark() -> None:
    dark = (ROWS > 160) & (ROWS < 240)
    shone_at = (ROWS > 140) & (ROWS < 260)
    light = line(STRAIGHT, 256, 3.03, 60.0 * ~dark) + line(STRAIGHT + 100.0, 256, 3.2, 150.0 * shone_at)
    wrong, lost = wrong_and_lost(light, np.where(dark, np.nan, STRAIGHT))
    assert wrong == 0.0
    assert lost < 0.02


def test_a_tilted_line_goes_on_behind_a_long_dark_stretch() -> None:
    tilted = 20.0 + 0.5 * ROWS
    dark = (ROWS > 120) & (ROWS < 264)
    wrong, lost = wrong_and_lost(line(tilted, 256, 3.03, 60.0 * ~dark), np.where(dark, np.nan, tilted))
    assert wrong == 0.0
    assert lost < 0.02


def test_a_reflection_as_wide_and_twice_as_bright_beside_the_whole_line_is_left_alone() -> None:
    light = line(STRAIGHT, 256, 3.03, 60.0) + line(STRAIGHT + 24.0, 256, 3.03, 120.0 * ((ROWS > 60) & (ROWS < 200)))
    wrong, lost = wrong_and_lost(light, STRAIGHT)
    assert wrong == 0.0
    assert lost < 0.02


def test_beyond_the_end_of_the_surface_nothing_is_reported() -> None:
    ended = ROWS < 300
    wrong, lost = wrong_and_lost(line(STRAIGHT, 256, 3.03, 60.0 * ended), np.where(ended, STRAIGHT, np.nan))
    assert wrong == 0.0
    assert lost < 0.01
