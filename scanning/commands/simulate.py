"""simulate: a scan of a tool whose shape is known, recorded as other software would leave it, with the truth beside."""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

from scanning.commands.progress import shown
from scanning.errors import BadInput

NAME = "simulate"
HELP = "record a simulated scan, with its truth"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scene", metavar="SCENE", help="R1, R2, R3, gauge or flat")
    parser.add_argument("--out", metavar="STACK", type=Path, required=True, help="folder to record into, new or empty")
    parser.add_argument("--seed", type=int, default=1, help="which individual part (default 1)")
    parser.add_argument("--noise-seed", type=int, default=0, help="which draw of the sensor's noise (default 0)")
    parser.add_argument("--steps", type=int, default=245, help="scan images (default 245)")
    parser.add_argument("--rows", type=int, help="rows along the laser line (default: the scene's)")
    parser.add_argument("--columns", type=int, default=256, help="columns (default 256)")
    parser.add_argument("--exposures", metavar="US,US,...", help="exposure times in us (default 100,300,500,700,900)")
    parser.add_argument("--step-um", type=float, default=8.33, help="distance between scan images (default 8.33)")
    parser.add_argument("--bits", type=int, choices=(8, 12, 16), default=8, help="bits of the camera (default 8)")
    parser.add_argument("--system", choices=("IS1", "IS2"), default="IS1", help="imaging system (default IS1)")
    parser.add_argument("--f-number", type=float, help="aperture of the lens (default: the system's)")
    parser.add_argument("--wear-um", type=float, default=0.0, help="mean edge recession of the knife (default 0)")
    parser.add_argument("--stray", choices=("none", "moderate", "busy", "hard"), help="stray reflections")


def run(arguments: argparse.Namespace) -> tuple[dict[str, Any], list[str]]:
    from scanning.rig.simulated.recorder import record

    out: Path = arguments.out
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise BadInput(f"{out} exists and is not an empty folder; give a new one")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        aside = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
    except OSError as error:
        raise BadInput(f"{out} cannot be written ({error.strerror}); check the folder and its rights") from error
    made = aside / out.name
    try:
        record(
            arguments.scene,
            made,
            steps=arguments.steps,
            rows=arguments.rows,
            columns=arguments.columns,
            exposures_us=_exposures(arguments.exposures),
            step_um=arguments.step_um,
            seed=arguments.seed,
            bits=arguments.bits,
            noise_seed=arguments.noise_seed,
            progress=shown("step"),
            system=arguments.system,
            f_number=arguments.f_number,
            wear_um=arguments.wear_um,
            stray=arguments.stray,
        )
        os.replace(made, out)
    except OSError as error:
        raise BadInput(f"{out} cannot be written ({error.strerror or error}); check the folder and the disk") from error
    finally:
        shutil.rmtree(aside, ignore_errors=True)
    result = {"scene": arguments.scene, "stack": str(out), "steps": arguments.steps, "truth": str(out / "truth.npz")}
    return result, [f"{arguments.steps} steps of {arguments.scene} written to {out}, the truth in truth.npz"]


def _exposures(text: str | None) -> list[float] | None:
    if text is None:
        return None
    try:
        return [float(one) for one in text.replace(";", ",").split(",")]
    except ValueError:
        raise BadInput(f'--exposures "{text}" is not a list of microseconds; write for example 100,300,500') from None
