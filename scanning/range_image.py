"""A range image: heights over the tool's surface, with everything needed to trust or recompute them.

One array without its pitches, its quality channels and its provenance is a picture, not a measurement; keeping them in
one object is what stops a number from travelling without its origin.
"""

from __future__ import annotations

import json
import math
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanning.errors import BadInput
from scanning.whole_file import whole_file

Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class RangeImage:
    """Heights of one scanned region.

    Arrays are (rows, profiles): rows along the laser line, profiles along the scan. NaN means not measured.
    ``height_um`` is positive out of the material. ``intensity`` is the grey value of the line's peak as the centroid
    saw it, ``width_px`` its full width at half maximum. ``confidence``, 0 to 1, says how sure it is that a point is on
    the laser line and not on a reflection (above 0.95 fewer than 1 in 1000 are not); None where nothing said so.
    ``row_pitch_um`` lies along the rows, ``profile_pitch_um`` along the scan (41.65 for block SCI, 8.33 sliding).
    ``saturated`` counts saturated pixels in the frames used, ``frame_pixels`` all pixels looked at.
    ``provenance`` is JSON-serialisable: recipe in full, header, calibration, software versions, estimated values.
    """

    column_px: Float32
    height_um: Float32
    row_pitch_um: float
    profile_pitch_um: float
    intensity: Float32
    width_px: Float32
    saturated: int = 0
    frame_pixels: int = 0
    wall_s: float = 0.0
    cpu_s: float = 0.0
    provenance: dict[str, Any] = field(default_factory=dict)
    confidence: Float32 | None = None

    @property
    def undefined(self) -> int:
        """Number of pixels without a height."""
        return int(np.count_nonzero(~np.isfinite(self.height_um)))

    @property
    def undefined_share(self) -> float:
        return self.undefined / self.height_um.size if self.height_um.size else 1.0

    @property
    def outside_calibrated(self) -> NDArray[np.bool_] | None:
        """(rows, profiles) True where a height is extrapolated: its column lies beyond the gauge's.

        None when the heights are not from a gauge (the stack header's mm per pixel), or its range is not told.
        """
        calibration = self.provenance.get("calibration")
        span = calibration.get("calibrated_range_px") if isinstance(calibration, dict) else None
        if not isinstance(span, (list, tuple)) or len(span) != 2:
            return None
        # float32, as columns are kept: a tread's own column must not fall outside by its rounding.
        low, high = np.float32(span[0]), np.float32(span[1])
        finite = np.isfinite(self.height_um)
        return np.asarray(finite & ~((self.column_px >= low) & (self.column_px <= high)), dtype=np.bool_)

    @property
    def saturated_share(self) -> float:
        return self.saturated / self.frame_pixels if self.frame_pixels else 0.0

    def save(self, path: Path | str) -> None:
        """Write ``range.npz`` (contract 3): the arrays as float32, both pitches, counts, and provenance as JSON text.

        With a calibration also ``outside_calibrated`` (bool), for those who read the file with other software.

        The file appears whole or not at all.
        """
        outside = self.outside_calibrated
        told: dict[str, Any] = {} if outside is None else {"outside_calibrated": outside}
        if self.confidence is not None:
            told["confidence"] = self.confidence.astype(np.float32, copy=False)
        with whole_file(path) as part, part.open("wb") as file:
            np.savez(
                file,
                **told,
                column_px=self.column_px.astype(np.float32, copy=False),
                height_um=self.height_um.astype(np.float32, copy=False),
                row_pitch_um=np.float64(self.row_pitch_um),
                profile_pitch_um=np.float64(self.profile_pitch_um),
                intensity=self.intensity.astype(np.float32, copy=False),
                width_px=self.width_px.astype(np.float32, copy=False),
                saturated=np.int64(self.saturated),
                frame_pixels=np.int64(self.frame_pixels),
                wall_s=np.float64(self.wall_s),
                cpu_s=np.float64(self.cpu_s),
                provenance=np.str_(json.dumps(self.provenance, allow_nan=False)),
            )

    @staticmethod
    def load(path: Path | str) -> RangeImage:
        """Read what `save` wrote, or a foreign .npz with ``height_um``, ``row_pitch_um`` and ``profile_pitch_um``.

        Channels that are not there become NaN, a confidence that is not there None; infinite heights become NaN.
        Raises `BadInput` naming file and fault.
        """
        place = Path(path)
        try:
            if place.is_file() and not zipfile.is_zipfile(place):
                raise ValueError("it is not a .npz file")
            with np.load(place, allow_pickle=False) as stored:
                held = {name: stored[name] for name in stored.files}
        except FileNotFoundError:
            raise BadInput(f"there is no range image at {place}; process a stack first") from None
        except (OSError, ValueError, EOFError, KeyError, AttributeError, zipfile.BadZipFile) as error:
            raise BadInput(f"{place} is not a range image or is damaged ({error}); process the stack again") from error
        for name in ("height_um", "row_pitch_um", "profile_pitch_um"):
            if name not in held:
                raise BadInput(f"{place} has no {name}; it is not a range image of `python -m scanning process`")
        height = _heights(held["height_um"], place)
        return RangeImage(
            column_px=_channel(held, "column_px", height, place),
            height_um=height,
            row_pitch_um=_pitch(held["row_pitch_um"], "row_pitch_um", place),
            profile_pitch_um=_pitch(held["profile_pitch_um"], "profile_pitch_um", place),
            intensity=_channel(held, "intensity", height, place),
            width_px=_channel(held, "width_px", height, place),
            saturated=int(_count(held, "saturated", place)),
            frame_pixels=int(_count(held, "frame_pixels", place)),
            wall_s=_count(held, "wall_s", place),
            cpu_s=_count(held, "cpu_s", place),
            provenance=_provenance(held, place),
            confidence=_channel(held, "confidence", height, place) if "confidence" in held else None,
        )


def _heights(stored: NDArray[Any], place: Path) -> Float32:
    if stored.ndim != 2 or stored.dtype.kind not in "fiu" or stored.size == 0:
        raise BadInput(
            f"{place}: height_um is {stored.dtype} of shape {stored.shape}; it must be (rows, profiles) numbers"
        )
    height = stored.astype(np.float32)
    height[~np.isfinite(height)] = np.nan
    return height


def _channel(held: dict[str, NDArray[Any]], name: str, height: Float32, place: Path) -> Float32:
    stored = held.get(name)
    if stored is None:
        return np.full_like(height, np.nan)
    if stored.shape != height.shape or stored.dtype.kind not in "fiu":
        raise BadInput(f"{place}: {name} is {stored.dtype} of shape {stored.shape}, but height_um is {height.shape}")
    return stored.astype(np.float32, copy=False)


def _count(held: dict[str, NDArray[Any]], name: str, place: Path) -> float:
    stored = held.get(name)
    if stored is None:
        return 0.0
    value = float(stored.item()) if stored.size == 1 and stored.dtype.kind in "fiu" else math.nan
    if not (math.isfinite(value) and value >= 0):
        raise BadInput(f"{place}: {name} must be one number, zero or more; process the stack again")
    return value


def _pitch(stored: NDArray[Any], name: str, place: Path) -> float:
    pitch = float(stored.item()) if stored.size == 1 and stored.dtype.kind in "fiu" else math.nan
    if not (math.isfinite(pitch) and pitch > 0):
        raise BadInput(f"{place}: {name} must be one number of micrometres greater than zero; process the stack again")
    return pitch


def _provenance(held: dict[str, NDArray[Any]], place: Path) -> dict[str, Any]:
    if "provenance" not in held:
        return {"origin": place.name}
    try:
        told = json.loads(str(held["provenance"]))
    except json.JSONDecodeError:
        raise BadInput(f"{place}: its provenance is not JSON; process the stack again") from None
    if not isinstance(told, dict):
        raise BadInput(f"{place}: its provenance is not a JSON object; process the stack again")
    return told
