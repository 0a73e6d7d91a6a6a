"""Frames of a laser line whose place is known, for the tests of the pipeline."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[Any]


def line(centre: Float, columns: int, fwhm_px: float, height: float | Float) -> Float:
    """(rows, columns) light of a Gaussian line at ``centre`` (rows,)."""
    away = np.arange(columns)[None, :] - centre[:, None]
    shape = np.exp(-4.0 * np.log(2.0) * (away / fwhm_px) ** 2)
    return np.asarray(np.atleast_1d(height)[:, None] * shape)


def speckle(light: Float, rng: np.random.Generator, grain_px: float = 1.7) -> Float:
    """Light as coherent light shows it: grains of fully developed speckle of about ``grain_px``."""
    fields = rng.normal(size=(2, *light.shape))
    frequency = np.add.outer(np.fft.fftfreq(light.shape[0]) ** 2, np.fft.fftfreq(light.shape[1]) ** 2)
    pupil = np.sqrt(frequency) <= 0.5 / grain_px
    amplitude = np.fft.ifft2(np.fft.fft2(fields[0] + 1j * fields[1]) * pupil)
    grains = np.abs(amplitude) ** 2
    return np.asarray(light * grains / grains.mean())


def shot(light: Float, rng: np.random.Generator, dark: float = 2.0, noise: float = 1.0) -> NDArray[np.uint8]:
    """An 8 bit camera's picture of it: shot noise (20 electrons per code), read noise, dark level, saturation."""
    codes = rng.poisson(light * 20.0) / 20.0 + dark + rng.normal(0.0, noise, light.shape)
    return np.clip(np.rint(codes), 0, 255).astype(np.uint8)
