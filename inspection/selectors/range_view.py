"""A range image as a browser can draw it: small integers, at the resolution the window deserves.

A full range image as JSON takes ten seconds on a tablet. It travels as int16 counts instead, averaged over areas
when there are more pixels than the screen can show. The average knows which pixels were measured; otherwise every hole
would grow a false slope around itself.
"""

from __future__ import annotations

import os
import zipfile
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, Literal

import cv2
import numpy as np
from django.conf import settings
from numpy.typing import NDArray

from inspection.models import Damage, RangeImage
from scanning.errors import BadInput
from scanning.surface.plane import fit_plane

Float32 = NDArray[np.float32]
Channel = Literal["level", "height", "intensity", "width", "confidence"]
CHANNELS: Final[dict[str, tuple[str, str]]] = {
    "level": ("Height above the plane", "um"),
    "height": ("Height as measured", "um"),
    "intensity": ("Brightness of the line", "grey"),
    "width": ("Width of the line", "px"),
    "confidence": ("Confidence", "1"),
}
#: The count that means "not measured".
NO_DATA: Final = -32768
#: Smallest step sent, in the channel's unit; coarser only when the values would not fit 16 bits.
FINEST: Final[dict[str, float]] = {"level": 0.1, "height": 0.1, "intensity": 0.1, "width": 0.01, "confidence": 0.001}
#: A colour scale from this share of the values hides single wild pixels, not damage.
STRETCH: Final = (0.5, 99.5)
#: A share is always drawn from 0 to 1: stretched, a scan that is sure everywhere would look doubtful.
FIXED_SPAN: Final[dict[str, tuple[float, float]]] = {"confidence": (0.0, 1.0)}


@dataclass(frozen=True)
class Window:
    """Rows and profiles of a range image, half open."""

    row: int
    row_end: int
    profile: int
    profile_end: int


@dataclass(frozen=True)
class Picture:
    """What is sent: counts (rows, columns), the value of one count, and where the cells lie in mm."""

    counts: NDArray[np.int16]
    scale: float
    unit: str
    origin_mm: tuple[float, float]
    cell_mm: tuple[float, float]
    span: tuple[float, float]

    def headers(self) -> dict[str, str]:
        """``X-Shape`` rows,columns; ``X-Origin-mm`` and ``X-Cell-mm`` across,along the edge, of the first cell."""
        return {
            "X-Shape": "{},{}".format(*self.counts.shape),
            "X-Scale": repr(self.scale),
            "X-Unit": self.unit,
            "X-No-Data": str(NO_DATA),
            "X-Origin-mm": "{:.6f},{:.6f}".format(*self.origin_mm),
            "X-Cell-mm": "{:.6f},{:.6f}".format(*self.cell_mm),
            "X-Span": "{:.4g},{:.4g}".format(*self.span),
        }


def file_of(image: RangeImage) -> Path:
    return Path(settings.RANGES) / image.file


def _written_at(file: str) -> int:
    """Part of the cache's key, so that a file restored, replaced or lost is noticed."""
    try:
        return os.stat(file).st_mtime_ns
    except OSError as error:
        raise _unreadable(file, error) from error


def _unreadable(file: str, error: Exception) -> BadInput:
    return BadInput(
        f"The range image file {Path(file).name} cannot be read ({type(error).__name__}); restore it from the backup "
        "or compute the scan again."
    )


@lru_cache(maxsize=6)
def _arrays(file: str, written_at: int) -> dict[str, Float32]:
    try:
        with np.load(file, allow_pickle=False) as stored:
            arrays = {
                "height": stored["height_um"].astype(np.float32),
                "intensity": stored["intensity"].astype(np.float32),
                "width": stored["width_px"].astype(np.float32),
            }
            if "confidence" in stored.files:
                arrays["confidence"] = stored["confidence"].astype(np.float32)
            return arrays
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise _unreadable(file, error) from error


@lru_cache(maxsize=6)
def _reference(file: str, written_at: int, stored: tuple[float, ...] | None, pitches: tuple[float, float]) -> Float32:
    """The plane under the surface, from the surface report or, for images without one, fitted now."""
    height = _arrays(file, written_at)["height"]
    if stored is None:
        try:
            fitted: Float32 = fit_plane(height, *pitches).height_um()
            return fitted
        except BadInput:
            # No plane agrees with this surface: show it about its median, which bends nothing.
            middle = np.nanmedian(height) if np.isfinite(height).any() else 0.0
            return np.full(height.shape, middle, np.float32)
    offset, slope_rows, slope_profiles, *quadratic = stored
    y = (np.arange(height.shape[0]) - (height.shape[0] - 1) / 2) * pitches[0] / 1e3
    x = (np.arange(height.shape[1]) - (height.shape[1] - 1) / 2) * pitches[1] / 1e3
    plane: NDArray[np.float64] = offset + slope_rows * y[:, None] + slope_profiles * x[None, :]
    if quadratic:
        yy, xy, xx = quadratic
        plane = plane + yy * y[:, None] ** 2 + xy * y[:, None] * x[None, :] + xx * x[None, :] ** 2
    return np.asarray(plane, np.float32)


def _stored_plane(image: RangeImage) -> tuple[float, ...] | None:
    plane = image.surface.get("plane") if isinstance(image.surface, dict) else None
    if not isinstance(plane, dict):
        return None
    try:
        return (
            float(plane["offset_um"]),
            float(plane["slope_rows_um_per_mm"]),
            float(plane["slope_profiles_um_per_mm"]),
            *(float(value) for value in plane.get("quadratic_um_per_mm2") or ()),
        )
    except (KeyError, TypeError, ValueError):
        return None


def channels_of(image: RangeImage) -> dict[str, tuple[str, str]]:
    """The channels this image has, for a choice: results from before there was a confidence are without it."""
    precision = getattr(image, "precision", None)
    told = precision is not None and precision.confident_share is not None
    return {key: words for key, words in CHANNELS.items() if key != "confidence" or told}


def values(image: RangeImage, channel: str) -> Float32:
    """One channel in full, (rows, profiles), NaN = not measured. BadInput: no such channel, or a lost file."""
    if channel not in CHANNELS:
        raise BadInput(f"There is no channel “{channel}”; choose one of {', '.join(CHANNELS)}.")
    file = str(file_of(image))
    written_at = _written_at(file)
    arrays: dict[str, Float32] = _arrays(file, written_at)
    if channel not in ("level", *arrays):
        raise BadInput("This result does not say how sure its points are; compute the scan again to know it.")
    if channel != "level":
        measured: Float32 = arrays[channel]
        return (
            measured if channel == "height" else np.where(np.isfinite(arrays["height"]), measured, np.float32(np.nan))
        )
    pitches = (image.row_pitch_um, image.profile_pitch_um)
    return arrays["height"] - _reference(file, written_at, _stored_plane(image), pitches)


def area_mean(data: Float32, rows: int, columns: int) -> Float32:
    """Shrink to (rows, columns) by the mean of the measured pixels in each area; an area with none stays NaN."""
    if (rows, columns) == data.shape:
        return data
    valid = np.isfinite(data)
    weight = cv2.resize(valid.astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA)
    total = cv2.resize(np.where(valid, data, np.float32(0)), (columns, rows), interpolation=cv2.INTER_AREA)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = total / weight
    # Less than half measured is shown as a hole: a speck of data must not paint the whole cell as measured.
    return np.where(weight >= 0.5, mean, np.float32(np.nan)).astype(np.float32)


def picture(data: Float32, image: RangeImage, channel: str, window: Window, most: int) -> Picture:
    """Cut a window and bring its longer side to at most ``most`` cells."""
    row, row_end = max(0, window.row), min(data.shape[0], window.row_end)
    profile, profile_end = max(0, window.profile), min(data.shape[1], window.profile_end)
    if row >= row_end or profile >= profile_end:
        raise BadInput(
            f"The window rows {window.row}-{window.row_end}, profiles {window.profile}-{window.profile_end} lies "
            f"outside the range image of {data.shape[0]} x {data.shape[1]}."
        )
    cut = data[row:row_end, profile:profile_end]
    rows, columns = min(cut.shape[0], most), min(cut.shape[1], most)
    small = area_mean(cut, rows, columns)
    finite = small[np.isfinite(small)]
    low, high = (float(v) for v in np.percentile(finite, STRETCH)) if finite.size else (0.0, 1.0)
    largest = float(np.abs(finite).max()) if finite.size else 0.0
    finest = FINEST.get(channel, 0.1)
    scale = finest if largest / finest <= 32767 else largest / 32767
    counts = np.full(small.shape, NO_DATA, np.int16)
    counts[np.isfinite(small)] = np.round(finite / scale).astype(np.int16)
    step_row, step_profile = cut.shape[0] / rows, cut.shape[1] / columns
    cell_mm = (step_row * image.row_pitch_um / 1e3, step_profile * image.profile_pitch_um / 1e3)
    origin_mm = (
        (row + (step_row - 1) / 2) * image.row_pitch_um / 1e3,
        (profile + (step_profile - 1) / 2) * image.profile_pitch_um / 1e3,
    )
    unit = CHANNELS[channel][1] if channel in CHANNELS else "um"
    return Picture(counts, scale, unit, origin_mm, cell_mm, FIXED_SPAN.get(channel, (low, high)))


def whole(image: RangeImage) -> Window:
    return Window(0, image.rows, 0, image.profiles)


def cut(image: RangeImage, channel: str, row: int, profile: int) -> dict[str, Any]:
    """The two profiles through one pixel at full resolution, JSON-ready: NaN is null."""
    data = values(image, channel)
    if not (0 <= row < data.shape[0] and 0 <= profile < data.shape[1]):
        raise BadInput(
            f"Row {row}, profile {profile} lies outside the range image of {data.shape[0]} x {data.shape[1]}."
        )
    return {
        "unit": CHANNELS[channel][1],
        "row": row,
        "profile": profile,
        "along": {"step_mm": image.profile_pitch_um / 1e3, "values": _nullable(data[row])},
        "across": {"step_mm": image.row_pitch_um / 1e3, "values": _nullable(data[:, profile])},
    }


def _nullable(line: Float32) -> list[float | None]:
    return [round(float(value), 3) if np.isfinite(value) else None for value in line]


def check_same_pitch(newer: RangeImage, older: RangeImage) -> None:
    """Raise BadInput if the pixels of two range images are not of one size, so that nothing can be subtracted."""
    same = np.isclose(newer.row_pitch_um, older.row_pitch_um, rtol=1e-3) and np.isclose(
        newer.profile_pitch_um, older.profile_pitch_um, rtol=1e-3
    )
    if not same:
        raise BadInput(
            f"The two scans have different pitches ({newer.row_pitch_um:.2f} x {newer.profile_pitch_um:.2f} um and "
            f"{older.row_pitch_um:.2f} x {older.profile_pitch_um:.2f} um), so they cannot be subtracted; compute one "
            "of them again with the recipe of the other."
        )


def difference(newer: RangeImage, older: RangeImage) -> Float32:
    """Levelled newer minus levelled older, cut to the part both have; negative is material lost.

    Both scans are taken at the same stage positions; there is no registration here, so a knife that was clamped
    differently shows as a ridge along every slope. Raises BadInput when the pitches differ.
    """
    check_same_pitch(newer, older)
    a, b = values(newer, "level"), values(older, "level")
    rows, profiles = min(a.shape[0], b.shape[0]), min(a.shape[1], b.shape[1])
    return a[:rows, :profiles] - b[:rows, :profiles]


def damage_box(damage: Damage, image: RangeImage) -> dict[str, Any] | None:
    """Where a damage lies in mm from the image's first row and profile: its box, and its outline as closed lines.

    None if the record holds only its length along the edge.
    """
    detail = damage.detail if isinstance(damage.detail, dict) else {}
    try:
        (row, row_end), (profile, profile_end) = detail["rows"], detail["profiles"]
    except (KeyError, TypeError, ValueError):
        return None
    row_mm, profile_mm = image.row_pitch_um / 1e3, image.profile_pitch_um / 1e3
    return {
        "y0": (row - 0.5) * row_mm,
        "y1": (row_end - 0.5) * row_mm,
        "x0": (profile - 0.5) * profile_mm,
        "x1": (profile_end - 0.5) * profile_mm,
        "outline": [
            [[round(x * profile_mm, 4), round(y * row_mm, 4)] for x, y in line]
            for line in _outlines(detail.get("mask_runs") or [], int(row), int(profile))
        ],
    }


def _outlines(runs: list[list[int]], row: int, profile: int) -> list[list[tuple[float, float]]]:
    """The borders of a mask given as runs [row, first profile, length], in pixels of the whole image."""
    if not runs:
        return []
    rows = max(run[0] for run in runs) - row + 1
    profiles = max(run[1] + run[2] for run in runs) - profile
    mask = np.zeros((rows, profiles), np.uint8)
    for at, first, length in runs:
        mask[at - row, first - profile : first - profile + length] = 1
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    return [[(float(x) + profile, float(y) + row) for x, y in line[:, 0]] for line in contours if len(line) > 2]
