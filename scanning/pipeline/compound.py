"""SCI, scan image compounding, eq. (4): the mean of N neighbouring scan images.

Neighbouring scan images see the same surface through partly different speckle, so their mean is a speckle average along
the scan; it costs N-fold lateral resolution and nothing else helps as much. As printed, the sum of eq. (4) has one
term; the reading that fits its limits and the region sizes is i = nN ... (n+1)N-1 ("block"). "sliding" keeps every
step as a profile.

The mean is never formed: the sum of N integers is exact, and everything behind it (threshold, width, centroid) does
not care about a factor N. A rounded mean would move ties between equal peaks.
"""

from __future__ import annotations

from collections import deque

import numba as nb
import numpy as np
from numpy.typing import NDArray

Sums = NDArray[np.int32]

COUNT_SHIFT = 24
"""Sums that count saturated images carry the count above this bit and the sum of codes below it."""
SUM_MASK = (1 << COUNT_SHIFT) - 1


@nb.njit(cache=True, nogil=True)
def _accumulate(sums, image, top, counting, sign):  # type: ignore[no-untyped-def]
    """sums += sign * min(image, top), plus sign << 24 where the image is saturated and ``counting``."""
    limit, times = np.int32(top), np.int32(sign)
    one_saturated = np.int32(sign << COUNT_SHIFT) if counting else np.int32(0)
    for r in range(image.shape[0]):
        row, out = image[r], sums[r]
        for c in range(row.size):  # without a branch, so that it is vector instructions
            code = np.int32(row[c])
            out[c] += np.int32(times * min(code, limit) + (one_saturated if code >= limit else np.int32(0)))


class CompoundWindow:
    """The running sum of the last N scan images of one exposure; memory is N images, however long the scan.

    ``top`` is the saturation level: codes above it say no more than it. With ``counting`` the sums also count, per
    pixel, how many of the N images are saturated.
    """

    def __init__(
        self, rows: int, columns: int, window: int, *, sliding: bool, top: int, counting: bool = False
    ) -> None:
        self._sums: Sums = np.zeros((rows, columns), np.int32)
        self._window = window
        self._kept: deque[NDArray[np.generic]] | None = deque() if sliding else None
        self._held = 0
        self._top = top
        self._counting = counting

    def add(self, image: NDArray[np.generic]) -> Sums | None:
        """Add one (rows, columns) image; return the sums of a full window, or None. The sums are only lent."""
        if self._held == self._window:
            if self._kept is None:
                self._sums[:] = 0
                self._held = 0
            else:
                _accumulate(self._sums, self._kept.popleft(), self._top, self._counting, -1)
                self._held -= 1
        _accumulate(self._sums, image, self._top, self._counting, 1)
        if self._kept is not None:
            self._kept.append(image.copy())
        self._held += 1
        return self._sums if self._held == self._window else None
