"""calibrate: pairs from a step gauge, or a scan of the gauge itself, become a line with its uncertainty."""

from __future__ import annotations

import argparse
import datetime as dt
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scanning.commands.stacks_read import GAUGE_RECIPE, heights_mm, range_image_of
from scanning.errors import BadInput

if TYPE_CHECKING:
    from scanning.calibration import Calibration
    from scanning.gauge import Gauge
    from scanning.triangulation import Comparison

NAME = "calibrate"
HELP = "fit height on pixel through the pairs of a step gauge, or through a scan of the gauge"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "pairs", metavar="PAIRS.csv", type=Path, nargs="?", help="CSV with the columns height_mm,column_px"
    )
    parser.add_argument("--gauge", metavar="STACK", type=Path, help="a scan of the staircase gauge, instead of pairs")
    parser.add_argument("--heights", metavar="MM,MM,...", help="certified heights of the treads, in their order")
    parser.add_argument(
        "--recipe", default=GAUGE_RECIPE, help="recipe for the gauge's scan (default: fused, unaveraged)"
    )
    parser.add_argument("--lies-true", action="store_true", help="the gauge is not tilted: do not take its slope out")
    parser.add_argument("--gauge-name", default="", help="gauge and certificate, kept with the calibration")
    parser.add_argument("--measured-on", metavar="DATE", help="day of the measurement, as 2026-11-24")
    parser.add_argument("--expires-on", metavar="DATE", help="last day of validity")
    parser.add_argument("--optics", choices=("IS1", "IS2"), default="IS1", help="camera whose eq. (1) is compared")
    parser.add_argument(
        "--axis-column", type=float, help="column of the optical axis (default: middle of the scan, or of the sensor)"
    )
    parser.add_argument("--out", metavar="FILE.json", type=Path, help="also write the calibration to this file")


def run(arguments: argparse.Namespace) -> tuple[dict[str, Any], list[str]]:
    from scanning.calibration import calibrate, read_calibration
    from scanning.gauge import find_gauge, match_heights
    from scanning.report import to_text
    from scanning.triangulation import Triangulation, compare_models, system_named
    from scanning.whole_file import whole_file

    if (arguments.pairs is None) == (arguments.gauge is None):
        raise BadInput("give either PAIRS.csv or --gauge STACK, one of the two")
    gauge: Gauge | None = None
    system = system_named(arguments.optics)
    axis = arguments.axis_column
    if arguments.gauge is None:
        if arguments.heights is not None:
            raise BadInput("--heights belongs to --gauge; pairs already have their heights")
        line = read_calibration(arguments.pairs)
    else:
        if arguments.heights is None:
            raise BadInput("--gauge needs --heights, the certified height of every tread in mm, in order")
        image = range_image_of(arguments.gauge, arguments.recipe)
        gauge = find_gauge(image, level=not arguments.lies_true)
        if axis is None:
            axis = (image.provenance["header"]["columns"] - 1) / 2.0
        heights = match_heights(gauge, heights_mm(arguments.heights))
        where = f"the scan {arguments.gauge.name}"
        columns = [t.column_px for t in gauge.treads]
        line = calibrate(heights, columns, u_scale_relative=gauge.u_scale_relative, where=where)
    line = _dated(line, arguments)
    comparison: Comparison | None = None
    if system.stand_off_mm is not None:
        seen_from = Triangulation(system) if axis is None else Triangulation(system, axis)
        comparison = compare_models(line, seen_from)
    told = line.to_json()
    told["standing"] = line.standing(dt.date.today())[0]  # noqa: DTZ011 - the mill's own calendar day
    told["models"] = None if comparison is None else comparison.to_json()
    if gauge is not None:
        told["gauge_scan"] = {**gauge.to_json(), "stack": arguments.gauge.name, "recipe": arguments.recipe}
    if arguments.out is not None:
        with whole_file(arguments.out) as part:
            part.write_text(to_text(told), encoding="utf-8")
    return told, _lines(line, gauge, comparison)


def _dated(line: Calibration, arguments: argparse.Namespace) -> Calibration:
    """The same line with the name and dates given, checked."""
    from scanning.calibration import calibrate

    changed = replace(
        line,
        gauge=arguments.gauge_name or line.gauge,
        measured_on=arguments.measured_on or line.measured_on,
        expires_on=arguments.expires_on or line.expires_on,
    )
    return calibrate(
        changed.heights_mm,
        changed.columns_px,
        gauge=changed.gauge,
        measured_on=changed.measured_on,
        expires_on=changed.expires_on,
        u_scale_relative=changed.u_scale_relative,
        where=str(arguments.pairs or arguments.gauge),
    )


def _lines(line: Calibration, gauge: Gauge | None, comparison: Comparison | None) -> list[str]:
    low_px, high_px = line.range_px
    low_mm, high_mm = line.range_mm
    of_line = line.u_slope_mm_per_px / abs(line.slope_mm_per_px)
    doubt = f"{line.u_slope_mm_per_px:.2g} ({100 * of_line:.2f} %)"
    lines = [
        f"slope          {line.slope_mm_per_px:.7f} mm/px +- {doubt}",
        f"intercept      {line.intercept_mm:.6f} mm +- {line.u_intercept_mm:.2g}, correlation {line.correlation:.3f}",
        f"residuals      largest {line.max_residual_um:.2f} um, standard deviation {line.residual_sd_um:.2f} um",
        f"leave one out  largest {line.leave_one_out_um:.2f} um",
        f"valid for      {low_px:g} ... {high_px:g} px, {low_mm:g} ... {high_mm:g} mm ({line.pairs} pairs)",
        f"standing       {line.standing(dt.date.today())[1]}",  # noqa: DTZ011
    ]
    if gauge is not None:
        taken = "taken out" if gauge.levelled else "left in, as it was said to lie true"
        lines.append(f"gauge          {len(gauge.treads)} treads found along the {gauge.direction}")
        askew = f"{gauge.askew_um_per_mm:.2f} +- {gauge.u_askew_um_per_mm:.2f} um per mm"
        lines.append(f"laid askew     {askew} ({taken})")
        if gauge.contradicts:
            lines.append("note           the treads slope more than chance allows; leave --lies-true out")
        lines.append(f"scale          known to {100 * line.u_slope_relative:.2f} %, what the tilt leaves open included")
    lines += ["", "  height mm   column px" + ("  u(column) px" if gauge else "") + "   residual um   left out um"]
    both = "   eq. (1): residual, left out um" if comparison is not None else ""
    lines[-1] += both
    for k, (height, column) in enumerate(zip(line.heights_mm, line.columns_px, strict=True)):
        row = f"  {height:9.4f}  {column:10.4f}"
        if gauge is not None:
            row += f"  {gauge.treads[k].u_column_px:12.4f}"
        row += f"  {line.residuals_um[k]:12.2f}  {line.leave_one_out_each_um[k]:12.2f}"
        if comparison is not None:
            curve = comparison.curve
            row += f"  {1000 * curve.residuals[k]:20.2f}  {1000 * curve.leave_one_out[k]:12.2f}"
        lines.append(row)
    if comparison is not None:
        verdict = f"{comparison.better} predicts better"
        if not comparison.decided:
            verdict = "this gauge cannot tell them apart"
        straight, bent = comparison.line_leave_one_out_um, comparison.curve_leave_one_out_um
        inside, depth = comparison.difference_um, comparison.difference_depth_um
        lines += [
            "",
            f"left out, rms  straight line {straight:.2f} um, eq. (1) {bent:.2f} um: {verdict}",
            f"they differ    by up to {inside:.2f} um in the calibrated range, {depth:.1f} um over 2.4 mm",
            "heights        use the straight line",
        ]
    return lines
