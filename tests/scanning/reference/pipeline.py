"""The pipeline again, in float64, one equation after the other, slow and obvious.

It shares nothing with the product but the reading of the paper, so that a mistake has to be made twice to stay hidden.
A stack here is a list of steps, a step a list of images (shortest exposure first).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
TIE = 1e-9
STRICT = 1 + 1e-12


@dataclass
class Setting:
    """Plain values, so that the product's Recipe is not needed here."""

    order: tuple[str, ...]  # of "sci", "hdre", "glt"
    exposures: tuple[float, ...] = (1.0,)
    dark: float = 0.0
    saturation: int = 255
    window: int = 5
    mode: str = "block"
    saturated: str = "all"
    p: float = 0.5
    k: float = 3.0
    floor: float = 0.1
    floor_from_row_mean: bool = True
    ceiling: float = 0.5
    grain: float = 0.0  # px between two grains of one line
    width: float | None = None  # as the image shows it
    width_factor: float = 2.0
    gate: float = 12.0
    gate_max: float = 64.0
    snr: float = 4.0
    seed: str = "best"
    candidates: str = "noise"
    continuity: str = "path"
    jump: float = 10.0
    touched: float = 0.3  # least likeness of a bright candidate on the carrier
    speed: float | None = None  # px per step of the surface on the sensor, for space-time analysis
    direction: int = 0
    share: float | None = None  # of the way to the centre of gravity in time; None: with which rows agree best
    light_width: float = 3.0  # px, before GLT; 3 where nobody knows


def grey_bits(window: int) -> int:
    bits = 20
    while 255 * 2**bits * window >= 2**31:
        bits -= 1
    return bits


def quantised(grey: Array, window: int) -> Array:
    bits = grey_bits(window)
    return np.rint(grey * 2.0**bits) / 2.0**bits


def eq_6(images: list[Array], saturated: list[NDArray[np.bool_]], s: Setting) -> Array:
    """Longest unsaturated exposure over its time, black level off first, as a share of Sat / e_1, times 255."""
    full = (s.saturation - s.dark) / s.exposures[0]
    result = np.full(images[0].shape, 255.0)
    for image, is_saturated, e in zip(images, saturated, s.exposures, strict=True):
        g = 255.0 * np.maximum(image - s.dark, 0.0) / e / full
        result = np.where(is_saturated, result, g)
    return result


def eq_7(g: Array, p: float) -> Array:
    return 255.0 * (np.log(g + 1.0) / math.log(256.0)) ** p


def windows(steps: int, s: Setting) -> list[range]:
    if "sci" not in s.order:
        return [range(i, i + 1) for i in range(steps)]
    if s.mode == "block":
        return [range(n * s.window, (n + 1) * s.window) for n in range(steps // s.window)]
    return [range(i, i + s.window) for i in range(steps - s.window + 1)]


def grey_images(stack: list[list[NDArray[Any]]], s: Setting) -> list[Array]:
    """The image MSNN sees, per profile; black level already off, so camera noise may be negative."""
    out = []
    window = s.window if "sci" in s.order else 1
    for span in windows(len(stack), s):
        codes = [[np.minimum(image.astype(float), s.saturation) for image in stack[i]] for i in span]
        fused_first = "hdre" in s.order and ("sci" not in s.order or s.order.index("hdre") < s.order.index("sci"))
        tone_first = "glt" in s.order and ("sci" not in s.order or s.order.index("glt") < s.order.index("sci"))
        if fused_first or (tone_first and "hdre" not in s.order):
            singles = []
            for images in codes:
                if fused_first:
                    g = eq_6(images, [image >= s.saturation for image in images], s)
                else:
                    g = 255.0 * np.maximum(images[0] - s.dark, 0.0) / (s.saturation - s.dark)
                if tone_first:
                    g = eq_7(g, s.p)
                singles.append(quantised(g, window))
            image = np.sum(singles, axis=0) / window
            if "glt" in s.order and not tone_first:
                image = quantised(eq_7(image, s.p), 1)
        else:
            means = [np.sum([step[e] for step in codes], axis=0) / window for e in range(len(codes[0]))]
            if "hdre" in s.order:
                full = [sum((step[e] >= s.saturation).astype(int) for step in codes) for e in range(len(codes[0]))]
                need = window if s.saturated == "all" else 1
                image = eq_6(means, [count >= need for count in full], s)
                if "glt" in s.order:
                    image = eq_7(image, s.p)
                image = quantised(image, window)
            elif "glt" in s.order:
                g = 255.0 * np.maximum(means[0] - s.dark, 0.0) / (s.saturation - s.dark)
                image = quantised(eq_7(g, s.p), window)
            else:
                image = means[0] - s.dark  # the noise is measured before it is cut at black
        out.append(image)
    return out


@dataclass
class Peak:
    first: int
    last: int
    height: float
    left: float = 0.0
    right: float = 0.0
    added: float = 0.0  # px^2 of the squared width that come from smoothing
    halves: tuple[float, float] | None = None
    pedestal: float = 0.0

    @property
    def width(self) -> float:
        return without_smoothing(self.right - self.left, self.added)

    @property
    def middle(self) -> float:
        return (self.left + self.right) / 2


def peaks_of_row(row: Array, threshold: float, faint: float, s: Setting) -> list[Peak]:
    P = row  # noqa: N806 - the letter of eq. (8)
    above = threshold * STRICT < P
    peaks: list[Peak] = []
    c = 0
    while c < P.size:
        if not above[c]:
            c += 1
            continue
        end = c
        while end + 1 < P.size and above[end + 1]:
            end += 1
        # cut the run [c, end] where the last non-zero gradient was negative and the next one is positive
        cuts = []
        sign = 0
        for i in range(c + 1, end + 1):
            d = P[i] - P[i - 1]
            if d > 0 and sign < 0:
                cuts.append(i)
            if d != 0:
                sign = 1 if d > 0 else -1
        edges = [c, *cuts, end + 1]
        pieces = [Peak(a, b - 1, float(P[a:b].max())) for a, b in pairwise(edges)]
        peaks += pieces
        c = end + 1
    if s.grain > 0:
        peaks = grains_joined(peaks, s)
    peaks = [peak for peak in peaks if peak.height > faint]
    for peak in peaks:
        half = peak.height / 2
        higher = [i for i in range(peak.first, peak.last + 1) if P[i] > half]
        i, j = higher[0], higher[-1]
        peak.left = i - 0.5
        if i > 0 and P[i - 1] <= half:
            peak.left = i - (P[i] - half) / (P[i] - P[i - 1])
        peak.right = j + 0.5
        if j < P.size - 1 and P[j + 1] <= half:
            peak.right = j + (P[j] - half) / (P[j] - P[j + 1])
    return peaks


def grains_joined(peaks: list[Peak], s: Setting) -> list[Peak]:
    joined: list[Peak] = []
    for peak in peaks:
        if joined:
            before = joined[-1]
            dark_between = peak.first - before.last - 1
            if dark_between <= s.grain:
                joined[-1] = Peak(before.first, peak.last, max(before.height, peak.height))
                continue
        joined.append(peak)
    return joined


def passes(peak: Peak, s: Setting) -> bool:
    return s.width is None or s.width / s.width_factor <= peak.width <= s.width * s.width_factor


def followed(rows: list[list[Peak]], row: int, k: int, s: Setting) -> list[int]:
    chosen = [-1] * len(rows)
    chosen[row] = k
    for order in (range(row - 1, -1, -1), range(row + 1, len(rows))):
        last, missed = rows[row][k], 0
        for r in order:
            gate = min(s.gate * (1 + missed), s.gate_max) + TIE
            best, least = -1, math.inf
            for n, peak in enumerate(rows[r]):
                moved = abs(peak.middle - last.middle)
                cost = moved + abs(peak.width - last.width)
                if moved <= gate and cost < least - TIE:
                    best, least = n, cost
            chosen[r] = best
            if best >= 0:
                last, missed = rows[r][best], 0
            else:
                missed += 1
    return chosen


def the_line(rows: list[list[Peak]], s: Setting) -> list[int]:
    none = [-1] * len(rows)
    bottom_up = range(len(rows) - 1, -1, -1)
    lone = [(r, 0) for r in bottom_up if len(rows[r]) == 1 and passes(rows[r][0], s)]
    ratios = []
    for r in bottom_up:
        for k, peak in enumerate(rows[r]):
            if passes(peak, s):
                others = [p.height for n, p in enumerate(rows[r]) if n != k]
                ratios.append((peak.height / max(others) if others else math.inf, r, k))
    if not ratios:
        return none
    best_ratio = ratios[0]
    for entry in ratios[1:]:
        if entry[0] > best_ratio[0] * STRICT:
            best_ratio = entry
    seeds = lone or [best_ratio[1:]]
    if s.seed == "first":
        return followed(rows, *seeds[0], s)
    seeds = seeds + lone + [(r, k) for r in bottom_up for k in range(len(rows[r])) if passes(rows[r][k], s)]
    everything = sum(len(peaks) for peaks in rows)
    first = followed(rows, *seeds[0], s)
    visited: set[tuple[int, int]] = set()
    best, most, tried = first, -1.0, 0
    for seed in seeds:
        if seed in visited:
            continue
        if tried and (tried >= 16 or everything - len(visited) <= most):
            break
        line = followed(rows, *seed, s)
        on_line = [(r, k) for r, k in enumerate(line) if k >= 0]
        visited |= set(on_line)
        score = sum(likeness(rows[r][k].width, s) for r, k in on_line)
        if score > most + TIE:
            best, most = line, score
        tried += 1
    return best


def likeness(width: float, s: Setting) -> float:
    if s.width is None:
        return 1.0
    if s.width_factor == 1:
        return float(width == s.width)
    return max(0.0, 1 - abs(math.log(width / s.width)) / math.log(s.width_factor))


def looked_at(rows: int) -> list[int]:
    count = min(rows, 32)
    return [(2 * i + 1) * rows // (2 * count) for i in range(count)]


def upper_median(values: Array) -> float:
    return float(np.sort(values, axis=None)[values.size // 2])


def noise_of(image: Array) -> float:
    return 1.4826 / math.sqrt(2) * upper_median(np.abs(np.diff(image[looked_at(len(image))], axis=1)))


def without_smoothing(width: float, added: float) -> float:
    return math.sqrt(max(width**2 - added, width**2 / 16))


def smoothed(image: Array, box: int) -> Array:
    """Three rows summed (the border's row counts twice), by a triangle across the columns, darkness outside."""
    tall = np.pad(image, ((1, 1), (0, 0)), mode="edge")
    sums = np.pad(tall[:-2] + tall[1:-1] + tall[2:], ((0, 0), (box - 1, box - 1)))
    weights = [box - abs(away) for away in range(1 - box, box)]
    return np.asarray(np.sum([w * sums[:, i : i + image.shape[1]] for i, w in enumerate(weights)], axis=0))


def standing_out(image: Array, faint: float, s: Setting) -> list[list[Peak]]:
    box = 3 if s.width is None else min(15, max(3, 2 * math.floor(s.width / 2) + 1))
    added = 8 * math.log(2) * (box**2 - 1) / 6
    # Sums of fractions differ in their last digit where the light is equal; equal light is no slope.
    soft = np.round(smoothed(image, box), 9)
    seen = soft[looked_at(len(soft))]
    level = upper_median(seen)
    apart = 2 * box % seen.shape[1]
    spread = 1.4826 / math.sqrt(2) * upper_median(np.abs(seen - np.roll(seen, -apart, axis=1)))
    reach = math.ceil(2.2 * s.light_width)
    rows = []
    for P, S in zip(image, soft, strict=True):  # noqa: N806
        tops: list[int] = []
        for a, b in flat_stretches(S):
            up = a == 0 or S[a - 1] < S[a]
            down = b == S.size - 1 or S[b + 1] < S[b]
            if not (up and down and S[a] > level + s.snr * spread + 1e-9 * (level + 1)):
                continue
            top = (a + b) // 2
            if tops:
                last = tops[-1]
                lower = min(S[last], S[top])
                if top - last <= s.grain or S[last : top + 1].min() - level > 0.8 * (lower - level):
                    tops[-1] = top if S[top] > S[last] else last
                    continue
            tops.append(top)
        peaks = []
        for n, top in enumerate(tops):
            tall = S[top] - level
            dim = max(level, np.minimum(S, S[top]).mean()) if s.floor_from_row_mean else level
            ends = max(level + 1.5 * spread, dim + s.floor * (S[top] - dim)) * (1 + 1e-12)
            first = last = top
            lowest, highest = top - reach, top + reach
            if n > 0:
                between = list(range(tops[n - 1] + 1, top + 1))
                lowest = max(lowest, max(between, key=lambda i: (-S[i], i)))
            if n + 1 < len(tops):
                between = list(range(top, tops[n + 1]))
                highest = min(highest, min(between, key=lambda i: (S[i], i)))
            while first > max(lowest, 0) and S[first - 1] > ends:
                first -= 1
            while last < min(highest, S.size - 1) and S[last + 1] > ends:
                last += 1
            height = float(P[first : last + 1].max())
            if height <= faint:
                continue
            half = level + tall / 2
            i = j = top
            while i > max(lowest, 0) and S[i - 1] > half:
                i -= 1
            while j < min(highest, S.size - 1) and S[j + 1] > half:
                j += 1
            left, right = i - 0.5, j + 0.5
            if i > 0 and S[i - 1] <= half:
                left = i - (S[i] - half) / (S[i] - S[i - 1])
            if j < S.size - 1 and S[j + 1] <= half:
                right = j + (S[j] - half) / (S[j] - S[j + 1])
            pedestal = min(ends / (3 * box**2), height * ends / S[top])
            peaks.append(Peak(first, last, height, left, right, added, (top - left, right - top), pedestal))
        rows.append(peaks)
    return rows


def flat_stretches(values: Array) -> list[tuple[int, int]]:
    ends = [i for i in range(values.size) if i + 1 == values.size or values[i + 1] != values[i]]
    return list(zip([0, *(e + 1 for e in ends[:-1])], ends, strict=True))


Rows = list[list[int]]


def averaged_halves(rows: list[list[Peak]], s: Setting) -> tuple[list[list[tuple[float, float]]], Rows, Rows]:
    """Half widths left and right of every candidate, averaged over its neighbours above and below.

    And the first and the last row of the run of neighbours it is in.
    """

    def own(peak: Peak) -> Array:
        return np.array(peak.halves if peak.halves is not None else (peak.width / 2, peak.width / 2))

    def one_way(order: list[int]) -> tuple[list[list[Array]], Rows]:
        out: list[list[Array]] = [[] for _ in rows]
        since: Rows = [[] for _ in rows]
        for n, r in enumerate(order):
            for peak in rows[r]:
                value, start = own(peak), r
                for q in order[max(0, n - 3) : n][::-1]:
                    near = [(abs(p.middle - peak.middle), k) for k, p in enumerate(rows[q])]
                    distance, k = s.light_width, -1
                    for d, index in near:
                        if d < distance - TIE:
                            distance, k = d, index
                    if k >= 0:
                        value, start = 0.8 * out[q][k] + 0.2 * own(peak), since[q][k]
                        break
                out[r].append(value)
                since[r].append(start)
        return out, since

    down, first = one_way(list(range(len(rows))))
    up, last = one_way(list(range(len(rows)))[::-1])
    means = [[tuple((a + b) / 2) for a, b in zip(d, u, strict=True)] for d, u in zip(down, up, strict=True)]
    return means, first, last


Carrier = tuple[float, float]
Earned = dict[tuple[int, int], float]


def judged(
    rows: list[list[Peak]], averages: list[list[tuple[float, float]]], width: float | None, carrier: Carrier,
    agreeing: float, s: Setting,
) -> Earned:  # fmt: skip
    """What every candidate earns, those that never are the line left out."""
    earned: Earned = {}
    highest = [max(p.height for p in peaks) for peaks in rows if peaks]
    bright = sum(highest) / len(highest) / 4 if highest else 1.0
    for r, peaks in enumerate(rows):
        for k, peak in enumerate(peaks):
            alike = 1.0
            if width is not None:
                one_side, both = 2 * min(averages[r][k]), sum(averages[r][k])
                off = min(abs(math.log(without_smoothing(w, peak.added) / width)) for w in (one_side, both))
                if s.width_factor == 1:
                    alike = float(off < TIE)
                else:
                    alike = max(0.0, min(1.0, 2 * (1 - off / math.log(s.width_factor))))
            near = 0.0
            if agreeing > 0:
                near = max(0.0, min(1.0, 2 - off_carrier(peak, r, carrier) / s.light_width))
                if peak.height >= bright:
                    alike = max(alike, s.touched * near)
                alike *= 1 - agreeing * 0.5 * (1 - near)
            if alike > TIE:
                earned[r, k] = alike * (0.9 + 0.1 * min(1.0, peak.height / bright)) + 0.5 * agreeing * near
    return earned


def off_carrier(peak: Peak, row: int, carrier: Carrier) -> float:
    return abs(peak.middle - carrier[0] - carrier[1] * row)


def straight_line(rows: list[list[Peak]], earned: Earned, chosen: list[int], s: Setting) -> tuple[Carrier, float]:
    """The line (column at row 0, columns per row) most rows have a candidate on, and the share of rows that do."""
    none = (0.0, 0.0), 0.0
    at = [r for r, k in enumerate(chosen) if k >= 0]
    n = len(at)
    if n < 16:
        return none
    best, most = (0.0, 0.0), -1
    for i in range(48):
        start = i * n // 48
        first, second = at[start], at[(start + n // 4 + i * 7 % 48 * n // 96) % n]
        if first == second or abs(second - first) < len(rows) // 8:
            continue
        here, there = rows[first][chosen[first]].middle, rows[second][chosen[second]].middle
        slope = (there - here) / (second - first)
        tried = here - slope * first, slope
        looked_at = range(0, len(rows), max(1, len(rows) // 64))
        agree = sum(any(k >= 0 for k in [nearest_on(rows[r], r, earned, tried, s)]) for r in looked_at)
        if agree > most:
            best, most = tried, agree
    if most < 0:
        return none
    count = 0
    for _ in range(2):
        on = [(r, k) for r in range(len(rows)) if (k := nearest_on(rows[r], r, earned, best, s)) >= 0]
        count = len(on)
        if count < 16:
            return none
        slope, column = np.polyfit([r for r, _ in on], [rows[r][k].middle for r, k in on], 1)
        best = float(column), float(slope)
    return best, count / sum(1 for peaks in rows if peaks)


def nearest_on(peaks: list[Peak], row: int, earned: Earned, carrier: Carrier, s: Setting) -> int:
    """The candidate nearest to the carrier within a line width, -1 where there is none."""
    nearest, least = -1, s.light_width + 2 * TIE
    for k, peak in enumerate(peaks):
        off = off_carrier(peak, row, carrier)
        if (row, k) in earned and off < least - TIE:
            nearest, least = k, off
    return nearest


def without_glow(rows: list[list[Peak]], chosen: list[int]) -> list[int]:
    """From darkness inwards, rows go that a median of seven d rows further on outshines 4 d times (2 d for d < 3)."""
    for order in (list(range(len(rows))), list(range(len(rows)))[::-1]):
        dark, nearest = 4, 8
        for n, r in enumerate(order):
            glow = False
            for d in range(nearest, 33):
                inner = [q for q in order[n + d : n + d + 7] if chosen[q] >= 0]
                heights = sorted(rows[q][chosen[q]].height for q in inner)
                if chosen[r] >= 0 and len(heights) > 3:
                    glow |= (2 if d <= 2 else 4) * d * rows[r][chosen[r]].height < heights[len(heights) // 2] * (
                        1 - TIE
                    )
            if chosen[r] >= 0 and (dark < 4 or not glow):
                dark = 0
            else:
                chosen[r] = -1
                dark += 1
                nearest = 1
    return chosen


def best_path(rows: list[list[Peak]], s: Setting) -> list[int]:
    """The best path; where most of it is straight, the best one again that knows so; without the lens' glow."""
    averages, first, last = averaged_halves(rows, s)
    earned = judged(rows, averages, s.width, (0.0, 0.0), 0.0, s)
    chosen = richest_path(rows, earned, first, last, s)
    carrier, share = straight_line(rows, earned, chosen, s)
    if share >= 0.4:
        width = s.width
        if width is not None:
            on = [
                without_smoothing(sum(averages[r][k]), rows[r][k].added)
                for r, k in earned
                if off_carrier(rows[r][k], r, carrier) <= s.light_width + TIE
            ]
            seen = sorted(on)[len(on) // 2] if on else width
            width = min(1.6 * width, max(width, seen))
        earned = judged(rows, averages, width, carrier, min(1.0, (share - 0.4) / (0.7 - 0.4)), s)
        chosen = richest_path(rows, earned, first, last, s)
    return without_glow(rows, chosen)


def richest_path(rows: list[list[Peak]], earned: Earned, first: Rows, last: Rows, s: Setting) -> list[int]:
    """Every candidate against every earlier one; latest row first, there the higher column first, wins a tie."""

    def sideways(a: tuple[int, int], b: tuple[int, int]) -> float:
        return abs(rows[a[0]][a[1]].middle - rows[b[0]][b[1]].middle)

    def price(a: tuple[int, int], b: tuple[int, int]) -> float:
        moved, rows_on = sideways(a, b), abs(b[0] - a[0])
        is_step = rows_on <= 16 and first[b[0]][b[1]] >= a[0] - 2 and last[a[0]][a[1]] <= b[0] + 2
        if moved > max(s.gate_max, 0.6 * rows_on) + TIE and not is_step:
            return math.inf
        return min(moved / s.light_width, s.jump + 0.3 * moved / s.light_width)

    def stays(old: tuple[int, int], new: tuple[int, int]) -> bool:
        moved = sideways(old, new)
        over = min(moved / s.light_width, s.jump + 0.3 * moved / s.light_width)
        return moved > s.gate_max + TIE or score[new] - over < score[old]

    score: dict[tuple[int, int], float] = {}
    before: dict[tuple[int, int], tuple[int, int] | None] = {}
    alive: list[tuple[int, int]] = []
    for r in range(len(rows)):
        here = [key for key in earned if key[0] == r]
        for key in here:
            score[key], before[key] = earned[key], None
            for other in sorted(alive, reverse=True):
                through = score[other] + earned[key] - price(other, key)
                if through > score[key] + TIE:
                    score[key], before[key] = through, other
        # From beside it, however long ago: the price without a gap.
        alive = [a for a in alive if all(stays(a, key) for key in here)] + here
    chosen = [-1] * len(rows)
    at: tuple[int, int] | None = None
    for key in sorted(score):
        if at is None or score[key] > score[at] + TIE:
            at = key
    while at is not None:
        chosen[at[0]] = at[1]
        at = before[at]
    return chosen


@dataclass
class Line:
    """The chosen candidate of a row and its centre of gravity."""

    column: float
    peak: Peak


def before_glt(image: Array, s: Setting) -> Array:
    """Light 0..255 that eq. (7) made these grey values of, told apart in steps of 2^-13 of the next power of two."""
    steps = grey_steps(s)
    light = 256.0 ** ((np.floor(image / steps + 1e-6) + 0.5) * steps / 255.0).clip(0, 1) ** (1 / s.p) - 1.0
    return np.where(image < steps * (1 - 1e-6), 0.0, np.rint(light * 4096) / 4096)


def after_glt(light: float, s: Setting) -> float:
    """The grey value of this light, on straight lines between the steps' middles."""
    steps = grey_steps(s)
    middles = (np.arange(math.floor(255.0 / steps + 1e-6) + 1) + 0.5) * steps
    table = np.rint((256.0 ** ((middles / 255.0).clip(0, 1) ** (1 / s.p)) - 1.0) * 4096)
    table[0] = 0.0
    entry = int(np.searchsorted(table, light * 4096))
    if entry == 0:
        return 0.0
    if entry >= table.size:
        return float((table.size - 1) * steps)
    share = (light * 4096 - table[entry - 1]) / (table[entry] - table[entry - 1])
    return float((entry - 1 + share + 0.5) * steps)


def grey_steps(s: Setting) -> float:
    """Grey levels per step of the light looked up."""
    window = s.window if "sci" in s.order else 1
    last = s.order[-1] == "glt" and "hdre" in s.order and "sci" in s.order
    if last and s.order[0] == "hdre":
        whole = 255 * 2.0**20
    elif s.order.index("glt") < (s.order.index("sci") if "sci" in s.order else 0):
        whole = 255 * 2.0 ** grey_bits(window) * window
    else:
        whole = 255 * 2.0 ** grey_bits(window)
    return float(2.0 ** (math.floor(math.log2(whole)) + 1 - 13) * 255 / whole)


def lines(image: Array, s: Setting) -> list[Line | None]:
    """MSNN and eq. (8) on one image whose black level is off; None where there is no line."""
    looked_for = image
    if "glt" in s.order and s.candidates == "noise":
        looked_for = before_glt(image, s)
    faint = s.snr * noise_of(looked_for) * STRICT
    image = np.maximum(image, 0.0)
    looked_for = np.maximum(looked_for, 0.0)
    rows = standing_out(looked_for, faint, s) if s.candidates == "noise" else above_threshold(image, faint, s)
    out: list[Line | None] = []
    for r, k in enumerate(best_path(rows, s) if s.continuity == "path" else the_line(rows, s)):
        out.append(None)
        if k >= 0:
            peak = rows[r][k]
            mask = np.zeros(image.shape[1])
            mask[peak.first : peak.last + 1] = 1
            columns = np.arange(image.shape[1])
            pedestal = peak.pedestal
            if looked_for is not image and "glt" in s.order and s.candidates == "noise":
                pedestal = after_glt(pedestal, s)
            weight = np.maximum(image[r] - pedestal, 0.0) * mask
            if weight.sum() > 0:
                out[r] = Line((columns * weight).sum() / weight.sum(), peak)
    return out


def column_of(found: list[Line | None]) -> Array:
    return np.array([math.nan if line is None else line.column for line in found])


def along_the_diagonals(
    singles: list[Array], centre: int, steps: int, speed: float, found: list[Line | None], s: Setting, last: int
) -> Array:
    """Centre of gravity in time of the light of surface points that move ``speed`` px per image.

    Images from 0 to ``last`` are there; a diagonal that would need others is cut on both sides alike.
    """
    out = column_of(found)
    for r, line in enumerate(found):
        if line is None:
            continue
        light, when = [], []
        for j in range(-(s.window // 2), s.window // 2 + 1):
            a = min(steps, centre + j, last - centre - j)
            for k in range(-a, a + 1):
                P = np.maximum(singles[centre + j + k][r], 0.0)  # noqa: N806
                x = line.column + speed * k
                if max(0, line.peak.first - 1) <= x <= min(P.size - 1, line.peak.last + 1):
                    light.append(max(0.0, float(np.interp(x, np.arange(P.size), P)) - line.peak.pedestal))
                    when.append(k)
        if sum(light) > 0:
            out[r] += speed * np.average(when, weights=light)
    return out


def share_of_the_way(seen: list[tuple[Array, Array]], s: Setting) -> float:
    """The share of the way to the centre of gravity in time with which neighbouring rows agree best."""
    if s.share is not None:
        return s.share
    x, y = [], []
    for column, apart in seen:
        a, b = np.diff(column), np.diff(apart)
        use = np.isfinite(a) & np.isfinite(b)
        for values in (a, b):
            if use.any():
                use = use & (np.abs(np.where(use, values, 0.0)) <= 4.0 * 1.4826 * np.median(np.abs(values[use])))
        x += list(-a[use])
        y += list(b[use])
    if np.sum(np.square(y)) <= 0:
        return 0.6
    best = min(1.0, max(0.0, float(np.dot(x, y) / np.sum(np.square(y)))))
    return (best * len(x) + 0.6 * 30) / (len(x) + 30)


def above_threshold(image: Array, faint: float, s: Setting) -> list[list[Peak]]:
    maxima = image.max(axis=1)
    asked = s.k * image.mean()
    if s.ceiling > 0:
        asked = min(asked, s.ceiling * maxima.mean())
    rows = []
    for P in image:  # noqa: N806
        background = P.mean() if s.floor_from_row_mean else 0.0
        rows.append(peaks_of_row(P, max(asked, background + s.floor * (P.max() - background)), faint, s))
    return rows


def range_columns(stack: list[list[NDArray[Any]]], s: Setting) -> Array:
    """(rows, profiles) columns of the line, px from 0."""
    found = [lines(image, s) for image in grey_images(stack, s)]
    columns = [column_of(one) for one in found]
    if s.speed is not None:
        singles = grey_images(stack, replace(s, order=tuple(o for o in s.order if o != "sci")))
        steps = min(12, math.ceil(2.2 * s.light_width / s.speed))
        need = s.window // 2 + steps
        way = s.direction
        seen: dict[int, list[tuple[Array, Array]]] = {}
        centres = [span[len(span) // 2] for span in windows(len(stack), s)]
        for n, centre in enumerate(centres):
            # A profile comes out with the last image it needs, the first ones with that of the first whole diagonals.
            last = min(max(centre, need) + need, len(stack) - 1)
            if way == 0:
                there = [m for m in range(n, len(centres)) if centres[m] + s.window // 2 <= last]
                longest = max(there, key=lambda m: min(need, centres[m], last - centres[m]))
                ways = {
                    w: along_the_diagonals(singles, centres[longest], steps, w * s.speed, found[longest], s, last)
                    for w in (-1, 1)
                }
                rough = {w: np.abs(np.diff(column)) for w, column in ways.items()}
                if not np.isfinite(rough[1]).any():
                    continue
                way = -1 if np.nanmedian(rough[-1]) <= np.nanmedian(rough[1]) + 1e-9 else 1
            last = len(stack) - 1
            apart = along_the_diagonals(singles, centre, steps, way * s.speed, found[n], s, last) - columns[n]
            reach = min(need, centre, last - centre)
            seen.setdefault(reach, []).append((columns[n], apart))
            columns[n] = columns[n] + share_of_the_way(seen[reach], s) * apart
    return np.stack(columns, axis=1)
