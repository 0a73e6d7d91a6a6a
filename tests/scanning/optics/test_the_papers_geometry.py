"""The paper's geometry comes out as its own numbers do (exact, 30 digits, computed apart)."""

from __future__ import annotations

import numpy as np
import pytest

from scanning.optics import (
    IS1,
    IS2,
    LINE_WIDTH_UM,
    STEP_UM,
    distance_from_magnification,
    dynamic_range_db,
    magnification_from_distance,
)

HALF_DETECTOR_MM = 3.2768


def test_eq_2_gives_the_height_per_pixel_of_both_systems() -> None:
    assert IS1.mm_per_pixel == pytest.approx(0.01430168, abs=5e-9)
    assert IS2.mm_per_pixel == pytest.approx(0.02, abs=1e-12)


def test_the_pitch_along_the_line_is_the_pixel_seen_through_the_lens() -> None:
    assert IS1.row_pitch_um == pytest.approx(7.150838, abs=5e-7)
    assert IS1.rows * IS1.row_pitch_um / 1000 == pytest.approx(10.98369, abs=5e-6)
    assert IS2.rows * IS2.row_pitch_um / 1000 == pytest.approx(5.76)


def test_a_step_of_the_stage_moves_the_surface_by_one_pixel() -> None:
    assert IS1.on_sensor_px(STEP_UM) == pytest.approx(1.008832, abs=5e-7)
    assert IS1.on_sensor_px(LINE_WIDTH_UM) == pytest.approx(3.027706, abs=5e-7)


def test_lens_distance_and_magnification_of_table_1_agree() -> None:
    assert magnification_from_distance(50, 162) == pytest.approx(0.4464286, abs=5e-8)
    assert distance_from_magnification(50, 0.4475) == pytest.approx(161.7318, abs=5e-5)
    assert IS1.principal_distance_mm == pytest.approx(72.32143, abs=5e-6)
    assert IS1.half_detector_mm == pytest.approx(HALF_DETECTOR_MM)


def test_eq_1_is_zero_where_the_reference_plane_is_seen() -> None:
    assert float(IS1.height_mm(-HALF_DETECTOR_MM)) == pytest.approx(0.0, abs=1e-9)
    assert float(IS1.height_mm(HALF_DETECTOR_MM)) == pytest.approx(26.51152137, abs=1e-7)
    assert float(IS1.height_mm(0.0)) == pytest.approx(14.29603583, abs=1e-7)


@pytest.mark.parametrize(
    ("detector_mm", "half_mm", "slope"),
    [
        (0.0, 0.0, 0.01432617856),
        (-HALF_DETECTOR_MM, HALF_DETECTOR_MM, 0.01514989393),
        (0.0, HALF_DETECTOR_MM, 0.01286535429),
        (HALF_DETECTOR_MM, HALF_DETECTOR_MM, 0.01106113784),
    ],
)
def test_eq_1_has_these_slopes(detector_mm: float, half_mm: float, slope: float) -> None:
    ends = IS1.height_mm([detector_mm - 1e-6, detector_mm + 1e-6], half_mm)
    assert float(ends[1] - ends[0]) / 2e-6 * 3.2e-3 == pytest.approx(slope, abs=1e-9)


@pytest.mark.parametrize(
    ("columns", "points", "largest_um", "tolerance"), [(52, 201, 0.5647, 3e-3), (168, 401, 5.827, 0.03)]
)
def test_a_straight_line_is_enough_only_inside_the_calibrated_range(
    columns: int, points: int, largest_um: float, tolerance: float
) -> None:
    pixels = np.linspace(0, columns, points)
    heights = IS1.height_mm(-HALF_DETECTOR_MM + pixels * 3.2e-3)
    line = np.polyval(np.polyfit(pixels, heights, 1), pixels)
    assert 1000 * np.abs(heights - line).max() == pytest.approx(largest_um, abs=tolerance)


def test_the_brackets_extend_the_range_by_19_and_39_db() -> None:
    assert dynamic_range_db(0.9, 0.1) == pytest.approx(19.0849, abs=5e-5)
    assert dynamic_range_db(9, 0.1) == pytest.approx(39.0849, abs=5e-5)
    assert dynamic_range_db(255, 1) == pytest.approx(48.1308, abs=5e-5)


@pytest.mark.parametrize(("f_number", "limit_um"), [(4, 5.449442), (5.6, 7.626441), (8, 10.892808), (11, 14.976299)])
def test_speckle_limits_the_height_noise(f_number: float, limit_um: float) -> None:
    assert IS1.speckle_limit_um(f_number) == pytest.approx(limit_um, abs=1e-6)


def test_a_speckle_is_larger_than_a_pixel_at_f_5_6() -> None:
    assert IS1.speckle_size_px(4) == pytest.approx(1.19, abs=5e-3)
    assert IS1.speckle_size_px(5.6) == pytest.approx(1.67, abs=5e-3)
    assert IS1.speckle_size_px(8) == pytest.approx(2.39, abs=5e-3)


def test_a_system_whose_lens_is_not_known_says_so() -> None:
    with pytest.raises(ValueError, match="IS2"):
        IS2.height_mm(0.0)
    with pytest.raises(ValueError, match="IS2"):
        IS2.speckle_limit_um(5.6)
