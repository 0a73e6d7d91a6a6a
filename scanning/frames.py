"""Scan images with their exposures: what a stack of them is, whichever way it is stored.

A stack is too large to hold (1205 steps x 5 exposures x 1000 x 256 bytes is 1.5 GB), so everything here is read and
written step by step. Without one common form, each of rig, import page, command line and reprocessing would have its
own idea of which exposure a page belongs to.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, Protocol

from scanning.rig.protocols import Image

Response = Literal["linear", "logarithmic"]


@dataclass(frozen=True)
class StackHeader:
    """Everything about a stack except its pixels.

    Lengths carry their unit. ``exposures_us`` ascends; a logarithmic camera has exactly one, 0. ``dark_level``,
    ``line_width_px`` may be None when whoever recorded the stack did not know them; they are then estimated and the
    report says so. ``steps`` is the number of stage positions, ``bits`` 8 or 16.
    """

    rows: int
    columns: int
    steps: int
    exposures_us: tuple[float, ...]
    step_um: float
    row_pitch_um: float
    mm_per_pixel: float
    saturation: int = 255
    line_width_px: float | None = None
    dark_level: float | None = None
    response: Response = "linear"
    bits: int = 8


class Stack(Protocol):
    """Frames of one scan, in the order they were taken."""

    @property
    def header(self) -> StackHeader: ...

    def step(self, index: int) -> list[Image]:
        """Return the (rows, columns) images of one stage position, one per exposure, shortest first."""
        ...

    def __iter__(self) -> Iterator[list[Image]]: ...

    def sha256(self) -> str:
        """Hash over header and pixels: the same for the same content, however it is stored."""
        ...
