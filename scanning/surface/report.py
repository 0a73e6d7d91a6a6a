"""What an inspection of a surface hands over: numbers, damages, images, and sentences for the reader.

A number without unit, uncertainty and origin cannot be defended in front of whoever pays for the knife; a report with
NaN in it breaks the first strict JSON reader it meets.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanning.surface.damage import DamageFinding
from scanning.surface.edge import Edge
from scanning.surface.filters import Float32, Float64, Mask
from scanning.surface.noise import Noise
from scanning.surface.plane import Plane
from scanning.surface.registration import Registration
from scanning.surface.roughness import Roughness
from scanning.surface.settings import InspectionSettings


@dataclass(frozen=True)
class Measurement:
    """One number: code and label, value (None when it cannot be known), unit, standard uncertainty in the same unit.

    ``source`` says in one sentence (at most 300 characters) where the number came from and which uncertainty inputs
    were unknown. ``scope`` is "region", or "damage n".
    """

    code: str
    label: str
    value: float | None
    unit: str
    u: float | None
    source: str
    scope: str = "region"


@dataclass(frozen=True)
class SurfaceReport:
    """Everything found on one surface. Arrays are (rows, profiles) of the image as it was given.

    ``residual_um`` is height minus reference (plane, or plane and baseline), positive out of the material, NaN where
    not measured or not trusted. ``damage_labels`` holds the damage number per pixel, 0 elsewhere. ``edge_um`` is the
    edge recession per position along the edge, None without an edge.
    """

    measurements: list[Measurement]
    damages: list[DamageFinding]
    plane: Plane
    noise: Noise
    edge: Edge | None
    registration: Registration | None
    roughness: Roughness | None
    residual_um: Float32
    damage_labels: NDArray[np.int32]
    edge_um: Float64 | None
    edge_pitch_um: float
    settings: InspectionSettings
    row_pitch_um: float
    profile_pitch_um: float
    warnings: list[str] = field(default_factory=list)

    @property
    def sigma_um(self) -> float:
        """Robust standard deviation of single pixels about the reference, in um."""
        return self.noise.sigma_um

    @property
    def kappa(self) -> float:
        """Sum of the two-dimensional noise autocorrelation, measured from this image."""
        return self.noise.kappa

    @property
    def damage_mask(self) -> Mask:
        return np.asarray(self.damage_labels > 0)

    def measurement(self, code: str) -> Measurement:
        """Return the region's measurement of that code; KeyError when this surface has none."""
        for one in self.measurements:
            if one.code == code:
                return one
        raise KeyError(code)

    def to_json(self) -> dict[str, Any]:
        """Return the report without its images as plain JSON values; what is not known is null, never NaN."""
        edge = None
        if self.edge is not None:
            edge = {
                "side": self.edge.side,
                "straightness_um": self.edge.straightness_um,
                "sigma_um": self.edge.sigma_um,
                "rounded_um": self.edge.rounded_um,
                "points": self.edge.points,
                "pitch_um": self.edge_pitch_um,
                "recession_um": np.round(self.edge.recession_um, 2),
            }
        report: dict[str, Any] = {
            "format": "edgewatch-surface/1",
            "shape": list(self.residual_um.shape),
            "row_pitch_um": self.row_pitch_um,
            "profile_pitch_um": self.profile_pitch_um,
            "sigma_um": self.sigma_um,
            "kappa": self.kappa,
            "noise": dataclasses.asdict(self.noise),
            "plane": {
                "offset_um": self.plane.offset_um,
                "slope_rows_um_per_mm": self.plane.slope_rows_um_per_mm,
                "slope_profiles_um_per_mm": self.plane.slope_profiles_um_per_mm,
                "quadratic_um_per_mm2": list(self.plane.quadratic),
                "inlier_fraction": self.plane.inlier_fraction,
                "points": self.plane.points,
                "start": self.plane.start,
            },
            "measurements": [dataclasses.asdict(one) for one in self.measurements],
            "damages": [dataclasses.asdict(one) for one in self.damages],
            "edge": edge,
            "registration": dataclasses.asdict(self.registration) if self.registration else None,
            "settings": self.settings.to_json(),
            "warnings": list(self.warnings),
        }
        plain = _plain(report)
        assert isinstance(plain, dict)
        return plain


def _plain(value: Any) -> Any:
    """JSON values only: arrays to lists, numpy scalars to Python, NaN and infinities to null."""
    if isinstance(value, dict):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    if isinstance(value, np.ndarray):
        return [_plain(one) for one in value.tolist()]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
