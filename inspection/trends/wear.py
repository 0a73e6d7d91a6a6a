"""How fast an edge wears, and when it will reach its limit, with what that forecast is worth.

A straight line through the scans of one wear segment (from one regrind to the next) and its 95 % prediction interval.
A forecast without the interval would send a knife to the grinder on the word of two noisy scans; a line drawn across a
regrind would say that wear heals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy import stats

#: Fewer points than this give no line at all.
POINTS_FOR_RATE = 3
#: Fewer points than this give a rate, marked as low confidence, but no interval.
POINTS_FOR_INTERVAL = 4
CONFIDENCE = 0.95

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class TimeToLimit:
    """When the fitted line reaches a limit, on the fit's own life axis.

    ``at`` is None when the line does not rise. ``earliest`` and ``latest`` are where the upper and the lower bound of
    the prediction interval cross the limit: None where there is no such crossing (``latest`` None = no upper bound,
    because the slope is not significantly above zero) or no interval (fewer than four points).
    """

    limit: float
    at: float | None
    earliest: float | None
    latest: float | None


@dataclass(frozen=True)
class WearFit:
    """w = intercept + rate * life, by least squares over ``n`` scans.

    ``s`` is the standard deviation used for intervals: that of the residuals, but never less than the measurement's own
    standard uncertainty, because three points on a straight line by luck do not make the rig more precise.
    """

    n: int
    intercept: float
    rate: float
    u_intercept: float
    u_rate: float
    s_fit: float
    s: float
    mean_life: float
    sxx: float
    first_life: float
    last_life: float

    @property
    def low_confidence(self) -> bool:
        return self.n < POINTS_FOR_INTERVAL

    def value(self, life: float | Float64) -> float | Float64:
        return self.intercept + self.rate * life

    def half_width(self, life: float | Float64, confidence: float = CONFIDENCE) -> float | Float64:
        """Half the prediction interval of one more scan at ``life``; NaN with fewer than four points."""
        if self.low_confidence:
            return np.full(np.shape(life), np.nan) if np.ndim(life) else float("nan")
        spread = 1.0 + 1.0 / self.n + (np.asarray(life, float) - self.mean_life) ** 2 / self.sxx
        width = self._k(confidence) * np.sqrt(spread)
        return width if np.ndim(life) else float(width)

    def time_to_limit(self, limit: float, confidence: float = CONFIDENCE) -> TimeToLimit:
        """Return when the line reaches ``limit`` with its interval: the roots of
        (L - a - b t)^2 = t_q^2 s^2 (1 + 1/n + (t - tbar)^2 / Sxx), solved in closed form.
        """
        at = (limit - self.intercept) / self.rate if self.rate > 0 else None
        if self.low_confidence:
            return TimeToLimit(limit, at, None, None)
        k2 = self._k(confidence) ** 2
        c = 1.0 + 1.0 / self.n
        gap = limit - self.intercept - self.rate * self.mean_life
        a2 = self.rate**2 - k2 / self.sxx
        a0 = gap**2 - k2 * c
        quarter_disc = k2 * (c * a2 + gap**2 / self.sxx)
        if a2 > 0 and self.rate > 0:
            # Both bounds cross once. The stable form avoids subtracting two nearly equal numbers.
            big = gap * self.rate + np.copysign(sqrt(quarter_disc), gap)
            roots = sorted((big / a2, a0 / big if big else 0.0))
            return TimeToLimit(limit, at, self.mean_life + roots[0], self.mean_life + roots[1])
        if quarter_disc < 0 or a2 == 0 or gap <= 0:
            return TimeToLimit(limit, at, None, None)
        # The slope may be zero: only the upper bound reaches the limit, at the later of its two crossings.
        roots = sorted((gap * self.rate + sign * sqrt(quarter_disc)) / a2 for sign in (-1.0, 1.0))
        return TimeToLimit(limit, at, self.mean_life + roots[1], None)

    def _k(self, confidence: float) -> float:
        return float(stats.t.ppf(0.5 + confidence / 2, self.n - 2)) * self.s


def fit_wear(life: Sequence[float], values: Sequence[float], u: Sequence[float | None] = ()) -> WearFit | None:
    """Fit the wear line of one segment; None if there are fewer than three points or they share one life value.

    ``life`` in the tool's life unit or in days, ``values`` in the metric's unit, ``u`` their standard uncertainties in
    the same unit (None = not known). Pairs with a non-finite member are left out.
    """
    pairs = [(x, y) for x, y in zip(life, values, strict=True) if isfinite(x) and isfinite(y)]
    n = len(pairs)
    if n < POINTS_FOR_RATE:
        return None
    x, y = np.array(pairs, dtype=float).T
    mean_x, mean_y = float(x.mean()), float(y.mean())
    sxx = float(((x - mean_x) ** 2).sum())
    if sxx <= 0.0:
        return None
    rate = float(((x - mean_x) * (y - mean_y)).sum()) / sxx
    intercept = mean_y - rate * mean_x
    residuals = y - intercept - rate * x
    s_fit = sqrt(float((residuals**2).sum()) / (n - 2))
    known = [value for value in u if value is not None and isfinite(value)]
    floor = sqrt(sum(value**2 for value in known) / len(known)) if known else 0.0
    s = max(s_fit, floor)
    return WearFit(
        n=n,
        intercept=intercept,
        rate=rate,
        u_intercept=s * sqrt(1.0 / n + mean_x**2 / sxx),
        u_rate=s / sqrt(sxx),
        s_fit=s_fit,
        s=s,
        mean_life=mean_x,
        sxx=sxx,
        first_life=float(x.min()),
        last_life=float(x.max()),
    )
