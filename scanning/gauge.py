"""The treads of a step gauge, found in its own range image.

Whoever reads eight columns off a screen, one per step, averages by eye, picks the quiet places, and does not say how
sure he is. Here the scan of the gauge says where its treads lie, which way they run (along the laser line or along the
scan), and what each one's column is, with an uncertainty from the scatter of blocks much larger than speckle.

1. The median over the other direction makes one column per place along the gauge.
2. A wall is where the medians of the places before and behind differ by more than the noise allows, and by at least
   `LEAST_STEP_PX`. Between walls lie treads; those shorter than `FEWEST_PLACES` are chamfers or dirt.
3. Beside every wall a guard is left out: there the line is cut in two, and a window of averaged images sees both sides.
4. A gauge laid askew shows the same slope on every tread, and would be mistaken for a part of the scale (0.1 degrees
   over 7 mm are 12 um, 1.6 % of the paper's gauge). The slope is estimated from all treads together and taken out,
   always: to take it out only where it is significant leaves slopes of up to three uncertainties in. Its uncertainty
   is one of the scale. Who knows that the gauge lies true may say so (``level=False``).
5. A tread's column is the mean of its pixels without those far off (4 robust standard deviations from the median).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from scanning.calibration import fit_line
from scanning.errors import BadInput
from scanning.range_image import RangeImage

Float64 = NDArray[np.float64]
Direction = Literal["rows", "profiles"]

LEAST_STEP_PX = 1.0
FEWEST_PLACES = 8
FEWEST_PIXELS = 30
CHAMFER = 8
"""Places of rounded edges, dirt and short pieces that may lie between two treads, beside the guards."""
SURE = 5.5
"""A wall stands out of the noise of the medians by so many standard deviations."""
SAME_MM = 1e-6
GUARD_ROWS = 8
"""On simulated gauges (f/5.6) the next tread draws a row 3 from the wall by 1.3 um, one 8 from it by 0.2 um."""
DIAGONAL_STEPS = 7
"""Images before and behind the window that space-time analysis reads on the paper's rig."""
REACH = 6
"""Places looked at on either side of a possible wall."""
FAR_OFF = 4.0
ASKEW = 0.001
"""A slope that chance alone gives with less than this probability contradicts that the gauge lies true."""
FLAT = 0.1
"""Treads may bend by this share of the smallest step between neighbours, beyond what noise explains."""
NOISE_OF_PARTS = 9.0
"""How far noise moves the medians of the sixths of a tread apart: in noise of a place over root of the places, with
room for grains of speckle that span four places."""
BLOCK = 10
"""Side of the blocks whose scatter gives uncertainties, pixels: larger than speckle and than an SCI window."""
_MAD = 1.4826


@dataclass(frozen=True)
class Tread:
    """One flat step: places [first, last) along the gauge, its column in px with standard uncertainty, pixels used.

    ``slope_px`` per place, with ``u_slope_px``, is the tread's own slope along the gauge.
    """

    first: int
    last: int
    column_px: float
    u_column_px: float
    pixels: int
    slope_px: float
    u_slope_px: float

    @property
    def middle(self) -> float:
        return (self.first + self.last - 1) / 2.0


@dataclass(frozen=True)
class Gauge:
    """The treads of a gauge in the order in which they lie, from place 0 on.

    ``direction``: "rows" when one walks from tread to tread along the laser line, "profiles" along the scan.
    ``askew_um_per_mm`` is the slope common to all treads, with its standard uncertainty; ``levelled`` says whether it
    was taken out of the columns.
    """

    treads: tuple[Tread, ...]
    direction: Direction
    pitch_um: float
    um_per_px: float
    askew_px: float
    u_askew_px: float
    levelled: bool
    chance_askew: float = 1.0

    @property
    def contradicts(self) -> bool:
        """Whether the treads slope although the gauge was said to lie true."""
        return not self.levelled and self.chance_askew < ASKEW

    @property
    def askew_um_per_mm(self) -> float:
        return self.askew_px * self.um_per_px / self.pitch_um * 1000.0

    @property
    def u_askew_um_per_mm(self) -> float:
        return self.u_askew_px * self.um_per_px / self.pitch_um * 1000.0

    @property
    def u_from_askew_px(self) -> float:
        """What the slope's uncertainty still allows the first and the last tread to be apart, in px."""
        return self.u_askew_px * abs(self.treads[-1].middle - self.treads[0].middle)

    @property
    def u_scale_relative(self) -> float:
        """What the slope's uncertainty allows the whole scale to be wrong by, as a share."""
        columns = [t.column_px for t in self.treads]
        u = self.u_from_askew_px / (max(columns) - min(columns))
        return u if self.levelled and math.isfinite(u) else 0.0

    def to_json(self) -> dict[str, Any]:
        return {
            "direction": self.direction,
            "askew_um_per_mm": self.askew_um_per_mm,
            "u_askew_um_per_mm": self.u_askew_um_per_mm,
            "levelled": self.levelled,
            "u_from_askew_px": self.u_from_askew_px,
            "treads": [
                {"first": t.first, "last": t.last, "column_px": t.column_px, "u_column_px": t.u_column_px,
                 "pixels": t.pixels} for t in self.treads
            ],
        }  # fmt: skip


def find_gauge(image: RangeImage, um_per_px: float | None = None, *, level: bool = True) -> Gauge:
    """Find the treads of the step gauge in a range image.

    ``um_per_px`` (default: the stack header's) only turns the common slope into um per mm. Both directions are tried;
    the one in which steps explain more of the columns is taken. Raises `BadInput` when neither shows two treads.
    """
    column = np.asarray(image.column_px, dtype=np.float64)
    header = image.provenance.get("header")
    scale = um_per_px if um_per_px is not None else _um_per_px(header)
    guards: dict[Direction, int] = {"rows": GUARD_ROWS, "profiles": _smeared(image) + 1}
    pitches: dict[Direction, float] = {"rows": image.row_pitch_um, "profiles": image.profile_pitch_um}
    best: tuple[float, Gauge] | None = None
    most, bend, ramp = 0, 0.0, 0
    for direction in ("rows", "profiles"):
        values = column if direction == "rows" else column.T
        spans = _spans(values, guards[direction])
        most = max(most, len(spans))
        if len(spans) < 2:
            continue
        gauge = _measured(values, spans, direction, pitches[direction], scale, level)
        if len(gauge.treads) < 2:
            continue
        bend = max(bend, _bend(values, gauge))
        ramp = max(ramp, _ramp(values, gauge, guards[direction]))
        if bend > FLAT or ramp > 0:
            continue
        columns = np.array([t.column_px for t in gauge.treads])
        weight = np.array([t.pixels for t in gauge.treads], dtype=np.float64)
        explained = float(weight @ (columns - weight @ columns / weight.sum()) ** 2)
        if best is None or explained > best[0]:
            best = explained, gauge
    if best is None and ramp > 0:
        raise BadInput(
            f"between two level parts the surface rises over {ramp} places instead of in a wall, so this is no step "
            "gauge; scan the gauge, or a cleaner part of it"
        )
    if best is None and bend > FLAT:
        raise BadInput(
            f"what lies between the walls is not flat (it bends by {100 * bend:.0f} % of a step), so these are no "
            "treads of a step gauge; scan the gauge, or a cleaner part of it"
        )
    if best is None:
        seen = int(np.count_nonzero(np.isfinite(column)))
        raise BadInput(
            f"no steps were found in the scan of the gauge ({max(most, 1)} flat tread in {column.shape[0]} rows and "
            f"{column.shape[1]} profiles, {100 * seen / max(column.size, 1):.0f} % of it measured); a wall must be at "
            f"least {LEAST_STEP_PX:g} px high and a tread {FEWEST_PLACES} places long"
        )
    return best[1]


def _bend(values: Float64, gauge: Gauge) -> float:
    """How far the sixths of a tread are apart at worst, beyond their noise, as a share of the smallest step."""
    step = min(abs(a.column_px - b.column_px) for a, b in pairwise(gauge.treads))
    worst = 0.0
    for tread in gauge.treads:
        rows = np.arange(tread.first, tread.last)
        level = values[rows] - (gauge.askew_px * (rows - tread.middle))[:, None]
        places = np.array([float(np.median(one[np.isfinite(one)])) for one in level if np.isfinite(one).any()])
        medians = [float(np.median(part)) for part in np.array_split(places, 6) if part.size]
        noise = NOISE_OF_PARTS * _noise(places) / math.sqrt(max(1.0, places.size / 6.0))
        worst = max(worst, max(medians) - min(medians) - noise)
    return worst / step if step > 0 else math.inf


def _ramp(values: Float64, gauge: Gauge, guard: int) -> int:
    """The most measured places between two treads, when they are more than guards and a chamfer explain; else 0."""
    measured = np.asarray(np.isfinite(values).any(axis=1))
    between = [int(measured[a.last : b.first].sum()) for a, b in pairwise(gauge.treads)]
    return max((n for n in between if n > 2 * guard + max(CHAMFER, guard)), default=0)


def match_heights(gauge: Gauge, heights_mm: Sequence[float]) -> list[float]:
    """The certified height of every tread, in the gauge's order.

    ``heights_mm`` are listed in the order in which the treads lie, from either end: the way round in which columns rise
    with heights is taken. Raises `BadInput` when the numbers differ, or when neither way round fits.
    """
    given, found = [float(h) for h in heights_mm], gauge.treads
    if len(given) != len(found):
        places = ", ".join(f"{t.first}-{t.last - 1}" for t in found)
        more = "more treads than heights" if len(found) > len(given) else "fewer treads than heights"
        raise BadInput(
            f"{more}: {len(found)} treads were found ({gauge.direction} {places}) but {len(given)} heights were given; "
            "list the height of every tread that is in the image, in order"
        )
    columns = [t.column_px for t in found]
    for way in (given, given[::-1]):
        if _rises(columns, way):
            return way
    told = ", ".join(f"{c:.1f}" for c in columns)
    raise BadInput(
        f"the columns found ({told} px) do not rise with the heights given "
        f"({', '.join(f'{h:g}' for h in given)} mm), in neither order; check which height each tread has"
    )


def _rises(columns: Sequence[float], heights: Sequence[float]) -> bool:
    """Whether columns rise wherever heights do; treads of one height (to a nanometre) may be in any order."""
    pairs = sorted(zip(heights, columns, strict=True))
    groups: list[list[float]] = []
    last = -math.inf
    for height, column in pairs:
        if height - last > SAME_MM:
            groups.append([])
        groups[-1].append(column)
        last = height
    return len(groups) > 1 and all(max(low) < min(high) for low, high in pairwise(groups))


def _um_per_px(header: object) -> float:
    if isinstance(header, dict) and isinstance(header.get("mm_per_pixel"), (int, float)):
        return 1000.0 * float(header["mm_per_pixel"])
    return math.nan


def _smeared(image: RangeImage) -> int:
    """How many profiles share images with one another: those of the SCI window, and of the diagonals through it."""
    recipe = image.provenance.get("recipe")
    reach = 1
    for operation in recipe.get("operations", []) if isinstance(recipe, dict) else []:
        if operation.get("operation") == "sci" and operation.get("mode") == "sliding":
            reach += int(operation["window"]) - 1
        if operation.get("operation") == "sta" and image.provenance.get("space_time_direction") is not None:
            reach += DIAGONAL_STEPS
    return reach


# -- where the treads lie ---------------------------------------------------------------------------------------------


def _spans(values: Float64, guard: int) -> list[tuple[int, int]]:
    """Treads along the first axis, guards left out."""
    finite = np.isfinite(values)
    usable = finite.sum(axis=1) >= max(2, 0.2 * finite.sum(axis=1).max(initial=0))
    if np.count_nonzero(usable) < 2 * FEWEST_PLACES:
        return []
    places = np.flatnonzero(usable)
    level = np.array([np.median(values[k][finite[k]]) for k in places])
    # A wall is rare, so the median of the differences between neighbours is the common slope, and their spread noise.
    level = level - float(np.median(np.diff(level) / np.diff(places))) * places
    walls = _walls(level)
    spans = []
    for first, last in zip([0, *walls], [*walls, places.size], strict=True):
        near = min(guard, max(3, (last - first) // 4))
        low = int(places[first]) + (near if first > 0 else 1)
        high = int(places[last - 1]) + 1 - (near if last < places.size else 1)
        if high - low >= FEWEST_PLACES:
            spans.append((low, high))
    return _joined(spans, level, places)


def _walls(level: Float64) -> list[int]:
    """Indices k where level[:k] and level[k:] lie on different treads."""
    noise = _noise(level)
    reach = min(REACH, max(2, level.size // 4))
    jump = np.zeros(level.size)
    for k in range(2, level.size - 1):
        before, behind = level[max(0, k - reach) : k], level[k : k + reach]
        jump[k] = np.median(behind) - np.median(before)
    # Neighbouring medians are correlated (speckle grains span rows), so their mean over `reach` is hardly quieter.
    least = max(LEAST_STEP_PX, SURE * noise)
    walls: list[int] = []
    size = np.abs(jump)
    while True:
        k = int(np.argmax(size))
        if size[k] <= least:
            return sorted(walls)
        # Several places see the same jump of medians; the wall is where the level itself jumps most among them.
        near = np.arange(max(1, k - reach // 2), min(level.size, k + reach // 2 + 1))
        at = int(near[np.argmax(np.sign(jump[k]) * (level[near] - level[near - 1]))])
        walls.append(at)
        size[max(0, at - reach) : at + reach + 1] = 0.0


def _noise(level: Float64) -> float:
    """Standard deviation of one place, from the differences between neighbours."""
    return _MAD * float(np.median(np.abs(np.diff(level)))) / math.sqrt(2.0) if level.size > 1 else 0.0


def _joined(spans: list[tuple[int, int]], level: Float64, places: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Neighbouring spans of one level are one tread (dirt or a scratch between them is not a wall)."""
    out: list[tuple[int, int]] = []
    heights: list[float] = []
    for low, high in spans:
        height = float(np.median(level[(places >= low) & (places < high)]))
        if out and abs(height - heights[-1]) < LEAST_STEP_PX / 2.0:
            out[-1] = (out[-1][0], high)
        else:
            out.append((low, high))
            heights.append(height)
    return out


# -- what their columns are -------------------------------------------------------------------------------------------


def _measured(
    values: Float64, spans: list[tuple[int, int]], direction: Direction, pitch_um: float, um_per_px: float, level: bool
) -> Gauge:
    slopes = [_slope(values[low:high]) for low, high in spans]
    askew, u_askew, chance = _common(slopes)
    levelled = level and math.isfinite(u_askew)
    places = np.arange(values.shape[0], dtype=np.float64)
    middle = (spans[0][0] + spans[-1][1] - 1) / 2.0
    flat = values - (askew * (places - middle))[:, None] if levelled else values
    treads = []
    for (low, high), slope in zip(spans, slopes, strict=True):
        mean, u, pixels = _mean(flat[low:high])
        if pixels >= FEWEST_PIXELS:
            treads.append(Tread(low, high, mean, u, pixels, slope.value, slope.u))
    return Gauge(tuple(treads), direction, pitch_um, um_per_px, askew, u_askew, levelled, chance)


def _common(slopes: Sequence[_Slope]) -> tuple[float, float, float]:
    """The slope of all treads together, its standard uncertainty, and the probability that chance gave it."""
    known = [one for one in slopes if one.freedom > 0]
    if not known:
        return 0.0, math.nan, 1.0
    weights = np.array([one.weight for one in known])
    values = np.array([one.value for one in known])
    slope = float(weights @ values / weights.sum())
    freedom = sum(one.freedom for one in known)
    variance = sum(one.squares for one in known) / freedom
    if len(known) > 1:
        # Treads of feeler gauges are not parallel to each other; their disagreement counts when it is larger.
        between = float(weights @ (values - slope) ** 2) / (len(known) - 1)
        if between > variance:
            variance, freedom = between, len(known) - 1
    u = max(math.sqrt(variance / float(weights.sum())), 1e-12)
    return slope, u, 2.0 * float(student.sf(abs(slope) / u, freedom))


def _near(values: Float64) -> Float64:
    """The values without those far off their median (NaN)."""
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return values
    median = float(np.median(finite))
    spread = max(_MAD * float(np.median(np.abs(finite - median))), 1e-6)
    return np.where(np.abs(values - median) <= FAR_OFF * spread, values, np.nan)


def _mean(values: Float64) -> tuple[float, float, int]:
    """Robust mean of a tread, its standard uncertainty from blocks, and how many pixels it is of."""
    kept = _near(values)
    count = int(np.count_nonzero(np.isfinite(kept)))
    if count < FEWEST_PIXELS:
        return math.nan, math.nan, count
    mean = float(np.nanmean(kept))
    blocks = _blocks(kept)
    u = float(blocks.std(ddof=1)) / math.sqrt(blocks.size) if blocks.size > 1 else math.nan
    return mean, u, count


def _blocks(values: Float64) -> Float64:
    """Means of blocks of 10 x 10 pixels or a few more that are at least half measured; where possible 2 x 2 of them."""
    parts = [np.array_split(np.arange(n), max(n // BLOCK, min(n, 2))) for n in values.shape]
    means = []
    for rows in parts[0]:
        for columns in parts[1]:
            block = values[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
            finite = block[np.isfinite(block)]
            if finite.size * 2 >= block.size:
                means.append(float(finite.mean()))
    return np.array(means)


@dataclass(frozen=True)
class _Slope:
    """px per place; the sum of squares of the places, that of the residuals, and their degrees of freedom."""

    value: float
    weight: float
    squares: float
    freedom: int

    @property
    def u(self) -> float:
        if self.freedom < 1:
            return math.nan
        return math.sqrt(self.squares / self.freedom / self.weight)


def _slope(values: Float64) -> _Slope:
    """Slope along the first axis: a line through the means of blocks."""
    kept = np.where(np.isfinite(_near(values - _line_through(values))), values, np.nan)
    middles, means = [], []
    for places in np.array_split(np.arange(values.shape[0]), max(3, values.shape[0] // BLOCK)):
        for others in np.array_split(np.arange(values.shape[1]), max(1, values.shape[1] // BLOCK)):
            block = kept[places[0] : places[-1] + 1, others[0] : others[-1] + 1]
            finite = np.isfinite(block)
            if np.count_nonzero(finite) * 2 >= block.size:
                middles.append(float(places[np.nonzero(finite)[0]].mean()))
                means.append(float(block[finite].mean()))
    if len(means) < 3 or np.ptp(middles) == 0:
        return _Slope(math.nan, math.nan, math.nan, 0)
    fit = fit_line(middles, means)
    x = np.array(middles) - np.mean(middles)
    return _Slope(fit.slope, float(x @ x), float(fit.residuals @ fit.residuals), len(means) - 2)


def _line_through(values: Float64) -> Float64:
    """The least-squares line along the first axis, (places, 1)."""
    places, others = np.nonzero(np.isfinite(values))
    out = np.zeros((values.shape[0], 1))
    if places.size < 2 or np.ptp(places) == 0:
        return out
    x = places - places.mean()
    z = values[places, others]
    slope = float(x @ (z - z.mean()) / (x @ x))
    out[:, 0] = z.mean() + slope * (np.arange(values.shape[0]) - places.mean())
    return out
