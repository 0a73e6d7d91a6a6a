"""The edge is found at the right end, chips are measured and the recession tells what no volume can."""

from __future__ import annotations

import numpy as np
import pytest

from scanning.surface import InspectionSettings, inspect_surface
from tests.scanning.surface.surfaces import WHITE, Chip, knife, range_image, surface

R2 = (Chip(420.0, 300.0, 180.0, 60.0), Chip(1100.0, 500.0, 220.0, 110.0), Chip(1700.0, 150.0, 90.0, 30.0))
R3 = (Chip(1000.0, 1300.0, 420.0, 260.0),)


@pytest.mark.parametrize("side", ["first", "last"])
def test_two_medium_and_one_minor_chip(side):
    report = inspect_surface(knife(chips=R2, side=side))
    assert report.edge is not None
    assert report.edge.side == side
    assert [one.severity for one in report.damages] == ["medium", "medium", "minor"]
    for found, chip in zip(report.damages, R2, strict=True):
        assert found.touches_edge
        assert found.volume_mm3 == pytest.approx(chip.volume_mm3, rel=0.12)
        assert found.depth_um == pytest.approx(chip.depth_um, abs=5.0)
        assert found.s_centroid_mm == pytest.approx(chip.profile_um / 1e3, abs=0.03)
        assert found.length_mm == pytest.approx(chip.length_um / 1e3, abs=0.05)
        assert found.edge_recession_um == pytest.approx(chip.reach_um, abs=15.0)


def test_a_chip_longer_than_half_of_the_region_is_not_taken_for_the_edge():
    report = inspect_surface(knife(chips=R3))
    (found,) = report.damages
    assert found.severity == "large"
    assert found.volume_mm3 == pytest.approx(R3[0].volume_mm3, rel=0.02)
    assert report.measurement("ER_max").value == pytest.approx(420.0, abs=8.0)


def test_block_averaged_profiles_five_times_wider():
    chips = (Chip(4000.0, 1300.0, 420.0, 260.0), Chip(7000.0, 500.0, 200.0, 110.0))
    image = knife(chips=chips, pitches_um=(7.15, 41.65), profiles=WHITE, sliding=1, seed=2)
    report = inspect_surface(image)
    assert [one.severity for one in report.damages] == ["large", "medium"]
    assert report.measurement("V-").value == pytest.approx(sum(chip.volume_mm3 for chip in chips), rel=0.03)
    assert report.measurement("cov").value == pytest.approx(100 * 1.8 / 10.04, abs=1.5)


def test_a_sharp_edge_has_no_recession():
    report = inspect_surface(knife())
    assert report.measurement("ER_max").value < 8.0
    assert abs(report.measurement("ER_mean").value) < 1.0
    assert report.measurement("EL").value < 15.0


def test_uniform_recession_shows_only_against_a_baseline():
    worn, new = knife(recession_um=40.0, seed=3), knife(seed=4)
    alone = inspect_surface(worn).measurement("ER_mean")
    assert abs(alone.value) < 1.0
    assert "uniform wear does not show" in alone.source
    against = inspect_surface(worn, baseline=new).measurement("ER_mean")
    assert against.value == pytest.approx(40.0, abs=3.0)


def test_material_gone_without_a_trace_is_remarked_on_and_counts_as_recession():
    image = knife()
    height = image.height_um.copy()
    height[890:, 100:140] = np.nan
    report = inspect_surface(range_image(height))
    assert report.damages == []
    assert report.measurement("ER_max").value == pytest.approx((931.6 - 890) * 7.15, abs=20.0)
    assert any("nothing was measured over" in warning for warning in report.warnings)


def test_a_plate_has_no_edge_and_says_nothing_about_one():
    report = inspect_surface(surface())
    assert report.edge is None
    assert report.edge_um is None
    with pytest.raises(KeyError):
        report.measurement("ER_mean")


def test_an_edge_asked_for_where_none_is_gets_a_sentence():
    report = inspect_surface(surface(), settings=InspectionSettings(edge_side="last"))
    assert report.edge is None
    assert any("No edge was found" in warning for warning in report.warnings)


def test_an_edge_along_the_laser_line_is_measured_by_turning_the_axes():
    image = knife(chips=R2)
    turned = range_image(np.ascontiguousarray(image.height_um.T), (8.33, 7.15))
    straight = inspect_surface(image)
    report = inspect_surface(turned, settings=InspectionSettings(edge_axis=0))
    assert report.residual_um.shape == turned.height_um.shape
    # Not bit for bit: what the tilted camera cannot have seen is judged along the scan only.
    volumes = [one.volume_mm3 for one in straight.damages]
    assert [one.volume_mm3 for one in report.damages] == pytest.approx(volumes, rel=0.01)
    for found in report.damages:
        rows, profiles = slice(*found.rows), slice(*found.profiles)
        assert np.count_nonzero(report.damage_labels[rows, profiles] == found.number) == found.pixels


@pytest.mark.parametrize("side", ["first", "last"])
def test_unsteady_heights_at_the_very_brink_are_wear_and_not_damage(side):
    nicks = tuple(Chip(200.0 + 300.0 * k, 120.0, 45.0, 40.0) for k in range(6))
    report = inspect_surface(knife(chips=nicks, side=side, seed=3))
    assert report.damages == []
    assert report.measurement("ER_max").value > 20.0, "what is no damage still counts as recession"


def test_a_chip_that_reaches_into_the_bevel_is_kept_whole():
    chip = Chip(900.0, 150.0, 110.0, 42.0)
    (found,) = inspect_surface(knife(chips=(chip,), seed=3)).damages
    assert found.severity == "minor"
    assert found.volume_mm3 == pytest.approx(chip.volume_mm3, rel=0.15)
