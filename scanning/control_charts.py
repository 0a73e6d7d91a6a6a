"""Control charts for what should stay the same: noise on the flat part, undefined share, check-standard error.

Never for wear: a wearing tool rises by nature and every run rule fires on it (Nelson names tool wear as the cause of
his third test).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

#: d2 and D4 for moving ranges of two points (NIST/SEMATECH e-Handbook 6.3.2.2).
D2 = 1.128
D4 = 3.267


@dataclass(frozen=True)
class Individuals:
    """An individuals and moving-range chart (I-MR). Values in the metric's unit."""

    mean: float
    mean_range: float
    upper: float
    lower: float
    range_upper: float
    outside: tuple[int, ...]
    range_outside: tuple[int, ...]


def individuals(values: Sequence[float], breaks: Sequence[int] = ()) -> Individuals | None:
    """Return the I-MR chart of ``values`` (NIST 6.3.2.2: mean +- 3 MRbar / 1.128); None without a range.

    ``breaks`` are indices before which something happened (an event, missing scans): no moving range spans them.
    """
    cuts = set(breaks)
    ranges = {i: abs(values[i] - values[i - 1]) for i in range(1, len(values)) if i not in cuts}
    if not ranges:
        return None
    mean = sum(values) / len(values)
    mean_range = sum(ranges.values()) / len(ranges)
    reach = 3 * mean_range / D2
    range_upper = D4 * mean_range
    return Individuals(
        mean=mean,
        mean_range=mean_range,
        upper=mean + reach,
        lower=mean - reach,
        range_upper=range_upper,
        outside=tuple(i for i, value in enumerate(values) if abs(value - mean) > reach),
        range_outside=tuple(i for i, value in ranges.items() if value > range_upper),
    )


@dataclass(frozen=True)
class Ewma:
    """An exponentially weighted moving average with its asymptotic limits."""

    values: tuple[float, ...]
    upper: float
    lower: float
    outside: tuple[int, ...]


def ewma(values: Sequence[float], target: float, sigma: float, weight: float = 0.2, width: float = 2.962) -> Ewma:
    """Return the EWMA of ``values`` starting at ``target`` (NIST 6.3.2.4).

    The default weight and width give a false alarm every 503 points and find a shift of one sigma after 9.4.
    """
    smooth, z = [], target
    for value in values:
        z = weight * value + (1 - weight) * z
        smooth.append(z)
    reach = width * sigma * sqrt(weight / (2 - weight))
    return Ewma(
        values=tuple(smooth),
        upper=target + reach,
        lower=target - reach,
        outside=tuple(i for i, value in enumerate(smooth) if abs(value - target) > reach),
    )


@dataclass(frozen=True)
class Cusum:
    """A tabular CUSUM. ``above`` and ``below`` in the metric's unit; ``run`` counts points since the sum left zero."""

    above: tuple[float, ...]
    below: tuple[float, ...]
    run_above: tuple[int, ...]
    run_below: tuple[int, ...]
    signals: tuple[int, ...]

    def mean_after_shift(self, index: int, target: float, sigma: float, slack: float = 0.5) -> float:
        """Estimate of the new mean at a signal (Montgomery, Introduction to SQC, 9.1)."""
        if self.above[index] >= self.below[index]:
            return target + slack * sigma + self.above[index] / self.run_above[index]
        return target - slack * sigma - self.below[index] / self.run_below[index]


def cusum(values: Sequence[float], target: float, sigma: float, slack: float = 0.5, decision: float = 5.0) -> Cusum:
    """Return the tabular CUSUM of ``values``; ``slack`` (k) and ``decision`` (h) in sigmas (Montgomery 9.1)."""
    above, below, run_above, run_below = [0.0], [0.0], [0], [0]
    for value in values:
        up = max(0.0, value - target - slack * sigma + above[-1])
        down = max(0.0, target - slack * sigma - value + below[-1])
        above.append(up)
        below.append(down)
        run_above.append(run_above[-1] + 1 if up > 0 else 0)
        run_below.append(run_below[-1] + 1 if down > 0 else 0)
    bound = decision * sigma
    return Cusum(
        above=tuple(above[1:]),
        below=tuple(below[1:]),
        run_above=tuple(run_above[1:]),
        run_below=tuple(run_below[1:]),
        signals=tuple(i for i in range(len(values)) if above[i + 1] > bound or below[i + 1] > bound),
    )
