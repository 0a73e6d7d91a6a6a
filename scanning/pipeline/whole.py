"""Whole stacks and single frames through the stream: a range image from a recorded stack, a profile from one frame."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanning.errors import BadInput
from scanning.frames import Response, Stack, StackHeader
from scanning.pipeline.stream import HeightScale, Profile, ProfileStream, heights_um
from scanning.range_image import RangeImage
from scanning.recipe import Recipe
from scanning.rig.protocols import Image

Progress = Callable[[int, int], None]
Float64 = NDArray[np.float64]


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
