"""Light that is not the line: second lines, bright spots and arcs, as shiny fixtures and nozzles send them.

An extractor that is never shown a brighter blob than its line looks perfect until it meets a nozzle. These
reflections have their own geometry: they do not obey the triangulation, they move with the stage in their own way or
not at all, and some are brighter than the line. They carry speckle like all laser light, from a frozen speckle tile
that slides along with them; they add to the line as intensity, not coherently.

Places are given in the frame: ``row`` as a share of the frame's height, ``offset_px`` in columns from the middle of the
frame, ``drift_px_per_mm`` in columns per millimetre of stage travel. Strengths are relative to the peak of the line on
plain ground steel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

Float32 = NDArray[np.float32]


_REACH = 5.5
"""Standard deviations after which a reflection ends: below 3e-7 of its peak, nothing even on a logarithmic camera."""


class Reflection(Protocol):
    def add(self, frame: Float32, tile: Float32, position_um: float, level: float) -> None:
        """Add this reflection to ``frame`` (rows, columns) at one stage position; ``tile`` is speckle of mean 1."""
        ...


@njit(cache=True, nogil=True)
def _textured(tile: Float32, row: int, column: int, shift_px: float) -> float:
    """Speckle at a pixel, the tile moved by ``shift_px`` columns."""
    n = tile.shape[0]
    u = column - shift_px
    j = math.floor(u)
    f = u - j
    r = row % n
    return float((1.0 - f) * tile[r, j % n] + f * tile[r, (j + 1) % n])


@njit(cache=True, nogil=True)
def _add_line(
    frame: Float32,
    tile: Float32,
    first: int,
    last: int,
    column: float,
    per_row: float,
    sigma: float,
    level: float,
    shift: float,
) -> None:
    for r in range(max(first, 0), min(last, frame.shape[0])):
        middle = column + per_row * (r - first)
        # Fades over its outer tenth instead of being cut.
        end = min(r - first, last - r) / (0.1 * (last - first) + 1e-9)
        strength = level * min(1.0, end)
        for c in range(max(0, int(middle - _REACH * sigma)), min(frame.shape[1], int(middle + _REACH * sigma) + 2)):
            value = strength * math.exp(-0.5 * ((c - middle) / sigma) ** 2)
            frame[r, c] += value * _textured(tile, r, c, shift)


@njit(cache=True, nogil=True)
def _add_spot(
    frame: Float32,
    tile: Float32,
    row: float,
    column: float,
    sigma_row: float,
    sigma_column: float,
    level: float,
    shift: float,
) -> None:
    for r in range(max(0, int(row - _REACH * sigma_row)), min(frame.shape[0], int(row + _REACH * sigma_row) + 2)):
        for c in range(
            max(0, int(column - _REACH * sigma_column)), min(frame.shape[1], int(column + _REACH * sigma_column) + 2)
        ):
            q = ((r - row) / sigma_row) ** 2 + ((c - column) / sigma_column) ** 2
            if q < _REACH**2:
                frame[r, c] += level * math.exp(-0.5 * q) * _textured(tile, r, c, shift)


@njit(cache=True, nogil=True)
def _add_arc(
    frame: Float32,
    tile: Float32,
    row: float,
    column: float,
    radius: float,
    sigma: float,
    start: float,
    end: float,
    level: float,
    shift: float,
) -> None:
    outer = radius + _REACH * sigma
    inner = max(0.0, radius - _REACH * sigma)
    for r in range(max(0, int(row - outer)), min(frame.shape[0], int(row + outer) + 2)):
        for c in range(max(0, int(column - outer)), min(frame.shape[1], int(column + outer) + 2)):
            q = (r - row) ** 2 + (c - column) ** 2
            if q < inner**2 or q > outer**2:
                continue
            turn = math.atan2(r - row, c - column)
            if turn < start or turn > end:
                continue
            # Brightest in the middle of the arc, as a specular glint is.
            glint = math.sin(math.pi * (turn - start) / (end - start)) ** 2
            value = level * glint * math.exp(-0.5 * ((math.sqrt(q) - radius) / sigma) ** 2)
            frame[r, c] += value * _textured(tile, r, c, shift)


@dataclass(frozen=True)
class SecondLine:
    """The line seen again by way of a shiny wall: other place, other slope, often wider."""

    first_row: float
    last_row: float
    offset_px: float
    per_row_px: float
    sigma_px: float
    strength: float
    drift_px_per_mm: float = 0.0

    def add(self, frame: Float32, tile: Float32, position_um: float, level: float) -> None:
        shift = self.drift_px_per_mm * position_um * 1e-3
        rows, columns = frame.shape
        column = (columns - 1) / 2 + self.offset_px + shift
        first, last = round(self.first_row * rows), round(self.last_row * rows)
        _add_line(frame, tile, first, last, column, self.per_row_px, self.sigma_px, level * self.strength, shift)


@dataclass(frozen=True)
class Spot:
    """A bright blob: a glint of a screw head, a burr, a drop of oil."""

    row: float
    offset_px: float
    sigma_row_px: float
    sigma_column_px: float
    strength: float
    drift_px_per_mm: float = 0.0

    def add(self, frame: Float32, tile: Float32, position_um: float, level: float) -> None:
        shift = self.drift_px_per_mm * position_um * 1e-3
        rows, columns = frame.shape
        column = (columns - 1) / 2 + self.offset_px + shift
        _add_spot(
            frame,
            tile,
            self.row * rows,
            column,
            self.sigma_row_px,
            self.sigma_column_px,
            level * self.strength,
            shift,
        )


@dataclass(frozen=True)
class Arc:
    """The rim of a nozzle: part of a bright ring, fixed to the rig."""

    row: float
    offset_px: float
    radius_px: float
    sigma_px: float
    start_deg: float
    end_deg: float
    strength: float
    drift_px_per_mm: float = 0.0

    def add(self, frame: Float32, tile: Float32, position_um: float, level: float) -> None:
        shift = self.drift_px_per_mm * position_um * 1e-3
        rows, columns = frame.shape
        _add_arc(
            frame,
            tile,
            self.row * rows,
            (columns - 1) / 2 + self.offset_px + shift,
            self.radius_px,
            self.sigma_px,
            math.radians(self.start_deg),
            math.radians(self.end_deg),
            level * self.strength,
            shift,
        )
