"""Sigma and kappa come out as they went in, also beside damage and under form."""

from __future__ import annotations

import numpy as np
import pytest

from scanning.surface.noise import local_noise, measure_noise
from tests.scanning.surface.surfaces import STEPS, WHITE, correlated_noise


def everything(shape):
    return np.ones(shape, dtype=bool)


def test_white_noise_has_kappa_one():
    noise = correlated_noise((500, 400), 4.2, np.random.default_rng(1), rows=WHITE).astype(np.float32)
    measured = measure_noise(noise, everything(noise.shape), 7.15, 8.33)
    assert measured.sigma_um == pytest.approx(4.2, rel=0.02)
    assert measured.kappa == pytest.approx(1.0, abs=0.1)


def test_row_correlation_of_speckle_gives_kappa_two():
    """1 + 2 (0.43 + 0.07) = 2.0: block SCI in measuring.md 1.3."""
    noise = correlated_noise((600, 241), 4.2, np.random.default_rng(2)).astype(np.float32)
    measured = measure_noise(noise, everything(noise.shape), 7.15, 41.65)
    assert measured.kappa == pytest.approx(2.0, abs=0.15)
    assert measured.along_rows[1:3] == pytest.approx((0.43, 0.07), abs=0.02)


def test_single_exposures_give_kappa_three_and_a_half():
    """2.0 along rows times 1 + 2 (0.64 + 0.03 - 0.28) = 1.78 along steps: 3.56, measuring.md says about 3.5."""
    noise = correlated_noise((600, 400), 7.6, np.random.default_rng(3), profiles=STEPS).astype(np.float32)
    measured = measure_noise(noise, everything(noise.shape), 7.15, 8.33)
    assert measured.kappa == pytest.approx(3.5, rel=0.15)
    for lag in (1, 2, 3):
        counted = np.corrcoef(noise[:, lag:].ravel(), noise[:, :-lag].ravel())[0, 1]
        assert measured.along_profiles[lag] == pytest.approx(counted, abs=0.02)


def test_sliding_average_is_seen_to_reach_further():
    rng = np.random.default_rng(4)
    noise = correlated_noise((600, 400), 4.2, rng, profiles=STEPS, sliding=5).astype(np.float32)
    measured = measure_noise(noise, everything(noise.shape), 7.15, 8.33)
    # White-noise density is kept by averaging: 3.56 x (7.6 / 4.6)^2.
    assert 7.5 < measured.kappa < 10.5


def test_kappa_predicts_how_the_mean_of_a_block_scatters():
    noise = correlated_noise((1000, 800), 5.0, np.random.default_rng(5), profiles=STEPS).astype(np.float32)
    measured = measure_noise(noise, everything(noise.shape), 7.15, 8.33)
    means = noise.reshape(25, 40, 20, 40).mean(axis=(1, 3))
    assert means.std() == pytest.approx(measured.sigma_um * np.sqrt(measured.kappa / 1600), rel=0.12)


def test_waviness_is_told_from_noise():
    noise = correlated_noise((800, 400), 2.0, np.random.default_rng(6))
    wave = 3.0 * np.sin(2 * np.pi * np.arange(800) * 7.15 / 3000.0)[:, None]
    measured = measure_noise((noise + wave).astype(np.float32), everything((800, 400)), 7.15, 8.33)
    # 1.4826 MAD of a sine of amplitude 3.
    assert measured.shape_um == pytest.approx(1.4826 * 3.0 * np.sin(np.pi / 4), rel=0.1)
    flat = measure_noise(noise.astype(np.float32), everything((800, 400)), 7.15, 8.33)
    assert flat.shape_um < 0.2


def test_local_noise_does_not_see_a_tilt():
    noise = correlated_noise((400, 300), 3.0, np.random.default_rng(7))
    tilted = noise + np.arange(400)[:, None] * 2.0
    assert local_noise(tilted.astype(np.float32), 7.15, 8.33) == pytest.approx(3.0, rel=0.03)
