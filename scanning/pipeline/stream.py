"""Frames in, profiles out: a Recipe's operations composed, one stage position at a time.

The rig pushes the images of each position as they are taken, a recorded stack does the same, so a scan and its
reprocessing give the same numbers bit for bit. Memory is that of a few images, however long the scan.
"""

from __future__ import annotations

import math
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numba
import numpy as np
from numpy.typing import NDArray

from scanning.errors import BadInput
from scanning.frames import Response, Stack, StackHeader
from scanning.pipeline import estimate
from scanning.pipeline.compound import CompoundWindow
from scanning.pipeline.exposure import exposure_grey, fuse_codes, fuse_sums, look_up
from scanning.pipeline.grey import DARK_UNIT
from scanning.pipeline.line import extract_line
from scanning.pipeline.space_time import SpaceTime, px_per_step
from scanning.pipeline.standing_out import PLACES, box_for
from scanning.pipeline.tone import (
    GREY_TOP,
    broadening,
    fixed_point,
    grey_bits,
    light_share,
    light_table,
    scaled_codes,
    tone,
)
from scanning.range_image import RangeImage
from scanning.recipe import Recipe
from scanning.rig.protocols import Image

FIRST_STEPS = 5
"""Stage positions looked at before the first profile when something must be estimated."""
RAW_FLOOR = 0.1
FOOT_FLOOR = 0.02
"""Where the base of a candidate standing out of the noise ends: this share of its own light."""
LOGARITHMIC_FLOOR = 0.6
RAW_SNR, COMPRESSED_SNR = 4.0, 3.0
GRAIN_PX = 3.0
REACH = 2.2
"""Line widths the base reaches to either side at most."""
PATHS_ALIVE = 1024
LEAST_SPEED, MOST_SPEED = 0.18, 0.6
"""Space-time analysis needs a surface that moves by these shares of the line's width per step, or between."""
WIDE_PX = 12.0
VERY_WIDE_PX = 30.0
"""Wider lines than this come from lamp-lit pictures of others: what they must stand out of is structure, not noise."""
FLAT_TOP_PX = 3
"""So many saturated pixels in a row are a line with a flat top and no single hot pixel."""
NOTED_SHARE = 0.1
"""Overexposed or lost rows are worth a sentence from this share on."""
INT32_TOP = (1 << 31) - 1
Progress = Callable[[int, int], None]
Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]


class HeightScale(Protocol):
    """A calibration: what turns the column of the line into a height."""

    def height_um(self, column_px: Float64) -> Float64: ...


@dataclass(frozen=True)
class Profile:
    """One row of heights-to-be: the line's column in every image row, NaN where it was not seen.

    ``column_px`` (rows,) from 0; ``intensity`` the line's maximum in grey levels above dark, as the centroid saw it;
    ``width_px`` its full width at half maximum; ``confidence`` (0 to 1) how sure it is that this is the line, NaN where
    the recipe does not say. ``position_um`` along the scan, from the first step, is that of the
    middle of the images used. ``saturated`` of ``frame_pixels`` pixels read since the last profile were saturated.
    """

    index: int
    position_um: float
    column_px: Float64
    intensity: Float32
    width_px: Float32
    saturated: int
    frame_pixels: int
    confidence: Float32


@dataclass(frozen=True)
class Settled:
    """What the stream worked with: from the header where it said so, estimated from the first steps elsewhere."""

    exposures_us: tuple[float, ...]
    dark_levels: tuple[float, ...]
    line_width_px: float | None
    expected_width_px: float | None
    k: float
    floor: float
    snr: float
    grain_px: float
    candidates: str
    continuity: str
    estimated: tuple[str, ...]


class ProfileStream:
    """Compose a recipe for stacks with this header; `push` every stage position, then `finish`.

    ``header.steps`` is not looked at: a live scan need not know it.
    """

    def __init__(self, recipe: Recipe, header: StackHeader) -> None:
        recipe.check_fits(header)
        if header.rows < 1 or header.columns < 2:
            raise BadInput(f"Images of {header.rows} x {header.columns} pixels hold no line; check the header.")
        if header.dark_level is not None and not 0 <= header.dark_level < header.saturation:
            raise BadInput(
                f"The dark level {header.dark_level:g} is not between 0 and the saturation {header.saturation}; "
                "correct dark_level in the header."
            )
        self.recipe = recipe
        self.header = header
        self.settled: Settled | None = None
        self._waiting: list[list[Image]] = []
        self._steps = 0
        self._profiles = 0
        self._saturated = 0
        self._pixels = 0
        self._rows_read = 0
        self._rows_full = 0
        self._rows_dark = 0
        self._chain: _Chain | None = None
        self._space_time: SpaceTime | None = None
        if not self._unknowns():
            self._settle([])

    # -- frames in, profiles out ----------------------------------------------------------------------------------

    def push(self, images: Sequence[Image]) -> list[Profile]:
        """Take the (rows, columns) images of the next stage position, shortest exposure first."""
        taken = self._checked(images)
        if self._chain is not None:
            return self._work(taken)
        self._waiting.append([image.copy() for image in taken])
        return self._release() if len(self._waiting) >= FIRST_STEPS else []

    def finish(self) -> list[Profile]:
        """The profiles still held back: first steps too few to estimate from, or waiting for images to come."""
        out = self._release() if self._waiting else []
        if self._space_time is not None:
            out += [replace(profile, column_px=column) for column, profile in self._space_time.ready(end=True)]
        return out

    def _release(self) -> list[Profile]:
        waiting, self._waiting = self._waiting, []
        self._settle(waiting)
        return [profile for images in waiting for profile in self._work(images)]

    def _checked(self, images: Sequence[Image]) -> list[Image]:
        h = self.header
        step = self._steps + len(self._waiting)
        if len(images) != len(h.exposures_us):
            raise BadInput(
                f"Step {step} has {len(images)} images but the header lists {len(h.exposures_us)} exposures; "
                "every step needs one image per exposure."
            )
        out: list[Image] = []
        for image in images:
            if image.shape != (h.rows, h.columns):
                raise BadInput(
                    f"An image of step {step} is {' x '.join(map(str, image.shape))} pixels but the header says "
                    f"{h.rows} x {h.columns}; all images of a stack must have the header's size."
                )
            if image.dtype.kind != "u" or image.dtype.itemsize > 2:
                raise BadInput(f"An image of step {step} has pixels of type {image.dtype}; use uint8 or uint16.")
            out.append(_native(image))
        return out

    def _work(self, images: list[Image]) -> list[Profile]:
        assert self._chain is not None
        used = [images[e] for e in self._chain.selected]
        for number, image in enumerate(used):
            full = image >= self.header.saturation
            self._saturated += int(np.count_nonzero(full))
            self._pixels += image.size
            if number == 0:  # of a bracket the shortest: what it overexposes no other exposure shows
                self._rows_full += int(np.count_nonzero(np.count_nonzero(full, axis=1) >= FLAT_TOP_PX))
                self._rows_read += image.shape[0]
        step = self._steps
        self._steps += 1
        lines = self._chain.run(used)
        out: list[Profile] = []
        if lines is not None:
            sci = self.recipe.compound
            profile = Profile(
                index=self._profiles,
                position_um=(step - 0.5 * ((sci.window if sci else 1) - 1)) * self.header.step_um,
                column_px=lines[0],
                intensity=lines[1],
                width_px=lines[2],
                saturated=self._saturated,
                frame_pixels=self._pixels,
                confidence=lines[3],
            )
            self._profiles += 1
            self._rows_dark += int(np.count_nonzero(np.isnan(lines[0])))
            self._saturated = self._pixels = 0
            out.append(profile)
        return out if self._space_time is None else self._later(self._space_time, out)

    def _later(self, space_time: SpaceTime, profiles: list[Profile]) -> list[Profile]:
        assert self._chain is not None
        space_time.add(self._chain.single)
        for profile in profiles:
            space_time.wait(profile.column_px, *self._chain.bases(), profile)
        return [replace(profile, column_px=column) for column, profile in space_time.ready()]

    def candidates(self) -> tuple[Float64, Float64]:
        """The peaks of the last profile as (row, column px) pairs: those taken as the line, and those rejected.

        For pictures and for a person who wonders why the line went where it went.
        """
        if self._chain is None:
            return np.empty((0, 2)), np.empty((0, 2))
        return self._chain.candidates()

    # -- what the header did not say ------------------------------------------------------------------------------

    def _measures_width(self) -> bool:
        # A header's width is that of the light; a logarithmic camera shows the line wider by an unknown amount.
        known = self.header.line_width_px is not None and self.header.response == "linear"
        return self.recipe.line.width_px is None and not known

    def _chooses_exposure(self) -> bool:
        return self.recipe.hdre is None and self.recipe.exposure == "auto" and len(self.header.exposures_us) > 1

    def _unknowns(self) -> bool:
        return self.header.dark_level is None or self._measures_width() or self._chooses_exposure()

    def _settle(self, steps: list[list[Image]]) -> None:
        h, line = self.header, self.recipe.line
        estimated: list[str] = []
        if h.dark_level is not None:
            darks = [float(h.dark_level)] * len(h.exposures_us)
        else:
            estimated.append("dark_level")
            darks = [
                estimate.dark_level([images[e] for images in steps], h.saturation) for e in range(len(h.exposures_us))
            ]
        darks = [min(round(d * DARK_UNIT) / DARK_UNIT, h.saturation - 1.0) for d in darks]
        if self.recipe.hdre is not None:
            selected = [h.exposures_us.index(t) for t in self.recipe.exposures_us or h.exposures_us]
        elif self._chooses_exposure():
            estimated.append("exposure")
            selected = [estimate.best_exposure(steps, darks, h.saturation)]
        else:
            selected = [0 if self.recipe.exposure == "auto" else h.exposures_us.index(float(self.recipe.exposure))]
        compressed = self.recipe.tone is not None or h.response == "logarithmic"
        k = line.k if line.k is not None else (1.5 if compressed else 3.0)
        width = h.line_width_px
        if self._measures_width():
            estimated.append("line_width_px")
            e = selected[0] if len(selected) == 1 else estimate.best_exposure(steps, darks, h.saturation)
            raw_k = 3.0 if h.response == "linear" else k
            seen = [images[e] for images in steps]
            width = estimate.line_width_px(seen, h.saturation, darks[e], raw_k, RAW_FLOOR, line.ceiling)
        wide = (line.width_px or width or 0.0) > WIDE_PX
        very_wide = (line.width_px or width or 0.0) > VERY_WIDE_PX
        candidates = line.candidates if line.candidates != "auto" else ("threshold" if wide else "noise")
        # Candidates standing out of the noise are looked for in the light before GLT.
        toned = self.recipe.tone if candidates == "threshold" else None
        expected = line.width_px
        if expected is None and width is not None:
            expected = width * broadening(toned.p) if toned is not None else width
        floor = line.floor
        if floor is None:
            share = FOOT_FLOOR if candidates == "noise" else RAW_FLOOR
            if toned is not None:
                floor = light_share(RAW_FLOOR / 2.0, toned.p)
            else:
                floor = share if h.response == "linear" else LOGARITHMIC_FLOOR
        self.settled = Settled(
            exposures_us=tuple(h.exposures_us[e] for e in selected),
            dark_levels=tuple(darks[e] for e in selected),
            line_width_px=width,
            expected_width_px=expected,
            k=k,
            floor=floor,
            snr=line.snr
            if line.snr is not None
            else (COMPRESSED_SNR if toned is not None or h.response == "logarithmic" else RAW_SNR),
            grain_px=line.grain_px
            if line.grain_px is not None
            else max(GRAIN_PX, (line.width_px or width or 0.0) / 4.0),
            candidates=candidates,
            continuity=line.continuity if line.continuity != "auto" else ("nearest" if very_wide else "path"),
            estimated=tuple(estimated),
        )
        self._chain = _Chain(self.recipe, h, self.settled, selected)
        sta, sci = self.recipe.diagonals, self.recipe.compound
        if sta is not None and sci is not None:
            speed = sta.px_per_step or px_per_step(h.step_um, h.mm_per_pixel, sta.angle_deg)
            light_width = line.width_px or width or GRAIN_PX
            if LEAST_SPEED * light_width <= speed <= MOST_SPEED * light_width:
                direction = {"auto": 0, "higher": 1, "lower": -1}[sta.direction]
                self._space_time = SpaceTime(
                    h.rows,
                    h.columns,
                    sci.window,
                    speed,
                    direction,
                    REACH * light_width,
                    *self._chain.single_grey,
                    sta.share,
                )

    def provenance(self) -> dict[str, Any]:
        """JSON-serialisable: recipe, header, what was estimated and used, software."""
        from scanning import __version__

        settled = self.settled
        notes: list[str] = []
        if settled is not None and settled.expected_width_px is None:
            notes.append("The line's width is unknown and too few rows show a line; peaks of any width were taken.")
        if self.recipe.diagonals is not None and self._space_time is None:
            notes.append("The surface moves too far or too little per step for space-time analysis; it was left out.")
        notes += self._bad_light()
        return {
            "recipe": self.recipe.to_json(),
            "recipe_sha256": self.recipe.sha256(),
            "header": {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self.header).items()},
            "exposures_used_us": [] if settled is None else list(settled.exposures_us),
            "dark_levels": [] if settled is None else list(settled.dark_levels),
            "line_width_px": None if settled is None else settled.line_width_px,
            "expected_width_px": None if settled is None else settled.expected_width_px,
            "threshold_k": None if settled is None else settled.k,
            "threshold_floor": None if settled is None else settled.floor,
            "threshold_snr": None if settled is None else settled.snr,
            "grain_px": None if settled is None else settled.grain_px,
            "candidates": None if settled is None else settled.candidates,
            "continuity": None if settled is None else settled.continuity,
            "space_time_direction": None if self._space_time is None else self._space_time.direction,
            "space_time_share": None if self._space_time is None else self._space_time.share,
            "estimated": [] if settled is None else list(settled.estimated),
            "notes": notes,
            "versions": {
                "edgewatch": __version__,
                "python": platform.python_version(),
                "numpy": np.__version__,
                "numba": numba.__version__,
            },
        }

    def _bad_light(self) -> list[str]:
        """What the exposures did to the line, in a sentence a person can act on."""
        notes: list[str] = []
        full = self._rows_full / self._rows_read if self._rows_read else 0.0
        if full >= NOTED_SHARE:
            notes.append(f"The line is overexposed in {100 * full:.0f} % of the rows; add a shorter exposure.")
        points = self._profiles * self.header.rows
        dark = self._rows_dark / points if points else 0.0
        if dark >= NOTED_SHARE:
            notes.append(
                f"No line was found in {100 * dark:.0f} % of the rows; where there is a surface, add a longer exposure."
                if full < NOTED_SHARE
                else f"No line was found in {100 * dark:.0f} % of the rows."
            )
        return notes


class _Chain:
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
            self._top, self._scale, self._dark = INT32_TOP, 1, 0
            self._grey_level = float((1 << self._bits) * (1 if not self._table_first else window))
        else:
            self._top, self._scale = header.saturation * window, DARK_UNIT
            self._dark = round(settled.dark_levels[0] * DARK_UNIT) * window
            self._grey_level = float(DARK_UNIT * window)
        if self._tone_last:
            self._grey_level = float(1 << 20)

        self._linear = np.zeros(0, np.int64), 0
        if glt is not None and settled.candidates == "noise":
            self._linear = light_table(round(GREY_TOP * self._grey_level), glt.p)
        width = settled.expected_width_px
        unit = line.width_px or settled.line_width_px or GRAIN_PX
        box = box_for(width)
        self._line = (
            settled.candidates == "noise", settled.continuity == "path", settled.k, settled.floor,
            line.floor_from == "row_mean", line.ceiling, settled.snr, settled.grain_px,
            1.0 if width is None else width, np.inf if width is None else line.width_factor,
            line.gate_px, line.gate_max_px, line.seed == "best", unit, line.jump, math.ceil(REACH * unit), box,
        )  # fmt: skip
        most = columns // 2 + 1
        self._scratch = (  # light, base, shape, height, counts, chosen, and for noise and path: see their files
            np.empty(rows, np.int64),
            np.empty((rows, most, 2), np.int64), np.empty((rows, most, 2)), np.empty((rows, most), np.int64),
            np.zeros(rows, np.int64), np.empty(rows, np.int64),
            np.empty((6, columns), np.int64), np.empty(2 * PLACES, np.int64), np.empty(most, np.int64),
            np.empty((rows, most, 2)), np.empty((rows, most)), np.empty((rows, most, 2, 2)),
            np.empty((rows, most, 2), np.int64), np.empty((rows, most)),
            np.empty((2, rows, most), np.int64), np.empty((PATHS_ALIVE, 2), np.int64),
        )  # fmt: skip
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
        highest = np.empty(self._rows, image.dtype)
        column_px = np.empty(self._rows)
        peak = np.empty(self._rows)
        width_px = np.empty(self._rows)
        confidence = np.empty(self._rows)
        extract_line(
            image,
            self._top,
            self._scale,
            self._dark,
            *self._linear,
            *self._line,
            highest,
            *self._scratch,
            column_px,
            peak,
            width_px,
            confidence,
        )
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
        return self._saturation, DARK_UNIT, self._dark // self._window

    def bases(self) -> tuple[NDArray[np.int64], Float64]:
        """Of the last profile's line: first and last column (rows, 2), and the pedestal in light of one image."""
        base, chosen, pedestal = self._scratch[1], self._scratch[5], self._scratch[10]
        rows, at = np.arange(self._rows), np.maximum(chosen, 0)
        level = pedestal[rows, at] / self._window if self._line[0] else np.zeros(self._rows)
        return base[rows, at], level

    def candidates(self) -> tuple[Float64, Float64]:
        shape, counts, chosen = self._scratch[2], self._scratch[4], self._scratch[5]
        pairs = [(r, float(shape[r, k, 0]), k == chosen[r]) for r in range(self._rows) for k in range(counts[r])]
        taken = np.array([(r, c) for r, c, is_line in pairs if is_line], dtype=np.float64).reshape(-1, 2)
        rejected = np.array([(r, c) for r, c, is_line in pairs if not is_line], dtype=np.float64).reshape(-1, 2)
        return taken, rejected

    def _apply_tables(self, images: list[Image]) -> None:
        assert self._tables is not None
        if not self._fuses:
            look_up(self._fused, images[0], self._tables[0], self._saturation)
            return
        for e, image in enumerate(images):
            fuse_codes(self._fused, image, self._tables[e], self._saturation, e == 0)

    def _apply_tables_to_sums(self, sums: list[Int32]) -> None:
        assert self._tables is not None
        if not self._fuses:
            look_up(self._fused, sums[0], self._tables[0], self._saturation * self._window)
            return
        top = int(self._tables[0, -1])
        for e, one in enumerate(sums):
            fuse_sums(self._fused, one, self._tables[e], self._saturated_from, top, e == 0)


def _native(image: Image) -> Image:
    """Contiguous, in the machine's byte order and writable, because numba compiles anything else anew."""
    plain: Image
    if image.dtype.itemsize == 1:
        plain = np.ascontiguousarray(image, dtype=np.uint8)
    else:
        plain = np.ascontiguousarray(image, dtype=np.uint16)
    return plain if plain.flags.writeable else plain.copy()


def profiles_of(stack: Stack, recipe: Recipe) -> Iterator[Profile]:
    """The profiles of a recorded stack, one by one, in constant memory."""
    stream = ProfileStream(recipe, stack.header)
    for images in stack:
        yield from stream.push(images)
    yield from stream.finish()


def process_stack(
    stack: Stack | str | Path,
    recipe: Recipe | str,
    calibration: HeightScale | None = None,
    progress: Progress | None = None,
) -> RangeImage:
    """Turn a stack into a range image.

    ``stack`` may be the path of one. Heights come from the calibration, else from the header's mm_per_pixel.
    ``progress(done, steps)`` is called after every step. A stack too short for one full SCI window raises `BadInput`.
    """
    recipe = Recipe.named(recipe) if isinstance(recipe, str) else recipe
    if isinstance(stack, (str, Path)):
        from scanning.stacks import open_stack

        with open_stack(Path(stack)) as opened:
            return process_stack(opened, recipe, calibration, progress)
    header = stack.header
    wall, cpu = time.perf_counter(), time.process_time()
    stream = ProfileStream(recipe, header)
    expected = recipe.profiles(header.steps)
    if expected < 1:
        window = recipe.compound.window if recipe.compound is not None else 1
        raise BadInput(
            f"Recipe {recipe.name} averages {window} images but the stack has {header.steps} steps; "
            "record more steps or use NF."
        )
    column_px = np.full((header.rows, expected), np.nan, np.float32)
    height_um = np.full((header.rows, expected), np.nan, np.float32)
    intensity = np.full((header.rows, expected), np.nan, np.float32)
    width_px = np.full((header.rows, expected), np.nan, np.float32)
    confidence = np.full((header.rows, expected), np.nan, np.float32)
    saturated = pixels = done = 0

    def keep(profiles: list[Profile]) -> None:
        nonlocal saturated, pixels
        for profile in profiles:
            column_px[:, profile.index] = profile.column_px
            height_um[:, profile.index] = heights_um(profile.column_px, header, calibration)
            intensity[:, profile.index] = profile.intensity
            width_px[:, profile.index] = profile.width_px
            confidence[:, profile.index] = profile.confidence
            saturated += profile.saturated
            pixels += profile.frame_pixels

    for images in stack:
        if done == header.steps:
            raise BadInput(f"The stack gives more steps than the {header.steps} its header says; record it again.")
        keep(stream.push(images))
        done += 1
        if progress is not None:
            progress(done, header.steps)
    if done < header.steps:
        raise BadInput(f"The stack ends after {done} of {header.steps} steps; copy or record it again.")
    keep(stream.finish())
    provenance = stream.provenance()
    provenance["calibration"] = _described(calibration, header)
    return RangeImage(
        column_px=column_px,
        height_um=height_um,
        row_pitch_um=header.row_pitch_um,
        profile_pitch_um=recipe.profile_pitch_um(header.step_um),
        intensity=intensity,
        width_px=width_px,
        confidence=confidence,
        saturated=saturated,
        frame_pixels=pixels,
        wall_s=time.perf_counter() - wall,
        cpu_s=time.process_time() - cpu,
        provenance=provenance,
    )


def heights_um(column_px: Float64, header: StackHeader, calibration: HeightScale | None) -> Float64:
    """Heights in micrometres from columns in px: the calibration's, else column x mm_per_pixel x 1000."""
    if calibration is not None:
        return calibration.height_um(column_px)
    return column_px * (header.mm_per_pixel * 1000.0)


def _described(calibration: HeightScale | None, header: StackHeader) -> Any:
    if calibration is None:
        return {"mm_per_pixel": header.mm_per_pixel, "source": "stack header"}
    to_json = getattr(calibration, "to_json", None)
    return to_json() if callable(to_json) else repr(calibration)


def extract_profile(
    frame: Image | Sequence[Image],
    recipe: Recipe | str = "NF",
    header: StackHeader | None = None,
    *,
    dark_level: float | None = None,
    line_width_px: float | None = None,
    saturation: int | None = None,
    exposures_us: Sequence[float] | None = None,
    response: Response = "linear",
) -> Float64:
    """The line's column (px from 0, NaN undefined) in every row of one (rows, columns) frame, or of one bracket.

    A bracket is a sequence of frames, shortest exposure first, with ``exposures_us``. Without a header, a dark level
    or line width that is not given is estimated from the frame; saturation is 255 (uint8) or 65535 (uint16).
    """
    recipe = Recipe.named(recipe) if isinstance(recipe, str) else recipe
    frames: list[Image] = [frame] if isinstance(frame, np.ndarray) and frame.ndim == 2 else list(frame)
    if not frames or any(not isinstance(f, np.ndarray) or f.ndim != 2 for f in frames):
        raise BadInput("A frame must be an array of (rows, columns), or a bracket a sequence of such arrays.")
    window = recipe.compound.window if recipe.compound is not None else 1
    if window > 1:
        raise BadInput(f"Recipe {recipe.name} averages {window} steps but one frame was given; use process_stack.")
    if header is None:
        if exposures_us is None:
            if len(frames) > 1:
                raise BadInput("A bracket of frames needs exposures_us, one time per frame, shortest first.")
            exposures_us = [0.0 if response == "logarithmic" else 1.0]
        times = tuple(float(t) for t in exposures_us)
        if len(times) != len(frames) or tuple(sorted(set(times))) != times:
            raise BadInput(f"exposures_us is {list(times)} for {len(frames)} frames; times must ascend, one per frame.")
        bits = 8 * frames[0].dtype.itemsize
        header = StackHeader(
            rows=frames[0].shape[0], columns=frames[0].shape[1], steps=1, exposures_us=times, step_um=1.0,
            row_pitch_um=1.0, mm_per_pixel=1.0,
            saturation=saturation if saturation is not None else (255 if bits == 8 else 65535),
            line_width_px=line_width_px, dark_level=dark_level, response=response, bits=bits,
        )  # fmt: skip
    stream = ProfileStream(recipe, header)
    profiles = stream.push(frames) + stream.finish()
    return profiles[0].column_px
