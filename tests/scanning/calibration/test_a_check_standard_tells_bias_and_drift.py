"""One known step, measured again and again: its bias, how sure it is, and whether the rig drifts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scanning.calibration import Calibration, calibrate
from scanning.check_standard import Check, drift_of, measure_step, read_history, write_history
from scanning.errors import BadInput
from scanning.gauge import Gauge, Tread

STEP_MM = 0.36


def line(u_scale: float = 0.0) -> Calibration:
    columns = [10.0, 20.0, 30.0, 40.0, 50.0]
    heights = [0.014 * c + 0.001 * e for c, e in zip(columns, (1, -1, 0, -1, 1), strict=True)]
    return calibrate(heights, columns, u_scale_relative=u_scale)


def gauge(step_um: float, u_px: float = 0.02, levelled: bool = False, u_askew: float = 0.001) -> Gauge:
    rise = step_um / (1000 * line().slope_mm_per_px)
    low = Tread(0, 100, 15.0, u_px, 3000, 0.0, 0.001)
    high = Tread(110, 210, 15.0 + rise, u_px, 3000, 0.0, 0.001)
    return Gauge((low, high), "rows", 7.15, 14.0, 0.0, u_askew, levelled)


def check(step_um: float, *, u_px: float = 0.02, u_reference_um: float = 0.5) -> Check:
    return measure_step(
        gauge(step_um, u_px), [0.0, STEP_MM], line(), u_reference_um=u_reference_um, taken_on="2026-11-24", stack="s"
    )


def history(biases: list[float]) -> list[Check]:
    return [check(360.0 + bias) for bias in biases]


def test_the_bias_is_measured_minus_certified() -> None:
    one = check(362.5)
    assert (one.measured_um, one.reference_um) == pytest.approx((362.5, 360.0))
    assert one.bias_um == pytest.approx(2.5)


def test_its_uncertainty_combines_treads_slope_and_standard() -> None:
    """GUM 5.1.2: the root of the sum of squares."""
    one = check(360.0)
    treads = 1000 * line().slope_mm_per_px * 0.02 * np.sqrt(2)
    slope = 360.0 * line().u_slope_mm_per_px / line().slope_mm_per_px
    assert one.u_treads_um == pytest.approx(treads)
    assert one.u_slope_um == pytest.approx(slope)
    assert one.u_bias_um == pytest.approx(np.sqrt(treads**2 + slope**2 + 0.25))


def test_a_slope_taken_out_of_the_treads_leaves_its_uncertainty() -> None:
    level = measure_step(gauge(360, levelled=True), [0, STEP_MM], line(), taken_on="2026-11-24", stack="s")
    assert level.u_treads_um > check(360.0).u_treads_um
    assert level.u_treads_um == pytest.approx(
        1000 * line().slope_mm_per_px * np.hypot(0.02 * np.sqrt(2), 0.11), rel=1e-3
    )


def test_a_bias_holds_within_twice_its_uncertainty() -> None:
    u = check(360.0).u_bias_um
    assert check(360.0 + 1.9 * u).holds
    assert not check(360.0 + 2.1 * u).holds
    assert not check(360.0 - 2.1 * u).holds


def test_the_last_tread_may_be_the_lower_one() -> None:
    turned = gauge(360.0)
    turned = replace(turned, treads=(replace(turned.treads[0], column_px=60.0), turned.treads[1]))
    one = measure_step(turned, [0.0, 0.28], line(), taken_on="2026-11-24", stack="s")
    assert one.measured_um > 0


def test_too_few_checks_give_no_limits() -> None:
    drift = drift_of(check(360.0), history([0.1] * 7))
    assert drift.state == "too few"
    assert "1 more" in drift.sentence
    assert drift.drift_um is None


BASELINE = [0.3, -0.2, 0.1, -0.4, 0.2, 0.0, -0.1, 0.4, -0.3, 0.1]


def test_a_check_like_the_others_is_in_control() -> None:
    drift = drift_of(check(360.1), history(BASELINE))
    assert drift.state == "in control"
    assert drift.mean_um == pytest.approx(np.mean(BASELINE))
    reach = 3 * np.mean(np.abs(np.diff(BASELINE))) / 1.128
    assert (drift.lower_um, drift.upper_um) == pytest.approx((np.mean(BASELINE) - reach, np.mean(BASELINE) + reach))


def test_a_jump_is_out_of_control() -> None:
    drift = drift_of(check(363.0), history(BASELINE))
    assert drift.state == "out of control"
    assert "lies outside" in drift.sentence
    assert "jumped" in drift.sentence


def test_a_slow_drift_is_seen_by_the_average_before_any_single_check_is() -> None:
    """0.06 um more from check to check: each lies within the limits, U is thirty times as large."""
    seen = history(BASELINE)
    found = None
    for k in range(1, 60):
        one = check(360.0 + 0.06 * k)
        drift = drift_of(one, seen)
        if drift.state == "out of control":
            found = k, one, drift
            break
        seen.append(one)
    assert found is not None
    k, one, drift = found
    assert "drifted" in drift.sentence
    assert "lies outside" not in drift.sentence
    assert one.holds
    assert drift.drift_um is not None
    assert drift.drift_limit_um is not None
    assert drift.drift_um > drift.drift_limit_um
    assert k < 20


def test_limits_do_not_learn_from_later_checks() -> None:
    steady, later = history(BASELINE * 2), history([5.0] * 30)
    assert drift_of(check(360.0), [*steady, *later]).upper_um == drift_of(check(360.0), steady).upper_um


def test_false_alarms_are_rare_on_a_steady_rig() -> None:
    """Known limits alarm once in 200 points with both charts (370 and 503); limits from 20 points somewhat more."""
    rng = np.random.default_rng(5)
    alarms = points = 0
    for _ in range(60):
        seen = history(list(rng.normal(0, 1.0, 20)))
        for bias in rng.normal(0, 1.0, 12):
            one = check(360.0 + bias)
            drift = drift_of(one, seen)
            points += 1
            if drift.state == "out of control":
                alarms += 1
                break
            seen.append(one)
    assert alarms / points < 0.04


def test_another_calibration_or_another_step_starts_a_new_chart() -> None:
    seen = history(BASELINE)
    assert drift_of(check(360.0), [replace(one, calibration="other") for one in seen]).earlier == 0
    assert drift_of(check(360.0), [replace(one, reference_um=250.0) for one in seen]).earlier == 0


def test_the_history_survives_its_file(tmp_path: Path) -> None:
    seen = history(BASELINE)
    write_history(tmp_path / "checks.csv", seen)
    assert read_history(tmp_path / "checks.csv") == seen
    assert read_history(tmp_path / "none-yet.csv") == []


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is no history of checks"),
        ("height_mm,column_px\n1,2\n", "is no history of checks"),
        ("HEAD\n2026-11-24,s,c,360,361,1,0.5,0.1,x,0\n", "line 2: u_slope_um is no number"),
        ("HEAD\n2026-11-24,s,c,360\n", "line 2: measured_um is no number"),
        ("HEAD\n2026-11-24,s,c,360,361,1,inf,0.1,1,0\n", "line 2: u_bias_um is no number"),
    ],
)
def test_a_broken_history_is_named_with_its_line(tmp_path: Path, text: str, said: str) -> None:
    write_history(tmp_path / "head.csv", [])
    head = (tmp_path / "head.csv").read_text().strip()
    (tmp_path / "checks.csv").write_text(text.replace("HEAD", head))
    with pytest.raises(BadInput) as caught:
        read_history(tmp_path / "checks.csv")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_standard_of_impossible_uncertainty_is_refused() -> None:
    with pytest.raises(BadInput, match="must be a number from 0 upwards"):
        check(360.0, u_reference_um=-1.0)


def test_treads_too_small_for_an_uncertainty_are_refused() -> None:
    with pytest.raises(BadInput, match="too small to say how sure"):
        check(360.0, u_px=float("nan"))
