"""Where a point of the tool lands on the detector of the simulated rig.

The simulator keeps its own projection instead of using the product's: if both shared one, an error in it would cancel
and every simulated measurement would look perfect.

The laser sheet stands vertically on the part and holds the line x = 0; the stage carries the part along x; the camera
looks down at ``elevation_deg`` above the surface, its axis meeting the sheet at the working height. A pinhole with
principal distance C = M S sees a point (x, z) at

    d = M u / (1 - a / S),   u = x sin b + z cos b,   a = z sin b - x cos b

which for x = 0 is eq. (1) of the paper with its reference on the axis, and for small d its eq. (2),
dz = dd / (M cos b).
Rows are taken as telecentric: over 0.3 mm of height the row magnification would change by 0.16 %.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanning.errors import BadInput

WORKING_HEIGHT_UM = 450.0
"""Height above the rig's datum at which the parts are mounted: the middle of the paper's gauge, 0.14 to 0.745 mm."""


@dataclass(frozen=True)
class ImagingSystem:
    """One row of the paper's Table 1. Lengths in the unit of their name, ``f_number`` as engraved on the lens."""

    name: str
    pixel_um: float
    magnification: float
    stand_off_mm: float
    rows: int
    columns: int
    f_number: float
    response: Literal["linear", "logarithmic"]
    elevation_deg: float = 60.0
    wavelength_um: float = 0.660

    @property
    def row_pitch_um(self) -> float:
        """Distance on the part between two camera rows, micrometres (7.150838 on IS1)."""
        return self.pixel_um / self.magnification

    @property
    def um_per_pixel(self) -> float:
        """Height per column on the axis, eq. (2), micrometres (14.30168 on IS1)."""
        return self.row_pitch_um / math.cos(math.radians(self.elevation_deg))

    @property
    def travel_per_pixel_um(self) -> float:
        """Stage travel that moves a surface point by one column, micrometres (8.257 on IS1)."""
        return self.row_pitch_um / math.sin(math.radians(self.elevation_deg))

    @property
    def working_f_number(self) -> float:
        return self.f_number * (1.0 + self.magnification)

    def column_px(self, height_um: ArrayLike, columns: int, x_um: ArrayLike = 0.0) -> NDArray[np.float64]:
        """Return the column (0-based) of a point ``height_um`` above the datum and ``x_um`` off the laser sheet.

        The optical axis lies in the middle of the ``columns`` wide region of interest.
        """
        z = np.asarray(height_um, dtype=np.float64) - WORKING_HEIGHT_UM
        x = np.asarray(x_um, dtype=np.float64)
        sin_b, cos_b, stand_off_um, _ = self.projection()
        along = (z * sin_b - x * cos_b) / stand_off_um
        d_px = (x * sin_b + z * cos_b) / (1.0 - along) / self.row_pitch_um
        return np.asarray((columns - 1) / 2.0 + d_px)

    def projection(self) -> tuple[float, float, float, float]:
        """Return sin b, cos b, stand-off in micrometres and columns per micrometre in the object plane."""
        b = math.radians(self.elevation_deg)
        return math.sin(b), math.cos(b), self.stand_off_mm * 1e3, 1.0 / self.row_pitch_um

    def with_f_number(self, f_number: float | None) -> ImagingSystem:
        """Return the same system with another aperture; None keeps the usual one."""
        if f_number is None:
            return self
        system = replace(self, f_number=float(f_number))
        # The intensity behind the pupil holds frequencies up to 1/(lambda N_w); the two samples per pixel used here
        # carry 1/pixel. A wider pupil would fold over and draw speckle that no lens makes.
        if not self.wavelength_um * system.working_f_number >= self.pixel_um:
            least = self.pixel_um / self.wavelength_um / (1.0 + self.magnification)
            raise BadInput(
                f"f/{f_number:g} is wider than {self.name} can be simulated with; use f/{least:.1f} or more."
            )
        return system


IS1 = ImagingSystem("IS1", 3.2, 0.4475, 162.0, 1536, 2048, 5.6, "linear")
"""The paper's first system. f/5.6 with a 25 um FWHM line reproduces its 7.6 and 4.2 um; the paper names neither."""

IS2 = ImagingSystem("IS2", 10.0, 1.0, 110.0, 576, 768, 14.0, "logarithmic")
"""The paper's high dynamic range system. The paper names no aperture; f/14 is chosen because five averaged images then
spread by 5.7 to 5.9 um in linear light, close to its 5.6 um."""

SYSTEMS = {system.name: system for system in (IS1, IS2)}
