"""Calibrations as pages show them: the fitted line, its residuals, and how long it still holds."""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass
from typing import Any, Final

from inspection.models import Calibration, Rig
from scanning.calibration import DUE_DAYS
from scanning.calibration import Calibration as Fit

#: From so many days before its expiry a calibration is shown in yellow.
SOON_DAYS: Final = DUE_DAYS


def colour(calibration: Calibration | None, today: dt.date) -> str:
    """Green while valid, yellow in its last 30 days, red when expired or missing."""
    if calibration is None or today > calibration.valid_until:
        return "red"
    return "yellow" if (calibration.valid_until - today).days <= SOON_DAYS else "green"


@dataclass(frozen=True)
class RigCalibration:
    rig: Rig
    current: Calibration | None
    colour: str
    history: list[Calibration]


def calibrations_by_rig(today: dt.date) -> list[RigCalibration]:
    rows = []
    for rig in Rig.objects.prefetch_related("calibrations__by"):
        history = sorted(rig.calibrations.all(), key=lambda c: (c.done_on, c.pk), reverse=True)
        current = history[0] if history else None
        rows.append(RigCalibration(rig, current, colour(current, today), history))
    return rows


def residual_chart(pairs: list[tuple[float, float]], residuals_um: list[float]) -> dict[str, Any]:
    """Data of the residual plot: height in mm against residual in um, in order of height."""
    ordered = sorted(zip(pairs, residuals_um, strict=True), key=lambda row: row[0][0])
    return {
        "rows": [[*pair, residual] for pair, residual in ordered],
        "height_mm": [pair[0] for pair, _ in ordered],
        "column_px": [pair[1] for pair, _ in ordered],
        "residual_um": [residual for _, residual in ordered],
    }


def stored_chart(calibration: Calibration) -> dict[str, Any]:
    """The residual plot of a stored calibration, from its own pairs and line."""
    pairs = [(float(height), float(column)) for height, column in calibration.pairs]
    residuals = [
        1000 * (height - calibration.intercept_mm - calibration.slope_mm_per_px * column) for height, column in pairs
    ]
    return residual_chart(pairs, residuals)


def fit_chart(fit: Fit) -> dict[str, Any]:
    return residual_chart(list(zip(fit.heights_mm, fit.columns_px, strict=True)), list(fit.residuals_um))
