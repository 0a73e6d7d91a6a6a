"""report.json and range.npz: what processing a stack leaves behind, together or not at all.

The numbers and the image they belong to must never be of two different runs, so both are made aside and then take
their places; and the report repeats everything the numbers depend on, because it travels without the image.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from scanning.errors import BadInput
from scanning.frames import Stack
from scanning.precision import PrecisionReport
from scanning.range_image import RangeImage
from scanning.stacks.description import header_to_json

FORMAT = "edgewatch-report/1"
RANGE_NPZ = "range.npz"
REPORT_JSON = "report.json"


def plain(value: Any) -> Any:
    """JSON values only: arrays become lists, numpy numbers plain ones, and what is not a finite number null."""
    if isinstance(value, dict):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(one) for one in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


def to_text(report: dict[str, Any]) -> str:
    """The report as JSON text: no NaN, readable by people, one trailing newline."""
    return json.dumps(plain(report), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def processing_report(
    image: RangeImage, precision: PrecisionReport, stack: Stack, name: str, *, partial: bool = False
) -> dict[str, Any]:
    """The content of report.json for one processed stack; ``name`` is what the stack is called."""
    rows, profiles = image.height_um.shape
    provenance = dict(image.provenance)
    recipe = provenance.pop("recipe", None)
    calibration = provenance.pop("calibration", None)
    report: dict[str, Any] = {
        "format": FORMAT,
        "rows": rows,
        "profiles": profiles,
        "row_pitch_um": image.row_pitch_um,
        "profile_pitch_um": image.profile_pitch_um,
        **precision.to_json(),
        "wall_s": image.wall_s,
        "cpu_s": image.cpu_s,
        "recipe": recipe,
        "calibration": calibration,
        "stack": {
            "name": name,
            "sha256": stack.sha256(),
            "partial": partial,
            "header": header_to_json(stack.header),
        },
        "provenance": provenance,
    }
    told = plain(report)
    assert isinstance(told, dict)
    return told


def write_results(
    out: Path,
    image: RangeImage,
    report: dict[str, Any],
    exports: dict[str, Callable[[RangeImage, Path], None]] | None = None,
) -> None:
    """Write ``range.npz``, ``report.json`` and further files by name into the folder ``out``, all or nothing.

    A folder that exists keeps its other files; results of an earlier run are replaced.
    """
    if out.exists() and not out.is_dir():
        raise BadInput(f"{out} is a file; give a folder for {RANGE_NPZ} and {REPORT_JSON}")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        aside = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
    except OSError as error:
        raise BadInput(f"{out} cannot be written ({error.strerror}); check the folder and its rights") from error
    try:
        image.save(aside / RANGE_NPZ)
        for name, export in (exports or {}).items():
            export(image, aside / name)
        (aside / REPORT_JSON).write_text(to_text(report), encoding="utf-8")
        if out.is_dir():
            for made in sorted(aside.iterdir(), key=lambda one: one.name == REPORT_JSON):
                os.replace(made, out / made.name)
        else:
            aside.chmod(0o777 & ~_umask())
            os.replace(aside, out)
    except OSError as error:
        raise BadInput(f"{out} cannot be written ({error.strerror or error}); check the folder and the disk") from error
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
