"""A calibration tells its covariance, when it expires, and which heights of an image it does not cover."""

from __future__ import annotations

import datetime as dt
import json
from pathlib import Path

import numpy as np
import pytest

from scanning.calibration import Calibration, calibrate
from scanning.errors import BadInput
from scanning.precision import precision_of
from scanning.range_image import RangeImage
from tests.scanning.calibration.test_the_line_through_a_step_gauge import HEIGHTS, IS1_COLUMNS


def test_the_covariance_gives_the_uncertainty_of_any_height() -> None:
    line = calibrate(HEIGHTS, IS1_COLUMNS)
    for column in (0.0, 9.152, 31.0, 200.0):
        vector = np.array([1.0, column])
        assert 1000 * np.sqrt(vector @ line.covariance @ vector) == pytest.approx(float(line.u_height_um(column)))
    told = np.array(line.to_json()["covariance"])
    np.testing.assert_array_equal(told, line.covariance)
    assert told[0, 1] < 0 < told[1, 1]


@pytest.mark.parametrize(
    ("on", "state", "said"),
    [
        ("2026-11-24", "valid", "valid until 2027-05-24"),
        ("2027-04-24", "due", "in 30 days"),
        ("2027-05-24", "due", "in 0 days"),
        ("2027-05-25", "expired", "expired on 2027-05-24, 1 day ago"),
    ],
)
def test_expiry_is_told_by_the_day(on: str, state: str, said: str) -> None:
    line = calibrate(HEIGHTS, IS1_COLUMNS, measured_on="2026-11-24", expires_on="2027-05-24")
    found, sentence = line.standing(dt.date.fromisoformat(on))
    assert found == state
    assert said in sentence


def test_a_calibration_without_expiry_says_so() -> None:
    assert calibrate(HEIGHTS, IS1_COLUMNS).standing(dt.date(2026, 11, 24))[0] == "without expiry"


@pytest.mark.parametrize(
    ("measured", "expires", "said"),
    [
        ("24.11.2026", None, 'measured_on is "24.11.2026", not a date'),
        (None, "soon", 'expires_on is "soon", not a date'),
        ("2026-11-24", "2026-11-23", "expire on 2026-11-23, before it was measured"),
    ],
)
def test_dates_that_make_no_sense_are_refused(measured: str | None, expires: str | None, said: str) -> None:
    with pytest.raises(BadInput) as caught:
        calibrate(HEIGHTS, IS1_COLUMNS, measured_on=measured, expires_on=expires)
    assert said in str(caught.value)


def test_what_stretches_all_heights_adds_to_the_slopes_uncertainty() -> None:
    plain = calibrate(HEIGHTS, IS1_COLUMNS)
    line = calibrate(HEIGHTS, IS1_COLUMNS, u_scale_relative=0.02)
    assert line.u_slope_relative == pytest.approx(np.hypot(plain.u_slope_relative, 0.02))
    assert line.u_slope_mm_per_px == plain.u_slope_mm_per_px
    assert float(line.u_height_difference_um(500.0)) == pytest.approx(500 * line.u_slope_relative)
    again = Calibration.from_json(json.loads(json.dumps(line.to_json())))
    assert again == line
    assert again.sha256() != plain.sha256()
    with pytest.raises(BadInput, match="u_scale_relative"):
        calibrate(HEIGHTS, IS1_COLUMNS, u_scale_relative=float("nan"))


def _image(columns: list[float], line: Calibration | None) -> RangeImage:
    column = np.array([columns], dtype=np.float32)
    height = (column * 14).astype(np.float32) if line is None else line.height_um(column).astype(np.float32)
    provenance = {"calibration": {"mm_per_pixel": 0.014} if line is None else line.to_json()}
    return RangeImage(column, height, 7.15, 8.33, column, column, provenance=provenance)


def test_every_height_outside_the_gauge_is_flagged_in_the_image_and_its_file(tmp_path: Path) -> None:
    line = calibrate(HEIGHTS, IS1_COLUMNS)
    image = _image([5.0, 9.152, 30.0, 52.03, 52.1, np.nan], line)
    expected = [[True, False, False, False, True, False]]
    assert image.outside_calibrated is not None
    assert image.outside_calibrated.tolist() == expected
    image.save(tmp_path / "range.npz")
    with np.load(tmp_path / "range.npz") as stored:
        assert stored["outside_calibrated"].tolist() == expected
    again = RangeImage.load(tmp_path / "range.npz").outside_calibrated
    assert again is not None
    assert again.tolist() == expected
    assert precision_of(image).to_json()["outside_calibrated"] == {"count": 2, "share": 0.4}


def test_heights_without_a_gauge_have_no_range(tmp_path: Path) -> None:
    image = _image([5.0, 30.0], None)
    assert image.outside_calibrated is None
    image.save(tmp_path / "range.npz")
    with np.load(tmp_path / "range.npz") as stored:
        assert "outside_calibrated" not in stored.files
    assert precision_of(image).to_json()["outside_calibrated"] is None
