"""Laying a baseline scan of the new tool under today's scan.

Against its own baseline a bevel needs no assumption of flatness, and grinding marks, waviness and marks that were
there from the start drop out. The price is alignment: a smooth straight edge says nothing about the position along
itself, so a shift is believed only when the surface texture proves it, and the report says which of the two it was.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft, ndimage

from scanning.errors import BadInput
from scanning.surface.filters import Float32, Mask, sigma_px, smooth

#: The best correlation peak must exceed the next one by this factor to be believed.
PEAK_RATIO = 1.3
#: And it must be this strong itself: below, the common texture is drowned in noise.
LEAST_CORRELATION = 0.08
#: Furthest shift looked for.
SEARCH_UM = 300.0


@dataclass(frozen=True)
class Registration:
    """Where the baseline had to be moved: shifts in um (today's position minus the baseline's).

    ``accepted`` is False when the texture did not prove a shift; then zero was used. ``correlation`` is the height of
    the peak, ``peak_ratio`` its lead over the next one, ``overlap_share`` the share of measured pixels that found a
    partner, ``rms_um`` the robust standard deviation of the difference.
    """

    shift_rows_um: float
    shift_profiles_um: float
    accepted: bool
    correlation: float
    peak_ratio: float
    overlap_share: float
    rms_um: float


def resample(
    height_um: Float32,
    pitches_um: tuple[float, float],
    shape: tuple[int, int],
    target_pitches_um: tuple[float, float],
    shift_um: tuple[float, float] = (0.0, 0.0),
) -> Float32:
    """Read ``height_um`` at the pixels of another grid, moved by ``shift_um`` (rows, profiles); NaN outside.

    Linear interpolation over measured neighbours; a pixel with less than half of its weight measured is NaN.
    """
    same = np.allclose(pitches_um, target_pitches_um, rtol=1e-9) and shift_um == (0.0, 0.0)
    if same:
        out = np.full(shape, np.nan, dtype=np.float32)
        rows, profiles = min(shape[0], height_um.shape[0]), min(shape[1], height_um.shape[1])
        out[:rows, :profiles] = height_um[:rows, :profiles]
        return out
    row = (np.arange(shape[0]) * target_pitches_um[0] - shift_um[0]) / pitches_um[0]
    profile = (np.arange(shape[1]) * target_pitches_um[1] - shift_um[1]) / pitches_um[1]
    where = np.meshgrid(row, profile, indexing="ij")
    measured = np.isfinite(height_um)
    filled = np.where(measured, height_um, np.float32(0.0)).astype(np.float32)
    weight = ndimage.map_coordinates(measured.astype(np.float32), where, order=1, mode="constant", cval=0.0)
    value = ndimage.map_coordinates(filled, where, order=1, mode="constant", cval=0.0)
    return np.where(weight >= 0.5, value / np.maximum(weight, 1e-6), np.nan).astype(np.float32)


def find_shift(
    image_um: Float32, baseline_um: Float32, sound: Mask, row_pitch_um: float, profile_pitch_um: float
) -> tuple[float, float, float, float, bool]:
    """Shift of the baseline that best explains the texture of ``image_um``, both residuals on one grid.

    Masked normalised cross-correlation of the band 20-300 um. Returns (rows um, profiles um, correlation, peak
    ratio, accepted).
    """
    fine, coarse = sigma_px(10.0, row_pitch_um, profile_pitch_um), sigma_px(100.0, row_pitch_um, profile_pitch_um)
    weights: list[Float32] = []
    pictures: list[Float32] = []
    for residual in (image_um, baseline_um):
        measured = np.isfinite(residual) & sound
        if np.count_nonzero(measured) < 500:
            return 0.0, 0.0, 0.0, 0.0, False
        band = smooth(residual, measured, fine).value - smooth(residual, measured, coarse).value
        limit = 4.0 * float(np.median(np.abs(band[measured]))) * 1.4826
        if limit <= 0.0:
            return 0.0, 0.0, 0.0, 0.0, False
        window = np.hanning(residual.shape[0] + 2)[1:-1, None] * np.hanning(residual.shape[1] + 2)[None, 1:-1]
        weights.append((measured * window).astype(np.float32))
        pictures.append(np.where(measured, np.clip(band, -limit, limit), 0.0).astype(np.float32))
    reach = (
        min(round(SEARCH_UM / row_pitch_um), image_um.shape[0] // 4),
        min(round(SEARCH_UM / profile_pitch_um), image_um.shape[1] // 4),
    )
    shape = (
        fft.next_fast_len(image_um.shape[0] + reach[0] + 1, real=True),
        fft.next_fast_len(image_um.shape[1] + reach[1] + 1, real=True),
    )

    def correlate(one: Float32, other: Float32) -> Float32:
        product = fft.irfft2(fft.rfft2(one, shape) * np.conj(fft.rfft2(other, shape)), shape)
        rows = np.arange(-reach[0], reach[0] + 1) % shape[0]
        profiles = np.arange(-reach[1], reach[1] + 1) % shape[1]
        return np.asarray(product[np.ix_(rows, profiles)], dtype=np.float32)

    energy = np.sqrt(
        np.maximum(correlate(weights[0] * pictures[0] ** 2, weights[1]), 1e-12)
        * np.maximum(correlate(weights[0], weights[1] * pictures[1] ** 2), 1e-12)
    )
    score = correlate(weights[0] * pictures[0], weights[1] * pictures[1]) / np.maximum(
        energy, float(energy.max()) * 0.05
    )
    peak = np.unravel_index(int(np.argmax(score)), score.shape)
    best = float(score[peak])
    apart = (max(2, round(30.0 / row_pitch_um)), max(2, round(30.0 / profile_pitch_um)))
    others = score.copy()
    others[
        max(0, peak[0] - apart[0]) : peak[0] + apart[0] + 1, max(0, peak[1] - apart[1]) : peak[1] + apart[1] + 1
    ] = -1.0
    second = max(float(others.max()), 1e-6)
    row, profile = (
        _parabola(score[:, peak[1]], int(peak[0])) - reach[0],
        _parabola(score[peak[0]], int(peak[1])) - reach[1],
    )
    accepted = best >= LEAST_CORRELATION and best / second >= PEAK_RATIO
    return row * row_pitch_um, profile * profile_pitch_um, best, best / second, accepted


def _parabola(values: Float32, index: int) -> float:
    if not 0 < index < values.size - 1:
        return float(index)
    before, at, after = (float(value) for value in values[index - 1 : index + 2])
    bend = before - 2.0 * at + after
    return index + (0.5 * (before - after) / bend if bend < 0 else 0.0)


def check_comparable(image_shape: tuple[int, int], baseline_shape: tuple[int, int], ratio: float) -> None:
    """Refuse a baseline that shares less than a quarter of the region with today's scan."""
    if ratio < 0.25:
        raise BadInput(
            f"The baseline ({baseline_shape[0]} x {baseline_shape[1]} pixels) covers only {100 * ratio:.0f} % of the "
            f"measured part of this range image ({image_shape[0]} x {image_shape[1]} pixels); "
            "choose the baseline of the same region."
        )
