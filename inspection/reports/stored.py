"""Reads a stored range image back, and refuses it when the file is no longer the one that was judged.

A report drawn from a damaged or exchanged file would show another surface under the old verdict.
"""

from __future__ import annotations

import hashlib
import zipfile
from pathlib import Path

import numpy as np
from django.conf import settings

from inspection.models import RangeImage as StoredRangeImage
from scanning.errors import BadInput
from scanning.range_image import RangeImage


def path_of(stored: StoredRangeImage) -> Path:
    return Path(settings.RANGES) / stored.file


def load(stored: StoredRangeImage) -> RangeImage:
    """Return the range image of ``stored``; raises BadInput if the file is missing, changed or unreadable."""
    path = path_of(stored)
    try:
        content = path.read_bytes()
    except OSError:
        raise BadInput(
            f"The range image file {stored.file} of scan {stored.scan_id} is missing; "
            "compute the scan again from its stack."
        ) from None
    if hashlib.sha256(content).hexdigest() != stored.sha256:
        raise BadInput(
            f"The range image file {stored.file} of scan {stored.scan_id} was changed after it was judged; "
            "compute the scan again from its stack."
        )
    try:
        with np.load(path, allow_pickle=False) as data:
            height = np.asarray(data["height_um"], np.float32)
            channel = {
                name: np.asarray(data[name], np.float32) if name in data else np.full_like(height, np.nan)
                for name in ("column_px", "intensity", "width_px")
            }
    except (KeyError, ValueError, OSError, zipfile.BadZipFile) as error:
        name = f"The range image file {stored.file} of scan {stored.scan_id}"
        raise BadInput(f"{name} cannot be read: {error}.") from None
    return RangeImage(
        column_px=channel["column_px"],
        height_um=height,
        row_pitch_um=stored.row_pitch_um,
        profile_pitch_um=stored.profile_pitch_um,
        intensity=channel["intensity"],
        width_px=channel["width_px"],
        provenance=stored.provenance,
    )
