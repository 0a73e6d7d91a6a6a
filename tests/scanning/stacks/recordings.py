"""Stack folders as other software would leave them, small enough to write for every case."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

ROWS, COLUMNS, STEPS = 20, 32, 5
EXPOSURES = (100, 300)
DESCRIPTION: dict[str, Any] = {
    "format": "edgewatch-stack/1",
    "exposures_us": list(EXPOSURES),
    "step_um": 8.33,
    "row_pitch_um": 7.150838,
    "mm_per_pixel": 0.0142,
    "line_width_px": 3.03,
    "dark_level": 2,
    "saturation": 255,
    "response": "linear",
}


def frames(seed: int = 1, dtype: Any = np.uint8, steps: int = STEPS) -> NDArray[Any]:
    """(exposures, steps, rows, columns) of noise: any mix-up of pages changes it."""
    top = np.iinfo(dtype).max
    return np.random.default_rng(seed).integers(0, top + 1, (len(EXPOSURES), steps, ROWS, COLUMNS), dtype=dtype)


def describe(folder: Path, **changes: Any) -> None:
    """Write stack.json; a change to None takes the key away."""
    said = {key: value for key, value in {**DESCRIPTION, **changes}.items() if value is not None}
    (folder / "stack.json").write_text(json.dumps(said))


def record(folder: Path, images: NDArray[Any] | None = None, **changes: Any) -> Path:
    """A good stack folder, one multi-page TIFF per exposure."""
    folder.mkdir(parents=True, exist_ok=True)
    described = {"saturation": 65535} | changes if images is not None and images.dtype == np.uint16 else changes
    describe(folder, **described)
    for exposure, pages in zip(EXPOSURES, frames() if images is None else images, strict=True):
        write_pages(folder / f"exposure-{exposure}us.tiff", pages)
    return folder


def write_pages(path: Path, pages: NDArray[Any], **options: Any) -> None:
    with tifffile.TiffWriter(path, bigtiff=options.pop("bigtiff", False)) as tiff:
        for page in pages:
            tiff.write(page, contiguous=False, photometric=options.get("photometric", "minisblack"), **{
                key: value for key, value in options.items() if key != "photometric"
            })  # fmt: skip


def write_image(path: Path, image: NDArray[Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    known, data = cv2.imencode(path.suffix, image)
    assert known
    path.write_bytes(data.tobytes())
