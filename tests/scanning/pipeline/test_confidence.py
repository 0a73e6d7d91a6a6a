"""Every point says how sure it is that it is the laser line, so that a doubtful one can be seen as such."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from scanning.pipeline.stream import Profile, ProfileStream
from scanning.pipeline.whole import process_stack
from scanning.range_image import RangeImage
from scanning.recipe import Recipe
from tests.scanning.pipeline.agreement import assert_agree, header_for
from tests.scanning.pipeline.scenes import line, shot, speckle
from tests.scanning.pipeline.test_stream import StackInMemory

ROWS = np.arange(300)
STRAIGHT = 100.0 + 0.05 * ROWS
ON = line(STRAIGHT, 256, 3.03, 60.0)


def profile(light: NDArray[np.float64], recipe: str | Recipe = "NF", seed: int = 4) -> Profile:
    rng = np.random.default_rng(seed)
    frame = shot(speckle(light, rng), rng)
    stream = ProfileStream(Recipe.named(recipe) if isinstance(recipe, str) else recipe, header_for([[frame]]))
    return (stream.push([frame]) + stream.finish())[0]


def test_a_straight_line_alone_is_sure() -> None:
    sure = profile(ON).confidence
    assert np.isfinite(sure).mean() > 0.99
    assert np.nanmin(sure) >= 0.0
    assert np.nanmax(sure) <= 1.0
    assert np.mean(sure[np.isfinite(sure)] > 0.9) > 0.95


def test_where_nothing_was_found_there_is_no_confidence() -> None:
    found = profile(ON * (ROWS < 200)[:, None])
    assert np.array_equal(np.isnan(found.confidence), np.isnan(found.column_px))
    assert np.isnan(found.confidence[210:]).all()


def test_points_off_the_straight_surface_beside_a_rival_are_doubtful() -> None:
    # For 60 rows the line is dark and a reflection as wide as it stands 8 px beside it.
    dark = (ROWS > 120) & (ROWS < 180)
    light = line(STRAIGHT, 256, 3.03, 60.0 * ~dark) + line(STRAIGHT + 9.0, 256, 3.2, 150.0 * dark)
    found = profile(light)
    taken = np.isfinite(found.column_px) & (np.abs(found.column_px - STRAIGHT) > 5.0)
    assert np.all(found.confidence[taken] < 0.9)
    rest = np.isfinite(found.column_px) & ~taken & ~dark
    assert np.median(found.confidence[rest]) > 0.95


def test_a_recipe_that_follows_neighbours_says_nothing() -> None:
    literal = Recipe.named("NF").with_settings({"msnn.reading": "literal"})
    assert np.isnan(profile(ON, literal).confidence).all()


def test_confidence_travels_with_the_range_image(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    steps = [[shot(ON, rng)] for _ in range(2)]
    image = process_stack(StackInMemory(header_for(steps), steps), "NF")
    assert image.confidence is not None
    assert image.confidence.shape == image.height_um.shape
    image.save(tmp_path / "range.npz")
    again = RangeImage.load(tmp_path / "range.npz")
    assert again.confidence is not None
    np.testing.assert_array_equal(again.confidence, image.confidence)


def test_an_older_file_loads_without_a_confidence(tmp_path: Path) -> None:
    np.savez(tmp_path / "old.npz", height_um=np.zeros((3, 4)), row_pitch_um=7.15, profile_pitch_um=8.33)
    assert RangeImage.load(tmp_path / "old.npz").confidence is None


@pytest.mark.parametrize(("peak", "said"), [(2000.0, "overexposed"), (60.0, "")])
def test_an_overexposed_line_is_said_in_a_sentence(peak: float, said: str) -> None:
    rng = np.random.default_rng(1)
    steps = [[shot(line(STRAIGHT, 256, 4.0, peak), rng)]]
    notes = process_stack(StackInMemory(header_for(steps, width=4.0), steps), "NF").provenance["notes"]
    assert any("overexposed in" in note for note in notes) == bool(said)


@pytest.mark.parametrize("name", ["NF", "HDRE-II", "HDRE-I"])
def test_the_reference_agrees_where_a_straight_surface_rules(name: str) -> None:
    """With a crossing, a touching and a far reflection, dark rows and an end inside the frame."""
    rng = np.random.default_rng(9)
    lit = line(STRAIGHT, 192, 3.03, 60.0 * ((ROWS > 20) & ((ROWS < 130) | (ROWS > 140))))
    lit += line(80.0 + 0.25 * ROWS, 192, 3.0, 90.0 * ((ROWS > 40) & (ROWS < 160)))
    lit += line(STRAIGHT + 7.0, 192, 8.0, 150.0 * ((ROWS > 200) & (ROWS < 230)))
    lit += line(np.full(300, 30.0), 192, 3.0, 120.0 * (ROWS > 220))
    times = (100.0, 500.0) if name != "NF" else (100.0,)
    recipe = Recipe.named(name)
    steps = [[shot(speckle(lit, rng) * t / 100.0, rng) for t in times] for _ in range(5 if name != "NF" else 2)]
    assert_agree(steps, header_for(steps, times), recipe)
