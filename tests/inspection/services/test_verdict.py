"""How a verdict comes about, as a table. Nothing is ever silently ok."""

from __future__ import annotations

import datetime as dt

import pytest

from inspection.models import Calibration, LimitSet, Rig, ToolType, User
from inspection.services.calibrations import add_calibration
from inspection.services.limits import set_limits
from inspection.services.verdict import Value, judge
from inspection.states import Verdict
from scanning.errors import BadInput

TODAY = dt.date(2026, 6, 1)
PAIRS = "height_mm,column_px\n0.14,100\n0.25,107.7\n0.36,115.5\n0.44,121.2\n0.55,128.8\n"


@pytest.fixture
def limits(tool_type: ToolType, erik: User) -> LimitSet:
    return set_limits(
        tool_type, {"d_max": (50.0, 150.0, "um"), "V-": (0.002, 0.02, "mm3")}, by=erik, reason="Trial at the mill"
    )


@pytest.fixture
def calibration(rig: Rig, erik: User) -> Calibration:
    return add_calibration(
        rig=rig, csv_file=PAIRS, by=erik, artefact="Feeler gauges 17", done_on=dt.date(2026, 1, 1),
        valid_until=dt.date(2026, 12, 31),
    )  # fmt: skip


def values(depth: float | None, volume: float | None = 0.0, u: float = 1.0) -> dict[str, Value]:
    return {"d_max": Value(depth, u, "um", "Depth"), "V-": Value(volume, 0.0001, "mm3", "Missing volume")}


@pytest.mark.parametrize(
    ("depth", "volume", "undefined", "partial", "expected", "says"),
    [
        (10.0, 0.0, 0.01, False, Verdict.OK, "within its limit of 50"),
        (50.0, 0.0, 0.01, False, Verdict.OK, "within"),
        (60.0, 0.0, 0.01, False, Verdict.WATCH, "above the watch limit of 50"),
        (149.0, 0.0, 0.01, False, Verdict.WATCH, "above the watch limit"),
        (160.0, 0.0, 0.01, False, Verdict.REPLACE, "above the replace limit of 150"),
        (10.0, 0.03, 0.01, False, Verdict.REPLACE, "Missing volume is 0.03 mm3"),
        (60.0, 0.03, 0.01, False, Verdict.REPLACE, "Missing volume"),
        (10.0, 0.0, 0.051, False, Verdict.UNKNOWN, "5.1 % of the tool was not measured"),
        (10.0, 0.0, float("nan"), False, Verdict.UNKNOWN, "not measured"),
        (60.0, 0.0, 0.30, False, Verdict.UNKNOWN, "30.0 % of the tool"),
        (160.0, 0.0, 0.30, False, Verdict.REPLACE, "above the replace limit"),
        (None, 0.0, 0.01, False, Verdict.UNKNOWN, "d_max has a limit but was not measured"),
        (float("nan"), 0.0, 0.01, False, Verdict.UNKNOWN, "d_max has a limit"),
        (10.0, 0.0, 0.01, True, Verdict.UNKNOWN, "ended early"),
        (160.0, 0.0, 0.01, True, Verdict.REPLACE, "above the replace limit"),
    ],
)
def test_the_verdict_table(
    limits: LimitSet, calibration: Calibration, depth: float | None, volume: float, undefined: float, partial: bool,
    expected: Verdict, says: str,
) -> None:  # fmt: skip
    got = judge(
        values(depth, volume), undefined_share=undefined, limit_set=limits, calibration=calibration, on=TODAY,
        partial=partial,
    )  # fmt: skip

    assert got.verdict == expected
    # What decided comes first; an "ok" lists every metric that was within its limit.
    assert says in (" ".join(got.reasons) if expected == Verdict.OK else got.reasons[0])


def test_a_large_uncertainty_turns_ok_into_watch(limits: LimitSet, calibration: Calibration) -> None:
    got = judge(values(40.0, u=60.0), undefined_share=0.0, limit_set=limits, calibration=calibration, on=TODAY)

    assert got.verdict == Verdict.WATCH
    assert "upper 95 % bound of 160" in got.reasons[0]


def test_an_expired_calibration_makes_ok_unknown_but_keeps_replace(limits: LimitSet, calibration: Calibration) -> None:
    late = dt.date(2027, 1, 1)
    fine = judge(values(10.0), undefined_share=0.0, limit_set=limits, calibration=calibration, on=late)
    bad = judge(values(300.0), undefined_share=0.0, limit_set=limits, calibration=calibration, on=late)

    assert fine.verdict == Verdict.UNKNOWN
    assert fine.reasons[0] == "The calibration of 2026-01-01 expired on 2026-12-31."
    assert bad.verdict == Verdict.REPLACE
    assert bad.reasons[-1] == "Remark: The calibration of 2026-01-01 expired on 2026-12-31."


def test_the_last_day_of_a_calibration_still_counts(limits: LimitSet, calibration: Calibration) -> None:
    got = judge(values(10.0), undefined_share=0.0, limit_set=limits, calibration=calibration, on=dt.date(2026, 12, 31))

    assert got.verdict == Verdict.OK


def test_without_limits_or_calibration_nothing_is_ok(calibration: Calibration, limits: LimitSet) -> None:
    no_limits = judge(values(10.0), undefined_share=0.0, limit_set=None, calibration=calibration, on=TODAY)
    no_scale = judge(values(10.0), undefined_share=0.0, limit_set=limits, calibration=None, on=TODAY)

    assert no_limits.verdict == no_scale.verdict == Verdict.UNKNOWN


def test_a_value_in_another_unit_than_its_limit_is_not_compared(limits: LimitSet, calibration: Calibration) -> None:
    wrong = {**values(10.0), "d_max": Value(0.3, 0.001, "mm", "Depth")}
    got = judge(wrong, undefined_share=0.0, limit_set=limits, calibration=calibration, on=TODAY)

    assert got.verdict == Verdict.UNKNOWN
    assert "is in mm but its limit is in um" in got.reasons[0]


def test_changing_limits_adds_a_set_and_keeps_the_old(limits: LimitSet, tool_type: ToolType, erik: User) -> None:
    newer = set_limits(tool_type, {"d_max": (10.0, None, "um")}, by=erik, reason="Finer chips wanted")

    assert (limits.version, newer.version) == (1, 2)
    assert limits.limits.get(metric="d_max").replace_above == 150.0


@pytest.mark.parametrize(
    ("asked", "reason", "says"),
    [
        ({"d_max": (50.0, 40.0, "um")}, "x", "below the watch limit"),
        ({"d_max": (float("nan"), 40.0, "um")}, "x", "from 0 up"),
        ({"d_max": (None, None, "um")}, "x", "is empty"),
        ({}, "x", "at least one limit"),
        ({"d_max": (1.0, 2.0, "um")}, "  ", "Say why"),
    ],
)
def test_impossible_limits_are_refused_whole(
    tool_type: ToolType, erik: User, asked: dict[str, tuple[float | None, float | None, str]], reason: str, says: str
) -> None:
    with pytest.raises(BadInput, match=says):
        set_limits(tool_type, asked, by=erik, reason=reason)

    assert not tool_type.limit_sets.exists()


def test_a_reason_shows_no_digits_below_the_uncertainty() -> None:
    from inspection.services.verdict import _figure

    assert _figure(-0.00265, 2.2) == "0"
    assert _figure(123.456, 1.7) == "123"
    assert _figure(0.034331, 0.00012) == "0.0343"
    assert _figure(0.0281) == "0.0281"
