"""The verdict on one region, in sentences: ok, watch, replace, or unknown.

How it comes about, in this order:

1. Each limited metric is held against its limits: above ``replace_above`` it says replace, above ``watch_above`` watch.
   A value whose upper 95 % bound (value + 2 u) lies beyond ``replace_above`` also says watch: replacing cannot be ruled
   out. The worst one counts.
2. Reasons to distrust the measurement are collected: no limits, no calibration or an expired one, too much of the tool
   not measured, a scan ended early, a limited metric without a value.
3. With any such reason "ok" and "watch" become "unknown": what was not seen, or seen with a scale nobody vouches for,
   may hide the damage that says replace, and "watch" would tell a person that the tool may go on cutting. "replace"
   stays, with the remark: damage that large is there in spite of the doubt, and missing pixels only hide more of it.

So nothing is ever silently ok: ok needs every limited metric measured, in date, over nearly all of the tool.
"""

from __future__ import annotations

import datetime as dt
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from inspection.models import Calibration, LimitSet
from inspection.states import Verdict

#: Beyond this share of the tool not measured, what is missing may be the damage (measuring.md 3, alarm logic).
MOST_UNDEFINED_SHARE = 0.05
#: Coverage factor of the bound that is held against the replace limit (about 95 %).
COVERAGE_K = 2.0

#: Why a metric can be missing, where there is a likelier reason than "it was not measured".
NOT_MEASURED = dict.fromkeys(
    ("ER_max", "ER_mean", "ER_p95", "ER_rms", "EL"),
    "No cutting edge was found in the range image, so its recession could not be held against its limit.",
)


@dataclass(frozen=True)
class Value:
    """A metric's value with its standard uncertainty ``u``, both in ``unit``. None means not measured."""

    value: float | None
    u: float | None = None
    unit: str = ""
    label: str = ""


@dataclass(frozen=True)
class Judgement:
    """A verdict with its reasons, one sentence each, the deciding ones first."""

    verdict: Verdict
    reasons: list[str]


def judge(
    values: Mapping[str, Value],
    *,
    undefined_share: float,
    limit_set: LimitSet | None,
    calibration: Calibration | None,
    on: dt.date,
    partial: bool = False,
    doubts: Iterable[str] = (),
) -> Judgement:
    """Judge one region by its metrics ``values`` against the limits its scan was ordered with.

    ``undefined_share`` is the share of the tool's own pixels without a height (0..1), ``on`` the local day of the scan,
    ``doubts`` further reasons in sentences why the measurement cannot be trusted.
    """
    limits = list(limit_set.limits.all()) if limit_set is not None else []
    worst = Verdict.OK
    findings: list[str] = []
    within: list[str] = []
    distrust = list(doubts)
    for limit in limits:
        got = values.get(limit.metric)
        if got is None or got.value is None or not math.isfinite(got.value):
            distrust.append(NOT_MEASURED.get(limit.metric, f"{limit.metric} has a limit but was not measured."))
            continue
        name = got.label or limit.metric
        shown = f"{name} is {_figure(got.value, got.u)} {limit.unit}"
        bound = got.value + COVERAGE_K * got.u if got.u is not None and math.isfinite(got.u) else got.value
        if got.unit and got.unit != limit.unit:
            distrust.append(f"{name} is in {got.unit} but its limit is in {limit.unit}; set the limit anew.")
        elif limit.replace_above is not None and got.value > limit.replace_above:
            worst = Verdict.REPLACE
            findings.insert(0, f"{shown}, above the replace limit of {limit.replace_above:g} {limit.unit}.")
        elif limit.watch_above is not None and got.value > limit.watch_above:
            worst = Verdict.WATCH if worst == Verdict.OK else worst
            findings.append(f"{shown}, above the watch limit of {limit.watch_above:g} {limit.unit}.")
        elif limit.replace_above is not None and bound > limit.replace_above:
            worst = Verdict.WATCH if worst == Verdict.OK else worst
            findings.append(
                f"{shown} with an upper 95 % bound of {_figure(bound, got.u)}, beyond the replace limit of "
                f"{limit.replace_above:g} {limit.unit}: replacing cannot be ruled out."
            )
        else:
            low = limit.watch_above if limit.watch_above is not None else limit.replace_above
            within.append(f"{shown}, within its limit of {low:g} {limit.unit}.")
    if not limits:
        distrust.append("No limits are set for this tool type, so nothing can be called ok.")
    if calibration is None:
        distrust.append("The rig has no calibration, so heights have no vouched-for scale.")
    elif calibration.expired(on):
        distrust.append(
            f"The calibration of {calibration.done_on:%Y-%m-%d} expired on {calibration.valid_until:%Y-%m-%d}."
        )
    if not undefined_share <= MOST_UNDEFINED_SHARE:  # NaN distrusts too
        most = 100 * MOST_UNDEFINED_SHARE
        distrust.append(
            f"{100 * undefined_share:.1f} % of the tool was not measured, more than the {most:g} % that a "
            f"verdict allows."
        )
    if partial:
        distrust.append("The scan was ended early, so part of the region was not looked at.")
    if not distrust:
        return Judgement(worst, findings or within)
    if worst == Verdict.REPLACE:
        return Judgement(worst, [*findings, *(f"Remark: {reason}" for reason in distrust)])
    return Judgement(Verdict.UNKNOWN, [*distrust, *findings])


def _figure(value: float, u: float | None = None) -> str:
    """Three digits at most, and none below the uncertainty's first: digits nobody measured are no reason."""
    if u is not None and math.isfinite(u) and u > 0:
        value = round(value, -math.floor(math.log10(u))) + 0.0  # + 0.0 turns -0.0 into 0
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
