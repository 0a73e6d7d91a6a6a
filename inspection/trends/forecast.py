"""A tool's forecast as a sentence a foreman can act on, and the wear segments it rests on.

The number alone ("29.9") invites trust it has not earned. The sentence always carries the interval, or says why there
is none, and nothing is extrapolated across a regrind.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from dataclasses import dataclass

from inspection.trends.wear import POINTS_FOR_RATE, TimeToLimit, WearFit, fit_wear
from inspection.units import unit_sign

DAY_S = 86400.0


@dataclass(frozen=True)
class Reading:
    """One scan's value of one metric. ``life`` in the tool's life unit, None where nobody noted it."""

    at: dt.datetime
    life: float | None
    value: float
    u: float | None


@dataclass(frozen=True)
class SegmentFit:
    """The wear line of one segment, over life used when every reading has it, else over days since ``origin``.

    ``life_per_day`` is how fast the tool was used during the segment: it turns a life into a date. None when it cannot
    be told.
    """

    wear: WearFit
    axis: str
    origin: dt.datetime
    origin_life: float
    life_per_day: float | None

    def position(self, at: dt.datetime) -> float:
        """The place of a moment on the date axis, in days."""
        return (at - self.origin).total_seconds() / DAY_S

    def date_of(self, position: float) -> dt.datetime | None:
        """The moment a place on the axis stands for; None when the tool's use per day is not known."""
        if self.axis == "date":
            days = position
        elif self.life_per_day:
            days = (position - self.origin_life) / self.life_per_day
        else:
            return None
        try:
            return self.origin + dt.timedelta(days=days)
        except OverflowError:  # a nearly level line meets its limit after the calendar's end
            return None


def segment_of(moments: Sequence[dt.datetime], ends: Sequence[dt.datetime]) -> list[int]:
    """Number each moment by the wear segment it lies in: 0 before the first end, one more after each.

    Both in rising order. A scan at the very moment of an event shows the new edge.
    """
    numbers, passed = [], 0
    for moment in moments:
        while passed < len(ends) and ends[passed] <= moment:
            passed += 1
        numbers.append(passed)
    return numbers


def fit_segment(readings: Sequence[Reading]) -> SegmentFit | None:
    """Fit one segment's readings, in order of time; None with fewer than three or all at one point of life."""
    if len(readings) < POINTS_FOR_RATE:
        return None
    first, last = readings[0], readings[-1]
    values, u = [r.value for r in readings], [r.u for r in readings]
    days = [(r.at - first.at).total_seconds() / DAY_S for r in readings]
    lives = [r.life for r in readings if r.life is not None]
    if len(lives) == len(readings) and (wear := fit_wear(lives, values, u)):
        used = lives[-1] - lives[0]
        rate = used / days[-1] if days[-1] > 0 and used > 0 else None
        return SegmentFit(wear, "life", first.at, lives[0], rate)
    wear_by_date = fit_wear(days, values, u)
    return SegmentFit(wear_by_date, "date", first.at, 0.0, 1.0) if wear_by_date and last.at > first.at else None


def forecast_sentence(
    *,
    label: str,
    unit: str,
    limit_name: str,
    limit: float,
    fit: SegmentFit | None,
    readings: int,
    latest_value: float | None,
    now: float | None,
    life_unit: str,
) -> tuple[str, TimeToLimit | None]:
    """Say when ``label`` will pass ``limit``, with the 95 % interval or the reason there is none.

    ``now`` is the tool's present place on the fit's axis. Returns the sentence and the numbers behind it (None where
    there is nothing to forecast).
    """
    unit = unit_sign(unit)
    target = f"the {limit_name} limit of {number(limit)} {unit}"
    if latest_value is not None and latest_value > limit:
        return f"{label} is {number(latest_value)} {unit}: {target} is already passed.", None
    if fit is None:
        have = "1 scan" if readings == 1 else f"{readings} scans"
        why = f"{have} since the edge was last renewed; a forecast needs at least {POINTS_FOR_RATE}"
        if readings >= POINTS_FOR_RATE:
            why = "all scans of this edge lie at one point of its life, so they show no rate"
        return f"No forecast for {label}: {why}.", None
    wear = fit.wear
    forecast = wear.time_to_limit(limit)
    if forecast.at is None:
        return f"{label} shows no rising trend over {wear.n} scans, so it does not approach {target}.", forecast
    unit_of_life = "days" if fit.axis == "date" else life_unit
    left = ""
    if now is not None:
        rest = max(0.0, forecast.at - now)
        left = f", {number(rest)} {unit_of_life} from now" if rest else ", which is now"
    at = _place(fit, forecast.at)
    early = _place(fit, forecast.earliest) if forecast.earliest is not None else None
    if wear.low_confidence:
        interval = f"low confidence: only {wear.n} scans, no interval"
    elif forecast.latest is not None and early is not None:
        interval = f"95 %: {early} to {_place(fit, forecast.latest)}"
    elif early is not None:
        interval = f"95 %: not before {early}, no upper bound"
    else:
        interval = "the trend is not yet clear of the scatter, no upper bound"
    unit_text = "" if fit.axis == "date" else f" {life_unit}"
    date = fit.date_of(forecast.at) if fit.axis == "life" else None
    present_use = f"; at the present use about {_day(date)}" if date else ""
    return f"{label} reaches {target} at about {at}{unit_text} ({interval}){left}{present_use}.", forecast


def _place(fit: SegmentFit, position: float) -> str:
    """A place on the fit's axis: the number on the life axis, the day on the date axis."""
    if fit.axis == "life":
        return number(position)
    date = fit.date_of(position)
    return _day(date) if date else f"day {number(position)}"


def _day(date: dt.datetime) -> str:
    return f"{date.day} {date:%B %Y}"


def number(value: float) -> str:
    """Three significant digits, without an exponent for the sizes met in a plant."""
    if value == 0:
        return "0"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
