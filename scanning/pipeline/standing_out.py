"""Candidates by noise: everything in a row that stands out of the noise, whatever else is in that row.

The paper's threshold is a share of the brightest thing: a reflection three times as bright as the line hides the line
altogether, and no choice made afterwards can bring it back (on a scene with dark zones the line was missing among the
candidates in 60 % of the rows beside a reflection). Noise is the same in every row, so it is the fair measure.

1. The light is smoothed: three rows (coherent light makes grains about a row high, and a row whose grain is dark still
   has its line) by a triangle across the columns as wide as the line (two boxes of ``box`` columns).
2. Level and spread of the smoothed light off the line come from 1024 places all over the image (`level_and_spread`).
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

from scanning.pipeline.grey import grey

PLACES = 1024
WIDEST_BOX = 15
"""Grains and noise are a few pixels wide, however wide the line."""
SPREAD_OF_PLACES = 2_654_435_761
STEP_TO_SIGMA = 1.4826 / np.sqrt(2.0)
BLOCK = 32
"""Columns looked at together: a block with nothing above the noise is skipped whole."""
SHALLOW = 0.8
"""A valley above this share of the lower of its two maxima does not part them."""
NOISE_AT_THE_FOOT = 1.5
"""The base ends this many spreads above the level off the line, however faint the line."""
BOX_WIDENS = 2.0 * np.log(2.0) * 4.0 / 6.0
"""Two boxes of b columns add this times (b^2 - 1) to the square of a Gaussian's full width at half maximum."""


def box_for(width_px: float | None) -> int:
    """Columns of the smoothing box for a line this wide: odd, from 3."""
    if width_px is None:
        return 3
    return min(WIDEST_BOX, max(3, 2 * int(width_px / 2.0) + 1))


@nb.njit(cache=True, nogil=True, inline="always")
def light(code, top, scale, dark, linear, shift):  # type: ignore[no-untyped-def]
    """Light of one pixel; of one that GLT compressed, what it was before (``linear``, see `tone.light_table`)."""
    if linear.size > 0:
        return linear[code >> shift]
    return grey(code, top, scale, dark)


@nb.njit(cache=True, nogil=True)
def light_of_row(image, r, top, scale, dark, linear, shift, out):  # type: ignore[no-untyped-def]
    """The light of row r, int64."""
    if linear.size > 0:
        for c in range(image.shape[1]):
            out[c] = linear[image[r, c] >> shift]
    else:
        for c in range(image.shape[1]):
            out[c] = grey(image[r, c], top, scale, dark)


@nb.njit(cache=True, nogil=True)
def smooth_row(above, own, below, box, three, once, smooth):  # type: ignore[no-untyped-def]
    """Write the smoothed light of a row from the light of three; all int64 and exact. Outside the image it is dark."""
    for c in range(own.size):
        three[c] = above[c] + own[c] + below[c]
    _box(three, box, once)
    _box(once, box, smooth)


@nb.njit(cache=True, nogil=True)
def _box(values, box, out):  # type: ignore[no-untyped-def]
    columns = values.size
    half = box // 2
    if half == 1 and columns > 2:
        out[0] = values[0] + values[1]
        for c in range(1, columns - 1):
            out[c] = values[c - 1] + values[c] + values[c + 1]
        out[columns - 1] = values[columns - 2] + values[columns - 1]
        return
    total = np.int64(0)
    for c in range(min(half, columns)):
        total += values[c]
    for c in range(columns):
        if c + half < columns:
            total += values[c + half]
        if c - half - 1 >= 0:
            total -= values[c - half - 1]
        out[c] = total


@nb.njit(cache=True, nogil=True)
def smoothed_at(image, r, c, box, top, scale, dark, linear, shift):  # type: ignore[no-untyped-def]
    """What `smooth_row` would write at one place."""
    rows, columns = image.shape
    half = box // 2
    total = np.int64(0)
    for away in range(-2 * half, 2 * half + 1):
        # Through the first box from column c + away, on to c through the second: boxes end at the border too.
        if 0 <= c + away < columns:
            ways = min(c + half, c + away + half, columns - 1) - max(c - half, c + away - half, 0) + 1
            three = np.int64(0)
            for q in (max(r - 1, 0), r, min(r + 1, rows - 1)):
                three += light(image[q, c + away], top, scale, dark, linear, shift)
            total += ways * three
    return total


@nb.njit(cache=True, nogil=True)
def level_and_spread(image, box, top, scale, dark, linear, shift, seen):  # type: ignore[no-untyped-def]
    """(median, standard deviation) of the smoothed light at places all over the image.

    The deviation comes from the steps between places two boxes apart, which share no pixel: the light of a lamp changes
    little over that distance and is no noise.
    """
    rows, columns = image.shape
    places = rows * columns
    count = min(places, seen.size // 2)
    for i in range(count):
        place = (i * SPREAD_OF_PLACES) % places
        r, c = place // columns, place % columns
        here = smoothed_at(image, r, c, box, top, scale, dark, linear, shift)
        seen[i] = here
        seen[count + i] = abs(
            here - smoothed_at(image, r, (c + 2 * box) % columns, box, top, scale, dark, linear, shift)
        )
    level = np.partition(seen[:count], count // 2)[count // 2]
    step = np.partition(seen[count : 2 * count], count // 2)[count // 2]
    return level, STEP_TO_SIGMA * step


@nb.njit(cache=True, nogil=True)
def _sum_up_to(values, most):  # type: ignore[no-untyped-def]
    total = np.int64(0)
    for c in range(values.size):
        total += min(values[c], most)
    return total


@nb.njit(cache=True, nogil=True)
def row_candidates(  # type: ignore[no-untyped-def]
    smooth, level, spread, snr, faint, floor, from_row_mean, grain_px, reach, box, own, maxima, base, shape,
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
    found = 0
    c = 0
    while c < columns:
        if c % BLOCK == 0 and c + BLOCK <= columns:
            most_of_block = smooth[c]
            for i in range(c + 1, c + BLOCK):
                most_of_block = max(most_of_block, smooth[i])
            if most_of_block < least:
                c += BLOCK
                continue
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
            valley = smooth[before]
            for i in range(before + 1, middle):
                valley = min(valley, smooth[i])
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
            total = smooth.sum() if k == brightest else _sum_up_to(smooth, smooth[m])
            background = max(background, total / columns)
        ends = max(foot, background + floor * (smooth[m] - background))
        middle_level = level + 0.5 * tall
        lowest, highest = max(0, m - reach), min(columns - 1, m + reach)
        if k > 0:
            valley = m
            for i in range(m - 1, maxima[k - 1], -1):
                if smooth[i] < smooth[valley]:
                    valley = i
            lowest = max(lowest, valley)
        if k + 1 < found:
            valley = m
            for i in range(m + 1, maxima[k + 1]):
                if smooth[i] < smooth[valley]:
                    valley = i
            highest = min(highest, valley)
        first = m
        while first > lowest and smooth[first - 1] > ends:
            first -= 1
        last = m
        while last < highest and smooth[last + 1] > ends:
            last += 1
        most = np.int64(0)
        for i in range(first, last + 1):
            most = max(most, own[i])
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
