"""Line and bar charts as SVG text: sharp at any size, a few kilobytes, and no plotting library to depend on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

COLOURS = ("#1f5fa8", "#c0392b", "#1e8449", "#8e44ad", "#b9770e", "#34495e")
WIDTH, HEIGHT = 640, 360
LEFT, RIGHT, TOP, BOTTOM = 62, 16, 40, 62


@dataclass(frozen=True)
class Series:
    """One line, or one bar per group. NaN leaves a gap."""

    name: str
    values: Sequence[float]


@dataclass(frozen=True)
class Mark:
    """A dashed level across the chart, for a value from elsewhere."""

    name: str
    value: float


def bars(title: str, unit: str, groups: Sequence[str], series: Sequence[Series], marks: Sequence[Mark] = ()) -> str:
    """Groups of bars side by side, the value over every bar."""
    chart = _Chart(title, unit, _top([v for s in series for v in s.values] + [m.value for m in marks]))
    wide = chart.width / len(groups)
    bar = wide * 0.8 / len(series)
    for g, group in enumerate(groups):
        chart.text(LEFT + wide * (g + 0.5), HEIGHT - BOTTOM + 16, group, "middle")
        for k, one in enumerate(series):
            value = one.values[g]
            if not math.isfinite(value):
                continue
            x, y = LEFT + wide * (g + 0.1) + bar * k, chart.y(value)
            chart.parts.append(
                f'<rect x="{x:.1f}" y="{y:.1f}" width="{bar * 0.92:.1f}" height="{HEIGHT - BOTTOM - y:.1f}" '
                f'fill="{COLOURS[k % len(COLOURS)]}"/>'
            )
            chart.text(x + bar * 0.46, y - 3, f"{value:.0f}" if value >= 100 else f"{value:.3g}", "middle", 9)
    return chart.finished(series, marks)


def lines(
    title: str, unit: str, along: str, at: Sequence[float], series: Sequence[Series], marks: Sequence[Mark] = ()
) -> str:
    """One line per series over the places ``at``, drawn at equal distances."""
    chart = _Chart(title, unit, _top([v for s in series for v in s.values] + [m.value for m in marks]))
    wide = chart.width / len(at)
    for k, place in enumerate(at):
        chart.text(LEFT + wide * (k + 0.5), HEIGHT - BOTTOM + 16, f"{place:g}", "middle")
    chart.text(LEFT + chart.width / 2, HEIGHT - BOTTOM + 31, along, "middle")
    for k, one in enumerate(series):
        points = [
            (LEFT + wide * (i + 0.5), chart.y(value)) for i, value in enumerate(one.values) if math.isfinite(value)
        ]
        colour = COLOURS[k % len(COLOURS)]
        told = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        chart.parts.append(f'<polyline points="{told}" fill="none" stroke="{colour}" stroke-width="2"/>')
        chart.parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="{colour}"/>' for x, y in points]
    return chart.finished(series, marks)


def _top(values: Sequence[float]) -> float:
    return max((v for v in values if math.isfinite(v)), default=1.0) * 1.12 or 1.0


class _Chart:
    def __init__(self, title: str, unit: str, top: float) -> None:
        self.top = top
        self.width = WIDTH - LEFT - RIGHT
        frame = f'viewBox="0 0 {WIDTH} {HEIGHT}" font-family="sans-serif" font-size="11"'
        self.parts = [
            f'<svg xmlns="http://www.w3.org/2000/svg" {frame}><title>{escape(title)}</title>',
            f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>',
        ]
        self.text(LEFT, 16, title, "start", 13)
        step = 10 ** math.floor(math.log10(top))
        step = next(s for s in (step / 5, step / 2, step, 2 * step) if top / s <= 7)
        for k in range(int(top / step) + 1):
            y = self.y(k * step)
            self.parts.append(f'<path d="M{LEFT} {y:.1f}H{WIDTH - RIGHT}" stroke="#dddddd"/>')
            self.text(LEFT - 6, y + 4, f"{k * step:g}", "end")
        self.parts.append(
            f'<text transform="translate(16 {(TOP + HEIGHT - BOTTOM) / 2:.0f}) rotate(-90)" text-anchor="middle">'
            f"{escape(unit)}</text>"
        )

    def y(self, value: float) -> float:
        return HEIGHT - BOTTOM - (HEIGHT - BOTTOM - TOP) * value / self.top

    def text(self, x: float, y: float, text: str, anchor: str, size: int = 11) -> None:
        self.parts.append(
            f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-size="{size}">{escape(text)}</text>'
        )

    def finished(self, series: Sequence[Series], marks: Sequence[Mark]) -> str:
        for mark in marks:
            y = self.y(mark.value)
            self.parts.append(f'<path d="M{LEFT} {y:.1f}H{WIDTH - RIGHT}" stroke="#555555" stroke-dasharray="5 4"/>')
            self.text(WIDTH - RIGHT - 3, y - 4, mark.name, "end", 10)
        x = float(LEFT)
        for k, one in enumerate(series):
            self.parts.append(
                f'<rect x="{x:.0f}" y="{HEIGHT - 18}" width="10" height="10" fill="{COLOURS[k % len(COLOURS)]}"/>'
            )
            self.text(x + 14, HEIGHT - 9, one.name, "start")
            x += 26 + 6.3 * len(one.name)
        return "\n".join([*self.parts, "</svg>\n"])
