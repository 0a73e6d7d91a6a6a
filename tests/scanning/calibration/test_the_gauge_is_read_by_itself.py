"""The treads of a step gauge are found in its range image: which way they run, where they end, how high they lie."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from scanning.calibration import calibrate
from scanning.commands.stacks_read import GAUGE_RECIPE, range_image_of
from scanning.errors import BadInput
from scanning.gauge import find_gauge, match_heights
from scanning.range_image import RangeImage
from scanning.rig.simulated.recorder import record

UM_PER_PX = 14.3
PITCH_UM = 7.15
HEIGHTS = (0.0, 0.14, 0.25, 0.36, 0.44, 0.55, 0.64, 0.745)


def image_of(column: NDArray[np.float64], recipe: dict[str, Any] | None = None) -> RangeImage:
    told: dict[str, Any] = {"header": {"mm_per_pixel": UM_PER_PX / 1000}}
    if recipe is not None:
        told["recipe"] = recipe
    f = column.astype(np.float32)
    return RangeImage(f, f * UM_PER_PX, PITCH_UM, 8.33, f, f, provenance=told)


def stairs(
    heights: tuple[float, ...] = HEIGHTS, tread: int = 60, wide: int = 30, tilt_px: float = 0.0, seed: int = 1
) -> NDArray[np.float64]:
    """(rows, profiles) columns of a staircase in mm, noise of 0.3 px with grains of two pixels, wild points, a gap."""
    rng = np.random.default_rng(seed)
    height = np.repeat(heights, tread)[:, None] * np.ones(wide)
    white = rng.normal(0, 0.3, (height.shape[0] + 1, wide + 1))
    noise = (white[1:, 1:] + white[:-1, 1:] + white[1:, :-1] + white[:-1, :-1]) / 2.0
    column = 100.0 + 1000.0 * height / UM_PER_PX + tilt_px * np.arange(height.shape[0])[:, None] + noise
    wild = rng.random(column.shape) < 0.01
    column[wild] += rng.uniform(-60, 60, int(wild.sum()))
    column[rng.random(column.shape) < 0.05] = np.nan
    column[3 * tread // 2 : 3 * tread // 2 + 4] = np.nan
    return column


@pytest.mark.parametrize("direction", ["rows", "profiles"])
def test_every_tread_is_found_with_its_column(direction: str) -> None:
    column = stairs()
    gauge = find_gauge(image_of(column if direction == "rows" else column.T))
    assert gauge.direction == direction
    assert len(gauge.treads) == 8
    for k, tread in enumerate(gauge.treads):
        assert 60 * k <= tread.first < tread.last <= 60 * (k + 1)
        assert tread.last - tread.first > 40
        assert 0.003 < tread.u_column_px < 0.05
    rise = np.diff([t.column_px for t in gauge.treads])
    np.testing.assert_allclose(rise, 1000 * np.diff(HEIGHTS) / UM_PER_PX, atol=0.1)


def test_a_gauge_laid_askew_keeps_its_scale() -> None:
    """2 um per mm over 3.4 mm are 7 um, 0.9 % of the gauge; left in they would be taken for height."""
    tilt_px = 2.0 / UM_PER_PX * PITCH_UM / 1000
    column = stairs(tilt_px=tilt_px, seed=4)
    gauge = find_gauge(image_of(column))
    assert gauge.levelled
    assert gauge.askew_um_per_mm == pytest.approx(2.0, abs=3 * gauge.u_askew_um_per_mm)
    line = calibrate(HEIGHTS, [t.column_px for t in gauge.treads], u_scale_relative=gauge.u_scale_relative)
    assert line.slope_mm_per_px == pytest.approx(UM_PER_PX / 1000, rel=3 * line.u_slope_relative)
    true = find_gauge(image_of(column), level=False)
    assert true.u_scale_relative == 0.0
    assert calibrate(HEIGHTS, [t.column_px for t in true.treads]).slope_mm_per_px < 0.995 * UM_PER_PX / 1000


def test_a_gauge_said_to_lie_true_that_does_not_is_seen() -> None:
    tilted = stairs(tilt_px=0.02)
    assert find_gauge(image_of(tilted), level=False).contradicts
    assert not find_gauge(image_of(tilted)).contradicts
    assert not find_gauge(image_of(stairs()), level=False).contradicts


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    steps=st.lists(st.sampled_from([-0.3, -0.12, -0.05, 0.05, 0.09, 0.2, 1.5]), min_size=1, max_size=6),
)
def test_any_staircase_up_and_down_is_found(seed: int, steps: list[float]) -> None:
    heights = tuple(np.cumsum([2.0, *steps]))
    gauge = find_gauge(image_of(stairs(heights, tread=45, wide=24, seed=seed)))
    assert len(gauge.treads) == len(heights)
    np.testing.assert_allclose(
        np.diff([t.column_px for t in gauge.treads]), 1000 * np.diff(heights) / UM_PER_PX, atol=0.5
    )
    assert match_heights(gauge, heights) in (list(heights), list(heights[::-1]))


def test_the_uncertainty_of_a_tread_covers_its_error() -> None:
    """On 25 gauges of eight treads, with grains of speckle that make neighbouring pixels alike."""
    z = []
    for seed in range(100, 125):
        gauge = find_gauge(image_of(stairs(seed=seed)), level=False)
        true = 100.0 + 1000.0 * np.array(HEIGHTS) / UM_PER_PX
        z += [(t.column_px - c) / t.u_column_px for t, c in zip(gauge.treads, true, strict=True)]
    assert 0.8 < float(np.std(z)) < 1.25


@pytest.mark.parametrize(("seed", "tilt_deg"), [(701, 0.0), (702, 0.1), (703, -0.15)])
def test_a_simulated_gauge_calibrates_the_rig(tmp_path: Path, seed: int, tilt_deg: float) -> None:
    """Treads of different brightness under coherent speckle. Truth: the simulator's own projection."""
    record("gauge", tmp_path / "scan", seed=seed, steps=12, exposures_us=(100, 300, 900), tilt_across_deg=tilt_deg)
    gauge = find_gauge(range_image_of(tmp_path / "scan", GAUGE_RECIPE))
    assert (gauge.direction, len(gauge.treads)) == ("rows", 8)
    with np.load(tmp_path / "scan" / "truth.npz") as truth:
        true = np.array([float(np.median(truth["column_px"][t.first : t.last])) for t in gauge.treads])
    tilt_px = math.tan(math.radians(tilt_deg)) * 7.150838 / 14.30168
    assert gauge.askew_px == pytest.approx(tilt_px, abs=3.5 * gauge.u_askew_px)
    true -= tilt_px * np.array([t.middle for t in gauge.treads])
    line = calibrate(HEIGHTS, [t.column_px for t in gauge.treads], u_scale_relative=gauge.u_scale_relative)
    expected = calibrate(HEIGHTS, list(true))
    assert line.slope_mm_per_px == pytest.approx(expected.slope_mm_per_px, rel=3.5 * line.u_slope_relative)
    assert line.u_slope_relative < 0.008
    assert line.max_residual_um < 1.5


@pytest.mark.parametrize(
    ("heights", "said"),
    [
        ((0.0, 0.14, 0.25), "more treads than heights: 8 treads were found (rows 1-"),
        ((*HEIGHTS, 0.9), "fewer treads than heights: 8 treads were found"),
        ((0.0, 0.25, 0.14, 0.36, 0.44, 0.55, 0.64, 0.745), "do not rise with the heights given"),
        ((0.5,) * 8, "do not rise with the heights given"),
    ],
)
def test_heights_that_do_not_fit_are_refused(heights: tuple[float, ...], said: str) -> None:
    with pytest.raises(BadInput) as caught:
        match_heights(find_gauge(image_of(stairs())), heights)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_heights_may_be_listed_from_either_end() -> None:
    gauge = find_gauge(image_of(stairs()))
    assert match_heights(gauge, HEIGHTS) == match_heights(gauge, HEIGHTS[::-1]) == list(HEIGHTS)


@pytest.mark.parametrize("seed", range(6))
def test_a_flat_plate_is_no_gauge(seed: int) -> None:
    plate = stairs((0.3,), tread=400, tilt_px=0.3, seed=seed)
    with pytest.raises(BadInput, match="no steps were found in the scan of the gauge"):
        find_gauge(image_of(plate))


def test_a_dark_scan_is_no_gauge() -> None:
    with pytest.raises(BadInput, match="0 % of it measured"):
        find_gauge(image_of(np.full((100, 20), np.nan)))


def test_bent_parts_between_walls_are_no_treads() -> None:
    column = stairs((0.0, 0.1, 0.2), tread=80)
    bow = 2.5 * np.tile(np.linspace(-1, 1, 80) ** 2, 3)
    with pytest.raises(BadInput, match="is not flat"):
        find_gauge(image_of(column + bow[:, None]))


def test_a_wavy_plate_is_no_gauge() -> None:
    """Its crests and troughs are level, and something rises in between; but over many rows."""
    wave = 60.0 * np.sin(np.arange(480) / 480 * 4 * np.pi)[:, None]
    with pytest.raises(BadInput, match="instead of in a wall"):
        find_gauge(image_of(stairs((0.3,), tread=480) + wave))


def test_averaged_images_blur_walls_along_the_scan_and_are_kept_away_from() -> None:
    column = stairs(wide=40).T
    sliding = {"operations": [{"operation": "sci", "mode": "sliding", "window": 5}]}
    plain, averaged = find_gauge(image_of(column)), find_gauge(image_of(column, sliding))
    assert averaged.treads[1].first - plain.treads[1].first == 4
