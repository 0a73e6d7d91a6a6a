"""The charts of the documentation are well-formed and show what they were given."""

from __future__ import annotations

import math
from xml.etree import ElementTree

import pytest

from benchmarks.plots import Mark, Series, bars, lines

SVG = "{http://www.w3.org/2000/svg}"


def test_bars_are_as_high_as_their_values() -> None:
    chart = bars("a < b & c", "um", ["x", "y"], [Series("s", [2.0, 4.0]), Series("t", [1.0, math.nan])], [Mark("m", 3)])
    root = ElementTree.fromstring(chart)
    drawn = [r for r in root.iter(f"{SVG}rect") if float(r.get("height", "0").rstrip("%")) not in (10.0, 360.0)]
    heights = [float(r.get("height", "0")) for r in drawn]
    assert len(heights) == 3
    assert heights[1] / heights[0] == pytest.approx(0.5, abs=0.01)
    assert heights[2] / heights[0] == pytest.approx(2.0, abs=0.02)
    assert "a < b & c" in [t.text for t in root.iter(f"{SVG}text")]


def test_a_line_rises_with_its_values_and_skips_what_is_not_known() -> None:
    root = ElementTree.fromstring(lines("t", "um", "p", [0.25, 1, 2], [Series("s", [1.0, math.nan, 3.0])]))
    points = [one.get("points", "").split() for one in root.iter(f"{SVG}polyline")]
    assert len(points) == 1
    ys = [float(p.split(",")[1]) for p in points[0]]
    assert len(ys) == 2
    assert ys[1] < ys[0]
