"""A range image: heights over the tool's surface, with everything needed to trust or recompute them.

One array without its pitches, its quality channels and its provenance is a picture, not a measurement; keeping them in
one object is what stops a number from travelling without its origin.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class RangeImage:
    """Heights of one scanned region.

    Arrays are (rows, profiles): rows along the laser line, profiles along the scan. NaN means not measured.
    ``height_um`` is positive out of the material. ``intensity`` is the grey value of the line's peak as the centroid
    saw it, ``width_px`` its full width at half maximum.
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

    @property
    def undefined(self) -> int:
        """Number of pixels without a height."""
        return int(np.count_nonzero(~np.isfinite(self.height_um)))

    @property
    def undefined_share(self) -> float:
        return self.undefined / self.height_um.size if self.height_um.size else 1.0

    @property
    def saturated_share(self) -> float:
        return self.saturated / self.frame_pixels if self.frame_pixels else 0.0
