"""inspect: a range image becomes metrics and a list of damages, each with its uncertainty."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

NAME = "inspect"
HELP = "measure wear and damage on a range image"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("range", metavar="RANGE", type=Path, help="range.npz, its folder, or an X3P file")
    parser.add_argument("--baseline", metavar="RANGE", type=Path, help="the same region of the new tool")
    parser.add_argument(
        "--calibration", type=Path, help="JSON of a calibration or CSV of gauge pairs, for uncertainties"
    )


def run(arguments: argparse.Namespace) -> tuple[dict[str, Any], list[str]]:
    from scanning.calibration import read_calibration
    from scanning.exchange import read_range
    from scanning.surface import inspect_surface

    image = read_range(arguments.range)
    baseline = read_range(arguments.baseline) if arguments.baseline else None
    calibration = read_calibration(arguments.calibration) if arguments.calibration else None
    report = inspect_surface(image, baseline=baseline, calibration=calibration).to_json()
    report["range"] = {"name": arguments.range.name, "provenance": image.provenance}
    report["baseline"] = None if arguments.baseline is None else arguments.baseline.name
    lines = [_line(one) for one in report["measurements"] if one["scope"] == "region"]
    lines += [""] if report["damages"] else []
    for damage in report["damages"]:
        lines += [f"damage {damage.get('number')} ({damage.get('severity')})"]
        lines += [
            "  " + _line(one) for one in report["measurements"] if one["scope"] == f"damage {damage.get('number')}"
        ]
    lines += [f"warning: {one}" for one in report["warnings"]]
    return report, lines


def _line(one: dict[str, Any]) -> str:
    if one["value"] is None:
        return f"{one['label']:44s} not known"
    doubt = "" if one["u"] is None else f" +- {one['u']:.2g}"
    return f"{one['label']:44s} {one['value']:.5g}{doubt} {one['unit']}".rstrip()
