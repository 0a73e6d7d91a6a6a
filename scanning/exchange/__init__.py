"""Range images to and from other programs: one file per format, listed here once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from scanning.exchange.csv import write_csv
from scanning.exchange.ply import write_ply
from scanning.exchange.tiff import write_tiff
from scanning.exchange.x3p import read_x3p, write_x3p
from scanning.range_image import RangeImage

WRITERS: dict[str, Callable[[RangeImage, Path], None]] = {
    "x3p": write_x3p,
    "csv": write_csv,
    "ply": write_ply,
    "tiff": write_tiff,
}

__all__ = ["WRITERS", "read_range", "read_x3p", "write_csv", "write_ply", "write_tiff", "write_x3p"]


def read_range(path: Path | str) -> RangeImage:
    """Read a range image from X3P, from ``range.npz``, or from the folder that ``process`` wrote."""
    place = Path(path)
    if place.is_dir():
        place = place / "range.npz"
    return read_x3p(place) if place.suffix.lower() == ".x3p" else RangeImage.load(place)
