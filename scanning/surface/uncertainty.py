"""Standard uncertainties of the surface numbers (GUM, first order), and what is known of the scale.

A depth without its uncertainty invites a decision the measurement cannot carry: at 500 um depth the calibration slope
alone contributes 8 um, twice the noise everybody looks at.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from scanning.range_image import RangeImage
from scanning.surface.noise import Noise
from scanning.surface.settings import InspectionSettings


@runtime_checkable
class HeightScale(Protocol):
    """The part of a calibration this module needs."""

    @property
    def slope_mm_per_px(self) -> float: ...
    @property
    def u_slope_mm_per_px(self) -> float: ...


@dataclass(frozen=True)
class Budget:
    """Everything that makes a height difference, a volume or a length uncertain.

    ``scale`` and ``pitch`` are relative standard uncertainties, None when nobody knows them. ``sentence`` says which
    inputs were known, for the reader of the number.
    """

    noise: Noise
    reference_um: float
    linearity_um: float
    scale: float | None
    pitch: float | None
    sentence: str

    def volume_mm3(self, volume_mm3: float, pixels: int, pixel_area_um2: float, u_filled_mm3: float = 0.0) -> float:
        """u(V): noise over the mask, reference over its area, scale and pitch over the volume.

        u^2 = (a sigma)^2 N kappa + (A u_ref)^2 + (V u_S/S)^2 + (V u_dx/dx)^2 + u_filled^2, the last for what was
        interpolated over undefined pixels.
        """
        noise = pixel_area_um2 * self.noise.sigma_um * math.sqrt(max(pixels, 0) * self.noise.kappa) * 1e-9
        reference = pixel_area_um2 * pixels * self.reference_um * 1e-9
        scale = volume_mm3 * (self.scale or 0.0)
        # Both pitches come from one magnification as a rule: an area is then twice as uncertain as a length.
        pitch = volume_mm3 * 2.0 * (self.pitch or 0.0)
        return math.sqrt(noise**2 + reference**2 + scale**2 + pitch**2 + u_filled_mm3**2)

    def depth_um(self, depth_um: float, sigma_smoothed_um: float) -> float:
        """u(d) = sqrt(sigma_g^2 + u_ref^2 + (d u_S/S)^2 + u_lin^2)."""
        scale = depth_um * (self.scale or 0.0)
        return math.sqrt(sigma_smoothed_um**2 + self.reference_um**2 + scale**2 + self.linearity_um**2)


def budget(
    image: RangeImage,
    noise: Noise,
    reference_pixels: int,
    settings: InspectionSettings,
    calibration: object | None,
) -> Budget:
    """Collect what is known: the calibration given, else the one in the image's provenance, else the settings."""
    scale, origin = _scale(image, settings, calibration)
    reference = math.hypot(noise.sigma_um * math.sqrt(noise.kappa / max(reference_pixels, 1)), noise.shape_um)
    pitch = settings.u_pitch_relative
    about_pitch = (
        "the pitches are taken as exact: no uncertainty was given for them"
        if pitch is None
        else f"pitches {100 * pitch:.2g} %"
    )
    return Budget(
        noise=noise,
        reference_um=reference,
        linearity_um=settings.u_linearity_um if scale is not None else 0.0,
        scale=scale,
        pitch=pitch,
        sentence=f"{origin}; {about_pitch}",
    )


def _scale(image: RangeImage, settings: InspectionSettings, calibration: object | None) -> tuple[float | None, str]:
    if isinstance(calibration, HeightScale) and calibration.slope_mm_per_px:
        relative = abs(calibration.u_slope_mm_per_px / calibration.slope_mm_per_px)
        if math.isfinite(relative):
            return relative, f"height scale {100 * relative:.2g} % from the calibration"
    recorded: Any = image.provenance.get("calibration")
    if isinstance(recorded, dict):
        slope, u_slope = recorded.get("slope_mm_per_px"), recorded.get("u_slope_mm_per_px")
        if isinstance(slope, (int, float)) and isinstance(u_slope, (int, float)) and slope:
            return abs(u_slope / slope), f"height scale {100 * abs(u_slope / slope):.2g} % from the calibration"
    if settings.u_scale_relative is not None:
        return settings.u_scale_relative, f"height scale {100 * settings.u_scale_relative:.2g} % as set"
    return None, "the height scale is taken as exact: no calibration with an uncertainty came with the range image"
