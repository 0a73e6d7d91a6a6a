"""Where a range image is noisier than elsewhere, and how much: one threshold for all of it would be wrong.

Dark stretches return few photons, and where the surface turns from dark to bright the line is pulled to the bright
side. A threshold for the calm middle of the bevel calls such places damaged (on a simulated sound bevel: most false
damages lay in a dark patch or on its rim); one high enough for them would miss small pits everywhere else. Both
follow from the light that came back, which is stored with every height, so the image itself tells how much they matter.
"""

from __future__ import annotations

import itertools

import cv2
import numpy as np
from scipy import ndimage

from scanning.surface.filters import Float32, Float64, Mask, sigma_px, smooth
from scanning.surface.noise import robust_sigma

MOST = 3.0
"""No place counts as more than this many times noisier than the whole."""
REACH_UM = 25.0
"""How far beside a change of the light its error is still found."""
SHARES = (0.0, 0.003, 0.01, 0.03, 0.1, 0.25, 0.5, 0.75, 0.9, 0.97, 0.99, 0.997, 1.0)
"""Places are sorted by their light (and by how fast it changes) into groups with these shares of all as bounds."""
LEAST_IN_GROUP = 100
HALF_NORMAL_MIDDLE, HALF_NORMAL_TAIL = 0.6745, 1.960
"""Of one side of a normal distribution: its median and its 95th percentile, in standard deviations."""
CHANCE = 1.2
"""Ratios below this are what correlated pixels scatter by chance."""


def by_light(lost_um: Float32, light: Float32, sound: Mask, row_pitch_um: float, profile_pitch_um: float) -> Float32:
    """Noise over that of the whole image, 1 to 3, from how much light came back and how fast it changes.

    ``lost_um`` (rows, profiles) is the smoothed residual, positive where material may be missing; ``light`` the line's
    intensity. Each group of pixels of similar light is judged by its heights on the other side only: on those no
    missing material lies, so a dark pit does not excuse itself. All 1 where no light was stored.
    """
    ones = np.ones(lost_um.shape, dtype=np.float32)
    lit = sound & np.isfinite(light) & (light > 0)
    if np.count_nonzero(lit) < 20 * LEAST_IN_GROUP:
        return ones
    scale = sigma_px(15.0, row_pitch_um, profile_pitch_um)
    level = smooth(np.log(np.where(lit, light, np.float32(1.0))).astype(np.float32), lit, scale).value
    rows, profiles = np.gradient(level, row_pitch_um, profile_pitch_um)
    # The profiles averaged and the smoothing carry an error this far from where the light changes.
    reach = tuple(2 * max(1, round(REACH_UM / pitch)) + 1 for pitch in (row_pitch_um, profile_pitch_um))
    change = np.hypot(rows, profiles).astype(np.float32)
    change = np.where(lit, change, np.float32(0.0))
    change = cv2.dilate(change, np.ones(reach, np.uint8))
    usable = lit & np.isfinite(level) & np.isfinite(change)
    overall = _other_side(lost_um[usable])
    if not overall > 0:
        return ones
    middle = float(np.median(level[usable]))
    excess = ones.copy() - 1.0
    for measure, start in ((level, middle), (change, 0.0)):
        excess += np.square(_by(measure, start, lost_um, usable, overall)) - 1.0
    ratio = np.sqrt(1.0 + excess)
    return np.where(usable, np.clip(ratio, 1.0, MOST), np.float32(1.0)).astype(np.float32)


def _by(measure: Float32 | Float64, start: float, lost_um: Float32, usable: Mask, overall: float) -> Float64:
    """The ratio at every pixel, growing away from ``start`` to both sides."""
    values = measure[usable].astype(np.float64)
    lost = lost_um[usable]
    bounds = np.unique(np.quantile(values, SHARES))
    at, ratios = [], []
    for low, high in itertools.pairwise(bounds):
        group = (values >= low) & (values <= high)
        here = _other_side(lost[group]) / overall if np.count_nonzero(group) >= LEAST_IN_GROUP else np.nan
        at.append(float(np.median(values[group])) if group.any() else 0.5 * (low + high))
        ratios.append(here if here > CHANCE else (1.0 if here <= CHANCE else np.nan))
    place, ratio = np.array(at), np.array(ratios)
    # Too few pixels to say: as the nearest group towards the middle.
    for step, order in ((1, range(len(ratios))), (-1, range(len(ratios) - 1, -1, -1))):
        last = 1.0
        for i in order:
            if (place[i] >= start) == (step > 0):
                ratio[i] = last = max(last, ratio[i]) if np.isfinite(ratio[i]) else last
    if place.size == 0:
        return np.ones(measure.shape)
    return np.interp(np.nan_to_num(measure, nan=start), place, ratio)


def _other_side(lost_um: Float32) -> float:
    """Standard deviation from the heights on the side where nothing is missing; heavy tails count."""
    raised = -lost_um[lost_um < 0]
    if raised.size < LEAST_IN_GROUP // 2:
        return float("nan")
    middle, tail = np.percentile(raised, (50.0, 95.0))
    return float(max(middle / HALF_NORMAL_MIDDLE, tail / HALF_NORMAL_TAIL))


def by_place(residual_um: Float32, smoothed_um: Float32, sound: Mask) -> Float32:
    """Noise of each neighbourhood over the noise of the whole image, between 1 and 3.

    Oxidised or rough stretches return a noisier line. What is left after smoothing is used, so a pit does not count as
    noise, and never less than 1: a quiet corner earns no extra alarms.
    """
    rough = np.where(sound, residual_um - smoothed_um, np.float32(np.nan))
    overall = robust_sigma(rough[sound])
    shape = residual_um.shape
    size = tuple(max(8, min(32, length // 4)) for length in shape)
    count = tuple(max(1, length // step) for length, step in zip(shape, size, strict=True))
    if not overall > 0 or count[0] * count[1] < 9:
        return np.ones(shape, dtype=np.float32)
    inner = rough[: count[0] * size[0], : count[1] * size[1]]
    blocks = np.abs(inner.reshape(count[0], size[0], count[1], size[1]).transpose(0, 2, 1, 3))
    blocks = np.sort(blocks.reshape(count[0] * count[1], -1), axis=1)
    measured = np.count_nonzero(np.isfinite(blocks), axis=1)
    median = np.take_along_axis(blocks, np.maximum(measured - 1, 0)[:, None] // 2, axis=1)[:, 0]
    ratio = np.where(measured >= 30, 1.4826 * median / overall, 1.0).reshape(count)
    ratio = np.clip(ndimage.median_filter(ratio, size=3, mode="nearest"), 1.0, 3.0).astype(np.float32)
    # A fifth above average is what 1000 correlated pixels scatter by chance.
    ratio[ratio < 1.2] = 1.0
    return np.asarray(cv2.resize(ratio, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR), dtype=np.float32)
