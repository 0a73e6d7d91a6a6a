"""Eq. (1) is fitted to the same pairs; the gauge itself says whether a straight line is enough."""

from __future__ import annotations

import numpy as np
import pytest

from scanning.calibration import calibrate, fit_line
from scanning.errors import BadInput
from scanning.optics import IS1, IS2
from scanning.triangulation import Triangulation, compare_models, system_named
from tests.scanning.calibration.test_the_line_through_a_step_gauge import HEIGHTS, IS1_COLUMNS


def test_the_height_is_0_at_the_border_of_the_detector() -> None:
    assert float(Triangulation().height_mm(-0.5)) == pytest.approx(0.0, abs=1e-12)


def test_eq_1_bends_as_the_golden_numbers_say() -> None:
    """0.5647 um over the 52 calibrated px, 5.827 um over the 2.4 mm depth of field (paper_golden.py)."""
    for reach, bend_um, tolerance in ((52, 0.5647, 0.003), (168, 5.827, 0.03)):
        columns = np.linspace(-0.5, reach - 0.5, 401)
        fit = fit_line(columns, Triangulation().height_mm(columns))
        assert 1000 * np.abs(fit.residuals).max() == pytest.approx(bend_um, abs=tolerance)


def test_the_papers_gauge_cannot_tell_the_models_apart() -> None:
    comparison = compare_models(calibrate(HEIGHTS, IS1_COLUMNS), Triangulation())
    assert comparison.line_leave_one_out_um == pytest.approx(9.6334, abs=1e-4)
    assert comparison.curve_leave_one_out_um == pytest.approx(9.8015, abs=1e-4)
    assert not comparison.decided
    assert comparison.difference_um < 0.6


def test_pairs_made_by_eq_1_are_fitted_by_eq_1() -> None:
    model = Triangulation(IS1, axis_column=127.5)
    columns = np.array([20.0, 60.0, 100.0, 140.0, 180.0, 220.0])
    heights = 0.3 + 1.02 * model.height_mm(columns)
    comparison = compare_models(calibrate(list(heights), list(columns)), model)
    assert comparison.better == "eq. (1)"
    assert comparison.decided
    assert comparison.scale == pytest.approx(1.02, rel=1e-9)
    assert comparison.curve_leave_one_out_um < 1e-6 < comparison.line_leave_one_out_um


def test_pairs_on_a_line_are_fitted_by_the_line() -> None:
    columns = [0.0, 400.0, 900.0, 1500.0, 2047.0]
    comparison = compare_models(calibrate([0.014 * c for c in columns], columns), Triangulation())
    assert comparison.better == "straight line"
    assert comparison.decided


def test_both_tables_are_told_pair_by_pair() -> None:
    told = compare_models(calibrate(HEIGHTS, IS1_COLUMNS), Triangulation()).to_json()
    for model in ("straight_line", "eq_1"):
        assert len(told[model]["residuals_um"]) == len(told[model]["leave_one_out_each_um"]) == 7
    assert told["straight_line"]["residuals_um"][3] == pytest.approx(11.665506, abs=1e-6)
    assert told["better"] == "straight line"


def test_a_system_of_unknown_stand_off_is_refused() -> None:
    with pytest.raises(BadInput, match="stand-off and the focal length of IS2"):
        compare_models(calibrate(HEIGHTS, IS1_COLUMNS), Triangulation(IS2))
    with pytest.raises(BadInput, match="choose one of IS1, IS2"):
        system_named("IS3")
