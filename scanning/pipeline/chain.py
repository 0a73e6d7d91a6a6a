"""A recipe's operations in its order, one stage position at a time, on scratch arrays that keep their size."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanning.frames import StackHeader
from scanning.pipeline.compound import CompoundWindow
from scanning.pipeline.exposure import exposure_grey, fuse_codes, fuse_sums, look_up
from scanning.pipeline.grey import DARK_UNIT
from scanning.pipeline.line import extract_line
from scanning.pipeline.path import TOUCHED
from scanning.pipeline.settle import GRAIN_PX, Settled
from scanning.pipeline.smoothing import ROWS_LOOKED_AT, WORD, Rows, box_for, kind_for
from scanning.pipeline.tone import GREY_TOP, fixed_point, grey_bits, light_table, scaled_codes, tone
from scanning.recipe import Recipe
from scanning.rig.protocols import Image

REACH = 2.2
"""Line widths the base reaches to either side at most."""
PATHS_ALIVE = 1024
FEW = 4
"""Candidates of a row there is room for at first."""
INT32_TOP = (1 << 31) - 1
Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]


class Scratch:
    """Where one image's candidates and paths are kept: as small as they are, because memory touched is time.

    A row may have a candidate in every other column, but hardly any has more than a few; room for the most seen so far
    is enough, and is made larger when a row has more.
    """

    def __init__(self, rows: int, columns: int, box: int, kind: Any) -> None:
        most = columns // 2 + 1
        self._of_three = Rows(columns, box, kind).arrays()
        self._of_row = (
            np.empty((most, 2), np.int64), np.empty((most, 2)), np.empty((most, 2)), np.empty(most, np.int64),
            np.empty(most),
        )  # fmt: skip
        self._light = np.empty(rows, np.int64)
        self._noise = np.empty(ROWS_LOOKED_AT * columns, np.int64)
        self._maxima = np.empty(most, np.int64)
        self._lit = np.zeros(-(-columns // WORD), np.uint64)
        self._alive = np.empty((PATHS_ALIVE, 2), np.int64)
        self.counts = np.zeros(rows, np.int64)
        self.chosen = np.empty(rows, np.int64)
        self._rows = rows
        self.make_room_for(FEW)

    def make_room_for(self, most: int) -> None:
        rows, self.most = self._rows, most
        self.base, self.shape = np.zeros((rows, most, 2), np.int64), np.zeros((rows, most, 2))
        self.half, self.height, self.pedestal = (
            np.zeros_like(self.shape),
            np.zeros((rows, most), np.int64),
            np.zeros((rows, most)),
        )
        self._of_path = (
            np.empty((rows, most, 2, 2)), np.empty((rows, most, 2), np.int64), np.empty((rows, most)),
            np.empty((rows, most), np.int64), np.empty((rows, most), np.int64), self._alive,
        )  # fmt: skip

    def arrays(self) -> tuple[Any, Any, Any, Any, Any, Any, Any, Any, Any, Any]:
        """What `extract_line` wants, in its order."""
        of_rows = (self.base, self.shape, self.half, self.height, self.pedestal)
        return (
            self._light, self._of_three, self._noise, self._maxima, self._lit, self._of_row, of_rows, self.counts,
            self.chosen, self._of_path,
        )  # fmt: skip


class Chain:
    """The recipe's operations in its order, on scratch arrays that keep their size."""

    def __init__(self, recipe: Recipe, header: StackHeader, settled: Settled, selected: list[int]) -> None:
        rows, columns = header.rows, header.columns
        self.selected = selected
        self._saturation = header.saturation
        sci, hdre, glt, line = recipe.compound, recipe.hdre, recipe.tone, recipe.line
        window = sci.window if sci is not None else 1
        self._window = window
        sci_first = recipe.comes_before("sci", "hdre") or (hdre is None and recipe.comes_before("sci", "glt"))
        self._tone_p = glt.p if glt is not None else None
        # GLT on sums of fused images meets values that no table holds.
        self._tone_last = hdre is not None and recipe.comes_before("hdre", "sci") and recipe.comes_before("sci", "glt")
        self._bits = grey_bits(window)

        self._tables: Int32 | None = None
        if hdre is not None or glt is not None:
            codes = np.arange(header.saturation * (window if sci_first else 1) + 1) / (window if sci_first else 1)
            if hdre is not None:
                grey = exposure_grey(codes, settled.exposures_us, settled.dark_levels, header.saturation)
            else:
                grey = scaled_codes(codes, settled.dark_levels[0], header.saturation)[np.newaxis]
            if glt is not None and not self._tone_last:
                grey = tone(grey, glt.p)
            if hdre is not None:
                grey[0, -1] = GREY_TOP
            self._tables = fixed_point(grey, self._bits)
        self._fuses = hdre is not None
        self._open_rows = np.zeros(rows, np.bool_)
        self._saturated_from = window if hdre is None or hdre.saturated == "all" else 1

        # In front of SCI, behind it, or (no SCI) the only stage: where the tables are applied.
        self._table_first = self._tables is not None and not sci_first
        self._table_behind = self._tables is not None and sci_first
        self._windows: list[CompoundWindow] = []
        if sci is not None:
            sliding = sci.mode == "sliding"
            counting = self._fuses and sci_first
            top = INT32_TOP if self._table_first else header.saturation
            channels = len(selected) if counting else 1
            self._windows = [
                CompoundWindow(rows, columns, window, sliding=sliding, top=top, counting=counting)
                for _ in range(channels)
            ]
        self._fused: Int32 = np.zeros((rows, columns) if self._tables is not None else (0, 0), np.int32)

        # What extract_line must know about the integers it gets (see grey.grey), and one grey level in its unit.
        if self._tables is not None:
            summed = window if self._table_first else 1
            self._top, self._scale, self._dark = int(GREY_TOP) * summed << self._bits, 1, 0
            self._grey_level = float(summed << self._bits)
        else:
            # The dark level as a whole number: the smaller its unit, the narrower the integers of all that follows.
            dark = round(settled.dark_levels[0] * DARK_UNIT)
            self._scale = DARK_UNIT // math.gcd(dark, DARK_UNIT)
            self._top, self._dark = header.saturation * window, dark * self._scale // DARK_UNIT * window
            self._grey_level = float(self._scale * window)
        if self._tone_last:
            self._top, self._grey_level = int(GREY_TOP) << 20, float(1 << 20)

        width = settled.expected_width_px
        unit = line.width_px or settled.line_width_px or GRAIN_PX
        box = box_for(width)
        # A logarithmic camera shows a reflection hardly brighter than the line: bright says nothing there.
        touched = TOUCHED if header.response == "linear" else 0.0
        self._line = (
            settled.candidates == "noise", settled.continuity == "path", settled.k, settled.floor,
            line.floor_from == "row_mean", line.ceiling, settled.snr, settled.grain_px,
            1.0 if width is None else width, np.inf if width is None else line.width_factor,
            line.gate_px, line.gate_max_px, line.seed == "best", unit, touched, line.jump,
            math.ceil(REACH * unit), box,
        )  # fmt: skip
        # The light before GLT, which candidates are looked for in.
        self._linear: tuple[NDArray[np.uint32], int] = np.zeros(0, np.uint32), 0
        kind = kind_for(box, self._top, self._scale)
        if glt is not None and settled.candidates == "noise":
            table, shift = light_table(self._top, glt.p)
            self._linear = table.astype(np.uint32), shift
            kind = kind_for(box, int(table[-1]), 1)
        self._scratch = Scratch(rows, columns, box, kind)
        self._rows = rows

    def run(self, images: list[Image]) -> tuple[Float64, Float32, Float32, Float32] | None:
        """(column_px, intensity, width_px, confidence) once enough images are in, else None."""
        image: NDArray[Any] = images[0]
        self._last = images[0]
        if self._table_first:
            self._apply_tables(images)
            image = self._fused
        if self._windows:
            inputs = [image] if len(self._windows) == 1 else images
            sums = [window.add(one) for window, one in zip(self._windows, inputs, strict=True)]
            full = [s for s in sums if s is not None]
            if not full:
                return None
            image = full[0]
            if self._table_behind:
                self._apply_tables_to_sums(full)
                image = self._fused
            elif self._tone_last:
                assert self._tone_p is not None
                mean = image / float(self._window << self._bits)
                image = fixed_point(tone(mean, self._tone_p), 20)
        column_px, peak, width_px, confidence = np.empty((4, self._rows))
        scratch = self._scratch
        highest = np.empty(self._rows, image.dtype)
        while True:
            most = extract_line(
                image, self._top, self._scale, self._dark, *self._linear, *self._line, highest, *scratch.arrays(),
                column_px, peak, width_px, confidence,
            )  # fmt: skip
            if most <= scratch.most:
                break
            scratch.make_room_for(most)
        confidence[np.isnan(column_px)] = np.nan
        intensity = (peak / self._grey_level).astype(np.float32)
        return column_px, intensity, width_px.astype(np.float32), confidence.astype(np.float32)

    @property
    def single(self) -> NDArray[Any]:
        """The image of the last stage position before SCI; only lent."""
        return self._fused if self._table_first else self._last

    @property
    def single_grey(self) -> tuple[int, int, int]:
        """(top, scale, dark) of `single`; see `grey.grey`."""
        if self._table_first:
            return INT32_TOP, 1, 0
        return self._saturation, self._scale, self._dark // self._window

    def bases(self) -> tuple[NDArray[np.int64], Float64]:
        """Of the last profile's line: first and last column (rows, 2), and the pedestal in light of one image."""
        base, chosen, pedestal = self._scratch.base, self._scratch.chosen, self._scratch.pedestal
        rows, at = np.arange(self._rows), np.maximum(chosen, 0)
        level = pedestal[rows, at] / self._window if self._line[0] else np.zeros(self._rows)
        return base[rows, at], level

    def candidates(self) -> tuple[Float64, Float64]:
        shape, counts, chosen = self._scratch.shape, self._scratch.counts, self._scratch.chosen
        pairs = [(r, float(shape[r, k, 0]), k == chosen[r]) for r in range(self._rows) for k in range(counts[r])]
        taken = np.array([(r, c) for r, c, is_line in pairs if is_line], dtype=np.float64).reshape(-1, 2)
        rejected = np.array([(r, c) for r, c, is_line in pairs if not is_line], dtype=np.float64).reshape(-1, 2)
        return taken, rejected

    def _apply_tables(self, images: list[Image]) -> None:
        assert self._tables is not None
        if not self._fuses:
            look_up(self._fused, images[0], self._tables[0], self._saturation)
            return
        last = len(images) - 1
        for e in range(last, -1, -1):
            fuse_codes(
                self._fused, images[e], self._tables[e], self._saturation, self._open_rows, e == last, e == 0
            )  # fmt: skip

    def _apply_tables_to_sums(self, sums: list[Int32]) -> None:
        assert self._tables is not None
        if not self._fuses:
            look_up(self._fused, sums[0], self._tables[0], self._saturation * self._window)
            return
        top = int(self._tables[0, -1])
        last = len(sums) - 1
        for e in range(last, -1, -1):
            fuse_sums(
                self._fused, sums[e], self._tables[e], self._saturated_from, top, self._open_rows, e == last, e == 0
            )  # fmt: skip
