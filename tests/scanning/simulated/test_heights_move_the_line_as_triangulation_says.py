"""Geometry: eq. (1) and (2) of the paper, and response slopes of 1.00 +- 0.01 for true heights."""

from __future__ import annotations

import math

import numpy as np
import pytest

from scanning.rig.simulated.geometry import IS1, IS2, WORKING_HEIGHT_UM
from scanning.rig.simulated.render import Renderer
from scanning.rig.simulated.scenes import GAUGE_HEIGHTS_UM, Pose, Scene, scene
from scanning.rig.simulated.surface import Damage
from tests.scanning.simulated.looking import centroid, scan


def test_eq_2_gives_the_height_of_one_pixel() -> None:
    assert IS1.um_per_pixel == pytest.approx(14.30168, abs=5e-6)
    assert IS2.um_per_pixel == pytest.approx(20.0, abs=1e-12)
    assert IS1.row_pitch_um == pytest.approx(7.150838, abs=5e-7)


def test_one_scan_step_moves_the_surface_by_one_pixel() -> None:
    moved = IS1.column_px(WORKING_HEIGHT_UM, 256, 8.33) - IS1.column_px(WORKING_HEIGHT_UM, 256, 0.0)
    assert float(moved) == pytest.approx(1.008832, abs=2e-4)


@pytest.mark.parametrize("height_um", [-1200.0, -300.0, 100.0, 1200.0])
def test_the_column_of_a_height_solves_eq_1(height_um: float) -> None:
    """Eq. (1) with D -> 0 (reference on the axis), H = S sin b and C = M S, in millimetres."""
    d = (float(IS1.column_px(WORKING_HEIGHT_UM + height_um, 256)) - 127.5) * 3.2e-3
    tan_b = math.tan(math.radians(60))
    big_h, c = 162.0 * math.sin(math.radians(60)), 0.4475 * 162.0
    r_mm = big_h * (1 - (c * tan_b - d) / (tan_b * (c + d * tan_b)))
    assert r_mm * 1e3 == pytest.approx(height_um, abs=1e-6)


def test_the_step_gauge_comes_out_straight_with_its_own_slope() -> None:
    gauge = scene("gauge", decades=0.0)
    frames = scan(Renderer(gauge, rows=1000, columns=128), 24, step_um=25.0)
    truth = gauge.truth(rows=1000, steps=1, columns=128)
    measured = np.mean([centroid(frame, truth.column_px[:, 0]) for frame in frames], axis=0)
    treads = [slice(125 * i + 6, 125 * i + 119) for i in range(8)]
    column = np.array([measured[t].mean() for t in treads])
    heights = np.array([0.0, *GAUGE_HEIGHTS_UM])
    slope, _ = np.polyfit(column, heights, 1)
    assert slope == pytest.approx(14.30168, rel=0.01)
    assert np.abs(column - [truth.column_px[t, 0].mean() for t in treads]).max() < 0.06


@pytest.mark.parametrize("shift_px", [0.25, 0.5, 1.0])
def test_lifting_the_plate_moves_the_line_by_the_true_shift(shift_px: float) -> None:
    def middle(lift_um: float) -> float:
        base = scene("flat", seed=4)
        lifted = Scene(
            "flat", base.seed, base.system, base.shape, base.reflectivity, Pose(height_um=WORKING_HEIGHT_UM + lift_um)
        )
        return float(np.mean([centroid(f, 31.5) for f in scan(Renderer(lifted, rows=200, columns=64), 20, 30.0)]))

    assert middle(shift_px * 14.30168) - middle(0.0) == pytest.approx(shift_px, rel=0.01)


def test_a_tilted_plate_and_a_damage_are_measured_with_slope_one() -> None:
    pit = Damage("dent", s_um=500.0, length_um=800.0, reach_um=500.0, depth_um=150.0, y_um=700.0)
    knife = scene("R1", seed=6, decades=0.0, stray="none", damages=(pit,), tilt_across_deg=0.8)
    frames = scan(Renderer(knife, rows=240, columns=96), 120)
    truth = knife.truth(rows=240, steps=120, columns=96)
    rows = slice(30, 240)
    measured = np.stack([centroid(frames[i, rows], truth.column_px[rows, i]) for i in range(120)], axis=1)
    height = (measured - 47.5) * 14.30168 + WORKING_HEIGHT_UM
    true = truth.height_um[rows].astype(np.float64)
    slope = np.polyfit((true - true.mean()).ravel(), height.ravel(), 1)[0]
    assert slope == pytest.approx(1.0, abs=0.01)
    assert abs(float((height - true).mean())) < 0.5
    assert 6.5 < float((height - true).std()) < 9.0


def test_thermal_drift_of_the_stand_off_is_an_error_and_not_part_of_the_truth() -> None:
    still, drifting = scene("flat", seed=5), scene("flat", seed=5, thermal_um_per_mm=20.0)
    assert np.array_equal(still.truth(rows=4, steps=4).height_um, drifting.truth(rows=4, steps=4).height_um)
    far = 2000.0
    moved = np.mean(centroid(Renderer(drifting, rows=200, columns=64).irradiance(far), 31.5)) - np.mean(
        centroid(Renderer(still, rows=200, columns=64).irradiance(far), 31.5)
    )
    assert moved * 14.30168 == pytest.approx(40.0, rel=0.1)
