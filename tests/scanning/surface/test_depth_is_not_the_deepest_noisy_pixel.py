"""Depth is read from the smoothed surface and freed of the excess every maximum of noise has."""

from __future__ import annotations

import numpy as np
import pytest

from scanning.surface import inspect_surface
from tests.scanning.surface.surfaces import Pit, surface


def test_a_flat_floor_is_reported_at_its_depth():
    errors, raw, inside = [], [], []
    for seed in range(8):
        image = surface((300, 240), pits=(Pit("box", 1072.0, 1000.0, 700.0, 60.0),), seed=seed)
        report = inspect_surface(image)
        (found,) = report.damages
        errors.append(found.depth_um - 60.0)
        raw.append(-np.nanmin(report.residual_um) - 60.0)
        inside.append(abs(errors[-1]) < 2.0 * found.u_depth_um)
    assert np.mean(raw) > 12.0
    assert abs(np.mean(errors)) < 1.5
    assert np.mean(inside) >= 0.85


@pytest.mark.parametrize("size_um", [160.0, 250.0, 400.0])
def test_what_smoothing_fills_in_of_a_rounded_pit_is_given_back(size_um: float) -> None:
    errors, inside = [], []
    for seed in range(6):
        pit = Pit("cap", 1072.0, 1000.0, size_um, 40.0)
        (found,) = inspect_surface(surface((300, 240), pits=(pit,), sigma_um=2.3, seed=seed)).damages
        errors.append(found.depth_um - 40.0)
        inside.append(abs(errors[-1]) < 2.0 * found.u_depth_um)
    assert abs(np.mean(errors)) < 0.06 * 40.0
    assert np.mean(inside) >= 0.8


def test_the_noise_alone_has_no_depth():
    report = inspect_surface(surface((500, 241), (7.15, 41.65)))
    assert report.measurement("d_max").value == 0.0


def test_the_ninety_ninth_percentile_lies_below_the_largest():
    report = inspect_surface(surface(pits=(Pit("cone", 1400.0, 1200.0, 500.0, 100.0),)))
    (found,) = report.damages
    assert 60.0 < found.d99_um < 100.0
    assert found.mean_depth_um == pytest.approx(100.0 / 3.0, rel=0.35)


def test_scale_uncertainty_dominates_deep_damage():
    """measuring.md 2.4: at 500 um the slope of IS1 (1.58 %) contributes 7.9 um."""

    class Line:
        slope_mm_per_px = 0.014237376
        u_slope_mm_per_px = 0.0002251273

    image = surface(pits=(Pit("box", 1400.0, 1200.0, 400.0, 500.0),))
    (found,) = inspect_surface(image, calibration=Line()).damages
    assert found.u_depth_um == pytest.approx(np.hypot(7.9, 2.0), rel=0.1)
    report = inspect_surface(image)
    assert report.damages[0].u_depth_um < 3.0
    assert "no calibration with an uncertainty" in report.measurement("d_max").source
