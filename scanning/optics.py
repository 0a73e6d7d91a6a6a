"""Where a height lands on the detector, and how finely it can be seen there.

Everything that relates micrometres on the tool to pixels on the sensor is here, as the paper's eq. (1) and (2) and the
lens relations behind them, with the paper's two imaging systems as data. Without one place for it, the simulator, the
calibration's plausibility check and the report would each carry their own copy of a tangent, and disagree.

Source: Amir and Thornberg, "High Precision Laser Scanning of Metallic Surfaces", Int. J. Optics 2017, eq. (1), (2),
Table 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanning.frames import Response

STEP_UM = 8.33
"""The paper's distance between two scan images: 17 motor steps of 0.49 um."""
LINE_WIDTH_UM = 25.0
"""Width of the laser line on the tool."""
WAVELENGTH_UM = 0.66
"""The red line laser of the paper."""


@dataclass(frozen=True)
class ImagingSystem:
    """A camera, its lens and where they stand, as in Table 1 of the paper.

    ``rows`` lie along the laser line, ``columns`` across it (the direction in which a height moves the line).
    ``angle_deg`` is the angle between the camera's axis and the surface, ``stand_off_mm`` the height H of the camera
    over it, ``distance_mm`` the distance S from the lens to the object. What a data sheet does not state is None.
    """

    name: str
    pixel_um: float
    magnification: float
    rows: int
    columns: int
    dynamic_range_db: float
    response: Response = "linear"
    angle_deg: float = 60.0
    focal_length_mm: float | None = None
    distance_mm: float | None = None
    stand_off_mm: float | None = None
    depth_of_field_mm: float | None = None

    @property
    def mm_per_pixel(self) -> float:
        """Height per column by eq. (2), dr = dd / (M cos b), in mm per pixel."""
        return self.pixel_um / 1000.0 / (self.magnification * math.cos(math.radians(self.angle_deg)))

    @property
    def row_pitch_um(self) -> float:
        """Distance on the tool between two neighbouring rows, in um."""
        return self.pixel_um / self.magnification

    def on_sensor_px(self, length_um: float) -> float:
        """Columns that a length along the scan covers on the sensor (foreshortened by the camera's angle).

        A stage step of 8.33 um is 1.0088 px and the 25 um line 3.0277 px on IS1.
        """
        return length_um * math.sin(math.radians(self.angle_deg)) * self.magnification / self.pixel_um

    @property
    def half_detector_mm(self) -> float:
        """D of eq. (1): half the detector's extent across the line.

        The paper calls D the size of the detector; with the full size r(-D) would not be 0, so it must be half.
        """
        return self.columns * self.pixel_um / 2000.0

    @property
    def principal_distance_mm(self) -> float:
        """C of eq. (1): lens to detector, fS/(S-f), by the thin lens."""
        focal, distance = self._lens()
        return focal * distance / (distance - focal)

    def height_mm(self, detector_mm: ArrayLike, half_detector_mm: float | None = None) -> NDArray[np.float64]:
        """Height over the reference plane by the full triangulation, eq. (1).

        ``detector_mm`` is d, the position on the detector measured from the optical axis; ``half_detector_mm`` is D
        (default: the whole detector's half), and the reference plane is seen at d = -D, where the height is 0.
        """
        if self.stand_off_mm is None:
            raise ValueError(f"the stand-off H of {self.name} is not known, so eq. (1) cannot be used; use eq. (2)")
        big_d = self.half_detector_mm if half_detector_mm is None else half_detector_mm
        c = self.principal_distance_mm
        tangent = math.tan(math.radians(self.angle_deg))
        d = np.asarray(detector_mm, dtype=np.float64)
        ratio = (c - big_d * tangent) * (c * tangent - d) / ((c * tangent + big_d) * (c + d * tangent))
        return np.asarray(self.stand_off_mm * (1.0 - ratio), dtype=np.float64)

    def speckle_size_px(self, f_number: float, wavelength_um: float = WAVELENGTH_UM) -> float:
        """Size of a speckle on the sensor, lambda N (1+M), in pixels. Below 1 px speckle averages out in the pixel."""
        return wavelength_um * f_number * (1.0 + self.magnification) / self.pixel_um

    def speckle_limit_um(self, f_number: float, wavelength_um: float = WAVELENGTH_UM, contrast: float = 1.0) -> float:
        """Smallest height noise that laser triangulation can have, in um: C lambda / (2 pi sin u sin theta).

        ``theta`` is the angle between the laser plane and the camera's axis, u the half angle of the aperture seen
        from the object. Source: Dorsch, Haeusler, Herrmann, Appl. Opt. 33 (1994) 1306.
        """
        focal, distance = self._lens()
        aperture = math.atan(focal / f_number / 2.0 / distance)
        theta = math.radians(90.0 - self.angle_deg)
        return contrast * wavelength_um / (2.0 * math.pi * math.sin(aperture) * math.sin(theta))

    def _lens(self) -> tuple[float, float]:
        if self.focal_length_mm is None or self.distance_mm is None:
            raise ValueError(f"focal length and object distance of {self.name} are not known")
        return self.focal_length_mm, self.distance_mm


def magnification_from_distance(focal_length_mm: float, distance_mm: float) -> float:
    """Thin lens: M = f / (S - f)."""
    return focal_length_mm / (distance_mm - focal_length_mm)


def distance_from_magnification(focal_length_mm: float, magnification: float) -> float:
    """Thin lens: S = f (1 + 1/M), in mm."""
    return focal_length_mm * (1.0 + 1.0 / magnification)


def dynamic_range_db(highest: float, lowest: float) -> float:
    """20 log10(highest / lowest): eq. (3) for grey values, eq. (5) for the extension by a bracket of exposures."""
    return 20.0 * math.log10(highest / lowest)


IS1 = ImagingSystem(
    name="IS1",
    pixel_um=3.2,
    magnification=0.4475,
    rows=1536,
    columns=2048,
    dynamic_range_db=60.0,
    focal_length_mm=50.0,
    distance_mm=162.0,
    stand_off_mm=140.2,
)
"""Linear camera with a 50 mm lens."""

IS2 = ImagingSystem(
    name="IS2",
    pixel_um=10.0,
    magnification=1.0,
    rows=576,
    columns=768,
    dynamic_range_db=120.0,
    response="logarithmic",
    distance_mm=None,
    stand_off_mm=None,
    depth_of_field_mm=1.2,
)
"""HDR camera with logarithmic photovoltaic pixels and a telecentric 1:1 lens, working distance 110 mm."""

SYSTEMS = {system.name: system for system in (IS1, IS2)}
