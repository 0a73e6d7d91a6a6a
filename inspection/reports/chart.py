"""The trend of one metric on paper: all regions together, limits as lines, events as marks, the present wear line.

Drawn by ourselves as vectors, because every report generator that borrows a browser for its charts breaks with the
browser's next update.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from typing import Any

from django.utils import timezone

from inspection.reports.svg import FAINT, INK, Drawing, tick_text, ticks
from inspection.units import unit_sign

#: Okabe-Ito colours, told apart by colour-blind readers; the marks differ too.
SERIES = [
    ("#0072b2", "circle"), ("#d55e00", "square"), ("#009e73", "triangle"), ("#cc79a7", "circle"), ("#56b4e9", "square"),
]  # fmt: skip
WATCH, REPLACE = "#b07d00", "#c1121f"
#: More marks than this would hide the curve (grafana#27474); the latest are drawn.
MOST_EVENTS = 8


def draw_trend(trends: Sequence[dict[str, Any]], width: float = 84.0, height: float = 52.0) -> str | None:
    """Return the SVG of one metric's trends (`selectors.trend`), one per region; None if nothing was ever measured."""
    points = [(moment(p["t"]), p["value"]) for trend in trends for p in trend["points"] if p["value"] is not None]
    if not points:
        return None
    limits = next((trend["limits"] for trend in trends if trend["limits"]), None)
    lines = [
        (bound, colour, name)
        for name, colour in (("watch", WATCH), ("replace", REPLACE))
        if (bound := (limits or {}).get(name)) is not None
    ]
    first, last = min(t for t, _ in points), max(t for t, _ in points)
    span = max((last - first).total_seconds(), 4 * 86400.0)
    begin, end = first - dt.timedelta(seconds=0.04 * span), last + dt.timedelta(seconds=0.14 * span)
    top_value = max([v for _, v in points] + [lim for lim, _, _ in lines])
    bottom_value = min([v for _, v in points] + [0.0])
    headroom = 0.08 * ((top_value - bottom_value) or 1.0)
    high, low = top_value + headroom, bottom_value - (headroom if bottom_value < 0 else 0)

    left, top, right, bottom = 11.5, 8.0, 2.0, 5.0
    w, h = width - left - right, height - top - bottom
    paper = Drawing(width, height)

    def x(t: dt.datetime) -> float:
        return left + (t - begin) / (end - begin) * w

    def y(value: float) -> float:
        return float(top + (high - min(max(value, low), high)) / (high - low) * h)

    for value in ticks(low, high, 5):
        paper.line(left, y(value), left + w, y(value), "#e4e8eb", 0.15)
        paper.text(left - 1, y(value) + 0.8, tick_text(value), 2.3, "end")
    for day in _days(begin, end):
        paper.line(x(day), top + h, x(day), top + h + 1)
        paper.text(x(day), top + h + 3.6, f"{day.day} {day:%b %y}", 2.3, "middle")
    for event in _marks(trends[0]["events"], begin, end):
        at = x(moment(event["t"]))
        paper.line(at, top, at, top + h, "#5b6770", 0.25, "0.8 0.6")
        paper.text(at, top - 0.8, event["label"], 2.1, "middle", "#5b6770")
    for limit, colour, name in lines:
        paper.line(left, y(limit), left + w, y(limit), colour, 0.35, "1.8 0.9")
        paper.text(left + w - 0.5, y(limit) - 0.7, f"{name} {tick_text(limit)}", 2.3, "end", colour, halo=True)
    for (colour, shape), trend in zip(SERIES, trends, strict=False):
        line = [(moment(p["t"]), p) for p in (trend["fit"] or {}).get("line", []) if p["t"]]
        line = [(t, p) for t, p in line if t <= end]
        band = [(t, p) for t, p in line if p["low"] is not None]
        outline = [(x(t), y(p["high"])) for t, p in band] + [(x(t), y(p["low"])) for t, p in reversed(band)]
        paper.path(outline, colour, 0, colour)
        paper.path([(x(t), y(p["value"])) for t, p in line if low <= p["value"] <= high], colour, 0.25)
        for p in trend["points"]:
            if p["value"] is not None:
                paper.mark(x(moment(p["t"])), y(p["value"]), shape, colour, p["used"])
    paper.line(left, top, left, top + h, FAINT)
    paper.line(left, top + h, left + w, top + h, FAINT)
    paper.text(2.4, top + h / 2, unit_sign(trends[0]["metric"]["unit"]), 2.4, "middle", INK, -90)
    at = left + 1.0
    for (colour, shape), trend in zip(SERIES, trends, strict=False):
        paper.mark(at, 1.9, shape, colour)
        paper.text(at + 1.6, 2.7, trend["region"]["name"], 2.5)
        at += 5.0 + 1.4 * len(trend["region"]["name"])
    return paper.svg()


def moment(text: str) -> dt.datetime:
    return timezone.localtime(dt.datetime.fromisoformat(text))


def _marks(events: Sequence[dict[str, Any]], begin: dt.datetime, end: dt.datetime) -> list[dict[str, Any]]:
    return [event for event in events if begin <= moment(event["t"]) <= end and event["kind"] != "note"][-MOST_EVENTS:]


def _days(begin: dt.datetime, end: dt.datetime) -> list[dt.datetime]:
    """Local midnights for the axis, about five, whole days apart."""
    start = timezone.localtime(begin).replace(hour=0, minute=0, second=0, microsecond=0) + dt.timedelta(days=1)
    step = max(1, round((end - begin).total_seconds() / 86400 / 4.5))
    found = []
    while start <= end:
        found.append(start)
        start += dt.timedelta(days=step)
    return found
