"""Against a scan of the new tool, form and texture drop out; a shift is believed only when texture proves it."""

from __future__ import annotations

import numpy as np
import pytest

from scanning.errors import BadInput
from scanning.surface import inspect_surface
from tests.scanning.surface.surfaces import Pit, correlated_noise, range_image, surface

PIT = Pit("cap", 2000.0, 1000.0, 300.0, 20.0)


def scan(seed, *, shift_px=0, pits=(), texture_um=2.0, tilt=(12.0, -7.0)):
    """A bevel hollow by 30 um with grinding texture fixed to the tool, seen under fresh noise and tilt."""
    rng = np.random.default_rng(3)
    lay = correlated_noise((600, 260), 1.0, rng, rows=(1, 0.8, 0.5, 0.2), profiles=(1, 0.8, 0.5, 0.2))
    plate = surface((600, 241), seed=seed, pits=pits, sigma_um=2.0, tilt_um_per_mm=tilt).height_um
    hollow = 30.0 * np.linspace(-1.0, 1.0, 600)[:, None] ** 2
    return range_image(plate + texture_um * lay[:, 10 - shift_px : 251 - shift_px] - hollow)


def test_the_shift_along_the_edge_is_found_and_taken_out():
    report = inspect_surface(scan(1, shift_px=3, pits=(PIT,)), baseline=scan(2, tilt=(2.0, 5.0)))
    assert report.registration is not None
    assert report.registration.accepted
    assert report.registration.shift_profiles_um == pytest.approx(3 * 8.33, abs=2.0)
    assert report.registration.shift_rows_um == pytest.approx(0.0, abs=2.0)
    (found,) = report.damages
    assert found.volume_mm3 == pytest.approx(PIT.volume_mm3, rel=0.05)


def test_a_bevel_without_texture_is_not_shifted_and_the_report_says_so():
    report = inspect_surface(scan(1, pits=(PIT,), texture_um=0.0), baseline=scan(2, texture_um=0.0))
    assert report.registration is not None
    assert not report.registration.accepted
    assert report.registration.shift_profiles_um == 0.0
    assert any("stage position only" in warning for warning in report.warnings)
    (found,) = report.damages
    assert found.volume_mm3 == pytest.approx(PIT.volume_mm3, rel=0.05)


def test_damage_that_was_there_from_the_start_is_not_counted_again():
    report = inspect_surface(scan(1, pits=(PIT,)), baseline=scan(2, pits=(PIT,)))
    assert report.damages == []


def test_a_baseline_with_another_pitch_is_resampled():
    image = surface((400, 300), pits=(Pit("cap", 1400.0, 1200.0, 300.0, 40.0),))
    report = inspect_surface(image, baseline=surface((400, 60), (7.15, 41.65), seed=5))
    (found,) = report.damages
    assert found.volume_mm3 == pytest.approx(Pit("cap", 0, 0, 300.0, 40.0).volume_mm3, rel=0.06)


def test_a_baseline_of_another_region_is_refused():
    with pytest.raises(BadInput, match="covers only"):
        inspect_surface(surface((400, 300)), baseline=surface((60, 60), seed=5))
