"""The precision report finds the flat part, gives its noise, and says what one value is averaged over."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from scanning.errors import BadInput
from scanning.precision import FlatRegion, find_flat, plane_residual, precision_of, read_flat, sigma_um
from scanning.range_image import RangeImage

SIGMA_UM = 4.2


def _image(height: NDArray[Any], **changes: Any) -> RangeImage:
    unknown = np.full(height.shape, np.nan, np.float32)
    values: dict[str, Any] = {
        "column_px": unknown, "height_um": height.astype(np.float32), "row_pitch_um": 7.15, "profile_pitch_um": 8.33,
        "intensity": unknown, "width_px": unknown, "wall_s": 0.5, "cpu_s": 0.25,
    }  # fmt: skip
    return RangeImage(**(values | changes))


def _tilted(rows: int = 400, profiles: int = 120, seed: int = 1) -> NDArray[np.float64]:
    """A noisy plane, 8 um/row and 3 um/profile steep: any other figure than sigma is the tilt's."""
    noise = np.random.default_rng(seed).normal(0, SIGMA_UM, (rows, profiles))
    return 1800 + 8.0 * np.arange(rows)[:, None] + 3.0 * np.arange(profiles)[None, :] + noise


def test_eq_9_gives_the_papers_4_2_um() -> None:
    assert sigma_um(0.2976, 0.0142) == pytest.approx(4.22592, abs=1e-9)
    assert sigma_um(0.2976, 0.014237375949) == pytest.approx(4.2370428, abs=1e-6)


def test_noise_about_a_tilted_plane_is_the_noise_that_was_added() -> None:
    report = precision_of(_image(_tilted()))
    assert report.sigma_um == pytest.approx(SIGMA_UM, rel=0.02)
    assert report.sigma_robust_um == pytest.approx(SIGMA_UM, rel=0.03)
    assert report.correlation_scan == pytest.approx([0, 0, 0], abs=0.03)
    assert report.flat_region is not None
    assert report.flat_region.last_row - report.flat_region.first_row == 240


def test_the_plane_is_the_one_of_least_squares() -> None:
    height = _tilted(60, 40)
    height[10:20, 5:30] = np.nan
    rows, profiles = np.nonzero(np.isfinite(height))
    design = np.column_stack([np.ones(rows.size), rows, profiles])
    known, *_ = np.linalg.lstsq(design, height[rows, profiles], rcond=None)
    np.testing.assert_allclose(
        plane_residual(height)[rows, profiles], height[rows, profiles] - design @ known, atol=1e-8
    )
    assert np.isnan(plane_residual(height)[12, 7])


def test_a_damage_and_the_missing_edge_do_not_enter_sigma() -> None:
    height = _tilted()
    height[:70] = np.nan
    height[80:140, 30:90] -= 200.0
    report = precision_of(_image(height))
    region = report.flat_region
    assert region is not None
    assert region.first_row >= 140
    assert region.chosen == "found"
    assert report.sigma_um == pytest.approx(SIGMA_UM, rel=0.03)


def test_on_a_staircase_one_tread_is_taken() -> None:
    height = _tilted(240, 210)
    for step in range(7):
        height[:, step * 30 :] += 110.0
    report = precision_of(_image(height))
    region = report.flat_region
    assert region is not None
    assert region.first_profile // 30 == (region.last_profile - 1) // 30
    assert report.sigma_um == pytest.approx(SIGMA_UM, rel=0.1)


def test_wild_pixels_count_in_sigma_and_not_in_the_robust_one() -> None:
    height = _tilted()
    wrong = np.random.default_rng(5).random(height.shape) < 0.003
    height[wrong] += 900.0
    report = precision_of(_image(height))
    assert report.sigma_um is not None
    assert report.sigma_um > 10 * SIGMA_UM
    assert report.sigma_robust_um == pytest.approx(SIGMA_UM, rel=0.05)
    assert report.flat_region is not None
    assert report.wild == np.count_nonzero(wrong[report.flat_region.slices])


def test_a_streak_of_wrong_peaks_is_passed_by_when_there_is_room_beside_it() -> None:
    height = _tilted()
    height[150:300, 20] -= 800.0
    report = precision_of(_image(height))
    assert report.wild == 0
    assert report.sigma_um == pytest.approx(SIGMA_UM, rel=0.03)
    assert report.flat_region is not None
    assert report.flat_region.chosen == "found"


def test_correlated_noise_is_seen_as_such() -> None:
    white = np.random.default_rng(2).normal(0, 1, (300, 200))
    report = precision_of(_image(white[:, :-4] + white[:, 1:-3] + white[:, 2:-2] + white[:, 3:-1] + white[:, 4:]))
    assert report.correlation_scan == pytest.approx([0.8, 0.6, 0.4], abs=0.04)
    assert report.correlation_rows == pytest.approx([0, 0, 0], abs=0.04)


def test_sliding_sci_averages_over_its_window_whatever_the_pitch_says() -> None:
    told = {
        "recipe": {"operations": [{"operation": "sci", "mode": "sliding", "window": 5}]},
        "header": {"step_um": 8.33},
    }
    assert precision_of(_image(_tilted(), provenance=told)).lateral_cell_um == pytest.approx((41.65, 7.15))
    assert precision_of(_image(_tilted())).lateral_cell_um == pytest.approx((8.33, 7.15))


def test_cost_and_counts_come_from_the_image() -> None:
    height = _tilted(100, 50)
    height[0, :10] = np.nan
    report = precision_of(_image(height, saturated=30, frame_pixels=3000))
    assert (report.undefined, report.undefined_share) == (10, 0.002)
    assert (report.saturated, report.saturated_share) == (30, 0.01)
    assert report.ns_per_range_pixel == pytest.approx(0.5e9 / 5000)
    assert report.cpu_ns_per_range_pixel == pytest.approx(0.25e9 / 5000)


def test_the_share_of_sure_points_counts_measured_points_only() -> None:
    height = _tilted(10, 10)
    height[0] = np.nan
    confidence = np.full(height.shape, 0.99, np.float32)
    confidence[1, :9] = 0.95  # not above 0.95
    confidence[2, :9] = np.nan  # measured, but nothing says how sure it is
    image = replace(_image(height), confidence=confidence)
    assert precision_of(image).to_json()["confident"] == {"above": 0.95, "share": pytest.approx(72 / 90)}


@pytest.mark.parametrize("confidence", [None, np.full((10, 10), np.nan, np.float32)], ids=["no channel", "never told"])
def test_an_image_that_does_not_say_how_sure_it_is_has_no_such_share(confidence: NDArray[Any] | None) -> None:
    assert precision_of(replace(_image(_tilted(10, 10)), confidence=confidence)).to_json()["confident"] is None


def test_a_given_flat_part_is_used() -> None:
    height = _tilted()
    height[:, :60] += np.random.default_rng(3).normal(0, 30, (400, 60))
    noisy = precision_of(_image(height), read_flat("0:400,0:60"))
    assert noisy.sigma_um == pytest.approx((30**2 + SIGMA_UM**2) ** 0.5, rel=0.03)


@pytest.mark.parametrize("text", ["", "1:2", "a:b,c:d", "1:2,3:4,5:6", "1,2"])
def test_a_flat_part_that_is_not_understood_is_refused(text: str) -> None:
    with pytest.raises(BadInput, match="not understood"):
        read_flat(text)


@pytest.mark.parametrize("region", [FlatRegion(0, 500, 0, 10), FlatRegion(5, 5, 0, 10), FlatRegion(-1, 5, 0, 10)])
def test_a_flat_part_outside_the_image_is_refused(region: FlatRegion) -> None:
    with pytest.raises(BadInput, match="is not inside the range image of 400 rows and 120 profiles"):
        precision_of(_image(_tilted()), region)


@pytest.mark.parametrize(
    "height",
    [
        np.full((30, 20), np.nan),
        np.where(np.arange(600).reshape(30, 20) == 7, 1.0, np.nan),
        np.ones((1, 20)),
        np.ones((30, 1)),
        np.ones((2, 2)),
        np.ones((30, 20)),
        np.where(np.arange(600).reshape(30, 20) % 20 == 3, 1.0, np.nan),
    ],
)
def test_where_little_or_nothing_was_measured_the_report_still_stands(height: NDArray[Any]) -> None:
    told = precision_of(_image(height)).to_json()
    json.dumps(told, allow_nan=False)
    assert told["sigma_um"] is None or told["sigma_um"] == pytest.approx(0.0, abs=1e-6)
    assert find_flat(np.full((5, 5), np.nan, np.float32)) is None
