"""What a stack did not say about itself: the level off the line, the width of the line, the exposure worth reading.

Frames recorded by others often come without them. A guessed dark level of 0 would lift the whole background through
GLT, and a guessed width would refuse the true line; so both are taken from the first frames, and the result says so.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanning.pipeline.centroid import centre_of_gravity
from scanning.pipeline.grey import DARK_UNIT
from scanning.pipeline.line import half_width, lowest_code_above, row_light, row_maxima, row_peaks
from scanning.pipeline.smoothing import WORD

PIXELS_LOOKED_AT = 1 << 16
FEWEST_ROWS = 8
GRAIN_PX = 3.0
INT64_TOP = (1 << 62) - 1
Image = NDArray[np.uint8] | NDArray[np.uint16]


def half_sample_mode(values: NDArray[np.generic]) -> float:
    """The value most samples crowd around: the densest half, of it the densest half, and so on (Robertson-Cryer).

    Unlike the mean and the median it does not move when part of the samples are something else altogether.
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64))
    while ordered.size > 2:
        half = (ordered.size + 1) // 2
        spans = ordered[half - 1 :] - ordered[: ordered.size - half + 1]
        narrowest = np.flatnonzero(spans == spans.min())
        start = int(narrowest[narrowest.size // 2])
        ordered = ordered[start : start + half]
        if ordered[0] == ordered[-1]:
            break
    return float(ordered.mean())


def dark_level(images: Sequence[Image], saturation: int) -> float:
    """Grey level off the line: the most crowded level of the unsaturated pixels of these images of one exposure.

    Where a lamp lights the scene this is the lit background, and subtracting it is what is wanted. There the most
    crowded level of a long exposure can be the camera's soft top; the median is lower then, and is taken.
    """
    every = max(1, sum(image.size for image in images) // PIXELS_LOOKED_AT)
    pixels = np.concatenate([image.ravel()[::every] for image in images])
    pixels = pixels[pixels < saturation]
    return min(half_sample_mode(pixels), float(np.median(pixels))) if pixels.size else 0.0


def line_width_px(
    images: Sequence[Image], saturation: int, dark: float, k: float, floor: float, ceiling: float
) -> float | None:
    """Full width at half maximum of the mean line, px; None when too few rows show one.

    The highest peaks of all rows are laid on each other by their centres and averaged: the width of a single row is
    that of its brightest speckle grain. Only rows whose peak reaches a quarter of the bright ones count, so that noise
    in dark rows has no say.
    """
    heights: list[float] = []
    seen: list[tuple[NDArray[np.float64], float, int]] = []
    level = round(dark * DARK_UNIT)
    for image in images:
        rows, columns = image.shape
        highest = np.empty(rows, image.dtype)
        row_maxima(image, highest)
        maxima = np.maximum(np.minimum(highest.astype(np.int64), saturation) * DARK_UNIT - level, 0)
        light = np.empty(rows, np.int64)
        row_light(image, saturation, DARK_UNIT, level, light)
        asked = k * float(light.sum()) / image.size
        if ceiling > 0:
            asked = min(asked, ceiling * float(maxima.mean()))
        most = columns // 2 + 1
        lit = np.zeros(-(-columns // WORD), np.uint64)
        base, shape, height = np.empty((most, 2), np.int64), np.empty((most, 2)), np.empty(most, np.int64)
        for r in range(rows):
            background = float(light[r]) / columns
            threshold = max(asked, background + floor * (float(maxima[r]) - background))
            lowest = lowest_code_above(threshold, DARK_UNIT, level)
            if min(int(highest[r]), saturation) < lowest:
                continue
            found = row_peaks(image[r], lowest, 0.0, GRAIN_PX, saturation, DARK_UNIT, level, lit, base, shape, height)
            best = int(np.argmax(height[:found]))
            heights.append(float(height[best]))
            first, last = int(base[best, 0]), int(base[best, 1])
            centre = centre_of_gravity(image[r], first, last, saturation, DARK_UNIT, level)
            lit = np.maximum(np.minimum(image[r].astype(np.float64), saturation) - dark, 0.0)
            seen.append((lit, float(centre), last - first + 1))
    if len(heights) < FEWEST_ROWS:
        return None
    tall = np.flatnonzero(np.asarray(heights) >= 0.25 * np.percentile(heights, 90))
    reach = 2 * int(np.median([seen[i][2] for i in tall])) + 2
    around = np.arange(-reach, reach + 1, 0.25)
    mean = np.zeros(around.size)
    for i in tall:
        lit, centre, _ = seen[i]
        mean += np.interp(centre + around, np.arange(lit.size), lit / lit.sum(), left=0.0, right=0.0)
    whole = np.rint(mean / mean.max() * 1e6).astype(np.int64)
    left, right = half_width(whole, 0, whole.size - 1, np.int64(1_000_000), INT64_TOP, 1, 0)
    return float(right - left) * 0.25


def best_exposure(steps: Sequence[Sequence[Image]], darks: Sequence[float], saturation: int) -> int:
    """Index of the exposure in which most rows have their maximum neither saturated nor in the lowest tenth.

    Equal exposures: the one with as many rows too bright as too dark; still equal: the shortest.
    """
    keys: list[tuple[int, int]] = []
    for e, dark in enumerate(darks):
        maxima = np.concatenate([images[e].max(axis=1) for images in steps]).astype(np.float64)
        bright = maxima >= saturation
        dim = maxima < dark + 0.1 * (saturation - dark)
        keys.append((int(np.count_nonzero(~bright & ~dim)), -abs(int(bright.sum()) - int(dim.sum()))))
    return max(range(len(keys)), key=lambda e: (keys[e], -e))
