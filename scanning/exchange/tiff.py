"""A range image as a 32-bit float TIFF, for ImageJ and everything that reads images."""

from __future__ import annotations

import json
from pathlib import Path

import tifffile

from scanning.range_image import RangeImage
from scanning.whole_file import whole_file


def write_tiff(image: RangeImage, path: Path | str) -> None:
    """Write heights in um as 32-bit floats, NaN where not measured; the description holds unit and pitches as JSON.

    The resolution tags give pixels per centimetre, x along the scan and y along the laser line.
    """
    described = {
        "unit": "um",
        "row_pitch_um": image.row_pitch_um,
        "profile_pitch_um": image.profile_pitch_um,
        "software": "Edgewatch",
    }
    with whole_file(path) as part:
        tifffile.imwrite(
            part,
            image.height_um,
            photometric="minisblack",
            description=json.dumps(described),
            resolution=(1e4 / image.profile_pitch_um, 1e4 / image.row_pitch_um),
            resolutionunit="CENTIMETER",
            metadata=None,
        )
