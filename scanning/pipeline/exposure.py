"""HDRE, high dynamic range extension, eq. (5), (6): one image from a bracket of exposures.

Per pixel P_HDR = P_i / e_i of the longest exposure i that is not saturated; Sat / e_1 where all are. The extension is
20 log10(e_last / e_1): 19.08 dB for E1 (0.1 ... 0.9 ms), 39.08 dB for E2 (0.1 ... 9 ms). Our readings: the level off
the line is subtracted before dividing (otherwise exposures disagree about black), and g = 255 P_HDR / (Sat / e_1)
brings the result to 0..255 for GLT. Where noise leaves a pixel saturated at a short exposure and not at a longer one,
the longest unsaturated one counts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numba as nb
import numpy as np
from numpy.typing import NDArray

from scanning.errors import BadInput
from scanning.pipeline.compound import COUNT_SHIFT, SUM_MASK
from scanning.pipeline.tone import GREY_TOP, Float


def extension_db(exposures_us: Sequence[float]) -> float:
    """How much a bracket extends the dynamic range, eq. (5): 20 log10(longest / shortest), dB."""
    if not exposures_us or min(exposures_us) <= 0:
        raise BadInput("The dynamic range extension needs exposure times above zero; correct exposures_us.")
    return 20.0 * math.log10(max(exposures_us) / min(exposures_us))


def exposure_grey(
    codes: Float, exposures_us: Sequence[float], dark_levels: Sequence[float], saturation: int
) -> NDArray[np.float64]:
    """Grey value 0..255 of every (exposure, code): shape (exposures, codes).

    g = 255 ((code - dark_i) / e_i) / ((Sat - dark_1) / e_1), never below 0. A code at saturation is 255 in the
    shortest exposure; in the longer ones it is never read.
    """
    light = (saturation - dark_levels[0]) / exposures_us[0]
    rows = [
        np.clip((codes - dark) / time / light, 0.0, 1.0) * GREY_TOP
        for time, dark in zip(exposures_us, dark_levels, strict=True)
    ]
    return np.stack(rows)


OPEN = np.int32(-1)
"""Stands where all exposures so far are saturated, until a shorter one says more."""


@nb.njit(cache=True, nogil=True)
def fuse_codes(fused, image, table, saturation, open_rows, longest, shortest):  # type: ignore[no-untyped-def]
    """Write table[code] where this exposure is not saturated and no longer one has said anything.

    Exposures come longest first: hardly a pixel of it is saturated, so the others are looked at in few rows only
    (``open_rows``, (rows,) bool, kept from one to the next). ``table`` is (saturation + 1,) int32; what is saturated
    in the shortest too is table[saturation] of that.
    """
    top = np.int64(saturation)
    for r in range(image.shape[0]):
        if not (longest or open_rows[r]):
            continue
        row, out = image[r], fused[r]
        some = np.uint8(0)
        for c in range(row.size):
            some |= np.uint8(row[c] >= saturation)
        if longest:
            for c in range(row.size):
                out[c] = table[min(np.int64(row[c]), top)]
            open_rows[r] = some != 0
            if some != 0 and not shortest:
                for c in range(row.size):
                    out[c] = OPEN if row[c] >= saturation else out[c]
        else:
            for c in range(row.size):
                if out[c] == OPEN and (row[c] < saturation or shortest):
                    out[c] = table[min(np.int64(row[c]), top)]


@nb.njit(cache=True, nogil=True)
def fuse_sums(fused, sums, table, saturated_from, top, open_rows, longest, shortest):  # type: ignore[no-untyped-def]
    """The same on compounded images (HDRE-I): a pixel is saturated from ``saturated_from`` saturated images up."""
    limit = np.int32(saturated_from << COUNT_SHIFT)
    for r in range(sums.shape[0]):
        if not (longest or open_rows[r]):
            continue
        row, out = sums[r], fused[r]
        some = np.uint8(0)
        for c in range(row.size):
            some |= np.uint8(row[c] >= limit)
        if longest:
            for c in range(row.size):
                out[c] = table[row[c] & SUM_MASK]
            open_rows[r] = some != 0
            if some != 0:
                for c in range(row.size):
                    if row[c] >= limit:
                        out[c] = top if shortest else OPEN
        else:
            for c in range(row.size):
                if out[c] == OPEN and row[c] < limit:
                    out[c] = table[row[c] & SUM_MASK]
                elif out[c] == OPEN and shortest:
                    out[c] = top


@nb.njit(cache=True, nogil=True)
def look_up(out, image, table, top):  # type: ignore[no-untyped-def]
    """out = table[min(image, top)], for GLT without HDRE."""
    rows, columns = image.shape
    for r in range(rows):
        for c in range(columns):
            code = np.int64(image[r, c])
            out[r, c] = table[code if code < top else top]
