"""check: a scan of one known step says whether the calibration still holds, and whether the rig drifts."""

from __future__ import annotations

import argparse
import datetime as dt
from pathlib import Path
from typing import Any

from scanning.commands.stacks_read import GAUGE_RECIPE, heights_mm, range_image_of
from scanning.errors import BadInput

NAME = "check"
HELP = "measure a known step: bias of the calibration with its uncertainty, and drift since earlier checks"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("stack", metavar="STACK", type=Path, help="a scan of the check standard")
    parser.add_argument(
        "--calibration", type=Path, required=True, help="JSON of a calibration or CSV of gauge pairs, as in use"
    )
    step = parser.add_mutually_exclusive_group(required=True)
    step.add_argument("--step", metavar="MM", type=float, help="height of the one step in the image")
    step.add_argument("--heights", metavar="MM,MM,...", help="heights of all treads, when there are more than two")
    parser.add_argument("--u-step-um", type=float, default=0.0, help="standard uncertainty of the step's own height")
    parser.add_argument("--lies-true", action="store_true", help="the standard is not tilted: its slope is left in")
    parser.add_argument("--recipe", default=GAUGE_RECIPE, help="recipe for the scan (default: fused, unaveraged)")
    parser.add_argument("--taken-on", metavar="DATE", help="day of the check (default: today)")
    parser.add_argument("--history", metavar="FILE.csv", type=Path, help="earlier checks; this one is added")


def run(arguments: argparse.Namespace) -> tuple[dict[str, Any], list[str]]:
    from scanning.calibration import read_calibration
    from scanning.check_standard import COVERAGE, drift_of, measure_step, read_history, to_json, write_history
    from scanning.gauge import find_gauge

    calibration = read_calibration(arguments.calibration)
    history = read_history(arguments.history) if arguments.history is not None else []
    taken_on = _day(arguments.taken_on)
    heights = [0.0, arguments.step] if arguments.heights is None else heights_mm(arguments.heights)
    if arguments.step is not None and not 0 < abs(arguments.step) < 1e3:
        raise BadInput(f"--step {arguments.step} is not a height in mm; write for example 0.36")
    image = range_image_of(arguments.stack, arguments.recipe)
    gauge = find_gauge(image, 1000.0 * calibration.slope_mm_per_px, level=not arguments.lies_true)
    check = measure_step(
        gauge,
        heights,
        calibration,
        u_reference_um=arguments.u_step_um,
        taken_on=taken_on.isoformat(),
        stack=arguments.stack.resolve().name,
    )
    drift = drift_of(check, history)
    if arguments.history is not None:
        write_history(arguments.history, [*history, check])
    state, standing = calibration.standing(taken_on)
    outside = int(sum(not bool(calibration.inside_range(t.column_px)) for t in gauge.treads))
    told = {**to_json(check, drift), "calibration_standing": state, "treads_outside_calibrated_range": outside}
    verdict = "within its uncertainty" if check.holds else "BEYOND its uncertainty: calibrate again"
    parts = f"treads {check.u_treads_um:.2f}, slope {check.u_slope_um:.2f}, standard {check.u_reference_um:.2f}"
    lines = [
        f"step           {check.measured_um:.2f} um measured, {check.reference_um:.2f} um certified",
        f"bias           {check.bias_um:+.2f} um, U = {COVERAGE * check.u_bias_um:.2f} um (k = 2): {verdict}",
        f"uncertainty    {parts} um (one standard deviation each)",
        f"drift          {drift.sentence}",
    ]
    if drift.drift_um is not None:
        lines += [
            f"chart          limits {drift.lower_um:.2f} to {drift.upper_um:.2f} um from {drift.baseline} checks",
            f"average        moved by {drift.drift_um:+.2f} um, limit {drift.drift_limit_um:.2f} um",
        ]
    if state in ("expired", "due"):
        lines.append(f"note           {standing}")
    if outside:
        lines.append(
            f"note           {outside} of {len(gauge.treads)} treads lie outside the calibrated range; there the line "
            "is an extrapolation"
        )
    if arguments.u_step_um == 0.0:
        lines.append("note           the standard's own uncertainty was not given (--u-step-um) and counts as none")
    return told, lines


def _day(written: str | None) -> dt.date:
    if written is None:
        return dt.date.today()  # noqa: DTZ011 - the mill's own calendar day
    try:
        return dt.date.fromisoformat(written)
    except ValueError:
        raise BadInput(f'--taken-on "{written}" is not a date; write it as 2026-11-24') from None
