"""Before its noise, an instrument shows its response: a line moved by x px is reported moved by x px.

A window that does not move with the line, or a threshold that favours the brightest grain, gives small noise by not
following the line. So the slope against true shifts comes first, on coherent speckle, and the noise after it.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from scanning.recipe import Recipe
from tests.scanning.pipeline.agreement import Steps, header_for, product
from tests.scanning.pipeline.scenes import shot

FINER = 4
COLUMNS, ROWS, STEPS = 128, 160, 10
PLACE = 60.0
UM_PER_PX = 14.2
GRAIN_PX, FWHM_PX = 1.67, 3.03  # f/5.6 on the paper's IS1; 25 um line


@pytest.fixture(scope="module")
def light() -> NDArray[np.float64]:
    """(steps, rows x 4, columns x 4): a line on a rough surface that moves one pixel per step under it."""
    rng = np.random.default_rng(4)
    rows, columns = ROWS * FINER, COLUMNS * FINER
    surface = np.exp(2j * np.pi * rng.random((rows, columns + FINER * STEPS)))
    x = (np.arange(columns) + 0.5) / FINER - 0.5
    amplitude = np.sqrt(np.exp(-4.0 * np.log(2.0) * ((x - PLACE) / FWHM_PX) ** 2))
    frequency = np.fft.fftfreq(rows, 1 / FINER)[:, None] ** 2 + np.fft.fftfreq(columns, 1 / FINER)[None, :] ** 2
    pupil = np.sqrt(frequency) <= 0.5 / GRAIN_PX
    steps = np.empty((STEPS, rows, columns))
    for s in range(STEPS):
        seen = surface[:, FINER * (STEPS - s) : FINER * (STEPS - s) + columns]
        steps[s] = np.abs(np.fft.ifft2(np.fft.fft2(seen * amplitude) * pupil)) ** 2
    return np.asarray(steps / steps.mean(axis=(0, 1)).max())


def recorded(light: NDArray[np.float64], shift: int, gains: tuple[float, ...]) -> Steps:
    moved = np.roll(light, shift, axis=2).reshape(STEPS, ROWS, FINER, COLUMNS, FINER).mean(axis=(2, 4))
    rng = np.random.default_rng(100 + shift)
    return [[shot(step * gain, rng) for gain in gains] for step in moved]


@pytest.mark.parametrize(
    ("name", "gains", "tolerance", "noise_um"),
    [
        ("NF", (60.0,), 0.03, 9.5),
        ("SCI", (60.0,), 0.03, 5.8),
        ("HDRE-I", (40.0, 120.0, 360.0), 0.05, 6.5),
        ("HDRE-II", (40.0, 120.0, 360.0), 0.05, 6.5),
    ],
)
def test_response_first_then_noise(
    light: NDArray[np.float64], name: str, gains: tuple[float, ...], tolerance: float, noise_um: float
) -> None:
    times = tuple(g / gains[0] * 100.0 for g in gains)
    recipe = Recipe.named(name)
    if recipe.compound is not None:
        recipe = recipe.with_settings({"sci.mode": "sliding"})
    found = {}
    for shift in (0, 2, 4):
        steps = recorded(light, shift, gains)
        found[shift] = product(steps, header_for(steps, times, width=FWHM_PX), recipe)
    error = found[0] - PLACE
    assert np.isfinite(error).mean() > 0.99
    assert np.mean(np.abs(error) > 4.0) < 0.001
    for shift in (2, 4):
        moved = (found[shift] - found[0])[np.isfinite(found[shift] + found[0])]
        assert moved.mean() / (shift / FINER) == pytest.approx(1.0, abs=tolerance)
    assert abs(np.nanmean(error)) < 0.05
    assert np.nanstd(error) * UM_PER_PX < noise_um


def test_a_peak_to_the_letter_is_a_grain_and_fails_the_response(light: NDArray[np.float64]) -> None:
    literal = Recipe.named("NF").with_settings({"msnn.reading": "literal"})
    found = {}
    for shift in (0, 2):
        steps = recorded(light, shift, (60.0,))
        found[shift] = product(steps, header_for(steps, width=FWHM_PX), literal)
    slope = np.nanmean(found[2] - found[0]) / 0.5
    assert slope < 0.95
    assert np.nanstd(found[0] - PLACE) * UM_PER_PX > 10.0
