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
