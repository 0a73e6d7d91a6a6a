"""No damage where there is none: correlated noise, wrong peaks, dropouts, dark stripes, waviness."""

from __future__ import annotations

import numpy as np
import pytest

from scanning.surface import inspect_surface
from tests.scanning.surface.surfaces import STEPS, correlated_noise, knife, range_image, surface


@pytest.mark.parametrize(
    ("shape", "pitches", "options"),
    [
        ((1000, 241), (7.15, 41.65), {}),
        ((1000, 241), (7.15, 8.33), {"profiles": STEPS, "sliding": 5}),
        ((1000, 241), (7.15, 8.33), {"profiles": STEPS, "sigma_um": 7.6, "missing": 0.2}),
        ((60, 40), (7.15, 8.33), {}),
        ((300, 300), (50.0, 100.0), {"sigma_um": 20.0}),
        ((400, 241), (7.15, 8.33), {"sigma_um": 0.5}),
    ],
    ids=["block", "sliding", "single exposure, a fifth missing", "small", "coarse", "quiet"],
)
def test_correlated_noise_alone(shape, pitches, options):
    for seed in range(4):
        report = inspect_surface(surface(shape, pitches, seed=seed, **options))
        assert report.damages == []
        assert report.edge is None


def test_isolated_wrong_peaks_and_runs_of_them():
    rng = np.random.default_rng(3)
    height = surface((600, 241)).height_um.copy()
    wrong = rng.random(height.shape) < 0.03
    height[wrong] += rng.uniform(-500, 500, int(wrong.sum()))
    for _ in range(40):
        row, profile = rng.integers(0, 580), rng.integers(0, 241)
        height[row : row + rng.integers(2, 14), profile] += rng.uniform(-500, 500)
    report = inspect_surface(range_image(height))
    assert report.damages == []
    assert any("wild pixels" in warning for warning in report.warnings)


def test_one_profile_that_jumped():
    height = surface((600, 241)).height_um.copy()
    height[:, 100] -= 60
    assert inspect_surface(range_image(height)).damages == []


def test_a_dark_stretch_with_three_times_the_noise():
    noise = correlated_noise((600, 241), 4.0, np.random.default_rng(8))
    noise[:200] *= 3.0
    assert inspect_surface(range_image(noise)).damages == []


def test_a_dropout_is_not_a_damage():
    height = surface((600, 241)).height_um.copy()
    height[200:260, 80:130] = np.nan
    assert inspect_surface(range_image(height)).damages == []


def test_waviness_is_remarked_on_and_not_called_damage():
    wave = 5.0 * np.sin(2 * np.pi * np.arange(600) * 7.15 / 1500.0)[:, None]
    report = inspect_surface(range_image(surface((600, 241)).height_um + wave))
    assert report.damages == []
    assert any("not flat" in warning for warning in report.warnings)


def test_a_sharp_edge_with_stray_heights_beyond_it():
    for seed in range(3):
        assert inspect_surface(knife(seed=seed, stray=0.05)).damages == []


def test_an_edge_rounded_along_its_whole_length_is_wear_and_not_damage():
    report = inspect_surface(knife(rounding_um=60.0))
    assert report.damages == []
    assert 15.0 < report.measurement("l_r").value < 70.0


def test_heights_without_any_sense_are_doubted():
    rng = np.random.default_rng(1)
    report = inspect_surface(range_image(rng.uniform(0, 2000, (200, 200))))
    assert any("wrong peaks" in warning for warning in report.warnings)


def test_a_gap_deeper_than_the_camera_can_look_into_is_a_reflection():
    """The camera sees the floor of a slot only when it is 0.58 times as wide as deep (60 degrees)."""
    height = surface((600, 241)).height_um.copy()
    height[300:400, 100:104] -= 700.0
    height[300:400, 150:153] -= 1100.0
    report = inspect_surface(range_image(height))
    assert report.damages == []


def test_a_flat_floor_far_down_is_doubted():
    height = surface((600, 241)).height_um.copy()
    height[300:400, 100:180] -= 700.0
    report = inspect_surface(range_image(height))
    assert len(report.damages) == 1
    assert any("without slopes" in warning for warning in report.warnings)


def test_stray_light_beyond_the_edge_dense_enough_to_look_measured():
    image = knife()
    height = image.height_um.copy()
    beyond = np.isnan(height)
    beyond[:920] = False
    beyond[960:] = False
    height[beyond] = 250.0 + np.random.default_rng(2).normal(0.0, 120.0, int(beyond.sum()))
    report = inspect_surface(range_image(height))
    assert report.damages == []
    assert report.edge is not None
    assert report.edge.reference_row[120] == pytest.approx(932.0, abs=3.0)
