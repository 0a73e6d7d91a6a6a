"""process: a stack of scan images becomes a range image and its precision report."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from scanning.commands.progress import shown
from scanning.errors import BadInput
from scanning.recipe import Recipe

NAME = "process"
HELP = "turn a stack of scan images into a range image and a precision report"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("stack", metavar="STACK", type=Path, help="folder with stack.json and images, or an .h5 stack")
    parser.add_argument("--recipe", required=True, help=f"one of {', '.join(Recipe.NAMES)}")
    parser.add_argument(
        "--set",
        dest="settings",
        metavar="NAME=VALUE",
        nargs="+",
        action="extend",
        default=[],
        help="change parameters of the recipe, for example sci.mode=sliding glt.p=1",
    )
    parser.add_argument("--calibration", type=Path, help="JSON of a calibration or CSV of gauge pairs")
    parser.add_argument("--flat", metavar="ROWS,PROFILES", help="flat sub-region for sigma, for example 200:800,0:241")
    parser.add_argument(
        "--export", choices=("x3p", "csv", "ply", "tiff"), action="append", default=[], help="also write this format"
    )
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder for range.npz and report.json")


def run(arguments: argparse.Namespace) -> tuple[dict[str, Any], list[str]]:
    from scanning.calibration import read_calibration
    from scanning.exchange import WRITERS
    from scanning.pipeline import warm_up
    from scanning.pipeline.stream import process_stack
    from scanning.precision import precision_of, read_flat
    from scanning.recipe import Recipe
    from scanning.report import processing_report, write_results
    from scanning.stacks import open_stack

    recipe = Recipe.named(arguments.recipe).with_settings(_settings(arguments.settings))
    calibration = read_calibration(arguments.calibration) if arguments.calibration else None
    flat = read_flat(arguments.flat) if arguments.flat else None
    if arguments.out.exists() and not arguments.out.is_dir():
        raise BadInput(f"{arguments.out} is a file; give a folder for the results")
    with open_stack(arguments.stack) as stack:
        recipe.check_fits(stack.header)
        # Compiled before the clock starts, so that the cost per range pixel is the pipeline's and not the compiler's.
        warm_up(shown("preparing"))
        image = process_stack(stack, recipe, calibration, shown("step"))
        report = processing_report(
            image, precision_of(image, flat), stack, arguments.stack.resolve().name, partial=stack.partial
        )
    exports = {f"range.{kind}": WRITERS[kind] for kind in arguments.export}
    write_results(arguments.out, image, report, exports)
    return report, _lines(report, arguments.out)


def _settings(given: list[str]) -> dict[str, str]:
    settings: dict[str, str] = {}
    for one in given:
        name, equals, value = one.partition("=")
        if not equals or not name.strip():
            raise BadInput(f'--set "{one}" is not understood; write NAME=VALUE, for example sci.mode=sliding')
        settings[name.strip()] = value.strip()
    return settings


def _lines(report: dict[str, Any], out: Path) -> list[str]:
    sigma, cell, flat = report["sigma_um"], report["lateral_cell_um"], report["flat_region"]
    where = ""
    if flat is not None:
        where = (
            f" in rows {flat['first_row']}:{flat['last_row']}, profiles {flat['first_profile']}:{flat['last_profile']}"
            f" ({flat['chosen']})"
        )
    size = f"{report['rows']} rows x {report['profiles']} profiles"
    lines = [
        f"range image   {size}, {report['row_pitch_um']:.4g} x {report['profile_pitch_um']:.4g} um",
        f"undefined     {report['undefined']['count']} ({100 * report['undefined']['share']:.2f} %)",
        f"saturated     {report['saturated']['count']} ({100 * report['saturated']['share']:.3f} % of frame pixels)",
        "sigma         nothing flat was measured"
        if sigma is None
        else f"sigma         {sigma:.2f} um per cell of {cell[0]:.4g} x {cell[1]:.4g} um{where}",
        f"cost          {report['ns_per_range_pixel'] or 0:.0f} ns per range pixel",
        f"written to    {out}",
    ]
    if report["stack"]["partial"]:
        lines.insert(1, "note          the stack is partial: its recording did not come to its end")
    return lines
