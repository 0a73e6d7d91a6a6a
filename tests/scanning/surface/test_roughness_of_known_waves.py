"""ISO 25178-2 parameters against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from scanning.surface import InspectionSettings, inspect_surface
from scanning.surface.roughness import parameters, scale_limited
from tests.scanning.surface.surfaces import range_image, surface


def sine(amplitude=5.0, period_um=250.0, shape=(1000, 400), pitch=2.0):
    row = np.arange(shape[0])[:, None] * pitch
    return (amplitude * np.sin(2 * np.pi * row / period_um) + np.zeros(shape)).astype(np.float32)


def test_a_sine():
    """Sa = 2A/pi, Sq = A/sqrt 2, Sz = 2A, Ssk = 0, Sku = 3/2, Sdq = 2 pi A / (period sqrt 2)."""
    found = parameters(sine(), 2.0, 2.0)
    assert found.Sa == pytest.approx(10.0 / math.pi, rel=1e-4)
    assert found.Sq == pytest.approx(5.0 / math.sqrt(2.0), rel=1e-4)
    assert found.Sz == pytest.approx(10.0, rel=1e-3)
    assert found.Ssk == pytest.approx(0.0, abs=1e-4)
    assert found.Sku == pytest.approx(1.5, rel=1e-4)
    slope = 2 * math.pi * 5.0 / 250.0
    assert found.Sdq == pytest.approx(slope / math.sqrt(2.0), rel=1e-3)
    # Small slopes: the developed area is half of the mean squared slope, minus an eighth of the mean fourth power.
    assert found.Sdr == pytest.approx(100 * (slope**2 / 4 - 3 * slope**4 / 64), rel=2e-3)


def test_a_gaussian_surface():
    z = np.random.default_rng(2).normal(0.0, 3.0, (1000, 1000)).astype(np.float32)
    found = parameters(z, 1.0, 1.0)
    assert found.Sa == pytest.approx(3.0 * math.sqrt(2.0 / math.pi), rel=5e-3)
    assert found.Sq == pytest.approx(3.0, rel=5e-3)
    assert found.Ssk == pytest.approx(0.0, abs=0.02)
    assert found.Sku == pytest.approx(3.0, abs=0.03)


def test_a_tilted_plane_develops_by_its_slope():
    z = (np.arange(50)[:, None] * 0.3 + np.arange(40)[None, :] * 0.4).astype(np.float32)
    found = parameters(z, 1.0, 1.0)
    assert found.Sdr == pytest.approx(100 * (math.sqrt(1.25) - 1), rel=1e-4)
    assert found.Sdq == pytest.approx(0.5, rel=1e-4)


def test_the_filters_pass_half_at_their_nesting_index():
    """ISO 16610-61: the transmission at the nesting index is 50 %."""
    z = sine(period_um=200.0, shape=(2000, 200))
    everything = np.ones(z.shape, dtype=bool)
    low = scale_limited(z, everything, 2.0, 2.0, 200.0, 0.0)[500:1500]
    high = scale_limited(z, everything, 2.0, 2.0, 0.0, 200.0)[500:1500]
    assert np.abs(low).max() == pytest.approx(2.5, rel=0.01)
    assert np.abs(high).max() == pytest.approx(2.5, rel=0.01)


def test_undefined_pixels_do_not_change_the_heights():
    z = sine()
    holed = z.copy()
    holed[np.random.default_rng(1).random(z.shape) < 0.1] = np.nan
    assert parameters(holed, 2.0, 2.0).Sq == pytest.approx(parameters(z, 2.0, 2.0).Sq, rel=0.01)


def test_damage_is_left_out():
    height = surface((400, 300), sigma_um=2.0, tilt_um_per_mm=(0.0, 0.0)).height_um
    dented = height.copy()
    dented[150:250, 100:200] -= 80.0
    clean, damaged = (inspect_surface(range_image(one)).measurement("Sq").value for one in (height, dented))
    assert damaged == pytest.approx(clean, rel=0.03)


def test_a_ground_bevel_under_speckle_is_called_not_resolvable():
    image = surface(sigma_um=4.2)
    unknown = inspect_surface(image).measurement("Sq_c")
    assert unknown.value is None
    assert "displaced repeat" in unknown.source
    sq = inspect_surface(image).measurement("Sq").value
    known = inspect_surface(image, settings=InspectionSettings(instrument_noise_um=sq)).measurement("Sq_c")
    assert known.value is None
    assert "Not resolvable" in known.source


def test_a_rough_surface_is_freed_of_the_noise_in_quadrature():
    wave = 20.0 * np.sin(2 * np.pi * np.arange(400) * 7.15 / 130.0)[:, None]
    image = range_image(surface((400, 300), sigma_um=4.0).height_um + wave)
    settings = InspectionSettings(instrument_noise_um=3.0)
    report = inspect_surface(image, settings=settings)
    sq, corrected = report.measurement("Sq"), report.measurement("Sq_c")
    assert corrected.value == pytest.approx(math.sqrt(sq.value**2 - 9.0))
    assert corrected.u >= sq.u
