"""The range image of a scan, growing while the stage moves.

Frames go through the same stream as a recorded stack, so computing the scan again from its stack gives the same numbers
bit for bit; here they are only taken as they come, and the image is ready when the last frame is.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from scanning.calibration import Calibration
from scanning.errors import BadInput
from scanning.frames import StackHeader
from scanning.pipeline.stream import Profile, ProfileStream, heights_um
from scanning.range_image import RangeImage
from scanning.recipe import Recipe
from scanning.rig.protocols import Image


class LiveRangeImage:
    """Collects the profiles of one scan. ``header.steps`` is the number of steps intended; fewer may come."""

    def __init__(self, recipe: Recipe, header: StackHeader, calibration: Calibration | None) -> None:
        self._stream = ProfileStream(recipe, header)
        self._recipe = recipe
        self._header = header
        self._calibration = calibration
        shape = (header.rows, recipe.profiles(header.steps))
        self._column_px = np.full(shape, np.nan, np.float32)
        self._height_um = np.full(shape, np.nan, np.float32)
        self._intensity = np.full(shape, np.nan, np.float32)
        self._width_px = np.full(shape, np.nan, np.float32)
        self._confidence = np.full(shape, np.nan, np.float32)
        self._profiles = 0
        self._steps = 0
        self._saturated = 0
        self._pixels = 0
        self._wall_s = 0.0
        self._cpu_s = 0.0

    def push(self, images: Sequence[Image]) -> None:
        """Take the (rows, columns) images of the next step, shortest exposure first."""
        wall, cpu = time.perf_counter(), time.thread_time()
        self._keep(self._stream.push(images))
        self._steps += 1
        self._wall_s += time.perf_counter() - wall
        self._cpu_s += time.thread_time() - cpu

    def finish(self) -> RangeImage:
        """The range image of what came. Raises `BadInput` if that was too little for a single profile."""
        wall, cpu = time.perf_counter(), time.thread_time()
        self._keep(self._stream.finish())
        self._wall_s += time.perf_counter() - wall
        self._cpu_s += time.thread_time() - cpu
        count = self._profiles
        if count == 0:
            raise BadInput(
                f"The scan ended after {self._steps} steps, too few for a single profile with {self._recipe.name}; "
                f"scan again."
            )
        provenance = self._stream.provenance()
        provenance["header"]["steps"] = self._steps
        provenance["calibration"] = (
            self._calibration.to_json()
            if self._calibration is not None
            else {"mm_per_pixel": self._header.mm_per_pixel, "source": "stack header"}
        )
        return RangeImage(
            column_px=self._column_px[:, :count],
            height_um=self._height_um[:, :count],
            row_pitch_um=self._header.row_pitch_um,
            profile_pitch_um=self._recipe.profile_pitch_um(self._header.step_um),
            intensity=self._intensity[:, :count],
            width_px=self._width_px[:, :count],
            confidence=self._confidence[:, :count],
            saturated=self._saturated,
            frame_pixels=self._pixels,
            wall_s=self._wall_s,
            cpu_s=self._cpu_s,
            provenance=provenance,
        )

    def _keep(self, profiles: Sequence[Profile]) -> None:
        for profile in profiles:
            at = profile.index
            self._column_px[:, at] = profile.column_px
            self._height_um[:, at] = heights_um(profile.column_px, self._header, self._calibration)
            self._intensity[:, at] = profile.intensity
            self._width_px[:, at] = profile.width_px
            self._confidence[:, at] = profile.confidence
            self._saturated += profile.saturated
            self._pixels += profile.frame_pixels
            self._profiles = at + 1
