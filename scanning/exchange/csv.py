"""A range image as a table that a spreadsheet opens as numbers, in Europe too.

Excel takes 22.5 for a date where the decimal sign is a comma, and takes UTF-8 for something else without a mark at its
start. So the mark is written, and separator and decimal sign are the caller's choice.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from scanning.errors import BadInput
from scanning.range_image import RangeImage
from scanning.whole_file import whole_file


def write_csv(
    image: RangeImage, path: Path | str, *, separator: Literal[",", ";", "\t"] = ",", decimal: Literal[".", ","] = "."
) -> None:
    """Write heights in um, one line per row of the range image, to the nearest nanometre; not measured is empty.

    The first line holds the positions along the scan in mm, the first column those along the laser line in mm.
    UTF-8 with byte order mark, CRLF line ends.
    """
    if separator == decimal:
        raise BadInput(f'separator and decimal sign are both "{separator}"; choose ";" with a decimal comma')
    rows, profiles = image.height_um.shape
    along_scan = np.arange(profiles) * image.profile_pitch_um / 1000.0
    along_rows = np.arange(rows) * image.row_pitch_um / 1000.0

    def cell(value: float, places: int) -> str:
        written = f"{value:.{places}f}" if np.isfinite(value) else ""
        return written.replace(".", ",") if decimal == "," else written

    with whole_file(path) as part, part.open("w", encoding="utf-8-sig", newline="") as file:
        title = "height in um; down: mm along the laser line; across: mm along the scan"
        first = title if separator == "," else title.replace(";", ",")
        file.write(separator.join([f'"{first}"', *(cell(one, 6) for one in along_scan.tolist())]) + "\r\n")
        for position, heights in zip(along_rows.tolist(), image.height_um.tolist(), strict=True):
            file.write(separator.join([cell(position, 6), *(cell(one, 3) for one in heights)]) + "\r\n")
