"""Smoothing that knows which pixels were measured.

An ordinary Gaussian spreads one undefined pixel over its whole kernel and treats the border as a cliff. Here every
pixel carries weight 1 or 0, so holes and borders only make the result noisier, and by how much is returned with it:
without that figure the strip beside every hole would look like damage at any sensible threshold.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Gaussian standard deviation per ISO nesting index: the weighting function of ISO 16610-61 passes half of the
#: amplitude at the nesting index, alpha = sqrt(ln 2 / pi), sigma = alpha * index / sqrt(2 pi).
ISO_SIGMA_PER_INDEX = math.sqrt(math.log(2.0) / math.pi) / math.sqrt(2.0 * math.pi)

#: Kernel half length in standard deviations; the tail left out is 6e-5 of the weight.
KERNEL_REACH = 4.0

EIGHT = np.ones((3, 3), dtype=np.uint8)


@dataclass(frozen=True)
class Smoothed:
    """A smoothed image with what it rests on.

    ``value`` is defined wherever any measured pixel lies under the kernel (else NaN). ``density`` is the share of the
    kernel's weight that was measured, 1 in the open field. ``spread`` is the factor by which the noise there exceeds
    the noise in the open field: sqrt(sum w^2) / sum w, normalised.
    """

    value: Float32
    density: Float32
    spread: Float32


def gaussian_kernel(sigma_px: float) -> Float32:
    """Return a 1-D Gaussian of odd length and unit sum; a sigma far below one pixel gives the identity."""
    reach = max(0, math.ceil(KERNEL_REACH * sigma_px - 0.5)) if sigma_px > 0.15 else 0
    offset = np.arange(-reach, reach + 1, dtype=np.float64)
    weights = np.exp(-0.5 * (offset / max(sigma_px, 1e-6)) ** 2)
    return np.asarray(weights / weights.sum(), dtype=np.float32)


def _separable(image: Float32, kernel_rows: Float32, kernel_profiles: Float32) -> Float32:
    filtered = cv2.sepFilter2D(image, cv2.CV_32F, kernel_profiles, kernel_rows, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(filtered, dtype=np.float32)


def smooth(values: Float32, valid: Mask, sigma_px: tuple[float, float]) -> Smoothed:
    """Gaussian mean over the measured pixels: sum(w m z) / sum(w m).

    ``values`` (rows, profiles) may hold anything where ``valid`` is False. ``sigma_px`` is (along rows, along
    profiles) in pixels. Cost: six 1-D passes, linear in pixels and kernel length.
    """
    kernel_rows, kernel_profiles = gaussian_kernel(sigma_px[0]), gaussian_kernel(sigma_px[1])
    weight = valid.astype(np.float32)
    filled = np.where(valid, values, np.float32(0.0)).astype(np.float32)
    total = _separable(filled, kernel_rows, kernel_profiles)
    density = _separable(weight, kernel_rows, kernel_profiles)
    squares = _separable(weight, kernel_rows**2, kernel_profiles**2)
    open_field = float(np.sum(kernel_rows**2, dtype=np.float64) * np.sum(kernel_profiles**2, dtype=np.float64))
    seen = density > 1e-4
    safe = np.where(seen, density, np.float32(1.0))
    value = np.where(seen, total / safe, np.float32(np.nan)).astype(np.float32)
    # Where nothing was seen the value is NaN already; a finite spread keeps arithmetic on the image quiet.
    spread = np.where(seen, np.sqrt(np.maximum(squares, 0.0) / open_field) / safe, np.float32(1e3))
    return Smoothed(value=value, density=density, spread=np.maximum(spread, 1.0).astype(np.float32))


def sigma_px(sigma_um: float, row_pitch_um: float, profile_pitch_um: float) -> tuple[float, float]:
    """Convert a kernel width in micrometres to pixels along rows and along profiles."""
    return sigma_um / row_pitch_um, sigma_um / profile_pitch_um


def ellipse(reach_um: float, row_pitch_um: float, profile_pitch_um: float) -> NDArray[np.uint8]:
    """Structuring element of all pixels whose centre lies within ``reach_um`` of its own, one pixel at least."""
    half_rows, half_profiles = max(reach_um, row_pitch_um), max(reach_um, profile_pitch_um)
    rows = np.arange(-int(half_rows / row_pitch_um), int(half_rows / row_pitch_um) + 1) * row_pitch_um / half_rows
    reach = int(half_profiles / profile_pitch_um)
    profiles = np.arange(-reach, reach + 1) * profile_pitch_um / half_profiles
    return np.asarray(rows[:, None] ** 2 + profiles[None, :] ** 2 <= 1.0 + 1e-9, dtype=np.uint8)


def dilate(mask: Mask, reach_um: float, row_pitch_um: float, profile_pitch_um: float) -> Mask:
    """Grow a mask by a distance in micrometres (and one pixel at least), whatever the pitches.

    The pixel next to a wall is partly wall: with a pitch wider than the distance it would be left out.
    """
    element = ellipse(reach_um, row_pitch_um, profile_pitch_um)
    return np.asarray(cv2.dilate(mask.astype(np.uint8), element, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0)


def label(mask: Mask) -> tuple[NDArray[np.int32], int]:
    """Number the 8-connected components of a mask from 1; 0 is background."""
    count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8, ltype=cv2.CV_32S)
    return np.asarray(labels, dtype=np.int32), int(count) - 1


def hysteresis(seed: Mask, grow: Mask) -> Mask:
    """Keep those 8-connected components of ``grow`` that contain at least one pixel of ``seed``."""
    labels, count = label(grow)
    if not count:
        return np.zeros_like(grow)
    kept = np.zeros(count + 1, dtype=bool)
    kept[np.unique(labels[seed & grow])] = True
    kept[0] = False
    return kept[labels]


def wild_pixels(
    residual_um: Float32, valid: Mask, *, noise_um: float, row_pitch_um: float, profile_pitch_um: float
) -> Mask:
    """Find isolated wrong heights: a wrong peak taken in one row, or one profile that jumped.

    A pixel is wild when it stands more than 6 noise standard deviations off the median of its 5 x 5 surroundings and
    at most one of its eight neighbours agrees with it; with two, when the group it belongs to is smaller than
    anything the optics can resolve (25 um, the width of the laser line, in one direction, or 4 pixels in all). The
    corner of a real pit has three agreeing neighbours and stays; a one-profile groove is not measurable and goes.
    Neighbourhoods of which a quarter disagrees are wild as a whole.
    """
    tolerance = np.float32(6.0 * noise_um)
    around = smooth(residual_um, valid, (1.5, 1.5)).value
    filled = np.where(valid, residual_um, np.nan_to_num(around, nan=0.0)).astype(np.float32)
    median = cv2.medianBlur(filled, 5)
    candidate = valid & (np.abs(filled - median) > tolerance)
    if not candidate.any():
        return np.asarray(candidate)
    # Stray light beyond an edge is answered by dense wrong heights: where a quarter of a neighbourhood disagrees
    # with its own median, none of it is a surface.
    measured = cv2.blur(valid.astype(np.float32), (9, 9))
    disagreeing = cv2.blur(candidate.astype(np.float32), (9, 9))
    chaos = valid & (disagreeing > 0.25 * measured)
    rows, profiles = np.nonzero(candidate)
    padded = np.pad(np.where(valid, residual_um, np.float32(np.nan)), 1, constant_values=np.nan)
    own = residual_um[rows, profiles]
    agreeing = np.zeros(rows.size, dtype=np.int64)
    for step_row in (-1, 0, 1):
        for step_profile in (-1, 0, 1):
            if step_row or step_profile:
                other = padded[rows + 1 + step_row, profiles + 1 + step_profile]
                agreeing += np.abs(other - own) <= tolerance
    lonely = np.zeros_like(candidate)
    lonely[rows[agreeing == 2], profiles[agreeing == 2]] = True
    wild = chaos
    wild[rows[agreeing < 2], profiles[agreeing < 2]] = True
    labels, _ = label(lonely)
    for number, place in enumerate(ndimage.find_objects(labels), start=1):
        group = labels[place] == number
        height_um = group.shape[0] * row_pitch_um
        width_um = group.shape[1] * profile_pitch_um
        if np.count_nonzero(group) <= 4 or min(height_um, width_um) <= 25.0:
            wild[place] |= group
    return np.asarray(wild)


def too_narrow_to_see(
    residual_um: Float32, valid: Mask, *, noise_um: float, profile_pitch_um: float, aspect: float
) -> Mask:
    """Find depths no camera could have seen: runs of profiles narrower than ``aspect`` times their depth.

    The camera looks down at 60 degrees: the floor of a slot is hidden unless the slot is at least 0.58 times as wide
    (along the scan) as it is deep. A narrower run, with the surface or nothing on both sides, is a reflection taken
    for the line. Runs that reach the border of the image are left alone. Works row by row; returns a mask.
    """
    deep = valid & (residual_um < -max(10.0 * noise_um, 30.0))
    hidden = np.zeros_like(valid)
    if not deep.any():
        return hidden
    padded = np.pad(deep.astype(np.int8), ((0, 0), (1, 1)))
    change = np.diff(padded, axis=1)
    rows, starts = np.nonzero(change == 1)
    _, ends = np.nonzero(change == -1)
    order = np.lexsort((starts, rows))
    rows, starts, ends = rows[order], starts[order], ends[order]
    flat = np.where(deep, -residual_um, np.float32(0.0)).ravel()
    width = residual_um.shape[1]
    # reduceat over [start, end) pairs; every second result is the gap between two runs.
    bounds = np.stack([rows * width + starts, rows * width + ends], axis=1).ravel()
    depth = np.add.reduceat(np.append(flat, np.float32(0.0)), bounds)[::2] / (ends - starts)
    narrow = ((ends - starts) * profile_pitch_um < aspect * depth) & (starts > 0) & (ends < width)
    for row, start, end in zip(rows[narrow], starts[narrow], ends[narrow], strict=True):
        hidden[row, start:end] = True
    return hidden
