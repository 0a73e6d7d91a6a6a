"""calibrate: pairs from a step gauge become a line with its uncertainty."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

NAME = "calibrate"
HELP = "fit height on pixel through the pairs of a step gauge"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("pairs", metavar="PAIRS.csv", type=Path, help="CSV with the columns height_mm,column_px")
    parser.add_argument("--out", metavar="FILE.json", type=Path, help="also write the calibration to this file")


def run(arguments: argparse.Namespace) -> tuple[dict[str, Any], list[str]]:
    from scanning.calibration import read_calibration
    from scanning.report import to_text
    from scanning.whole_file import whole_file

    line = read_calibration(arguments.pairs)
    told = line.to_json()
    if arguments.out is not None:
        with whole_file(arguments.out) as part:
            part.write_text(to_text(told), encoding="utf-8")
    low_px, high_px = line.range_px
    low_mm, high_mm = line.range_mm
    doubt = f"{line.u_slope_mm_per_px:.2g} ({100 * line.u_slope_relative:.2f} %)"
    return told, [
        f"slope          {line.slope_mm_per_px:.7f} mm/px +- {doubt}",
        f"intercept      {line.intercept_mm:.6f} mm",
        f"residuals      largest {line.max_residual_um:.2f} um, standard deviation {line.residual_sd_um:.2f} um",
        f"leave one out  largest {line.leave_one_out_um:.2f} um",
        f"valid for      {low_px:g} ... {high_px:g} px, {low_mm:g} ... {high_mm:g} mm ({line.pairs} pairs)",
    ]
