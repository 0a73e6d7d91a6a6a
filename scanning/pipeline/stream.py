"""Frames in, profiles out: the rig pushes the images of each stage position as they are taken.

A recorded stack does the same (whole.py), so a scan and its reprocessing give the same numbers bit for bit. Memory is
that of a few images, however long the scan. settle.py says what to work with, chain.py does the operations.
"""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Protocol

import numba
import numpy as np
from numpy.typing import NDArray

from scanning.errors import BadInput
from scanning.frames import StackHeader
from scanning.pipeline.chain import REACH, Chain
from scanning.pipeline.grey import count_saturated
from scanning.pipeline.settle import GRAIN_PX, Settled, has_unknowns, settle
from scanning.pipeline.space_time import SpaceTime, px_per_step
from scanning.recipe import Recipe
from scanning.rig.protocols import Image

FIRST_STEPS = 5
"""Stage positions looked at before the first profile when something must be estimated."""
LEAST_SPEED, MOST_SPEED = 0.18, 0.6
"""Space-time analysis needs a surface that moves by these shares of the line's width per step, or between."""
FLAT_TOP_PX = 3
"""So many saturated pixels in a row are a line with a flat top and no single hot pixel."""
NOTED_SHARE = 0.1
"""Overexposed or lost rows are worth a sentence from this share on."""
Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]


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
        self._chain: Chain | None = None
        self._space_time: SpaceTime | None = None
        if not has_unknowns(recipe, header):
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
            saturated, rows_full = count_saturated(image, self.header.saturation, FLAT_TOP_PX)
            self._saturated += saturated
            self._pixels += image.size
            if number == 0:  # of a bracket the shortest: what it overexposes no other exposure shows
                self._rows_full += rows_full
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

    def _settle(self, steps: list[list[Image]]) -> None:
        self.settled, selected = settle(self.recipe, self.header, steps)
        self._chain = Chain(self.recipe, self.header, self.settled, selected)
        sta, sci = self.recipe.diagonals, self.recipe.compound
        if sta is not None and sci is not None:
            speed = sta.px_per_step or px_per_step(self.header.step_um, self.header.mm_per_pixel, sta.angle_deg)
            light_width = self.recipe.line.width_px or self.settled.line_width_px or GRAIN_PX
            if LEAST_SPEED * light_width <= speed <= MOST_SPEED * light_width:
                direction = {"auto": 0, "higher": 1, "lower": -1}[sta.direction]
                self._space_time = SpaceTime(
                    self.header.rows,
                    self.header.columns,
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


def _native(image: Image) -> Image:
    """Contiguous, in the machine's byte order and writable, because numba compiles anything else anew."""
    plain: Image
    if image.dtype.itemsize == 1:
        plain = np.ascontiguousarray(image, dtype=np.uint8)
    else:
        plain = np.ascontiguousarray(image, dtype=np.uint16)
    return plain if plain.flags.writeable else plain.copy()


def heights_um(column_px: Float64, header: StackHeader, calibration: HeightScale | None) -> Float64:
    """Heights in micrometres from columns in px: the calibration's, else column x mm_per_pixel x 1000."""
    if calibration is not None:
        return calibration.height_um(column_px)
    return column_px * (header.mm_per_pixel * 1000.0)
