"""The noise of a height: two scans of a flat part, moved in between, compared pixel by pixel of the instrument.

Truth is the simulator's closed form. Without moving, or aligned on the part, speckle repeats and the noise seems small.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.precision import Found, Optics, named, scanned
from scanning.errors import BadInput
from scanning.precision import FlatRegion, plane_residual
from scanning.range_image import RangeImage
from scanning.repeats import repeat_noise, sq_of_difference

UM_PER_PX = 14.30168
ROW_UM, STEP_UM = 7.150838, 8.33
FLAT = FlatRegion(40, 200, 5, 45)


def scan(rows_moved: float = 0.0, steps_moved: float = 0.0, draw: int = 0, recipe: str = "NF") -> Found:
    part = Optics(5.6, "fwhm").scene("R1", 811, stray="none")
    pose = replace(part.pose, shift_across_um=rows_moved * ROW_UM, shift_along_um=steps_moved * STEP_UM)
    recipes = {recipe: named(recipe)}
    return scanned(replace(part, pose=pose), recipes, rows=220, steps=50, exposures_us=(300.0,), noise_seed=draw)[
        recipe
    ]


def image(found: Found, pitch_um: float = STEP_UM) -> RangeImage:
    column = found.sound_px.astype(np.float32)
    recipe = {"operations": [{"operation": "sci", "mode": "sliding", "window": 5}] if found.window > 1 else []}
    told = {"recipe": recipe, "header": {"step_um": STEP_UM}, "recipe_sha256": "one"}
    height = (column * UM_PER_PX).astype(np.float32)
    return RangeImage(column, height, ROW_UM, pitch_um, column, column, provenance=told)


@pytest.fixture(scope="module")
def first() -> Found:
    return scan()


@pytest.fixture(scope="module")
def true_noise(first: Found) -> float:
    error = plane_residual(((first.sound_px - first.true_px) * UM_PER_PX)[FLAT.slices])
    return float(np.nanstd(error))


def test_a_static_repeat_shows_a_tenth_of_the_noise(first: Found, true_noise: float) -> None:
    again = scan(draw=1)
    static, _, _ = sq_of_difference(
        image(first).height_um[FLAT.slices].astype(float), image(again).height_um[FLAT.slices].astype(float)
    )
    assert 6.0 < true_noise < 10.0
    assert static < 0.15 * true_noise


@pytest.mark.parametrize(("rows", "steps"), [(3.0, 0.0), (20.0, 0.0), (0.0, 12.0), (0.0, -6.0)])
def test_a_displaced_repeat_shows_the_noise(first: Found, true_noise: float, rows: float, steps: float) -> None:
    moved = scan(rows, steps, draw=1)
    along, moved_um = ("rows", rows * ROW_UM) if rows else ("scan", steps * STEP_UM)
    found = repeat_noise(image(first), image(moved), moved_um, along, FLAT)  # type: ignore[arg-type]
    assert found.noise_um == pytest.approx(true_noise, rel=0.12)
    assert found.lateral_cell_um == pytest.approx((8.33, 7.150838))
    assert found.same_point_um is not None
    assert found.same_point_um < 0.15 * true_noise, "aligned on the part, its speckle cancels as if it had not moved"


def test_the_cell_of_an_averaged_recipe_is_told_and_needs_a_larger_displacement() -> None:
    first, moved = scan(recipe="SCI"), scan(0.0, 12.0, 1, "SCI")
    found = repeat_noise(image(first), image(moved), 12 * STEP_UM, "scan", FLAT)
    assert found.lateral_cell_um == pytest.approx((41.65, 7.150838))
    true = float(np.nanstd(plane_residual(((first.sound_px - first.true_px) * UM_PER_PX)[FLAT.slices])))
    assert found.noise_um == pytest.approx(true, rel=0.15)
    with pytest.raises(BadInput, match=r"at least 66\.\d um"):
        repeat_noise(image(first), image(moved), 40.0, "scan", FLAT)


def synthetic(seed: int, rows: int = 200, profiles: int = 60, tilt: float = 0.0) -> NDArray[np.float64]:
    noise = np.random.default_rng(seed).normal(0.0, 4.0, (rows, profiles))
    return 900 + tilt * np.arange(rows)[:, None] + noise


def height_image(height: NDArray[np.float64], **changes: object) -> RangeImage:
    f = height.astype(np.float32)
    made = RangeImage(f, f, ROW_UM, STEP_UM, f, f, provenance={"recipe_sha256": "one"})
    return replace(made, **changes)  # type: ignore[arg-type]


def test_another_tilt_and_missing_points_do_not_enter_the_noise() -> None:
    a, b = synthetic(1), synthetic(2, tilt=0.5)
    b[50:60] = np.nan
    found = repeat_noise(height_image(a), height_image(b), 10 * ROW_UM)
    assert found.noise_um == pytest.approx(4.0, rel=0.03)
    assert found.robust_um == pytest.approx(4.0, rel=0.05)
    assert found.left_um == pytest.approx(0.0, abs=1e-9)


def test_wild_points_show_in_the_noise_and_not_in_the_robust_figure() -> None:
    a, b = synthetic(1), synthetic(2)
    b[::20, ::10] += 300.0
    found = repeat_noise(height_image(a), height_image(b), 30.0, flat=FlatRegion(0, 200, 0, 60))
    assert found.noise_um > 8.0
    assert found.robust_um == pytest.approx(4.0, rel=0.05)


@pytest.mark.parametrize(
    ("moved_um", "along", "said"),
    [
        (0.0, "rows", "without moving the part shows the same speckle twice"),
        (10.0, "rows", "move the part by at least 21.5 um (3 rows)"),
        (25.0, "scan", "move the part by at least 33.3 um"),
        (float("nan"), "rows", "must be a number"),
    ],
)
def test_a_displacement_that_proves_nothing_is_refused(moved_um: float, along: str, said: str) -> None:
    with pytest.raises(BadInput) as caught:
        repeat_noise(height_image(synthetic(1)), height_image(synthetic(2)), moved_um, along)  # type: ignore[arg-type]
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_scans_that_cannot_be_compared_are_refused() -> None:
    one = height_image(synthetic(1))
    for other, said in (
        (height_image(synthetic(2, rows=180)), "scan the same region twice"),
        (height_image(synthetic(2), profile_pitch_um=41.65), "differ in profile_pitch_um"),
        (height_image(synthetic(2), provenance={"recipe_sha256": "two"}), "different recipes"),
        (height_image(np.full((200, 60), np.nan)), "only 0 pixels in common"),
    ):
        with pytest.raises(BadInput, match=said):
            repeat_noise(one, other, 50.0)
    with pytest.raises(BadInput, match="nothing flat was measured"):
        repeat_noise(height_image(np.full((200, 60), np.nan)), one, 50.0)
