"""COG, centre of gravity, eq. (8): sum c P M / sum P M per row, c counted from 0, P above the dark level.

Where the mask is empty there is no position: NaN, never a magic number. The sums are whole numbers, so the result does
not depend on the order of adding.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from scanning.pipeline.grey import grey


@nb.njit(cache=True, nogil=True)
def centre_of_gravity(row, first, last, top, scale, dark):  # type: ignore[no-untyped-def]
    """Column (px, from 0) of the centre of gravity of row[first..last], both included; NaN when no light is there."""
    light = np.int64(0)
    moment = np.int64(0)
    for c in range(first, last + 1):
        value = grey(row[c], top, scale, dark)
        light += value
        moment += value * (c - first)
    if light == 0:
        return np.nan
    return first + moment / light


@nb.njit(cache=True, nogil=True)
def centre_above(row, first, last, pedestal, top, scale, dark):  # type: ignore[no-untyped-def]
    """The same of the light above a pedestal, the level at which the base ends; NaN when nothing is above it.

    A base is whole pixels wide. With the pedestal left in, a line that moves by a quarter of a pixel inside its base
    seems to move less (response slope 0.86 after GLT, whose pedestal is 0.6 of the maximum) until the base jumps on.
    """
    light = 0.0
    moment = 0.0
    for c in range(first, last + 1):
        value = grey(row[c], top, scale, dark) - pedestal
        if value > 0.0:
            light += value
            moment += value * (c - first)
    if light <= 0.0:
        return np.nan
    return first + moment / light
