"""From what an industrial sensor sends to the frame the measurement wants.

Every vendor names its pixels by the same GenICam words (``Mono12``, ``BayerRG8``); what they mean for a laser line is
the same for all of them and is said here once. A colour sensor under a 660 nm laser sees the line only at its red
sites, one pixel in four; taking the other three along would put three dark pixels between two lit ones and move every
centroid. So a Bayer frame is its red sites alone, two sensor pixels apart, and the camera says so (``pitch_factor``).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanning.errors import BadInput, CameraFault
from scanning.rig.protocols import Image, SensorMode

_FORMAT = re.compile(r"(Mono|Bayer(RG|GR|GB|BG))(8|10|12|16)")
#: Row and column of the red site in each cell of 2 x 2 pixels (GenICam PFNC: the letters are the first row's).
_RED_SITE = {"RG": (0, 0), "GR": (0, 1), "GB": (1, 0), "BG": (1, 1)}


@dataclass(frozen=True)
class SensorFormat:
    """One GenICam pixel format: its ``bits`` per pixel and, for a Bayer mosaic, the row and column of its red site."""

    name: str
    bits: int
    red_site: tuple[int, int] | None = None

    @property
    def pitch_factor(self) -> int:
        """How many sensor pixels lie between two pixels of a frame."""
        return 1 if self.red_site is None else 2

    @property
    def saturation(self) -> int:
        return (1 << self.bits) - 1


@dataclass(frozen=True)
class SensorRegion:
    """What a sensor is told to send, in its own pixels."""

    height: int
    width: int
    top: int
    left: int


def sensor_format(name: str) -> SensorFormat:
    """``Mono8`` .. ``Mono16`` and ``BayerRG8`` .. ``BayerBG16``. Raises `BadInput` for anything else."""
    match = _FORMAT.fullmatch(name)
    if match is None:
        raise BadInput(
            f"The camera's pixel format is '{name}'; choose Mono8, Mono10, Mono12, Mono16 or a Bayer format of as many "
            "bits (BayerRG8), not a packed one."
        )
    return SensorFormat(name, int(match[3]), _RED_SITE[match[2]] if match[2] else None)


def sensor_region(mode: SensorMode, pixels: SensorFormat, *, turned: bool = False) -> SensorRegion:
    """The part of the sensor that gives frames of ``mode``.

    ``turned``: the laser line lies along the sensor's rows, so a frame's rows are the sensor's columns. Raises
    `BadInput` when the frames' bits cannot hold the format's.
    """
    if (mode.bits <= 8) != (pixels.bits <= 8):
        raise BadInput(
            f"Frames of {mode.bits} bits were asked for but the camera's pixel format is {pixels.name}; "
            "make the rig's bits and the pixel format agree."
        )
    k = pixels.pitch_factor
    height, width, top, left = mode.rows * k, mode.columns * k, mode.row_offset * k, mode.column_offset * k
    return SensorRegion(width, height, left, top) if turned else SensorRegion(height, width, top, left)


def frame_image(data: NDArray[Any], region: SensorRegion, pixels: SensorFormat, *, turned: bool = False) -> Image:
    """A frame from what the sensor sent: (rows, columns), 8 or 16 bit, contiguous and its own memory.

    Raises `CameraFault` when the sensor sent another size or type than it was told to.
    """
    if data.shape != (region.height, region.width):
        raise CameraFault(
            f"The camera sent a frame of {'x'.join(map(str, data.shape))} pixels instead of "
            f"{region.height}x{region.width}; check the camera's region of interest and binning."
        )
    wanted = np.uint8 if pixels.bits <= 8 else np.uint16
    if data.dtype != wanted:
        raise CameraFault(f"The camera sent pixels of type {data.dtype} in format {pixels.name}; check that format.")
    if pixels.red_site is not None:
        row, column = pixels.red_site
        data = data[row::2, column::2]
    data = data.T if turned else data
    return data.astype(np.uint8, order="C") if pixels.bits <= 8 else data.astype(np.uint16, order="C")
