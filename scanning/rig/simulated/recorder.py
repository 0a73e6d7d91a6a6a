"""Records a simulated scan as a stack folder, as other software would leave it, with the truth beside the frames.

This is the scan without a stage, a serial line and a queue: for benchmarks, tests and for people who want to try the
product on data whose answer is known. Frames go to disk one by one, so memory does not grow with the number of steps.
``stack.json`` is written last: a recording that was interrupted is not yet a stack and cannot be mistaken for one.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from scanning.errors import BadInput
from scanning.rig.simulated.illumination import LaserLine
from scanning.rig.simulated.render import Renderer
from scanning.rig.simulated.scenes import STEP_UM, Scene, scene

E1_US = (100.0, 300.0, 500.0, 700.0, 900.0)
"""The paper's exposure bracket of 19 dB, microseconds; its E2 of 39 dB is 100, 500, 1000, 5000, 9000."""


def _plain(microseconds: float) -> int | float:
    """Return whole microseconds as an int, so that names and JSON say 300 and not 300.0."""
    return int(microseconds) if float(microseconds).is_integer() else float(microseconds)


def stack_header(renderer: Renderer, exposures_us: Sequence[float], step_um: float = STEP_UM) -> dict[str, Any]:
    """Return what ``stack.json`` says about the frames of ``renderer``: what the rig's builder would know, no truth."""
    system, line, sensor = renderer.scene.system, renderer.scene.line, renderer.sensor
    fwhm_um = line.sigma_um * math.sqrt(8.0 * math.log(2.0))
    return {
        "format": "edgewatch-stack/1",
        "exposures_us": [_plain(e) for e in exposures_us],
        "step_um": step_um,
        "row_pitch_um": round(system.row_pitch_um, 6),
        "mm_per_pixel": round(system.um_per_pixel * 1e-3, 8),
        "line_width_px": round(fwhm_um / system.travel_per_pixel_um, 2),
        "dark_level": sensor.dark_level,
        "saturation": sensor.saturation,
        "response": sensor.response,
    }


def record(
    scene_name: str | Scene,
    out_folder: Path | str,
    *,
    steps: int = 245,
    rows: int | None = None,
    columns: int = 256,
    exposures_us: Sequence[float] | None = None,
    step_um: float = STEP_UM,
    seed: int = 1,
    bits: int = 8,
    noise_seed: int = 0,
    line_width_um: float = 25.0,
    line_width_is: str = "fwhm",
    progress: Callable[[int, int], None] | None = None,
    **scene_options: Any,
) -> Path:
    """Record ``steps`` scan images per exposure of a scene into ``out_folder`` and return the folder.

    245 steps give the paper's 241 profiles with a sliding window, 1205 with blocks of five. ``scene_options`` go to
    `scenes.scene` (f_number, system, wear_um, visit, stray, decades, tilts, damages ...). The folder gets
    ``stack.json``, one multi-page TIFF per exposure, ``truth.npz`` (`Truth.save`) and ``scene.json`` (every parameter).
    ``noise_seed`` is the draw of the sensor noise: another one repeats the scan without moving the part. Raises
    BadInput when the folder already holds something or a number makes no sense.
    """
    if isinstance(scene_name, Scene):
        if scene_options:
            raise BadInput("Options of the scene cannot be changed once it is made; pass its name instead.")
        subject = scene_name
    else:
        if line_width_is not in ("fwhm", "1/e2"):
            raise BadInput(f"The line width is 'fwhm' or '1/e2', not {line_width_is!r}.")
        line = LaserLine(line_width_um, "fwhm" if line_width_is == "fwhm" else "1/e2")
        subject = scene(scene_name, seed=seed, line=line, **scene_options)
    renderer = Renderer(subject, rows=rows, columns=columns, bits=bits)
    logarithmic = renderer.sensor.response == "logarithmic"
    if exposures_us is None:
        exposures_us = (0.0,) if logarithmic else E1_US
    exposures = sorted(float(e) for e in exposures_us)
    if logarithmic and exposures != [0.0]:
        raise BadInput("A logarithmic camera has no exposure time; leave the exposures out or give just 0.")
    if not logarithmic and (not exposures or min(exposures) <= 0 or len(set(exposures)) != len(exposures)):
        raise BadInput("The exposures must be different numbers of microseconds above 0.")
    if steps < 1 or not step_um > 0:
        raise BadInput(f"A scan needs at least one step of more than 0 um, not {steps} of {step_um:g} um.")
    folder = Path(out_folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise BadInput(f"{folder} already exists and is not an empty folder; name a new one.")
    folder.mkdir(parents=True, exist_ok=True)

    big = steps * renderer.rows * renderer.columns * (1 if bits == 8 else 2) > 3.9e9
    with ExitStack() as files:
        writers = [
            files.enter_context(tifffile.TiffWriter(folder / f"exposure-{_plain(e)}us.tiff", bigtiff=big))
            for e in exposures
        ]
        for step in range(steps):
            light = renderer.irradiance(step * step_um)
            for number, (exposure, writer) in enumerate(zip(exposures, writers, strict=True)):
                rng = np.random.default_rng((noise_seed, subject.seed, step, number))
                image = renderer.expose(light, exposure, rng)
                writer.write(image, photometric="minisblack", contiguous=True, metadata=None)
            if progress is not None:
                progress(step + 1, steps)
    truth = subject.truth(rows=renderer.rows, steps=steps, step_um=step_um, columns=columns)
    truth.save(folder / "truth.npz")
    told = {**subject.parameters(), "rows": renderer.rows, "columns": columns, "steps": steps, "noise_seed": noise_seed}
    (folder / "scene.json").write_text(json.dumps({**told, "damages": truth.damages}, indent=1) + "\n")
    header = stack_header(renderer, exposures, step_um)
    (folder / "stack.json").write_text(json.dumps(header, indent=1) + "\n")
    return folder
