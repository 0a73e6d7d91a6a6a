"""A step gauge becomes the line that the paper found, with the uncertainty that it left out.

Golden values: Table 2 of the paper, recomputed in exact rational arithmetic; NIST StRD, Norris.
"""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from scanning.calibration import Calibration, calibrate, fit_line
from scanning.errors import BadInput
from scanning.optics import IS1, IS2

HEIGHTS = [0.14, 0.25, 0.36, 0.44, 0.55, 0.64, 0.745]
IS1_COLUMNS = [9.152, 17.9658, 25.72, 29.8984, 38.65, 44.7688, 52.03]
IS2_COLUMNS = [6.22, 12.03, 16.41, 22.80, 26.89, 31.3215, 37.4921]

# NIST StRD, linear regression, Norris: y, x
NORRIS = np.array(
    [
        [0.1, 0.2], [338.8, 337.4], [118.1, 118.2], [888.0, 884.6], [9.2, 10.1], [228.1, 226.5], [668.5, 666.3],
        [998.5, 996.3], [449.1, 448.6], [778.9, 777.0], [559.2, 558.2], [0.3, 0.4], [0.1, 0.6], [778.1, 775.5],
        [668.8, 666.9], [339.3, 338.0], [448.9, 447.5], [10.8, 11.6], [557.7, 556.0], [228.3, 228.1], [998.0, 995.8],
        [888.8, 887.6], [119.6, 120.2], [0.3, 0.3], [0.6, 0.3], [557.6, 556.8], [339.3, 339.1], [888.0, 887.2],
        [998.5, 999.0], [778.9, 779.0], [10.2, 11.1], [117.6, 118.3], [228.9, 229.2], [668.4, 669.1], [449.2, 448.9],
        [0.2, 0.5],
    ]
)  # fmt: skip


def test_table_2_of_is1_comes_out() -> None:
    line = calibrate(HEIGHTS, IS1_COLUMNS)
    assert line.slope_mm_per_px == pytest.approx(0.014237375949, rel=1e-10)
    assert line.intercept_mm == pytest.approx(0.002659732649, rel=1e-9)
    assert line.max_residual_um == pytest.approx(11.6655063, rel=1e-8)
    assert line.residual_sd_um == pytest.approx(8.32204059, rel=1e-9)
    assert line.u_slope_mm_per_px == pytest.approx(2.251273102e-4, rel=1e-9)
    assert 100 * line.u_slope_relative == pytest.approx(1.58124159, rel=1e-8)
    assert line.r_squared == pytest.approx(0.998751398, abs=1e-9)
    assert line.residuals_um == pytest.approx(
        [7.039803, -8.445581, -8.845042, 11.665506, -2.934313, -0.049969, 1.569597], abs=1e-6
    )
    assert line.slope_mm_per_px / IS1.mm_per_pixel == pytest.approx(0.995503955, abs=1e-7)


def test_table_2_of_is2_comes_out() -> None:
    line = calibrate(HEIGHTS, IS2_COLUMNS)
    assert line.slope_mm_per_px == pytest.approx(0.019436482199, rel=1e-10)
    assert line.intercept_mm == pytest.approx(0.021148345009, rel=1e-9)
    assert line.max_residual_um == pytest.approx(24.3001391, rel=1e-8)
    assert line.residual_sd_um == pytest.approx(15.35527511, rel=1e-9)
    assert 100 * line.u_slope_relative == pytest.approx(2.92199681, rel=1e-8)
    assert line.r_squared == pytest.approx(0.995749114, abs=1e-9)
    assert line.residuals_um == pytest.approx(
        [-2.043264, -4.969226, 19.898982, -24.300139, 6.204649, 10.071878, -4.862879], abs=1e-6
    )
    assert line.slope_mm_per_px / IS2.mm_per_pixel == pytest.approx(0.97182, abs=5e-6)


def test_the_largest_leave_one_out_error_is_larger_than_the_largest_residual() -> None:
    assert calibrate(HEIGHTS, IS1_COLUMNS).leave_one_out_um == pytest.approx(14.0126, abs=1e-4)
    assert calibrate(HEIGHTS, IS2_COLUMNS).leave_one_out_um == pytest.approx(28.3885, abs=1e-4)


def test_leaving_one_out_means_fitting_again_without_it() -> None:
    line = calibrate(HEIGHTS, IS1_COLUMNS)
    for left_out in range(7):
        others = [i for i in range(7) if i != left_out]
        again = calibrate([HEIGHTS[i] for i in others], [IS1_COLUMNS[i] for i in others])
        error_um = 1000 * HEIGHTS[left_out] - float(again.height_um(IS1_COLUMNS[left_out]))
        assert line.leave_one_out_each_um[left_out] == pytest.approx(error_um, abs=1e-9)


def test_the_residuals_of_the_two_systems_have_no_common_cause() -> None:
    one, two = calibrate(HEIGHTS, IS1_COLUMNS), calibrate(HEIGHTS, IS2_COLUMNS)
    correlation = np.dot(one.residuals_um, two.residuals_um) / math.sqrt(
        np.dot(one.residuals_um, one.residuals_um) * np.dot(two.residuals_um, two.residuals_um)
    )
    assert correlation == pytest.approx(-0.7171912, abs=1e-6)


def test_the_fit_passes_nists_norris_data() -> None:
    fit = fit_line(NORRIS[:, 1], NORRIS[:, 0])
    assert fit.slope == pytest.approx(1.00211681802045, rel=1e-12)
    assert fit.intercept == pytest.approx(-0.262323073774029, rel=1e-10)
    assert fit.u_slope == pytest.approx(0.429796848199937e-03, rel=1e-11)
    assert fit.u_intercept == pytest.approx(0.232818234301152, rel=1e-11)
    assert fit.residual_sd == pytest.approx(0.884796396144373, rel=1e-11)
    assert fit.r_squared == pytest.approx(0.999993745883712, rel=1e-12)


def test_uncertainty_of_a_height_is_smallest_in_the_middle_of_the_gauge() -> None:
    line = calibrate(HEIGHTS, IS1_COLUMNS)
    middle = float(np.mean(IS1_COLUMNS))
    assert float(line.u_height_um(middle)) == pytest.approx(line.residual_sd_um / math.sqrt(7), rel=1e-9)
    assert float(line.u_height_um(0.0)) == pytest.approx(1000 * line.u_intercept_mm, rel=1e-9)


def test_the_parameters_covariance_is_that_of_the_normal_equations() -> None:
    line = calibrate(HEIGHTS, IS1_COLUMNS)
    design = np.column_stack([np.ones(7), IS1_COLUMNS])
    covariance = np.linalg.inv(design.T @ design) * (line.residual_sd_um / 1000) ** 2
    assert line.u_intercept_mm == pytest.approx(math.sqrt(covariance[0, 0]), rel=1e-9)
    assert line.correlation * line.u_intercept_mm * line.u_slope_mm_per_px == pytest.approx(covariance[0, 1], rel=1e-9)


def test_a_depth_carries_the_slopes_uncertainty_and_not_the_intercepts() -> None:
    line = calibrate(HEIGHTS, IS1_COLUMNS)
    assert float(line.u_height_difference_um(-500.0)) == pytest.approx(7.906, abs=1e-3)


def test_a_column_outside_the_gauge_is_told_from_one_inside() -> None:
    line = calibrate(HEIGHTS, IS1_COLUMNS)
    assert line.inside_range(np.array([9.151, 9.152, 30.0, 52.03, 52.04, np.nan])).tolist() == [
        False, True, True, True, False, False,
    ]  # fmt: skip
    assert line.range_px == (9.152, 52.03)
    assert line.range_mm == (0.14, 0.745)


def test_not_measured_stays_not_measured() -> None:
    line = calibrate(HEIGHTS, IS1_COLUMNS)
    heights = line.height_um(np.array([[10.0, np.nan]]))
    assert heights.shape == (1, 2)
    assert heights[0, 0] == pytest.approx(2.659732649 + 142.37375949)
    assert np.isnan(heights[0, 1])


def test_a_calibration_survives_its_json() -> None:
    line = calibrate(HEIGHTS, IS1_COLUMNS, gauge="feeler set 12", measured_on="2026-11-02", expires_on="2027-05-02")
    told = json.dumps(line.to_json(), allow_nan=False)
    again = Calibration.from_json(json.loads(told))
    assert again == line
    assert again.sha256() == line.sha256()
    assert line.sha256() != calibrate(HEIGHTS, IS1_COLUMNS).sha256()


def test_a_calibration_edited_by_hand_is_refused() -> None:
    told = calibrate(HEIGHTS, IS1_COLUMNS).to_json()
    told["slope_mm_per_px"] = 0.0143
    with pytest.raises(BadInput, match="edited by hand"):
        Calibration.from_json(told)
