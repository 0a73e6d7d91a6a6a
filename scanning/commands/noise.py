"""noise: two scans of a flat part, the second displaced, say how noisy a single height is."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from scanning.commands.stacks_read import range_image_of

NAME = "noise"
HELP = "noise of a single height from two scans of a flat part, moved between them"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("first", metavar="STACK_A", type=Path, help="a scan of a flat part")
    parser.add_argument("second", metavar="STACK_B", type=Path, help="the same again after the part was moved")
    parser.add_argument("--moved-um", type=float, required=True, help="how far the part was moved")
    parser.add_argument(
        "--along", choices=("rows", "scan"), default="rows", help="moved along the laser line (rows) or the scan"
    )
    parser.add_argument("--recipe", default="NF", help="recipe for both scans (default NF)")
    parser.add_argument("--flat", metavar="ROWS,PROFILES", help="flat sub-region, for example 200:800,0:241")


def run(arguments: argparse.Namespace) -> tuple[dict[str, Any], list[str]]:
    from scanning.precision import read_flat
    from scanning.repeats import refuse_static, repeat_noise

    refuse_static(arguments.moved_um)
    flat = read_flat(arguments.flat) if arguments.flat else None
    first = range_image_of(arguments.first, arguments.recipe)
    second = range_image_of(arguments.second, arguments.recipe)
    found = repeat_noise(first, second, arguments.moved_um, arguments.along, flat)
    told = {"recipe": arguments.recipe, **found.to_json()}
    cell = found.lateral_cell_um
    point = "not enough in common" if found.same_point_um is None else f"{found.same_point_um:.2f} um"
    region = found.flat_region
    rows = f"rows {region.first_row}:{region.last_row}, profiles {region.first_profile}:{region.last_profile}"
    one_value = f"one value over {cell[0]:.4g} x {cell[1]:.4g} um"
    return told, [
        f"noise          {found.noise_um:.2f} um (robust {found.robust_um:.2f}), {one_value}",
        f"from           {found.pixels} pixels, {rows}, moved {found.moved_um:g} um along the {found.along}",
        f"same point     {point}: how well one surface point repeats with its speckle; this is NOT the noise",
    ]
