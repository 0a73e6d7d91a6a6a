"""Smoothed light and its noise: what candidates must stand out of, at a cost close to reading the image.

The light is summed over three rows (the border's row counts twice: coherent light makes grains about a row high, and a
row whose grain is dark still has its line) and then over a triangle across the columns, two boxes of ``box`` columns.
Outside the image it is dark. All sums are whole numbers, so nothing depends on the order of adding.

Why it is fast: whole rows at a time, in the narrowest integers that hold the largest sum (`kind_for`), in loops without
a branch, of a length the compiler does not know. Those it turns into vector instructions: 32 or 64 columns each. What
follows is not looked at column by column either: `mark_lit` leaves one byte per column, read eight at a time, so that a
stretch without light costs an eighth of a comparison per column.

Level and spread come from whole rows spread evenly over the image, by bisection: counting how many values are below a
guess is a loop of that kind too, sorting is not.
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

ROWS_LOOKED_AT = 32
"""Rows that level, spread and noise come from; the line covers a small part of each, so medians do not see it."""
STEP_TO_SIGMA = 1.4826 / np.sqrt(2.0)
WIDEST_BOX = 15
"""Grains and noise are a few pixels wide, however wide the line."""
WORD = 8
"""Columns looked at together once they are marked: as many as bytes in a word."""


def box_for(width_px: float | None) -> int:
    """Columns of the smoothing box for a line this wide: odd, from 3."""
    if width_px is None:
        return 3
    return min(WIDEST_BOX, max(3, 2 * int(width_px / 2.0) + 1))


def kind_for(box: int, top: int, scale: int) -> Any:
    """The narrowest type that holds every smoothed sum of light up to ``top * scale``: unsigned, int64 over 32 bits."""
    largest = 3 * box * box * top * scale
    return np.uint16 if largest < 1 << 16 else np.uint32 if largest < 1 << 32 else np.int64


class Rows:
    """Scratch: ``light`` of three rows, their sum ``three``, ``once`` boxed, both with darkness around, and ``smooth``.

    ``looked_at`` has room for the rows that level and spread come from, and for the steps in them.
    """

    def __init__(self, columns: int, box: int, kind: Any) -> None:
        around = 2 * (box // 2)
        self.light: NDArray[Any] = np.zeros((3, columns), kind)
        self.three: NDArray[Any] = np.zeros(columns + 2 * around, kind)
        self.once: NDArray[Any] = np.zeros(columns + around, kind)
        self.smooth: NDArray[Any] = np.zeros(columns, kind)
        self.looked_at: NDArray[Any] = np.zeros((2, ROWS_LOOKED_AT * columns), kind)

    def arrays(self) -> tuple[NDArray[Any], ...]:
        return self.light, self.three, self.once, self.smooth, self.looked_at


@nb.njit(cache=True, nogil=True)
def light_of_row(image, r, top, scale, dark, linear, shift, out):  # type: ignore[no-untyped-def]
    """The light of row r; of pixels that GLT compressed what it was before (``linear``, see `tone.light_table`)."""
    row = image[r]
    if linear.size > 0:
        for c in range(out.size):
            out[c] = linear[row[c] >> shift]
    else:
        kind = out.dtype.type
        highest, unit, nothing = kind(top), kind(scale), kind(dark)
        for c in range(out.size):
            code = kind(min(kind(row[c]), highest) * unit)
            out[c] = kind(max(code, nothing) - nothing)


@nb.njit(cache=True, nogil=True)
def smooth_row(above, own, below, box, three, once, smooth):  # type: ignore[no-untyped-def]
    """Write the smoothed light of a row from the light of three; see `Rows` for the scratch."""
    kind = smooth.dtype.type
    inner = three[box - 1 :]
    for c in range(own.size):
        inner[c] = kind(above[c] + own[c] + below[c])
    if box == 3:
        for c in range(smooth.size):
            smooth[c] = kind(three[c] + three[c + 4] + 2 * (three[c + 1] + three[c + 3]) + 3 * three[c + 2])
    else:
        _box(three, box, once)
        _box(once, box, smooth)


@nb.njit(cache=True, nogil=True)
def _box(values, box, out):  # type: ignore[no-untyped-def]
    """Sums of ``box`` neighbours; ``values`` is box - 1 longer than ``out``."""
    kind = out.dtype.type
    if box == 5:
        for c in range(out.size):
            out[c] = kind(values[c] + values[c + 1] + values[c + 2] + values[c + 3] + values[c + 4])
    elif box == 7:
        for c in range(out.size):
            few = values[c] + values[c + 1] + values[c + 2] + values[c + 3]
            out[c] = kind(few + values[c + 4] + values[c + 5] + values[c + 6])
    else:
        total = np.int64(0)
        for c in range(box - 1):
            total += values[c]
        for c in range(out.size):
            total += values[c + box - 1]
            out[c] = kind(total)
            total -= values[c]


@nb.njit(cache=True, nogil=True)
def mark_lit(values, least, lit):  # type: ignore[no-untyped-def]
    """Set byte c of ``lit`` (uint64 words) to 1 where values[c] >= least, else to 0."""
    limit = values.dtype.type(least)
    if np.int64(limit) != np.int64(least):  # above all that these integers can hold
        lit[:] = 0
        return
    marks = lit.view(np.uint8)
    for c in range(values.size):
        marks[c] = np.uint8(values[c] >= limit)


@nb.njit(cache=True, nogil=True, inline="always")
def next_lit(c, lit):  # type: ignore[no-untyped-def]
    """The column to go on at: c, or where c begins a word without light the beginning of the next word that has some.

    May lie behind the last column.
    """
    if c & 7 == 0:
        word = c >> 3
        while word < lit.size and lit[word] == 0:
            word += 1
        return max(c, word << 3)
    return c


@nb.njit(cache=True, nogil=True)
def median(values, highest):  # type: ignore[no-untyped-def]
    """The upper median of whole numbers from 0 to ``highest``, by bisection."""
    kind = values.dtype.type
    low, high = np.int64(0), np.int64(highest)
    while low < high:
        middle = (low + high) // 2
        guess = kind(middle)
        below_or_at = np.int64(0)
        for start in range(0, values.size, 1 << 14):  # so that the counts fit 16 bits
            part = values[start : start + (1 << 14)]
            count = np.uint16(0)
            for i in range(part.size):
                count = np.uint16(count + np.uint16(part[i] <= guess))
            below_or_at += count
        if below_or_at > values.size // 2:
            high = middle
        else:
            low = middle + 1
    return low


@nb.njit(cache=True, nogil=True)
def looked_at_row(i, rows):  # type: ignore[no-untyped-def]
    """The i-th of the rows that level, spread and noise come from."""
    count = min(rows, ROWS_LOOKED_AT)
    return (2 * i + 1) * rows // (2 * count)


@nb.njit(cache=True, nogil=True)
def level_and_spread(image, box, top, scale, dark, linear, shift, of_three):  # type: ignore[no-untyped-def]
    """(median, standard deviation) of the smoothed light of rows all over the image.

    The deviation comes from the steps between places two boxes apart, which share no pixel: the light of a lamp changes
    little over that distance and is no noise. Behind the last column it goes on at the first.
    """
    light, three, once, smooth, looked_at = of_three
    rows, columns = image.shape
    apart = (2 * box) % columns
    count = min(rows, ROWS_LOOKED_AT)
    highest = np.int64(0)
    for i in range(count):
        r = looked_at_row(i, rows)
        for away in range(-1, 2):
            light_of_row(image, min(max(r + away, 0), rows - 1), top, scale, dark, linear, shift, light[away + 1])
        smooth_row(light[0], light[1], light[2], box, three, once, smooth)
        seen, steps = looked_at[0, i * columns : (i + 1) * columns], looked_at[1, i * columns : (i + 1) * columns]
        most = smooth[0]
        for c in range(columns):
            seen[c] = smooth[c]
            most = max(most, smooth[c])
        highest = max(highest, np.int64(most))
        _steps(smooth[: columns - apart], smooth[apart:], steps)
        _steps(smooth[columns - apart :], smooth[:apart], steps[columns - apart :])
    level = median(looked_at[0, : count * columns], highest)
    step = median(looked_at[1, : count * columns], highest)
    return level, STEP_TO_SIGMA * step


@nb.njit(cache=True, nogil=True)
def _steps(here, there, out):  # type: ignore[no-untyped-def]
    kind = out.dtype.type
    for c in range(here.size):
        out[c] = kind(max(here[c], there[c]) - min(here[c], there[c]))


@nb.njit(cache=True, nogil=True)
def noise_of(image, top, scale, linear, shift, looked_at):  # type: ignore[no-untyped-def]
    """Noise of a pixel (standard deviation, in light): 1.4826 / sqrt 2 x the median step between neighbouring columns.

    The median over rows spread over the image does not see the line, which covers a small part of it. ``looked_at`` is
    int64 scratch of ROWS_LOOKED_AT x columns.
    """
    rows, columns = image.shape
    count = min(rows, ROWS_LOOKED_AT)
    highest = np.int64(0)
    for i in range(count):
        row = image[looked_at_row(i, rows)]
        steps = looked_at[i * (columns - 1) : (i + 1) * (columns - 1)]
        if linear.size > 0:
            for c in range(columns - 1):
                steps[c] = abs(np.int64(linear[row[c + 1] >> shift]) - np.int64(linear[row[c] >> shift]))
        else:
            for c in range(columns - 1):
                steps[c] = abs(min(np.int64(row[c + 1]), top) - min(np.int64(row[c]), top)) * scale
        for c in range(columns - 1):
            highest = max(highest, steps[c])
    return STEP_TO_SIGMA * median(looked_at[: count * (columns - 1)], highest)


@nb.njit(cache=True, nogil=True)
def total_of(values):  # type: ignore[no-untyped-def]
    """Sum of whole numbers, exact."""
    total = np.int64(0)
    for c in range(values.size):
        total += np.int64(values[c])
    return total


@nb.njit(cache=True, nogil=True)
def sum_up_to(values, most):  # type: ignore[no-untyped-def]
    """The same with every value cut at ``most``."""
    total = np.int64(0)
    for c in range(values.size):
        total += np.int64(min(values[c], most))
    return total


@nb.njit(cache=True, nogil=True)
def lowest_of(values):  # type: ignore[no-untyped-def]
    """The lowest of at least one value."""
    least = values[0]
    for c in range(values.size):
        least = min(least, values[c])
    return least
