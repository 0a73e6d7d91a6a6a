"""How noisy a range image is, and how far that noise reaches from pixel to pixel.

Speckle noise is not white: neighbouring rows correlate by about 0.43, neighbouring steps by 0.64, and sliding SCI adds
its own five-step memory. A volume is a sum over thousands of pixels, so treating them as independent would print an
uncertainty two to five times too small. ``kappa``, the sum of the noise autocorrelation over both directions, is that
factor (in variance), and it is measured from the very image it is used on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft

from scanning.surface.filters import Float32, Float64, Mask, sigma_px, smooth

MAD_TO_SIGMA = 1.4826

#: How far the noise is followed. Speckle ends after three steps (25 um), sliding SCI after eight (67 um).
REACH_ROWS_UM = 45.0
REACH_PROFILES_UM = 70.0

#: Waves longer than this are shape, not noise, and are taken out before correlations are measured.
SHAPE_SIGMA_UM = 200.0


@dataclass(frozen=True)
class Noise:
    """``sigma_um`` is the robust standard deviation of single pixels about the reference, shape included.

    ``kappa`` is the sum of the two-dimensional autocorrelation (1 for white noise). ``along_rows`` and
    ``along_profiles`` hold the correlations at lags 0, 1, 2 ... in pixels. ``shape_um`` is the standard deviation of
    what remains when the noise is averaged away (0.4 mm blocks): waviness and form the plane does not take up.
    """

    sigma_um: float
    kappa: float
    along_rows: tuple[float, ...]
    along_profiles: tuple[float, ...]
    shape_um: float


def robust_sigma(values: Float32 | Float64) -> float:
    """Return 1.4826 times the median absolute deviation, NaN for an empty array."""
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return float("nan")
    return float(MAD_TO_SIGMA * np.median(np.abs(finite - np.median(finite))))


def local_noise(height_um: Float32, row_pitch_um: float, profile_pitch_um: float) -> float:
    """Pixel noise from differences over about 60 um, which a tilt or a bow hardly enters.

    Needs no reference plane, so it can judge one. Differences are taken in both directions and the smaller figure is
    used: roughness with a lay raises only one of them.
    """
    figures = []
    for axis, pitch in ((0, row_pitch_um), (1, profile_pitch_um)):
        lag = max(2, round(60.0 / pitch))
        if height_um.shape[axis] > 2 * lag:
            near, far = (height_um[lag:], height_um[:-lag]) if axis == 0 else (height_um[:, lag:], height_um[:, :-lag])
            difference = near - far
            if np.count_nonzero(np.isfinite(difference)) >= 100:
                figures.append(robust_sigma(difference) / np.sqrt(2.0))
    return float(min(figures)) if figures else robust_sigma(height_um)


def autocorrelation(residual_um: Float32, valid: Mask, reach_px: tuple[int, int]) -> Float64:
    """Masked autocorrelation for lags 0..reach along rows and -reach..reach along profiles.

    Shape (reach_rows + 1, 2 reach_profiles + 1), lag zero at [0, reach_profiles], equal to 1. Each lag is normalised
    by the number of pairs that were measured. Cost: three FFTs of the padded image.
    """
    reach_rows, reach_profiles = reach_px
    shape = (
        fft.next_fast_len(residual_um.shape[0] + reach_rows + 1, real=True),
        fft.next_fast_len(residual_um.shape[1] + reach_profiles + 1, real=True),
    )
    weight = fft.rfft2(valid.astype(np.float32), shape)
    signal = fft.rfft2(np.where(valid, residual_um, np.float32(0.0)), shape)
    pairs = fft.irfft2(np.abs(weight) ** 2, shape)
    product = fft.irfft2(np.abs(signal) ** 2, shape)
    lags_rows = np.arange(reach_rows + 1)
    lags_profiles = np.arange(-reach_profiles, reach_profiles + 1) % shape[1]
    pairs = pairs[np.ix_(lags_rows, lags_profiles)].astype(np.float64)
    product = product[np.ix_(lags_rows, lags_profiles)].astype(np.float64)
    covariance = np.where(pairs > 50, product / np.maximum(pairs, 1.0), 0.0)
    variance = covariance[0, reach_profiles]
    return covariance / variance if variance > 0 else np.zeros_like(covariance)


def measure_noise(residual_um: Float32, sound: Mask, row_pitch_um: float, profile_pitch_um: float) -> Noise:
    """Describe the noise of the undamaged pixels ``sound`` of a residual image (rows, profiles) in um."""
    sigma = robust_sigma(residual_um[sound])
    if not np.isfinite(sigma) or sigma == 0.0:
        return Noise(0.0 if sigma == 0.0 else sigma, 1.0, (1.0,), (1.0,), 0.0)
    # Half a million pixels settle kappa to a per cent; more only cost time.
    rows = slice(0, min(residual_um.shape[0], 1024))
    profiles = slice(0, max(min(residual_um.shape[1], 500_000 // (rows.stop or 1)), 1))
    patch, mask = residual_um[rows, profiles], sound[rows, profiles]
    if np.count_nonzero(mask) < 200:
        patch, mask = residual_um, sound
    span_um = min(patch.shape[0] * row_pitch_um, patch.shape[1] * profile_pitch_um)
    shape_sigma_um = max(SHAPE_SIGMA_UM, 12.0 * max(row_pitch_um, profile_pitch_um))
    if span_um > 3 * shape_sigma_um:
        patch = patch - smooth(patch, mask, sigma_px(shape_sigma_um, row_pitch_um, profile_pitch_um)).value
    limit = np.float32(5.0 * sigma)
    patch = np.clip(np.nan_to_num(patch, nan=0.0), -limit, limit).astype(np.float32)
    patch = patch - np.float32(patch[mask].mean(dtype=np.float64))
    reach = (
        min(max(2, round(REACH_ROWS_UM / row_pitch_um)), 16, patch.shape[0] // 4),
        min(max(2, round(REACH_PROFILES_UM / profile_pitch_um)), 24, patch.shape[1] // 4),
    )
    rho = autocorrelation(patch, mask, reach)
    # A lag whose correlation cannot be told from chance (2 / sqrt n) would only add its own scatter, and there are
    # hundreds: on a small image their sum would be anything. Lags along negative rows mirror those along positive.
    certain = np.where(np.abs(rho) > 2.0 / np.sqrt(np.count_nonzero(mask)), rho, 0.0)
    kappa = max(1.0, float(certain[0].sum() + 2.0 * certain[1:].sum()))
    shape_um = _shape(residual_um, sound, row_pitch_um, profile_pitch_um, sigma**2 * kappa)
    return Noise(
        sigma_um=sigma,
        kappa=kappa,
        along_rows=tuple(float(value) for value in rho[:, reach[1]]),
        along_profiles=tuple(float(value) for value in rho[0, reach[1] :]),
        shape_um=shape_um,
    )


def _shape(residual_um: Float32, sound: Mask, row_pitch_um: float, profile_pitch_um: float, density: float) -> float:
    """Standard deviation of 0.4 mm block means beyond what noise of variance ``density`` / pixels explains."""
    block_rows = max(2, min(round(400.0 / row_pitch_um), residual_um.shape[0] // 4))
    block_profiles = max(2, min(round(400.0 / profile_pitch_um), residual_um.shape[1] // 4))
    rows = residual_um.shape[0] // block_rows * block_rows
    profiles = residual_um.shape[1] // block_profiles * block_profiles
    if rows == 0 or profiles == 0:
        return 0.0
    split = (rows // block_rows, block_rows, profiles // block_profiles, block_profiles)
    weight = sound[:rows, :profiles].reshape(split).sum(axis=(1, 3))
    total = np.where(sound, residual_um, 0.0)[:rows, :profiles].astype(np.float64).reshape(split).sum(axis=(1, 3))
    full = weight > 0.5 * block_rows * block_profiles
    if np.count_nonzero(full) < 6:
        return 0.0
    means = total[full] / weight[full]
    # A plane was fitted: three degrees of freedom are gone.
    degrees = means.size / (means.size - 3)
    variance = robust_sigma(means) ** 2 * degrees
    return float(np.sqrt(max(0.0, variance - density * float(np.mean(1.0 / weight[full])))))
