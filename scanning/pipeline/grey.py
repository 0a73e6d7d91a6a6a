"""What a pixel's code is worth: its light above the dark level, as a whole number.

The operations behind it (threshold, width, centroid) do not care about a common factor, so codes stay integers:
value = max(0, min(code, top) * scale - dark). For camera codes scale is 2^10 and dark the dark level in the same unit
(so 2.5 is exact); for sums of N images dark is N-fold; for values out of a table scale is 1 and dark 0.
"""

from __future__ import annotations

import numba as nb
import numpy as np

DARK_UNIT = 1 << 10
"""Dark levels are kept as whole multiples of 1/1024 grey level."""


@nb.njit(cache=True, nogil=True, inline="always")
def grey(code, top, scale, dark):  # type: ignore[no-untyped-def]
    """Light of one code above the dark level, int64."""
    value = min(np.int64(code), top) * scale - dark
    return value if value > 0 else np.int64(0)


@nb.njit(cache=True, nogil=True)
def count_saturated(image, saturation, fewest):  # type: ignore[no-untyped-def]
    """(codes at ``saturation`` or above in a (rows, columns) image, rows with at least ``fewest`` of them)."""
    count, rows = np.int64(0), np.int64(0)
    for r in range(image.shape[0]):
        row = image[r]
        some = np.uint8(0)
        for c in range(row.size):
            some |= np.uint8(row[c] >= saturation)
        if some != 0:
            before = count
            for c in range(row.size):
                count += row[c] >= saturation
            if count - before >= fewest:
                rows += 1
    return count, rows
