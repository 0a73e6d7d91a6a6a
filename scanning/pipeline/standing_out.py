"""Candidates by noise: everything in a row that stands out of the noise, whatever else is in that row.

The paper's threshold is a share of the brightest thing: a reflection three times as bright as the line hides the line
altogether, and no choice made afterwards can bring it back (on a scene with dark zones the line was missing among the
candidates in 60 % of the rows beside a reflection). Noise is the same in every row, so it is the fair measure.

1. The light is smoothed: three rows by a triangle across the columns as wide as the line (smoothing.py).
2. Level and spread of the smoothed light off the line come from rows all over the image (`level_and_spread`).
   A candidate is a maximum more than ``snr`` spreads above that level, and in its own row its highest pixel is above
   the noise of one pixel: at a step of the surface the neighbour's line must not lend its light to this row.
3. Two maxima are grains of one line when they are ``grain_px`` or less apart, or when the valley between them is
   shallow (above 0.8 of the lower one).
4. The base, over which the centre of gravity is taken, reaches on both sides to where the smoothed light falls to
   ``floor`` of the candidate's own height or into the noise, to the valley before the next candidate, and no further
   than ``reach`` columns. The share counts from the row's mean, so that a lamp does not stretch the base; light above
   the candidate's own is left out of that mean, or a bright reflection would lift it over a dim line. It is found
   in the smoothed light, so no single grain decides where it ends.

Width is the full width at half maximum of the smoothed light, less what the smoothing added.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from scanning.pipeline.smoothing import lowest_of, mark_lit, next_lit, sum_up_to, total_of

SHALLOW = 0.8
"""A valley above this share of the lower of its two maxima does not part them."""
NOISE_AT_THE_FOOT = 1.5
"""The base ends this many spreads above the level off the line, however faint the line."""
ABOVE = 1.0 + 1e-12
"""Light is above where a base ends when it is above it by more than rounding."""
BOX_WIDENS = 2.0 * np.log(2.0) * 4.0 / 6.0
"""Two boxes of b columns add this times (b^2 - 1) to the square of a Gaussian's full width at half maximum."""


@nb.njit(cache=True, nogil=True)
def row_candidates(  # type: ignore[no-untyped-def]
    smooth, level, spread, snr, faint, floor, from_row_mean, grain_px, reach, box, own, lit, maxima, base, shape,
    half, height, pedestal,
):  # fmt: skip
    """Candidates of one row, from low to high columns; return how many.

    Written per candidate: base (first, last), shape (position, width) in px, half (from the maximum to
    half height on the left, on the right; px, as smoothed), height and pedestal in light of the row itself
    (``own``).
    """
    columns = own.size
    limit = level + snr * spread
    least = np.int64(np.floor(limit)) + 1
    mark_lit(smooth, least, lit)
    found = 0
    c = 0
    while c < columns:
        c = next_lit(c, lit)
        if c >= columns:
            break
        if smooth[c] < least:
            c += 1
            continue
        # Uphill, over the flat top, and this is a maximum when it goes down behind it.
        if c > 0 and smooth[c - 1] > smooth[c]:
            c += 1
            continue
        start = c
        while c + 1 < columns and smooth[c + 1] == smooth[c]:
            c += 1
        if c + 1 < columns and smooth[c + 1] > smooth[c]:
            c += 1
            continue
        middle = (start + c) // 2
        c += 1
        if found > 0:
            before = maxima[found - 1]
            valley = lowest_of(smooth[before:middle])
            lower = min(smooth[before], smooth[middle])
            if middle - before <= grain_px or valley - level > SHALLOW * (lower - level):
                if smooth[middle] > smooth[before]:
                    maxima[found - 1] = middle
                continue
        maxima[found] = middle
        found += 1
    kept = 0
    foot = level + NOISE_AT_THE_FOOT * spread
    brightest = 0
    for k in range(found):
        if smooth[maxima[k]] > smooth[maxima[brightest]]:
            brightest = k
    widened = BOX_WIDENS * (box * box - 1)
    for k in range(found):
        m = maxima[k]
        tall = float(smooth[m] - level)
        background = float(level)
        if from_row_mean:
            total = total_of(smooth) if k == brightest else sum_up_to(smooth, smooth[m])
            background = max(background, total / columns)
        ends = max(foot, background + floor * (smooth[m] - background)) * ABOVE
        middle_level = level + 0.5 * tall
        lowest, highest = max(0, m - reach), min(columns - 1, m + reach)
        if k > 0:
            # The valley nearest to the maximum; where it is beyond the reach it does not matter.
            valley_level = lowest_of(smooth[maxima[k - 1] + 1 : m + 1])
            valley = m
            while valley > lowest and smooth[valley] != valley_level:
                valley -= 1
            lowest = max(lowest, valley)
        if k + 1 < found:
            valley_level = lowest_of(smooth[m : maxima[k + 1]])
            valley = m
            while valley < highest and smooth[valley] != valley_level:
                valley += 1
            highest = min(highest, valley)
        first = m
        while first > lowest and smooth[first - 1] > ends:
            first -= 1
        last = m
        while last < highest and smooth[last + 1] > ends:
            last += 1
        most = np.int64(0)
        for i in range(first, last + 1):
            most = max(most, np.int64(own[i]))
        if most <= faint:
            continue
        i = m
        while i > lowest and smooth[i - 1] > middle_level:
            i -= 1
        left = i - 0.5
        if i > 0 and smooth[i - 1] <= middle_level:
            left = i - (smooth[i] - middle_level) / (smooth[i] - smooth[i - 1])
        i = m
        while i < highest and smooth[i + 1] > middle_level:
            i += 1
        right = i + 0.5
        if i < columns - 1 and smooth[i + 1] <= middle_level:
            right = i + (smooth[i] - middle_level) / (smooth[i] - smooth[i + 1])
        width = right - left
        base[kept, 0], base[kept, 1] = first, last
        shape[kept, 0] = 0.5 * (left + right)
        shape[kept, 1] = np.sqrt(max(width * width - widened, 0.0625 * width * width))
        half[kept, 0], half[kept, 1] = m - left, right - m
        # A row much darker than its neighbours keeps its line: the same share of its own light.
        pedestal[kept] = min(ends / (3.0 * box * box), most * (ends / smooth[m]))
        height[kept] = most
        kept += 1
    return kept
