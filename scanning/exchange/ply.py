"""A range image as a cloud of points, for CloudCompare, MeshLab and CAD."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scanning.range_image import RangeImage
from scanning.whole_file import whole_file


def write_ply(image: RangeImage, path: Path | str) -> None:
    """Write every measured point as binary PLY: x along the scan, y along the laser line, z height, all in mm.

    Points that were not measured are left out. ``intensity`` is the peak's grey value, 0 where it is not known.
    """
    rows, profiles = np.nonzero(np.isfinite(image.height_um))
    points = np.empty(rows.size, dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])
    points["x"] = profiles * (image.profile_pitch_um / 1000.0)
    points["y"] = rows * (image.row_pitch_um / 1000.0)
    points["z"] = image.height_um[rows, profiles] / 1000.0
    points["intensity"] = np.nan_to_num(image.intensity[rows, profiles], nan=0.0)
    head = (
        "ply\nformat binary_little_endian 1.0\ncomment Edgewatch range image, millimetres\n"
        f"element vertex {rows.size}\n"
        "property float x\nproperty float y\nproperty float z\nproperty float intensity\nend_header\n"
    )
    with whole_file(path) as part, part.open("wb") as file:
        file.write(head.encode("ascii"))
        file.write(points.tobytes())
