"""The laser line: a Gaussian across, slowly uneven along, fixed in space while the tool moves under it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from scanning.errors import BadInput

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class LaserLine:
    """A laser line ``width_um`` wide on the part.

    The paper says "25 um" without saying of what: ``width_is`` "fwhm" takes it as full width at half maximum, "1/e2" as
    the full width between the points of 1/e^2 of the peak, a line 1.7 times narrower. ``unevenness`` is the share of
    light missing at the ends of a 7 mm line.
    """

    width_um: float = 25.0
    width_is: Literal["fwhm", "1/e2"] = "fwhm"
    unevenness: float = 0.15

    def __post_init__(self) -> None:
        if not 2.0 <= self.width_um <= 500.0:
            raise BadInput(f"A laser line of {self.width_um:g} um cannot be simulated; use 2 to 500 um.")
        if self.width_is not in ("fwhm", "1/e2"):
            raise BadInput(f"The line width is 'fwhm' or '1/e2', not {self.width_is!r}.")

    @property
    def sigma_um(self) -> float:
        """Standard deviation of the intensity profile."""
        if self.width_is == "fwhm":
            return self.width_um / math.sqrt(8.0 * math.log(2.0))
        return self.width_um / 4.0

    @property
    def reach_um(self) -> float:
        """Distance from the middle beyond which less than 4e-5 of the peak intensity is left."""
        return 4.5 * self.sigma_um

    def amplitude(self, x_um: Float64) -> Float64:
        """Return the field amplitude across the line, 1 in the middle."""
        return np.asarray(np.exp(-(x_um**2) / (4.0 * self.sigma_um**2)))

    def along(self, y_um: Float64, middle_um: float) -> Float64:
        """Return the relative intensity along the line, 1 in the middle."""
        return np.asarray(1.0 - self.unevenness * np.clip(((y_um - middle_um) / 3500.0) ** 2, 0.0, 1.0))
