"""MSNN, maximum signal-to-noise and nearest neighbour: which peak of each row is the laser line.

A machined metal surface throws reflections beside the line, often brighter than it. Taking the brightest peak of every
row follows them in a fifth to a quarter of the rows. MSNN uses what a reflection does not share with the line: its
width, and being where the line was in the row before.

1. Peaks. A row's threshold is k times the mean of the image, but not under a share (``floor``) of the row's maximum;
   the share counts from the row's mean (``floor_from``), because a lamp or GLT can lift the whole background above a
   tenth of the maximum. k times the mean is cut at ``ceiling`` x the mean of all row maxima, because in a narrow or
   bright image it would rise above the line itself. A peak starts where the row rises above the threshold (strictly)
   and ends where it falls to it, at the last column, or where the gradient turns from negative to positive: at that
   valley pixel, which still belongs to it. On flat stretches the last gradient that was not zero counts.
   Coherent light makes grains of the line, so taken literally a "peak" is often one grain of it. Neighbouring peaks
   no more than ``grain_px`` pixels apart are one; a ghost wider than the line becomes one wide peak that way and
   fails the width check. Measured on coherent speckle (f/5.6, 160 columns, one exposure): sigma 15.6 um and response
   slope 0.73-0.89 literally, 8.1 um and 0.99-1.00 joined.
   A peak no higher than ``snr`` x the noise of a pixel is noise.
   A peak has a base (first to last pixel), a height (maximum), a width (full width at half its height, interpolated;
   where the base ends above half height, the base's edge) and a position (the middle of that width).
2. Seed. From the bottom row, the first row whose peak passes the width check and is alone in its row: no better signal
   to noise. If no such row exists, the row with the largest ratio between a peak that passes and the highest other one.
3. Continuity. From the seed upwards and downwards, the candidate with the least |width change| + |column change|,
   ties to the lower column, within gate_px (1 + rows missed), at most gate_max_px. Rows without one do not end it.
4. ``seed = "best"``: the literal rule loses the whole frame when the lowest lone peak is a reflection. So lines from
   other seeds are followed too (lone peaks first, bottom up, then any that pass; at most 16), and the line that looks
   most like the line over most rows wins: the sum over its rows of 1 - |log(width / expected)| / log(width_factor),
   not below 0. Where nothing else is in the image this ends after the literal line.

All numbers are relative to the light of the frame: twice the light gives the same line.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from scanning.pipeline.centroid import centre_above, centre_of_gravity
from scanning.pipeline.grey import grey
from scanning.pipeline.path import find_path
from scanning.pipeline.smoothing import level_and_spread, light_of_row, mark_lit, next_lit, noise_of, smooth_row
from scanning.pipeline.standing_out import BOX_WIDENS, row_candidates

LINES_TRIED = 16
TIE = 1e-9
"""Costs closer than this (px) are equal; rounding must not decide between two equal candidates."""
STRICT = 1.0 + 1e-12
"""A value is above a threshold only when it is above it by more than rounding."""


@nb.njit(cache=True, nogil=True)
def row_maxima(image, highest):  # type: ignore[no-untyped-def]
    """The highest code of every row."""
    rows, columns = image.shape
    for r in range(rows):
        most = image[r, 0]
        for c in range(1, columns):
            most = max(most, image[r, c])
        highest[r] = most


@nb.njit(cache=True, nogil=True)
def row_light(image, top, scale, dark, light):  # type: ignore[no-untyped-def]
    """Sum of the light of every row, exact."""
    rows, columns = image.shape
    nothing = dark // scale
    for r in range(rows):
        codes = np.int64(0)
        lit = np.int64(0)
        for c in range(columns):
            code = min(np.int64(image[r, c]), top)
            if code > nothing:
                codes += code
                lit += 1
        light[r] = codes * scale - lit * dark


@nb.njit(cache=True, nogil=True)
def lowest_code_above(threshold, scale, dark):  # type: ignore[no-untyped-def]
    """The smallest code whose light is above the threshold."""
    limit = threshold * STRICT
    code = np.int64(np.floor((limit + dark) / scale))
    while code * scale - dark > limit:
        code -= 1
    while code * scale - dark <= limit:
        code += 1
    return code


@nb.njit(cache=True, nogil=True)
def half_width(row, first, last, height, top, scale, dark):  # type: ignore[no-untyped-def]
    """(left, right) columns, px, where the peak crosses half its height; the base's edge where it does not."""
    i = first
    while 2 * grey(row[i], top, scale, dark) <= height:
        i += 1
    left = i - 0.5
    if i > 0:
        below = grey(row[i - 1], top, scale, dark)
        if 2 * below <= height:
            left = i - 1 + (0.5 * height - below) / (grey(row[i], top, scale, dark) - below)
    j = last
    while 2 * grey(row[j], top, scale, dark) <= height:
        j -= 1
    right = j + 0.5
    if j < row.size - 1:
        below = grey(row[j + 1], top, scale, dark)
        if 2 * below <= height:
            right = j + 1 - (0.5 * height - below) / (grey(row[j], top, scale, dark) - below)
    return left, right


@nb.njit(cache=True, nogil=True)
def row_peaks(row, lowest, faint, grain_px, top, scale, dark, lit, base, shape, height):  # type: ignore[no-untyped-def]
    """Find the peaks of one row, from low to high columns; return how many.

    ``lowest`` is the smallest code above the threshold; peaks no higher than ``faint`` are left out. Written per peak:
    base (first, last), shape (position, width) in px, height in light. ``lit`` is scratch, a byte per column.
    """
    columns = row.size
    mark_lit(row, lowest, lit)
    found = 0
    c = 0
    while c < columns:
        c = next_lit(c, lit)
        if c >= columns:
            break
        if row[c] < lowest:
            c += 1
            continue
        # A run of pixels above the threshold starts at c; cut it at its valleys.
        while c < columns and row[c] >= lowest:
            first = c
            value = grey(row[c], top, scale, dark)
            most_light = value
            falling = False
            c += 1
            while c < columns and row[c] >= lowest:
                following = grey(row[c], top, scale, dark)
                if following < value:
                    falling = True
                elif following > value and falling:
                    break
                value = following
                most_light = max(most_light, value)
                c += 1
            joins = False
            if found > 0 and grain_px > 0.0:
                apart = first - base[found - 1, 1] - 1
                joins = apart <= grain_px
            if joins:
                base[found - 1, 1] = c - 1
                height[found - 1] = max(height[found - 1], most_light)
            else:
                base[found, 0] = first
                base[found, 1] = c - 1
                height[found] = most_light
                found += 1
    kept = 0
    for k in range(found):
        if height[k] > faint:
            base[kept, 0], base[kept, 1], height[kept] = base[k, 0], base[k, 1], height[k]
            kept += 1
    for k in range(kept):
        left, right = half_width(row, base[k, 0], base[k, 1], height[k], top, scale, dark)
        shape[k, 0] = 0.5 * (left + right)
        shape[k, 1] = right - left
    return kept


@nb.njit(cache=True, nogil=True)
def follow(counts, shape, seed_row, seed_peak, gate_px, gate_max_px, chosen):  # type: ignore[no-untyped-def]
    """Follow the line from its seed both ways; write the chosen peak of every row, -1 where there is none."""
    rows = counts.size
    chosen[:] = -1
    chosen[seed_row] = seed_peak
    for direction in (-1, 1):
        column = shape[seed_row, seed_peak, 0]
        width = shape[seed_row, seed_peak, 1]
        missed = 0
        r = seed_row + direction
        while 0 <= r < rows:
            gate = min(gate_px * (1 + missed), gate_max_px) + TIE
            best = -1
            least = np.inf
            for k in range(counts[r]):
                moved = abs(shape[r, k, 0] - column)
                if moved <= gate:
                    cost = moved + abs(shape[r, k, 1] - width)
                    if cost < least - TIE:
                        least = cost
                        best = k
            chosen[r] = best
            if best >= 0:
                column = shape[r, best, 0]
                width = shape[r, best, 1]
                missed = 0
            else:
                missed += 1
            r += direction


@nb.njit(cache=True, nogil=True)
def best_ratio_seed(counts, shape, height, narrowest, widest):  # type: ignore[no-untyped-def]
    """(row, peak) whose height stands most above the highest other peak of its row; (-1, -1) when none passes."""
    seed_row, seed_peak, best = -1, -1, 0.0
    for r in range(counts.size - 1, -1, -1):
        for k in range(counts[r]):
            if narrowest <= shape[r, k, 1] <= widest:
                other = np.int64(0)
                for j in range(counts[r]):
                    if j != k:
                        other = max(other, height[r, j])
                ratio = height[r, k] / other if other > 0 else np.inf
                if ratio > best * STRICT:
                    seed_row, seed_peak, best = r, k, ratio
    return seed_row, seed_peak


@nb.njit(cache=True, nogil=True)
def likeness(width, expected, factor):  # type: ignore[no-untyped-def]
    """How much a peak of this width looks like the line: 1 at the expected width, 0 where the width check ends."""
    if np.isinf(factor):
        return 1.0
    if factor <= 1.0:
        return 1.0 if width == expected else 0.0
    return max(0.0, 1.0 - abs(np.log(width / expected)) / np.log(factor))


@nb.njit(cache=True, nogil=True)
def visit(line, shape, expected, factor, visited):  # type: ignore[no-untyped-def]
    """(sum of likeness over the rows of this line, how many of its peaks were not on a line before)."""
    total = 0.0
    fresh = 0
    for q in range(line.size):
        if line[q] >= 0:
            total += likeness(shape[q, line[q], 1], expected, factor)
            if not visited[q, line[q]]:
                visited[q, line[q]] = True
                fresh += 1
    return total, fresh


@nb.njit(cache=True, nogil=True)
def find_line(counts, shape, height, expected, factor, gate_px, gate_max_px, best_seed, chosen):  # type: ignore[no-untyped-def]
    """Choose the peak of every row that is the laser line; all -1 when no peak passes the width check.

    ``expected`` width in px, and the factor it may be off; an infinite factor lets every width pass.
    """
    rows = counts.size
    narrowest, widest = expected / factor, expected * factor
    chosen[:] = -1
    seed_row, seed_peak = -1, -1
    for r in range(rows - 1, -1, -1):
        if counts[r] == 1 and narrowest <= shape[r, 0, 1] <= widest:
            seed_row, seed_peak = r, 0
            break
    if seed_row < 0:
        seed_row, seed_peak = best_ratio_seed(counts, shape, height, narrowest, widest)
    if seed_row < 0:
        return
    follow(counts, shape, seed_row, seed_peak, gate_px, gate_max_px, chosen)
    if not best_seed:
        return
    # The literal line is there; is another one more like the line, over more rows?
    visited = np.zeros(height.shape, np.bool_)
    most, fresh = visit(chosen, shape, expected, factor, visited)
    unvisited = counts.sum() - fresh
    tried = 1
    line = np.empty_like(chosen)
    for alone in (True, False):
        for r in range(rows - 1, -1, -1):
            if alone and counts[r] != 1:
                continue
            for k in range(counts[r]):
                if unvisited <= most or tried >= LINES_TRIED:
                    return
                if visited[r, k] or not narrowest <= shape[r, k, 1] <= widest:
                    continue
                follow(counts, shape, r, k, gate_px, gate_max_px, line)
                total, fresh = visit(line, shape, expected, factor, visited)
                unvisited -= fresh
                tried += 1
                if total > most + TIE:
                    most = total
                    chosen[:] = line


@nb.njit(cache=True, nogil=True)
def keep(r, count, of_row, of_rows):  # type: ignore[no-untyped-def]
    """Copy the candidates of one row out of its scratch to where those of all rows are kept, if there is room."""
    base, shape, half, height, pedestal = of_rows
    if count > height.shape[1]:
        return
    for k in range(count):
        base[r, k, 0], base[r, k, 1] = of_row[0][k, 0], of_row[0][k, 1]
        shape[r, k, 0], shape[r, k, 1] = of_row[1][k, 0], of_row[1][k, 1]
        half[r, k, 0], half[r, k, 1] = of_row[2][k, 0], of_row[2][k, 1]
        height[r, k], pedestal[r, k] = of_row[3][k], of_row[4][k]


@nb.njit(cache=True, nogil=True)
def candidates_by_threshold(  # type: ignore[no-untyped-def]
    image, top, scale, dark, k, floor, from_row_mean, ceiling, faint, grain_px, highest, light, lit, of_row, of_rows,
    counts,
):  # fmt: skip
    """The peaks of every row above the paper's threshold; see `keep`. Returns the most in one row."""
    rows, columns = image.shape
    row_maxima(image, highest)
    row_light(image, top, scale, dark, light)
    mean = light.sum() / (rows * columns)
    asked = k * mean
    if ceiling > 0.0:
        of_maxima = np.int64(0)
        for r in range(rows):
            of_maxima += grey(highest[r], top, scale, dark)
        asked = min(asked, ceiling * (of_maxima / rows))
    base, shape, half, height, _ = of_row
    most = 0
    for r in range(rows):
        background = light[r] / columns if from_row_mean else 0.0
        threshold = max(asked, background + floor * (grey(highest[r], top, scale, dark) - background))
        lowest = lowest_code_above(threshold, scale, dark)
        counts[r] = 0
        if min(np.int64(highest[r]), top) >= lowest:
            counts[r] = row_peaks(image[r], lowest, faint, grain_px, top, scale, dark, lit, base, shape, height)
            for p in range(counts[r]):
                half[p, 0] = half[p, 1] = 0.5 * shape[p, 1]
            keep(r, counts[r], of_row, of_rows)
            most = max(most, counts[r])
    return most


@nb.njit(cache=True, nogil=True)
def candidates_by_noise(  # type: ignore[no-untyped-def]
    image, top, scale, dark, linear, shift, floor, from_row_mean, snr, faint, grain_px, reach, box, of_three, maxima,
    lit, of_row, of_rows, counts,
):  # fmt: skip
    """What stands out of the noise in every row; see standing_out.py. Returns the most in one row."""
    level, spread = level_and_spread(image, box, top, scale, dark, linear, shift, of_three)
    light, three, once, smooth, _ = of_three
    base, shape, half, height, pedestal = of_row
    most = 0
    rows = image.shape[0]
    light_of_row(image, 0, top, scale, dark, linear, shift, light[0])
    for r in range(rows):
        if r + 1 < rows:
            light_of_row(image, r + 1, top, scale, dark, linear, shift, light[(r + 1) % 3])
        above, own, below = light[max(r - 1, 0) % 3], light[r % 3], light[min(r + 1, rows - 1) % 3]
        smooth_row(above, own, below, box, three, once, smooth)
        counts[r] = row_candidates(
            smooth, level, spread, snr, faint, floor, from_row_mean, grain_px, reach, box, own, lit, maxima, base,
            shape, half, height, pedestal,
        )  # fmt: skip
        keep(r, counts[r], of_row, of_rows)
        most = max(most, counts[r])
    return most


@nb.njit(cache=True, nogil=True)
def compressed(value, linear, shift):  # type: ignore[no-untyped-def]
    """The grey value whose light this is: the inverse of ``linear``."""
    entry = np.searchsorted(linear, value)
    if entry == 0:
        return 0.0
    if entry >= linear.size:
        return float((linear.size - 1) << shift)
    share = (value - linear[entry - 1]) / (linear[entry] - linear[entry - 1])
    return (entry - 1 + share + 0.5) * (1 << shift)


@nb.njit(cache=True, nogil=True)
def extract_line(  # type: ignore[no-untyped-def]
    image, top, scale, dark, linear, shift, by_noise, by_path, k, floor, from_row_mean, ceiling, snr, grain_px,
    expected, factor, gate_px, gate_max_px, best_seed, light_width, touched, jump, reach, box,
    highest, light, of_three, noise, maxima, lit, of_row, of_rows, counts, chosen, of_path, column_px, peak, width_px,
    confidence,
):  # fmt: skip
    """MSNN then COG on one (rows, columns) image of integer codes (see `grey.grey` for top, scale, dark).

    Writes, per row, column_px (px from 0, NaN undefined), peak (light of the line's maximum), width_px (full width at
    half maximum, px) and confidence (0 to 1, see `path.trust`; NaN without a path), and returns the most candidates in
    one row. If the scratch has no room for so many, nothing is written. What lies between ``box`` and ``column_px`` is
    scratch that keeps its size; see `chain.Scratch`. ``linear`` and ``shift`` undo GLT (`tone.light_table`; empty where
    there is none).
    """
    rows = image.shape[0]
    faint = snr * noise_of(image, top, scale, linear, shift, noise) * STRICT if snr > 0.0 else 0.0
    if by_noise:
        most = candidates_by_noise(
            image, top, scale, dark, linear, shift, floor, from_row_mean, snr, faint, grain_px, reach, box, of_three,
            maxima, lit, of_row, of_rows, counts,
        )  # fmt: skip
    else:
        most = candidates_by_threshold(
            image, top, scale, dark, k, floor, from_row_mean, ceiling, faint, grain_px, highest, light, lit, of_row,
            of_rows, counts,
        )  # fmt: skip
    base, shape, half, height, pedestal = of_rows
    if most > height.shape[1]:
        return most
    if by_path:
        widened = BOX_WIDENS * (box * box - 1) if by_noise else 0.0
        average, track, score, back_row, back_peak, alive = of_path
        find_path(
            counts, shape, half, height, widened, expected, factor, light_width, touched, jump, gate_max_px, average,
            track, score, back_row, back_peak, alive, chosen, confidence,
        )  # fmt: skip
    else:
        find_line(counts, shape, height, expected, factor, gate_px, gate_max_px, best_seed, chosen)
        confidence[:] = np.nan
    for r in range(rows):
        peak_of_row = chosen[r]
        if peak_of_row < 0:
            column_px[r] = np.nan
            peak[r] = np.nan
            width_px[r] = np.nan
        else:
            first, last = base[r, peak_of_row, 0], base[r, peak_of_row, 1]
            if by_noise:
                if linear.size > 0:
                    # The base ends at this light; the centre of gravity is that of what GLT made of it.
                    pedestal[r, peak_of_row] = compressed(pedestal[r, peak_of_row], linear, shift)
                    height[r, peak_of_row] = image[r, first : last + 1].max()
                column_px[r] = centre_above(image[r], first, last, pedestal[r, peak_of_row], top, scale, dark)
            else:
                column_px[r] = centre_of_gravity(image[r], first, last, top, scale, dark)
            peak[r] = height[r, peak_of_row]
            width_px[r] = shape[r, peak_of_row, 1]
    return most
