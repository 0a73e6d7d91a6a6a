"""The line as the best path through the candidates of all rows.

Following the nearest candidate from row to row cannot turn back: once on a reflection it stays there. Seen over the
whole image the line is what is as wide as the line, in most rows, with few jumps. That is a path of least cost, and
dynamic programming finds the best of all paths in one pass, without a seed, from both sides at once.

A path takes at most one candidate per row. Each candidate taken earns its likeness: 1 at the line's width, falling to
0 where the width check ends; one that fails it earns nothing and is never taken. A tenth of it goes by the light.
Speckle scatters the width of a single row from half to twice the line's, so widths are averaged (fading over about five
rows each way) along neighbours within a line width: a reflection is too wide in all its rows, the line only by chance.
A reflection that touches the line widens it on one side only, so twice the narrower half may pass as the width too.
Between one candidate and the next of the path, d line widths to the side cost min(STIFF d, jump + FAR d): a bend costs
what it bends; a step of the surface, a damage or a reflection costs a jump, the more the further it goes. Rows in
between cost nothing, whether damage, darkness or reflection fills them.
Further than gate_max_px (or than a tilted line would get over the gap) only a step leads: a block's line starts where
the other one ends, within a few rows, however high the block is; a reflection has rows in common with the line. Where
the line has ended, a reflection far away is no line.

A reflection can be as wide as the line and brighter, over a few hundred rows; then only the surface tells: it is a
straight line over most rows, and a reflection is not on it. So the best path is found twice. In between, the straight
line that most rows have a candidate on (the carrier) is looked for. Where fewer than 40 % of the rows agree on one, a
staircase or a curved part, the first path stands; from 70 % on the carrier has its full say: a candidate on it earns
half as much again, one off it half as much, and one on it that a reflection touches and widens is taken too, if it is
bright. The width is then that of the carrier's own candidates: a lens widens the line, and a line narrower than what
the lens makes of it is a reflection.

Where the line ends, the lens lights rows in which there is no surface; see `leave_glow_out`.

A path is forgotten as soon as a path of a later row within gate_max_px is so much better that coming over from that one
to where it stands costs less than it is behind: the cost is concave in d, so it could not win again. A handful of paths
stay alive.
"""

from __future__ import annotations

import numba as nb
import numpy as np

TIE = 1e-9
FADING = 0.8
"""Share of the width average that the next row keeps."""
ROWS_BACK = 3
"""A candidate's neighbour may be missing in up to two rows."""
STIFF = 1.0
"""Reward lost per line width moved to the side."""
FAR = 0.3
"""The same beyond a jump: of two steps the lower one is likelier."""
TILT = 0.6
"""Across a gap a line may go on this steeply, px a row."""
LEAP_ROWS = 16
"""Rows within which the other side of a high step must be seen."""
IN_COMMON = 2
"""Rows the two sides of a step may both be seen in: the lens blurs its brink."""
LINES_TRIED = 48
ROWS_LOOKED_AT = 64
"""Of all rows, for counting who agrees with a straight line that is tried."""
FEWEST_ROWS = 16
LEAST_SHARE, FULL_SHARE = 0.4, 0.7
"""Rows that must agree on the carrier: below none of it counts, above all."""
TOUCHED = 0.3
"""Least likeness of a bright candidate on the carrier, however wide a reflection makes it."""
DARK_ROWS = 4
"""So many rows without a line end it."""
ROWS_INSIDE = 7
GLOW_ROWS = 32
BORDER_ROWS = 8
BRINK_ROWS = 2
MOST_BLURRED = 1.6
UNSEEN, OFF_THE_CARRIER = 0.9, 0.5
AROUND, SEEN_AROUND = 8, 0.65
ASIDE = 0.5
"""Share of the reward a candidate off the carrier loses."""
BONUS = 0.5
"""Reward for being on the carrier."""
BY_LIGHT = 0.1
"""This share of the reward depends on the light: of two equal paths the brighter one is the line."""
BRIGHT = 0.25
"""A candidate is bright from this share of the mean highest candidate on."""


@nb.njit(cache=True, nogil=True)
def average_halves(counts, shape, half, near, average, track):  # type: ignore[no-untyped-def]
    """Write average (rows, peaks, side, direction): half widths averaged over the rows above, over those below.

    And track (rows, peaks, 2): the first and the last row of the run of neighbours a candidate is in.
    """
    rows = counts.size
    for direction in range(2):
        towards = 1 if direction == 0 else -1
        for i in range(rows):
            r = i if direction == 0 else rows - 1 - i
            for k in range(counts[r]):
                left, right = half[r, k, 0], half[r, k, 1]
                track[r, k, direction] = r
                nearest = near
                for back in range(1, ROWS_BACK + 1):
                    q = r - towards * back
                    if q < 0 or q >= rows:
                        break
                    for p in range(counts[q]):
                        moved = abs(shape[q, p, 0] - shape[r, k, 0])
                        if moved < nearest - TIE:
                            nearest = moved
                            track[r, k, direction] = track[q, p, direction]
                            left = FADING * average[q, p, 0, direction] + (1.0 - FADING) * half[r, k, 0]
                            right = FADING * average[q, p, 1, direction] + (1.0 - FADING) * half[r, k, 1]
                    if nearest < near:
                        break
                average[r, k, 0, direction] = left
                average[r, k, 1, direction] = right


@nb.njit(cache=True, nogil=True)
def likeness(average, widened, expected, factor):  # type: ignore[no-untyped-def]
    """How much a candidate looks like the line, 1 to 0, from its averaged halves (side, direction) in px."""
    left = 0.5 * (average[0, 0] + average[0, 1])
    right = 0.5 * (average[1, 0] + average[1, 1])
    return max(
        likeness_of(2.0 * min(left, right), widened, expected, factor),
        likeness_of(left + right, widened, expected, factor),
    )


@nb.njit(cache=True, nogil=True)
def likeness_of(width, widened, expected, factor):  # type: ignore[no-untyped-def]
    """The same of one width."""
    width = np.sqrt(max(width * width - widened, 0.0625 * width * width))
    times = width / expected if width > expected else expected / width
    if factor <= 1.0:
        return 1.0 if np.log(times) < TIE else 0.0
    # A logarithm costs as much as all the rest of a candidate, and at both ends of the scale none is needed.
    if times >= factor:
        return 0.0
    if times * times <= factor:
        return 1.0
    return max(0.0, min(1.0, 2.0 * (1.0 - np.log(times) / np.log(factor))))


@nb.njit(cache=True, nogil=True)
def mean_of_highest(counts, height):  # type: ignore[no-untyped-def]
    """Mean over the rows with a candidate of its highest one's light."""
    total, rows = 0.0, 0
    for r in range(counts.size):
        if counts[r] > 0:
            highest = height[r, 0]
            for k in range(1, counts[r]):
                highest = max(highest, height[r, k])
            total += highest
            rows += 1
    return total / rows if rows > 0 else 1.0


@nb.njit(cache=True, nogil=True)
def cost(moved, rows_on, is_step, width, jump, gate):  # type: ignore[no-untyped-def]
    """What it costs to go ``moved`` px to the side, ``rows_on`` rows further; infinite where only a step may lead."""
    if moved > max(gate, TILT * rows_on) + TIE and not is_step:
        return np.inf
    widths = moved / width
    return min(STIFF * widths, jump + FAR * widths)


@nb.njit(cache=True, nogil=True)
def judge(  # type: ignore[no-untyped-def]
    counts, shape, height, average, widened, expected, factor, bright, width, touched, carrier, agreeing, earned
):
    """Write what every candidate earns when it is taken, 0 for one that never is."""
    judged = np.isfinite(factor)
    for r in range(counts.size):
        for k in range(counts[r]):
            alike = 1.0
            if judged:
                alike = likeness(average[r, k], widened, expected, factor)
            near = 0.0
            if agreeing > 0.0:
                off = abs(shape[r, k, 0] - carrier[0] - carrier[1] * r) / width
                near = max(0.0, min(1.0, 2.0 - off))
                if height[r, k] >= bright:
                    alike = max(alike, touched * near)
                alike *= 1.0 - agreeing * ASIDE * (1.0 - near)
            if alike > TIE:
                alike *= 1.0 - BY_LIGHT + BY_LIGHT * min(1.0, height[r, k] / bright)
                alike += agreeing * BONUS * near
            earned[r, k] = alike


@nb.njit(cache=True, nogil=True)
def find_carrier(counts, shape, earned, chosen, width, carrier):  # type: ignore[no-untyped-def]
    """Write the straight line (column at row 0, columns per row) that most rows have a candidate on.

    Return the share of the rows with a candidate that do. Lines through two rows of the path are tried.
    """
    rows = counts.size
    on_path = 0
    seen = 0
    for r in range(rows):
        if chosen[r] >= 0:
            on_path += 1
        if counts[r] > 0:
            seen += 1
    if on_path < FEWEST_ROWS:
        return 0.0
    at = np.empty(on_path, np.int64)
    n = 0
    for r in range(rows):
        if chosen[r] >= 0:
            at[n] = r
            n += 1
    every = max(1, rows // ROWS_LOOKED_AT)
    most, column, slope = -1, 0.0, 0.0
    for i in range(LINES_TRIED):
        first = at[(i * n) // LINES_TRIED]
        second = at[((i * n) // LINES_TRIED + n // 4 + ((i * 7) % LINES_TRIED) * n // (2 * LINES_TRIED)) % n]
        if abs(second - first) < rows // 8 or first == second:
            continue
        here, there = shape[first, chosen[first], 0], shape[second, chosen[second], 0]
        per_row = (there - here) / (second - first)
        start = here - per_row * first
        agree = 0
        for r in range(0, rows, every):
            for k in range(counts[r]):
                if earned[r, k] > TIE and abs(shape[r, k, 0] - start - per_row * r) <= width + TIE:
                    agree += 1
                    break
        if agree > most:
            most, column, slope = agree, start, per_row
    if most < 0:
        return 0.0
    for _ in range(2):
        count, sum_r, sum_c, sum_rr, sum_rc = 0, 0.0, 0.0, 0.0, 0.0
        for r in range(rows):
            nearest, off = -1, width + 2.0 * TIE
            for k in range(counts[r]):
                away = abs(shape[r, k, 0] - column - slope * r)
                if earned[r, k] > TIE and away < off - TIE:
                    nearest, off = k, away
            if nearest >= 0:
                c = shape[r, nearest, 0]
                count += 1
                sum_r += r
                sum_c += c
                sum_rr += r * r
                sum_rc += r * c
        spread = count * sum_rr - sum_r * sum_r
        if count < FEWEST_ROWS or spread <= 0.0:
            return 0.0
        slope = (count * sum_rc - sum_r * sum_c) / spread
        column = (sum_c - slope * sum_r) / count
    carrier[0], carrier[1] = column, slope
    return count / seen


@nb.njit(cache=True, nogil=True)
def width_on(counts, shape, earned, average, carrier, width, widened, expected):  # type: ignore[no-untyped-def]
    """Median width (px, as the image shows it without smoothing) of the candidates on the carrier."""
    widths = np.empty(counts.size)
    n = 0
    for r in range(counts.size):
        for k in range(counts[r]):
            if earned[r, k] > TIE and abs(shape[r, k, 0] - carrier[0] - carrier[1] * r) <= width + TIE:
                a = average[r, k]
                whole = 0.5 * (a[0, 0] + a[0, 1] + a[1, 0] + a[1, 1])
                widths[n] = np.sqrt(max(whole * whole - widened, 0.0625 * whole * whole))
                n += 1
    if n == 0:
        return expected
    return np.partition(widths[:n], n // 2)[n // 2]


@nb.njit(cache=True, nogil=True)
def find_path(  # type: ignore[no-untyped-def]
    counts, shape, half, height, widened, expected, factor, width, touched, jump, gate, average, track, score,
    back_row, back_peak, alive, chosen, confidence,
):  # fmt: skip
    """Choose the candidate of every row that is on the best path, -1 where there is none; see `trust` for confidence.

    ``expected`` width (px) as the image shows it and the factor it may be off (inf: any); ``width`` of the light, the
    unit of moving; ``touched`` is TOUCHED, or 0 for a camera whose grey values do not tell bright from dim.
    ``average, track, score, back_row, back_peak, alive`` are scratch.
    """
    average_halves(counts, shape, half, width, average, track)
    bright = BRIGHT * mean_of_highest(counts, height)
    carrier = np.zeros(2)
    earned = np.zeros_like(score)
    judge(counts, shape, height, average, widened, expected, factor, bright, width, touched, carrier, 0.0, earned)
    best_path(counts, shape, earned, width, jump, gate, track, score, back_row, back_peak, alive, chosen)
    share = find_carrier(counts, shape, earned, chosen, width, carrier)
    agreeing = 0.0
    if share >= LEAST_SHARE:
        if np.isfinite(factor):
            blurred = width_on(counts, shape, earned, average, carrier, width, widened, expected)
            expected = min(MOST_BLURRED * expected, max(expected, blurred))
        agreeing = min(1.0, (share - LEAST_SHARE) / (FULL_SHARE - LEAST_SHARE))
        judge(
            counts, shape, height, average, widened, expected, factor, bright, width, touched, carrier, agreeing, earned
        )
        best_path(counts, shape, earned, width, jump, gate, track, score, back_row, back_peak, alive, chosen)
    leave_glow_out(height, chosen)
    trust(counts, shape, average, widened, expected, factor, width, carrier, agreeing, earned, chosen, confidence)


@nb.njit(cache=True, nogil=True)
def trust(  # type: ignore[no-untyped-def]
    counts, shape, average, widened, expected, factor, width, carrier, agreeing, earned, chosen, confidence
):
    """Write how sure it is, 0 to 1, that the path's candidate is the line; NaN where there is none.

    The product of three: how near the carrier it is (off it, how much the row's best other candidate earns in
    comparison), whether its width is the line's, and how many of the rows around it have a line. Above 0.9 are only
    points on a straight surface that most rows agree on. How bright it is was tried and says no more.
    """
    rows = counts.size
    for r in range(rows):
        k = chosen[r]
        if k < 0:
            confidence[r] = np.nan
            continue
        rival = 0.0
        for p in range(counts[r]):
            if p != k:
                rival = max(rival, earned[r, p])
        rival = min(1.0, rival / earned[r, k])
        alone = (UNSEEN - (UNSEEN - OFF_THE_CARRIER) * agreeing) * (1.0 - 0.5 * rival)
        near = 0.0
        if agreeing > 0.0:
            near = agreeing * max(0.0, min(1.0, 2.0 - abs(shape[r, k, 0] - carrier[0] - carrier[1] * r) / width))
        alike = 1.0
        if np.isfinite(factor):
            alike = 0.5 + 0.5 * min(1.0, 2.0 * likeness(average[r, k], widened, expected, factor))
        seen, there = 0, 0
        for q in range(max(0, r - AROUND), min(rows, r + AROUND + 1)):
            there += 1
            if chosen[q] >= 0:
                seen += 1
        confidence[r] = (alone + (1.0 - alone) * near) * alike * min(1.0, seen / (SEEN_AROUND * there))


@nb.njit(cache=True, nogil=True)
def leave_glow_out(height, chosen):  # type: ignore[no-untyped-def]
    """Where the line ends at darkness, take the rows away that only the lens lights.

    The image of a brink has half the light of the surface there; beyond it a lens spreads the light of an edge as
    1 / distance (simulated at f/4 to f/8: 0.05 to 0.2 over the rows between, 9 of 10 rows below 0.25).
    """
    rows = chosen.size
    inside = np.empty(ROWS_INSIDE, np.int64)
    for way in (1, -1):
        dark = DARK_ROWS
        nearest = BORDER_ROWS  # the frame's border may cut the line, and a single row of speckle is dark
        for i in range(rows):
            r = i if way == 1 else rows - 1 - i
            if chosen[r] >= 0 and (dark < DARK_ROWS or not is_glow(height, chosen, r, way, nearest, inside)):
                dark = 0
            else:
                chosen[r] = -1
                dark += 1
                nearest = 1


@nb.njit(cache=True, nogil=True)
def is_glow(height, chosen, r, way, nearest, inside):  # type: ignore[no-untyped-def]
    """Whether the rows further on (``way``) outshine row r so much that its light is theirs."""
    rows = chosen.size
    for d in range(nearest, GLOW_ROWS + 1):
        n = 0
        for on in range(d, d + ROWS_INSIDE):
            q = r + way * on
            if 0 <= q < rows and chosen[q] >= 0:
                inside[n] = height[q, chosen[q]]
                n += 1
        times = 2 * d if d <= BRINK_ROWS else 4 * d
        if n > ROWS_INSIDE // 2 and times * height[r, chosen[r]] < np.partition(inside[:n], n // 2)[n // 2]:
            return True
    return False


@nb.njit(cache=True, nogil=True)
def best_path(  # type: ignore[no-untyped-def]
    counts, shape, earned, width, jump, gate, track, score, back_row, back_peak, alive, chosen
):
    """Choose the candidates on the path of the most earnings less costs, -1 where there is none."""
    rows = counts.size
    chosen[:] = -1
    best, end_row, end_peak = 0.0, -1, -1
    living = 0
    for r in range(rows):
        fresh = living
        for k in range(counts[r]):
            own = earned[r, k]
            if own <= TIE:
                continue
            value, from_row, from_peak = own, -1, -1
            for s in range(living - 1, -1, -1):  # the latest first: it wins a tie
                q, p = alive[s, 0], alive[s, 1]
                if score[q, p] + own <= value + TIE:
                    continue  # even for nothing this is no better way
                moved = abs(shape[r, k, 0] - shape[q, p, 0])
                starts, ends = track[r, k, 0] >= q - IN_COMMON, track[q, p, 1] <= r + IN_COMMON
                is_step = starts and ends and r - q <= LEAP_ROWS
                through = score[q, p] + own - cost(moved, r - q, is_step, width, jump, gate)
                if through > value + TIE:
                    value, from_row, from_peak = through, q, p
            score[r, k] = value
            back_row[r, k], back_peak[r, k] = from_row, from_peak
            if value > best + TIE:
                best, end_row, end_peak = value, r, k
            if fresh < alive.shape[0]:
                alive[fresh, 0], alive[fresh, 1] = r, k
                fresh += 1
        # Forget what can be reached more cheaply by coming over from this row.
        kept = 0
        for s in range(fresh):
            q, p = alive[s, 0], alive[s, 1]
            keep = True
            if s < living:
                for n in range(living, fresh):
                    if score[alive[n, 0], alive[n, 1]] < score[q, p]:
                        continue
                    moved = abs(shape[alive[n, 0], alive[n, 1], 0] - shape[q, p, 0])
                    if moved > gate + TIE:
                        continue
                    if score[alive[n, 0], alive[n, 1]] - cost(moved, 0, False, width, jump, gate) >= score[q, p]:
                        keep = False
                        break
            if keep:
                alive[kept, 0], alive[kept, 1] = q, p
                kept += 1
        living = kept
    while end_row >= 0:
        chosen[end_row] = end_peak
        end_row, end_peak = back_row[end_row, end_peak], back_peak[end_row, end_peak]
