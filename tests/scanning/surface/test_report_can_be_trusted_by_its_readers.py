"""What pages, exports and the command line rely on: strict JSON, units, origins, one clear sentence on bad input."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from scanning.errors import BadInput
from scanning.surface import InspectionSettings, inspect_surface
from tests.scanning.surface.surfaces import Chip, knife, range_image, surface


@pytest.fixture(scope="module")
def report():
    return inspect_surface(knife(chips=(Chip(420.0, 300.0, 180.0, 60.0), Chip(1500.0, 500.0, 220.0, 110.0))))


def test_it_is_strict_json(report):
    text = json.dumps(report.to_json(), allow_nan=False)
    assert json.loads(text)["damages"][1]["severity"] == "medium"


def test_every_number_has_unit_origin_and_fits_its_record(report):
    for one in report.measurements:
        assert one.unit in {"um", "mm", "mm2", "mm3", "%", "1"}
        assert one.source.endswith(".")
        assert len(one.code) <= 30
        assert len(one.label) <= 80
        assert len(one.source) <= 300
        assert one.value is None or np.isfinite(one.value)
        assert one.u is None or one.u >= 0.0


def test_region_codes_are_unique_and_complete(report):
    codes = [one.code for one in report.measurements if one.scope == "region"]
    assert len(codes) == len(set(codes))
    expected = {"V-", "V+", "A", "d_max", "d_99", "d_mean", "n", "n_10mm", "cov", "L_max", "ER_mean", "ER_max"}
    expected |= {"ER_p95", "ER_rms", "EL", "Sa", "Sq", "Sz", "Sp", "Sv", "Ssk", "Sku", "Sdq", "Sdr", "Sq_c"}
    assert expected | {"q_undef", "sigma"} <= set(codes)


def test_the_mask_runs_draw_the_damage_again(report):
    for found in report.damages:
        mask = np.zeros(report.residual_um.shape, dtype=bool)
        for row, first, length in found.mask_runs:
            mask[row, first : first + length] = True
        assert np.array_equal(mask, report.damage_labels == found.number)
        assert mask.sum() == found.pixels


def test_positions_count_from_the_datum():
    image = knife(chips=(Chip(1000.0, 300.0, 180.0, 60.0),))
    (found,) = inspect_surface(image, settings=InspectionSettings(start_mm=40.0)).damages
    assert found.s_centroid_mm == pytest.approx(41.0, abs=0.02)
    assert found.s_end_mm - found.s_start_mm == pytest.approx(found.length_mm)


def test_a_calibration_in_the_provenance_is_used():
    recorded = {"calibration": {"slope_mm_per_px": 0.0142, "u_slope_mm_per_px": 0.000225}}
    image = dataclasses.replace(surface(), provenance=recorded)
    assert "1.6 % from the calibration" in inspect_surface(image).measurement("V-").source


def test_infinities_are_missing_points():
    height = surface().height_um.copy()
    height[::7, ::5] = np.inf
    assert inspect_surface(range_image(height)).damages == []


@pytest.mark.parametrize(
    ("height", "sentence"),
    [
        (np.full((50, 50), np.nan), "No pixel of the range image was measured"),
        (np.zeros((5, 5)), "at least 8 rows and 8 profiles"),
        (np.zeros(50), "has shape"),
    ],
)
def test_it_refuses_what_cannot_be_measured(height, sentence):
    with pytest.raises(BadInput, match=sentence):
        inspect_surface(range_image(height))


def test_it_refuses_a_pitch_that_is_no_length():
    with pytest.raises(BadInput, match="profile_pitch_um"):
        inspect_surface(range_image(np.zeros((50, 50)), (7.15, 0.0)))


@pytest.mark.parametrize("wrong", [{"edge_axis": 2}, {"edge_side": "left"}, {"seed_k": 0.0}, {"form": "cubic"}])
def test_it_refuses_settings_without_meaning(wrong):
    with pytest.raises(BadInput):
        InspectionSettings(**wrong)
