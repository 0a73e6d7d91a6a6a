"""Is a straight line enough? The paper's eq. (1) fitted to the same gauge pairs, beside the line.

A camera at 60 degrees does not see equal heights as equal distances: eq. (1) bends by 0.56 um over the paper's 52
calibrated columns, by 5.8 um over 2.4 mm. Whether that matters is for the gauge to say. Both models get the same two
free parameters, an offset and a scale (height = a + b x for the line, a + k r(d) for eq. (1) with the data sheet's C, H
and angle), and the one that predicts a step it was not fitted to better is the better one.

D, half the detector's extent, only chooses the reference plane (r(-D) = 0, and H is counted from there), so offset and
scale take it up; what bends the curve is where the optical axis meets the image.

Source: Amir and Thornberg 2017, eq. (1), (2), Table 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanning.calibration import Calibration, LineFit, fit_line
from scanning.errors import BadInput
from scanning.optics import IS1, SYSTEMS, ImagingSystem

Float64 = NDArray[np.float64]
DECIDED = 0.8


@dataclass(frozen=True)
class Triangulation:
    """Eq. (1) for one camera. ``axis_column`` is the (0-based) column in which the optical axis meets the image."""

    system: ImagingSystem = IS1
    axis_column: float = (IS1.columns - 1) / 2.0

    def height_mm(self, column_px: ArrayLike) -> Float64:
        """r of eq. (1) in mm, any shape: D reaches from the axis to the left border of column 0, where r is 0."""
        pixel_mm = self.system.pixel_um / 1000.0
        half = (self.axis_column + 0.5) * pixel_mm
        d = (np.asarray(column_px, dtype=np.float64) - self.axis_column) * pixel_mm
        return self.system.height_mm(d, half)


@dataclass(frozen=True)
class Comparison:
    """The straight line and eq. (1) through the same pairs; residuals and leave-one-out errors in um, pair by pair.

    ``scale`` is k. ``difference_um`` is the largest difference of the two between the lowest and the highest pair: what
    the straight line costs inside the calibrated range; ``difference_depth_um`` the same over 2.4 mm about its middle
    (the paper's depth of field).
    """

    line: LineFit
    curve: LineFit
    system: str
    axis_column: float
    difference_um: float
    difference_depth_um: float

    @property
    def scale(self) -> float:
        return self.curve.slope

    @property
    def line_leave_one_out_um(self) -> float:
        """Root mean square leave-one-out error."""
        return _rms_um(self.line.leave_one_out)

    @property
    def curve_leave_one_out_um(self) -> float:
        return _rms_um(self.curve.leave_one_out)

    @property
    def decided(self) -> bool:
        """Whether one model's error is at least a fifth smaller; otherwise this gauge cannot tell them apart."""
        small, large = sorted((self.line_leave_one_out_um, self.curve_leave_one_out_um))
        return small < DECIDED * large

    @property
    def better(self) -> str:
        """ "straight line" or "eq. (1)": the smaller root mean square leave-one-out error."""
        return "eq. (1)" if self.curve_leave_one_out_um < self.line_leave_one_out_um else "straight line"

    def to_json(self) -> dict[str, Any]:
        def model(fit: LineFit, rms_um: float) -> dict[str, Any]:
            return {
                "residuals_um": (1000.0 * fit.residuals).tolist(),
                "leave_one_out_each_um": (1000.0 * fit.leave_one_out).tolist(),
                "residual_sd_um": 1000.0 * fit.residual_sd,
                "leave_one_out_rms_um": rms_um,
            }

        return {
            "straight_line": model(self.line, self.line_leave_one_out_um),
            "eq_1": {
                **model(self.curve, self.curve_leave_one_out_um),
                "system": self.system,
                "axis_column": self.axis_column,
                "scale": self.scale,
                "u_scale": self.curve.u_slope,
            },
            "better": self.better,
            "decided": self.decided,
            "largest_difference_um": self.difference_um,
            "largest_difference_over_2.4_mm_um": self.difference_depth_um,
        }


def compare_models(calibration: Calibration, triangulation: Triangulation) -> Comparison:
    """Fit both models to the pairs of a calibration. `BadInput` where the system's stand-off is not known (IS2)."""
    system = triangulation.system
    if system.stand_off_mm is None or system.focal_length_mm is None:
        raise BadInput(
            f"eq. (1) needs the stand-off and the focal length of {system.name}, which are not known; compare with "
            "IS1 or leave the comparison out"
        )
    columns = np.asarray(calibration.columns_px)
    heights = np.asarray(calibration.heights_mm)
    line = fit_line(columns, heights)
    curve = fit_line(triangulation.height_mm(columns), heights)
    low, high = calibration.range_px
    middle, reach = (low + high) / 2.0, 1.2 / abs(calibration.slope_mm_per_px)

    def apart_um(between: Float64) -> float:
        bent = curve.intercept + curve.slope * triangulation.height_mm(between)
        return 1000.0 * float(np.abs(bent - line.intercept - line.slope * between).max())

    return Comparison(
        line=line,
        curve=curve,
        system=system.name,
        axis_column=triangulation.axis_column,
        difference_um=apart_um(np.linspace(low, high, 201)),
        difference_depth_um=apart_um(np.linspace(middle - reach, middle + reach, 201)),
    )


def system_named(name: str) -> ImagingSystem:
    if name not in SYSTEMS:
        raise BadInput(f'there is no imaging system "{name}"; choose one of {", ".join(SYSTEMS)}')
    return SYSTEMS[name]


def _rms_um(errors: Float64) -> float:
    return 1000.0 * math.sqrt(float(errors @ errors) / errors.size)
