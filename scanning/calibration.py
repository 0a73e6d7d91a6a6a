"""Pixels to millimetres: a straight line through a step gauge, with everything needed to doubt it.

The paper regresses HEIGHT ON PIXEL (its printed slopes settle the direction) and calls the largest residual the
accuracy. That is an in-sample figure; here it stands beside the standard uncertainties, their correlation and the
leave-one-out error, and a height outside the gauge's range can be told from one inside. Without the uncertainty of the
slope, a deep damage would be reported as precisely as a shallow one: on IS1 it is 1.58 %, more than the noise for every
depth over 270 um.

Source: Amir and Thornberg 2017, section 4.5 and Table 2; ordinary least squares with n - 2 degrees of freedom.
"""

from __future__ import annotations

import csv
import datetime as dt
import hashlib
import io
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanning.errors import BadInput

FORMAT = "edgewatch-calibration/1"
FEWEST_PAIRS = 3
STEEPEST_MM_PER_PX = 10.0
"""As for a stack's mm_per_pixel: heights written in um give 14 on IS1 and would pass for a good line."""
DUE_DAYS = 30
"""A calibration that expires within so many days is due."""
State = Literal["valid", "due", "expired", "without expiry"]
HEIGHT = "height_mm"
COLUMN = "column_px"


@dataclass(frozen=True)
class LineFit:
    """y = intercept + slope x by ordinary least squares, in the units of x and y.

    ``correlation`` is r(intercept, slope); ``leverage`` is the diagonal of the hat matrix; ``residual_sd`` has n - 2
    degrees of freedom.
    """

    slope: float
    intercept: float
    u_slope: float
    u_intercept: float
    correlation: float
    residual_sd: float
    r_squared: float
    residuals: NDArray[np.float64]
    leverage: NDArray[np.float64]

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Covariance of (intercept, slope), (2, 2), in the units of y, and y per x."""
        mixed = self.correlation * self.u_intercept * self.u_slope
        return np.array([[self.u_intercept**2, mixed], [mixed, self.u_slope**2]])

    @property
    def leave_one_out(self) -> NDArray[np.float64]:
        """Each point's error against the line through all the others: residual / (1 - leverage)."""
        return self.residuals / (1.0 - self.leverage)


def fit_line(x: ArrayLike, y: ArrayLike) -> LineFit:
    """Fit y = a + b x by least squares. Needs three points with three different x; values must be finite."""
    x_values = np.asarray(x, dtype=np.float64)
    y_values = np.asarray(y, dtype=np.float64)
    count = x_values.size
    x_mean, y_mean = float(x_values.mean()), float(y_values.mean())
    dx, dy = x_values - x_mean, y_values - y_mean
    sxx = float(dx @ dx)
    slope = float(dx @ dy) / sxx
    intercept = y_mean - slope * x_mean
    residuals = dy - slope * dx
    sse, syy = float(residuals @ residuals), float(dy @ dy)
    residual_sd = math.sqrt(sse / (count - 2))
    root = math.sqrt(1.0 / count + x_mean * x_mean / sxx)
    return LineFit(
        slope=slope,
        intercept=intercept,
        u_slope=residual_sd / math.sqrt(sxx),
        u_intercept=residual_sd * root,
        correlation=-x_mean / math.sqrt(sxx) / root,
        residual_sd=residual_sd,
        r_squared=1.0 - sse / syy if syy > 0 else 1.0,
        residuals=residuals,
        leverage=1.0 / count + dx * dx / sxx,
    )


@dataclass(frozen=True)
class Calibration:
    """A straight line from column to height, with its uncertainty and where it holds.

    ``heights_mm`` and ``columns_px`` are the gauge pairs in the order given; ``residuals_um`` and
    ``leave_one_out_each_um`` belong to them one by one. ``leave_one_out_um`` is the LARGEST absolute leave-one-out
    error (14.0 um for the paper's IS1, 28.4 um for IS2), as ``max_residual_um`` is the largest absolute residual.
    ``measured_on`` and ``expires_on`` are ISO dates or None. ``u_scale_relative`` is what stretches all heights alike
    and so leaves no residual: how sure the gauge's tilt is known, its certificate.
    """

    heights_mm: tuple[float, ...]
    columns_px: tuple[float, ...]
    slope_mm_per_px: float
    intercept_mm: float
    u_slope_mm_per_px: float
    u_intercept_mm: float
    correlation: float
    residual_sd_um: float
    max_residual_um: float
    leave_one_out_um: float
    r_squared: float
    residuals_um: tuple[float, ...]
    leave_one_out_each_um: tuple[float, ...]
    gauge: str = ""
    measured_on: str | None = None
    expires_on: str | None = None
    u_scale_relative: float = 0.0

    @property
    def pairs(self) -> int:
        return len(self.heights_mm)

    @property
    def range_px(self) -> tuple[float, float]:
        """Lowest and highest column of the gauge: outside them a height is extrapolated."""
        return min(self.columns_px), max(self.columns_px)

    @property
    def range_mm(self) -> tuple[float, float]:
        return min(self.heights_mm), max(self.heights_mm)

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Covariance of (intercept, slope), (2, 2): mm2, mm2 per px, mm2 per px2."""
        mixed = self.correlation * self.u_intercept_mm * self.u_slope_mm_per_px
        return np.array([[self.u_intercept_mm**2, mixed], [mixed, self.u_slope_mm_per_px**2]])

    def standing(self, on: dt.date) -> tuple[State, str]:
        """Whether the calibration holds on a day, and the sentence that says so. The last day still counts."""
        if self.expires_on is None:
            return "without expiry", "The calibration has no expiry date; calibrate with one."
        return standing(dt.date.fromisoformat(self.expires_on), on)

    @property
    def u_slope_relative(self) -> float:
        """u(slope) / |slope|, without unit: of the line, and of the gauge's scale as a whole."""
        return math.hypot(self.u_slope_mm_per_px / abs(self.slope_mm_per_px), self.u_scale_relative)

    def height_um(self, column_px: ArrayLike) -> NDArray[np.float64]:
        """Height in um of a line seen at ``column_px`` (0-based columns, any shape). NaN stays NaN."""
        column = np.asarray(column_px, dtype=np.float64)
        return 1000.0 * (self.intercept_mm + self.slope_mm_per_px * column)

    def u_height_um(self, column_px: ArrayLike) -> NDArray[np.float64]:
        """Standard uncertainty in um of a height from the line alone: both parameters and their correlation."""
        column = np.asarray(column_px, dtype=np.float64)
        variance = (
            self.u_intercept_mm**2
            + (column * self.u_slope_mm_per_px) ** 2
            + 2.0 * column * self.correlation * self.u_intercept_mm * self.u_slope_mm_per_px
        )
        return 1000.0 * np.sqrt(np.maximum(variance, 0.0))

    def u_height_difference_um(self, difference_um: ArrayLike) -> NDArray[np.float64]:
        """Standard uncertainty in um of a height difference from the slope alone: |dh| u(S)/S.

        A depth is a difference, so the intercept drops out and the slope does not.
        """
        return np.abs(np.asarray(difference_um, dtype=np.float64)) * self.u_slope_relative

    def inside_range(self, column_px: ArrayLike) -> NDArray[np.bool_]:
        """True where a column lies between the gauge's lowest and highest one. NaN is not inside."""
        low, high = self.range_px
        column = np.asarray(column_px, dtype=np.float64)
        return np.asarray((column >= low) & (column <= high), dtype=np.bool_)

    def to_json(self) -> dict[str, Any]:
        """All of it as plain JSON values, derived figures included."""
        return {
            "format": FORMAT,
            "model": "straight line, height on pixel",
            "pairs": self.pairs,
            **{name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()},
            "covariance": self.covariance.tolist(),
            "u_slope_percent": 100.0 * self.u_slope_relative,
            "calibrated_range_px": list(self.range_px),
            "calibrated_range_mm": list(self.range_mm),
        }

    @staticmethod
    def from_json(stored: object, where: str = "the calibration") -> Calibration:
        """Read back what ``to_json`` gave. The line is fitted again from the pairs, so a file cannot disagree with
        itself: a stored slope that differs from the pairs' is refused."""
        if not isinstance(stored, dict) or stored.get("format") != FORMAT:
            raise BadInput(f'{where} is no calibration: its "format" must be "{FORMAT}"; make one by calibrate')
        try:
            heights = [float(value) for value in stored["heights_mm"]]
            columns = [float(value) for value in stored["columns_px"]]
            slope = float(stored["slope_mm_per_px"])
            u_scale = float(stored.get("u_scale_relative", 0.0))
        except (KeyError, TypeError, ValueError) as error:
            raise BadInput(f"{where} lacks or garbles {error}; write it again with calibrate") from error
        calibration = calibrate(
            heights,
            columns,
            gauge=str(stored.get("gauge") or ""),
            measured_on=_text_or_none(stored.get("measured_on")),
            expires_on=_text_or_none(stored.get("expires_on")),
            u_scale_relative=u_scale,
            where=where,
        )
        if not math.isclose(calibration.slope_mm_per_px, slope, rel_tol=1e-9):
            raise BadInput(
                f"{where} says slope {slope:.9g} mm/px but its pairs give {calibration.slope_mm_per_px:.9g}; "
                "it was edited by hand, so calibrate again from the pairs"
            )
        return calibration

    def sha256(self) -> str:
        """Identity of the calibration: the hash of what it was made from, not of figures that a CPU may round."""
        origin: list[Any] = [FORMAT, self.heights_mm, self.columns_px, self.gauge, self.measured_on, self.expires_on]
        origin += [self.u_scale_relative] if self.u_scale_relative else []
        told = json.dumps(origin, separators=(",", ":"), allow_nan=False)
        return hashlib.sha256(told.encode()).hexdigest()


def calibrate(
    heights_mm: Sequence[float],
    columns_px: Sequence[float],
    *,
    gauge: str = "",
    measured_on: str | None = None,
    expires_on: str | None = None,
    u_scale_relative: float = 0.0,
    where: str = "the gauge pairs",
) -> Calibration:
    """Fit height on pixel through gauge pairs. ``where`` names their origin in the sentence of a `BadInput`.

    Refused: fewer than three pairs, values that are not finite, fewer than three different columns or heights, dates
    that are no ISO dates (2026-11-24) or an expiry before the measurement.
    """
    if not (math.isfinite(u_scale_relative) and u_scale_relative >= 0.0):
        raise BadInput(f"{where}: u_scale_relative is {u_scale_relative}, not a number from 0 upwards; calibrate again")
    measured, expires = _day(measured_on, "measured_on", where), _day(expires_on, "expires_on", where)
    if measured is not None and expires is not None and expires < measured:
        raise BadInput(
            f"{where}: it would expire on {expires}, before it was measured on {measured}; correct the dates"
        )
    if len(heights_mm) != len(columns_px):
        raise BadInput(f"{where}: {len(heights_mm)} heights but {len(columns_px)} columns; give one column per height")
    if len(heights_mm) < FEWEST_PAIRS:
        raise BadInput(
            f"{where}: {len(heights_mm)} pairs are too few for a line with an uncertainty; measure at least three steps"
        )
    for number, (height, column) in enumerate(zip(heights_mm, columns_px, strict=True), start=1):
        for name, value in ((HEIGHT, height), (COLUMN, column)):
            if not math.isfinite(value):
                raise BadInput(f"{where}: {name} of pair {number} is {value}, not a finite number; measure it again")
    for name, values in ((COLUMN, columns_px), (HEIGHT, heights_mm)):
        different = len(set(values))
        if different < FEWEST_PAIRS:
            raise BadInput(
                f"{where}: only {different} different {name} in {len(values)} pairs; "
                "a line needs at least three different steps"
            )
    with np.errstate(all="ignore"):
        fit = fit_line(columns_px, heights_mm)
        residuals_um = 1000.0 * fit.residuals
        left_out_um = 1000.0 * fit.leave_one_out
    if fit.slope == 0.0 or not (math.isfinite(fit.slope) and math.isfinite(fit.u_slope)):
        raise BadInput(f"{where}: no line fits (slope {fit.slope} mm/px); check that heights are in mm, columns in px")
    if not np.isfinite(left_out_um).all():
        alone = int(np.flatnonzero(~np.isfinite(left_out_um))[0]) + 1
        raise BadInput(f"{where}: pair {alone} lies so far from all others that it alone makes the line; check it")
    if abs(fit.slope) > STEEPEST_MM_PER_PX:
        raise BadInput(
            f"{where}: the slope is {fit.slope:.4g} mm per px, which no laser line scanner has; "
            "write heights in mm, not um"
        )
    return Calibration(
        heights_mm=tuple(float(value) for value in heights_mm),
        columns_px=tuple(float(value) for value in columns_px),
        slope_mm_per_px=fit.slope,
        intercept_mm=fit.intercept,
        u_slope_mm_per_px=fit.u_slope,
        u_intercept_mm=fit.u_intercept,
        correlation=fit.correlation,
        residual_sd_um=1000.0 * fit.residual_sd,
        max_residual_um=float(np.abs(residuals_um).max()),
        leave_one_out_um=float(np.abs(left_out_um).max()),
        r_squared=fit.r_squared,
        residuals_um=tuple(float(value) for value in residuals_um),
        leave_one_out_each_um=tuple(float(value) for value in left_out_um),
        gauge=gauge,
        measured_on=measured_on,
        expires_on=expires_on,
        u_scale_relative=u_scale_relative,
    )


def _text_or_none(stored: object) -> str | None:
    return None if stored is None else str(stored)


def _day(written: str | None, what: str, where: str) -> dt.date | None:
    if written is None:
        return None
    try:
        return dt.date.fromisoformat(written)
    except ValueError:
        raise BadInput(f'{where}: {what} is "{written}", not a date; write it as 2026-11-24') from None


def read_pairs(text: str, where: str = "the gauge pairs") -> tuple[list[float], list[float]]:
    """Heights in mm and columns in px from CSV text with the columns ``height_mm`` and ``column_px``.

    Comma, semicolon or tab between the cells; with semicolon or tab a decimal comma is understood, as European
    spreadsheets write it. Blank lines and further columns are passed over. ``where`` names the file in a `BadInput`.
    """
    lines = text.lstrip("\ufeff").splitlines()
    numbered = [(number, line) for number, line in enumerate(lines, start=1) if line.strip().strip(",;\t")]
    if numbered and numbered[0][1].strip().lower().startswith("sep="):
        numbered = numbered[1:]
    if not numbered:
        raise BadInput(f"{where} is empty; it must have the columns {HEIGHT},{COLUMN} and at least three rows")
    separator = next((sign for sign in (";", "\t") if sign in numbered[0][1]), ",")

    def cells(line: str) -> list[str]:
        return [cell.strip() for cell in next(csv.reader(io.StringIO(line), delimiter=separator))]

    titles = [title.lower() for title in cells(numbered[0][1])]
    places: dict[str, int] = {}
    for name in (HEIGHT, COLUMN):
        if titles.count(name) != 1:
            fault = "has no" if name not in titles else "has more than one"
            raise BadInput(
                f"{where}, line {numbered[0][0]}: {fault} column {name} (found: {', '.join(titles)}); "
                f"the first line must name {HEIGHT} and {COLUMN}"
            )
        places[name] = titles.index(name)
    values: dict[str, list[float]] = {HEIGHT: [], COLUMN: []}
    for number, line in numbered[1:]:
        row = cells(line)
        for name, place in places.items():
            written = row[place] if place < len(row) else ""
            values[name].append(_number(written, separator != ",", f"{where}, line {number}: {name}"))
    return values[HEIGHT], values[COLUMN]


def _number(written: str, decimal_comma: bool, what: str) -> float:
    plain = written.replace(",", ".") if decimal_comma and "." not in written else written
    try:
        value = float(plain if "_" not in plain else "")
    except ValueError:
        said = f'"{written}"' if written else "missing"
        raise BadInput(f"{what} is {said}, not a number; correct the cell or delete the line") from None
    if not math.isfinite(value):
        raise BadInput(f'{what} is "{written}", not a finite number; measure this step again or delete the line')
    return value


def standing(expires_on: dt.date, on: dt.date) -> tuple[State, str]:
    """Whether a calibration that expires on one day holds on another, and the sentence. The last day still counts."""
    left = (expires_on - on).days
    days = f"{abs(left)} day" if abs(left) == 1 else f"{abs(left)} days"
    if left < 0:
        return "expired", f"The calibration expired on {expires_on}, {days} ago; calibrate again."
    if left <= DUE_DAYS:
        return "due", f"The calibration expires on {expires_on}, in {days}."
    return "valid", f"The calibration is valid until {expires_on}."


def read_calibration(path: Path) -> Calibration:
    """A calibration from a file: a CSV of gauge pairs, or the JSON that ``calibrate --json`` printed."""
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise BadInput(f"{path} cannot be read ({error.strerror}); check the path") from error
    except UnicodeDecodeError:
        raise BadInput(f"{path} is not text; give a CSV with columns {HEIGHT},{COLUMN} or a calibration JSON") from None
    if text.lstrip().startswith("{"):
        try:
            stored = json.loads(text)
        except json.JSONDecodeError as error:
            raise BadInput(f"{path} is not valid JSON (line {error.lineno}: {error.msg}); write it again") from None
        return Calibration.from_json(stored, str(path))
    heights, columns = read_pairs(text, str(path))
    return calibrate(heights, columns, where=str(path))
