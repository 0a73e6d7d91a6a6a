"""NF as one would write it with OpenCV and NumPy: the measure of what a compiled kernel of our own is worth.

Both readings of MSNN, vectorised over the frame wherever the step from row to row allows it. What is left in Python is
what has a memory: following the nearest peak, and the best path. It is written to be fast, not to lose: 8 bit
operations where 8 bits suffice, one gather for all peaks of a frame. Compared with the product it leaves out the
averaging of widths along the line and the rule for steps, so a few rows differ; `python -m benchmarks speed` prints how
many agree.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Image = NDArray[np.uint8]
WIDTH_FACTOR, GATE_PX, GATE_MAX_PX, SNR, FLOOR, JUMP, FAR, GRAIN_PX = 2.0, 12.0, 64.0, 4.0, 0.02, 10.0, 0.3, 3.0


def literal(frame: Image, dark: int, width_px: float) -> Float64:
    """The paper's MSNN: peaks above max(3 x mean, a tenth of the row's maximum), nearest neighbour, COG; column_px."""
    light = np.asarray(cv2.subtract(frame, np.full_like(frame, dark)), np.uint8)
    rows, columns = light.shape
    highest = cv2.reduce(light, 1, cv2.REDUCE_MAX)[:, 0]
    threshold = np.maximum(3.0 * cv2.mean(light)[0], 0.1 * highest)
    above = light > np.minimum(np.floor(threshold), 255).astype(np.uint8)[:, None]
    padded = np.zeros((rows, columns + 1), np.int8)
    padded[:, :-1] = above.view(np.int8)
    edges = np.diff(padded.ravel(), prepend=np.int8(0))
    first, last = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1
    first, last = first - first // (columns + 1), last - last // (columns + 1)
    first, last = _cut_at_valleys(light, above, first, last)
    row, first, last = first // columns, first % columns, last % columns
    if row.size == 0:
        return np.full(rows, np.nan)
    at = np.clip(first[:, None] + np.arange(int((last - first).max()) + 1), 0, columns - 1)
    own = light[row[:, None], at] * (at <= last[:, None])
    height = own.max(axis=1).astype(np.float64)
    position, width = _half_width(light, row, first, last, height)
    chosen = _nearest(rows, row, position, width, height, width_px)
    taken = chosen[chosen >= 0]
    weight = own[taken].astype(np.float64)
    out = np.full(rows, np.nan)
    out[row[taken]] = (weight * at[taken]).sum(axis=1) / weight.sum(axis=1)
    return out


def _cut_at_valleys(light: NDArray[Any], above: NDArray[np.bool_], first: Int64, last: Int64) -> tuple[Int64, Int64]:
    """A run ends where the gradient turns from negative to positive; the valley pixel still belongs to it.

    Runs are places in the flattened frame; on flat stretches the last gradient that was not zero counts.
    """
    falls = cv2.compare(light[:, 1:], light[:, :-1], cv2.CMP_LT)
    rises = cv2.compare(light[:, 1:], light[:, :-1], cv2.CMP_GT)
    both = (above[:, 1:] & above[:, :-1]).view(np.uint8)
    moves = np.flatnonzero(cv2.bitwise_and(cv2.bitwise_or(falls, rises), both))
    if moves.size == 0:
        return first, last
    up = np.asarray(rises).ravel()[moves] > 0
    to = moves + moves // (light.shape[1] - 1) + 1
    run = np.searchsorted(first, to, side="right")
    cuts = to[1:][up[1:] & ~up[:-1] & (run[1:] == run[:-1])]
    return np.sort(np.concatenate([first, cuts])), np.sort(np.concatenate([last, cuts - 1]))


def _half_width(light: NDArray[Any], row: Int64, first: Int64, last: Int64, height: Float64) -> tuple[Float64, Float64]:
    """(position, width) px where each peak crosses half its height, all peaks at once."""
    columns = light.shape[1]
    reach = int((last - first).max()) + 1
    at = first[:, None] + np.arange(-1, reach + 1)
    values = light[row[:, None], np.clip(at, 0, columns - 1)].astype(np.float64)
    inside = (at >= first[:, None]) & (at <= last[:, None]) & (2.0 * values > height[:, None])
    n = np.arange(row.size)
    i = np.argmax(inside, axis=1)
    j = inside.shape[1] - 1 - np.argmax(inside[:, ::-1], axis=1)
    half = 0.5 * height

    def crossing(inner: Int64, outer: Int64, way: int) -> Float64:
        outside = np.clip(outer, 0, at.shape[1] - 1)
        below = values[n, outside]
        there = (at[n, outside] >= 0) & (at[n, outside] < columns) & (below <= half) & (outside == outer)
        with np.errstate(divide="ignore", invalid="ignore"):
            part = (half - below) / (values[n, inner] - below)
        return np.where(there, at[n, outside] + way * part, at[n, inner] - 0.5 * way)

    left, right = crossing(i, i - 1, 1), crossing(j, j + 1, -1)
    return 0.5 * (left + right), right - left


def _nearest(rows: int, row: Int64, position: Float64, width: Float64, height: Float64, width_px: float) -> Int64:
    """Index of the peak of every row that is nearest to the one before; -1 where none is."""
    begin = np.searchsorted(row, np.arange(rows + 1)).tolist()
    good = (width >= width_px / WIDTH_FACTOR) & (width <= width_px * WIDTH_FACTOR)
    chosen = np.full(rows, -1)
    alone = [r for r in range(rows - 1, -1, -1) if begin[r + 1] - begin[r] == 1 and good[begin[r]]]
    if not alone:
        return chosen
    seed = alone[0]
    where, wide = position.tolist(), width.tolist()
    chosen[seed] = begin[seed]
    for order in (range(seed - 1, -1, -1), range(seed + 1, rows)):
        column, width_before, missed = where[begin[seed]], wide[begin[seed]], 0
        for r in order:
            gate = min(GATE_PX * (1 + missed), GATE_MAX_PX) + 1e-9
            best, least = -1, math.inf
            for k in range(begin[r], begin[r + 1]):
                moved = abs(where[k] - column)
                if moved <= gate and moved + abs(wide[k] - width_before) < least:
                    best, least = k, moved + abs(wide[k] - width_before)
            if best >= 0:
                chosen[r], column, width_before, missed = best, where[best], wide[best], 0
            else:
                missed += 1
    return chosen


def shipped(frame: Image, dark: int, width_px: float) -> Float64:
    """Candidates by noise and the best path, COG above the foot of the line; column_px (rows,)."""
    rows, columns = frame.shape
    box = min(15, max(3, 2 * int(width_px / 2.0) + 1))
    reach = math.ceil(2.2 * width_px)
    light = np.asarray(cv2.subtract(frame, np.full_like(frame, dark)), np.uint8)
    three = cv2.boxFilter(light, cv2.CV_32F, (1, 3), normalize=False, borderType=cv2.BORDER_REPLICATE)
    soft = three
    for _ in range(2):
        soft = cv2.boxFilter(soft, cv2.CV_32F, (box, 1), normalize=False, borderType=cv2.BORDER_CONSTANT)
    sample = soft[:: max(1, rows // 16)]
    level = float(np.median(sample))
    spread = 1.4826 / math.sqrt(2.0) * float(np.median(np.abs(sample[:, 2 * box :] - sample[:, : -2 * box])))
    top = cv2.dilate(soft, np.ones((1, 3), np.uint8))
    row, middle = np.nonzero((soft == top) & (soft > level + SNR * spread))
    if row.size == 0:
        return np.full(rows, np.nan)
    # Of maxima closer than a grain, or on one plateau, the highest stays.
    group = np.concatenate([[0], np.cumsum((np.diff(row) != 0) | (np.diff(middle) > GRAIN_PX))])
    order = np.lexsort((-soft[row, middle], group))
    keep = order[np.concatenate([[0], np.flatnonzero(np.diff(group[order])) + 1])]
    row, middle = row[keep], middle[keep]
    tall = soft[row, middle].astype(np.float64)
    background = np.maximum(level, cv2.reduce(soft, 1, cv2.REDUCE_AVG)[row, 0])
    ends = np.maximum(level + 1.5 * spread, background + FLOOR * (tall - background))
    at = middle[:, None] + np.arange(-reach, reach + 1)
    inside = (at >= 0) & (at < columns)
    clipped = np.clip(at, 0, columns - 1)
    around = soft[row[:, None], clipped]
    base = _joined(inside & (around > ends[:, None]), reach)
    over = _joined(inside & (around > 0.5 * (level + tall)[:, None]), reach)
    n = np.arange(row.size)

    def crossing(edge: Int64, way: int) -> Float64:
        outer = np.clip(edge + way, 0, 2 * reach)
        inner_value, outer_value = around[n, edge].astype(np.float64), around[n, outer].astype(np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            part = (inner_value - 0.5 * (level + tall)) / (inner_value - outer_value)
        return np.asarray(at[n, edge] + way * np.where((outer_value < inner_value) & (part <= 1.0), part, 0.5))

    left = crossing(np.argmax(over, axis=1), -1)
    right = crossing(2 * reach - np.argmax(over[:, ::-1], axis=1), 1)
    widened = 8.0 * math.log(2.0) * (box * box - 1) / 6.0
    width = np.sqrt(np.maximum((right - left) ** 2 - widened, (right - left) ** 2 / 16.0))
    own = np.where(base, light[row[:, None], clipped], 0).astype(np.float64)
    chosen = _best_path(rows, row, 0.5 * (left + right), width, own.max(axis=1), width_px)
    taken = chosen[chosen >= 0]
    weight = np.maximum(own[taken] - (ends[taken] / (3.0 * box * box))[:, None], 0.0) * base[taken]
    out = np.full(rows, np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        out[row[taken]] = (weight * at[taken]).sum(axis=1) / weight.sum(axis=1)
    return out


def _joined(mask: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """What of each row of ``mask`` is joined to its middle column."""
    out = mask.copy()
    out[:, reach:] = np.logical_and.accumulate(mask[:, reach:], axis=1)
    out[:, : reach + 1] = np.logical_and.accumulate(mask[:, reach::-1], axis=1)[:, ::-1]
    return out


def _best_path(rows: int, row: Int64, position: Float64, width: Float64, height: Float64, width_px: float) -> Int64:
    """Index of the candidate of every row on the path of least cost; -1 where there is none."""
    off = np.abs(np.log(np.maximum(width, 1e-9) / width_px))
    earned = np.clip(2.0 * (1.0 - off / math.log(WIDTH_FACTOR)), 0.0, 1.0)
    earned *= 0.9 + 0.1 * np.minimum(1.0, height / (0.25 * max(1e-9, float(height.mean()))))
    begin = np.searchsorted(row, np.arange(rows + 1)).tolist()
    where, reward = position.tolist(), earned.tolist()
    score, before = [0.0] * row.size, [-1] * row.size
    alive: list[int] = []
    for r in range(rows):
        fresh = []
        for k in range(begin[r], begin[r + 1]):
            if reward[k] <= 0.0:
                continue
            best, best_from = reward[k], -1
            for a in alive:
                widths = abs(where[k] - where[a]) / width_px
                through = score[a] + reward[k] - min(widths, JUMP + FAR * widths)
                if through > best:
                    best, best_from = through, a
            score[k], before[k] = best, best_from
            fresh.append(k)
        if fresh:
            strongest = max(score[k] for k in fresh)
            alive = [a for a in alive if score[a] > strongest - JUMP][-8:] + fresh
    chosen = np.full(rows, -1)
    at = int(np.argmax(score)) if row.size else -1
    while at >= 0:
        chosen[row[at]] = at
        at = before[at]
    return chosen
