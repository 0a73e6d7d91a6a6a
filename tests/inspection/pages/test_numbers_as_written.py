"""Numbers are cut at their uncertainty, nothing measured is said in words, times in what people say."""

from __future__ import annotations

import datetime as dt
import math

import pytest
from django.utils import timezone

from inspection.selectors.overview import worst
from inspection.templatetags.plant import ago_words, duration, figure, percent, quantity, with_uncertainty
from inspection.units import with_unit_signs as with_units


@pytest.mark.parametrize(
    ("value", "u", "written"),
    [
        (123.456, 1.7, ("123.5", "3.4")),
        (0.0123456, 0.00041, ("0.01235", "0.00082")),
        (98765.0, 340.0, ("98760", "680")),
        (-0.0001, 0.02, ("0.000", "0.040")),
        (214.0, 4.4, ("214.0", "8.8")),
        (3.0, None, ("3", "")),
        (2.5, 0.0, ("2.5", "")),
        (2.5, math.nan, ("2.5", "")),
        (None, 1.0, ("", "")),
        (math.nan, 1.0, ("", "")),
        (math.inf, 1.0, ("", "")),
    ],
)
def test_a_value_is_rounded_to_its_uncertainty(value: float | None, u: float | None, written: tuple[str, str]) -> None:
    assert with_uncertainty(value, u) == written


def test_nothing_measured_is_said_in_words() -> None:
    for nothing in (None, math.nan):
        assert "not measured" in quantity(nothing, 1.0, "um")
        assert "not measured" in str(percent(nothing))
        assert "not measured" in str(figure(nothing))


def test_units_are_written_as_people_write_them() -> None:
    assert "0.40 µm" in quantity(12.3, 0.2, "um")
    assert with_units("Depth is 239 um in 0.07 mm3; the sum stays") == "Depth is 239 µm in 0.07 mm³; the sum stays"


@pytest.mark.parametrize(
    ("share", "text"), [(0.0, "0.0 %"), (2e-6, "below 0.01 %"), (0.0042, "0.42 %"), (0.25, "25 %")]
)
def test_small_shares_do_not_become_zero(share: float, text: str) -> None:
    assert percent(share) == text


@pytest.mark.parametrize(
    ("seconds", "text"), [(42, "42 s"), (190, "3 min 10 s"), (1500, "25 min"), (7500, "2 h 05 min")]
)
def test_durations_read_aloud(seconds: float, text: str) -> None:
    assert duration(seconds) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (10, "now"),
        (200, "3 min ago"),
        (7300, "2 h ago"),
        (86400, "1 day ago"),
        (5 * 86400, "5 days ago"),
        (-600, "in 10 min"),
    ],
)
def test_moments_are_told_from_now(seconds: int, text: str) -> None:
    now = timezone.now()
    assert ago_words(now - dt.timedelta(seconds=seconds), now) == text


@pytest.mark.parametrize(
    ("parts", "whole"),
    [
        (["ok", "ok", "ok"], "ok"),
        (["ok", "watch", "ok"], "watch"),
        (["ok", "unknown"], "unknown"),
        (["watch", "unknown"], "watch"),
        (["ok", None], "unknown"),
        (["replace", None], "replace"),
        ([None, None], None),
        ([], None),
    ],
)
def test_a_tool_is_as_bad_as_its_worst_region(parts: list[str | None], whole: str | None) -> None:
    assert worst(parts) == whole
