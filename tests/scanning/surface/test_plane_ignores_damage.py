"""The reference plane is that of the sound surface, whatever else is in the image."""

from __future__ import annotations

import numpy as np
import pytest

from scanning.errors import BadInput
from scanning.surface.plane import fit_plane, least_squares_plane
from tests.scanning.surface.surfaces import Pit, range_image, surface

PITCHES = (7.15, 8.33)


def test_it_equals_least_squares_on_a_plane_without_outliers():
    """On Gaussian noise the two estimators differ only by Tukey's 5 % of efficiency."""
    image = surface((300, 200), sigma_um=2.0)
    robust = fit_plane(image.height_um, *PITCHES).coefficients
    ordinary = least_squares_plane(image.height_um, *PITCHES)
    assert robust == pytest.approx(ordinary, abs=0.05)


def test_least_squares_equals_numpy_on_the_bare_design_matrix():
    image = surface((80, 60), sigma_um=3.0, missing=0.1)
    row, profile = np.nonzero(np.isfinite(image.height_um))
    y, x = (row - 79 / 2) * 7.15e-3, (profile - 59 / 2) * 8.33e-3
    design = np.stack([np.ones(row.size), y, x], axis=1)
    expected = np.linalg.lstsq(design, image.height_um[row, profile].astype(float), rcond=None)[0]
    assert least_squares_plane(image.height_um, *PITCHES) == pytest.approx(expected, rel=1e-9)


def test_it_finds_the_slopes_it_was_given():
    plane = fit_plane(surface(sigma_um=4.2, tilt_um_per_mm=(31.0, -17.0)).height_um, *PITCHES)
    assert plane.slope_rows_um_per_mm == pytest.approx(31.0, abs=0.1)
    assert plane.slope_profiles_um_per_mm == pytest.approx(-17.0, abs=0.1)


@pytest.mark.parametrize("share", [0.1, 0.3, 0.4])
def test_it_does_not_follow_a_large_pit(share):
    side = float(np.sqrt(share * 300 * 7.15 * 300 * 8.33))
    image = surface((300, 300), pits=(Pit("box", 1000.0, 1300.0, side, 120.0),), tilt_um_per_mm=(0.0, 0.0))
    plane = fit_plane(image.height_um, *PITCHES)
    assert plane.height_um() == pytest.approx(250.0, abs=0.6)
    assert plane.inlier_fraction == pytest.approx(1.0 - share, abs=0.03)


def test_it_starts_from_ransac_when_least_squares_is_captured():
    height = surface((200, 200), sigma_um=2.0, tilt_um_per_mm=(0.0, 0.0)).height_um.copy()
    height[:, :85] -= np.linspace(200, 900, 85, dtype=np.float32)
    plane = fit_plane(height, *PITCHES)
    assert abs(plane.slope_profiles_um_per_mm) < 1.0
    assert plane.inlier_fraction == pytest.approx(115 / 200, abs=0.05)


def test_it_refuses_when_less_than_half_agrees():
    height = surface((200, 200), sigma_um=2.0).height_um.copy()
    height[:, 0:70] -= 150
    height[:, 70:135] += 300
    with pytest.raises(BadInput, match="% of the measured pixels lie within"):
        fit_plane(height, *PITCHES)


def test_it_refuses_almost_nothing_measured():
    height = np.full((100, 100), np.nan, dtype=np.float32)
    height[:10, :10] = 5.0
    with pytest.raises(BadInput, match="Only 100 of 10000 pixels"):
        fit_plane(height, *PITCHES)


def test_a_bowl_needs_the_quadratic_form():
    row = np.linspace(-1.0, 1.0, 300)[:, None]
    image = range_image(surface((300, 200), sigma_um=1.0).height_um - 40.0 * row**2)
    plane = fit_plane(image.height_um, *PITCHES)
    bowl = fit_plane(image.height_um, *PITCHES, form="quadratic")
    assert plane.sigma_um > 5.0
    assert bowl.sigma_um == pytest.approx(1.0, rel=0.05)
