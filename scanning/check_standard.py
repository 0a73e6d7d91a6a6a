"""One known step, measured again and again: does the calibration still hold?

A calibration says how well the line fitted on the day of the gauge. Whether the lens has been knocked since is for a
check standard to say: the same step, scanned before each shift. Each check gives a bias with its uncertainty; all of
them together, on a chart of individuals with moving ranges and an EWMA, say whether the rig drifts. A drift much
smaller than the uncertainty of one check shows on the chart long before it shows in a bias.

The limits come from the first checks after a calibration (`FEWEST` to `BASELINE`) and then stand: limits that learn
from drifting values drift along. A new calibration or another standard starts a new chart.

Source: NIST/SEMATECH e-Handbook 2.3.5, 6.3.2.2, 6.3.2.4; GUM 5.1.2.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from scanning.calibration import Calibration
from scanning.control_charts import D2, ewma, individuals
from scanning.errors import BadInput
from scanning.gauge import Gauge, match_heights
from scanning.whole_file import whole_file

FEWEST = 8
BASELINE = 20
COVERAGE = 2.0


@dataclass(frozen=True)
class Check:
    """One check. Lengths in um; ``u_bias_um`` combines the treads, the calibration's slope and the standard itself."""

    taken_on: str
    stack: str
    calibration: str
    reference_um: float
    measured_um: float
    bias_um: float
    u_bias_um: float
    u_treads_um: float
    u_slope_um: float
    u_reference_um: float

    @property
    def holds(self) -> bool:
        """Whether the bias is within its expanded uncertainty (k = 2)."""
        return abs(self.bias_um) <= COVERAGE * self.u_bias_um


@dataclass(frozen=True)
class Drift:
    """Where the newest check stands on its chart. None and "too few" until `FEWEST` earlier checks are there.

    ``drift_um`` is the EWMA's distance from the mean of the baseline, ``drift_limit_um`` what chance allows it.
    """

    earlier: int
    baseline: int
    state: str
    sentence: str
    mean_um: float | None = None
    lower_um: float | None = None
    upper_um: float | None = None
    range_limit_um: float | None = None
    drift_um: float | None = None
    drift_limit_um: float | None = None


def measure_step(
    gauge: Gauge,
    heights_mm: Sequence[float],
    calibration: Calibration,
    *,
    u_reference_um: float = 0.0,
    taken_on: str,
    stack: str,
) -> Check:
    """The step between the lowest and the highest tread, as calibrated, against its certified height."""
    if not (math.isfinite(u_reference_um) and u_reference_um >= 0):
        raise BadInput(f"the uncertainty of the standard is {u_reference_um} um; it must be a number from 0 upwards")
    heights = match_heights(gauge, heights_mm)
    low, high = heights.index(min(heights)), heights.index(max(heights))
    below, above = gauge.treads[low], gauge.treads[high]
    reference = 1000.0 * (heights[high] - heights[low])
    measured = float(calibration.height_um(above.column_px) - calibration.height_um(below.column_px))
    askew_px = 0.0
    if gauge.levelled and math.isfinite(gauge.u_askew_px):
        askew_px = gauge.u_askew_px * (above.middle - below.middle)
    u_treads = abs(1000.0 * calibration.slope_mm_per_px) * math.sqrt(
        below.u_column_px**2 + above.u_column_px**2 + askew_px**2
    )
    if not math.isfinite(u_treads):
        raise BadInput("a tread of the check standard is too small to say how sure its height is; scan more of it")
    u_slope = float(calibration.u_height_difference_um(measured))
    return Check(
        taken_on=taken_on,
        stack=stack,
        calibration=calibration.sha256()[:16],
        reference_um=reference,
        measured_um=measured,
        bias_um=measured - reference,
        u_bias_um=math.sqrt(u_treads**2 + u_slope**2 + u_reference_um**2),
        u_treads_um=u_treads,
        u_slope_um=u_slope,
        u_reference_um=u_reference_um,
    )


def drift_of(check: Check, history: Sequence[Check]) -> Drift:
    """Judge ``check`` against the earlier ones of the same standard under the same calibration, in order of time."""
    earlier = [one for one in history if _same(one, check)]
    if len(earlier) < FEWEST:
        need = FEWEST - len(earlier)
        return Drift(
            len(earlier), 0, "too few",
            f"{len(earlier)} earlier checks of this step under this calibration; limits need {FEWEST}, {need} more.",
        )  # fmt: skip
    biases = [one.bias_um for one in earlier]
    baseline = biases[:BASELINE]
    chart = individuals(baseline)
    assert chart is not None
    sigma = chart.mean_range / D2
    smooth = ewma([*biases, check.bias_um], target=chart.mean, sigma=sigma)
    drift, limit = smooth.values[-1] - chart.mean, smooth.upper - chart.mean
    faults = []
    if not chart.lower <= check.bias_um <= chart.upper:
        faults.append(f"this check lies outside {chart.lower:.2f} to {chart.upper:.2f} um")
    if abs(check.bias_um - biases[-1]) > chart.range_upper:
        faults.append(f"it jumped by more than {chart.range_upper:.2f} um since the last one")
    if abs(drift) > limit:
        faults.append(f"the average has drifted by {drift:+.2f} um where chance allows {limit:.2f} um")
    sentence = "The rig measures this step as it did at first."
    if faults:
        sentence = f"Do not release measurements: {', and '.join(faults)}; look for the cause and calibrate again."
    return Drift(
        earlier=len(earlier),
        baseline=len(baseline),
        state="out of control" if faults else "in control",
        sentence=sentence,
        mean_um=chart.mean,
        lower_um=chart.lower,
        upper_um=chart.upper,
        range_limit_um=chart.range_upper,
        drift_um=drift,
        drift_limit_um=limit,
    )


def to_json(check: Check, drift: Drift) -> dict[str, Any]:
    return {**asdict(check), "holds": check.holds, "drift": asdict(drift)}


def _same(one: Check, other: Check) -> bool:
    near = math.isclose(one.reference_um, other.reference_um, rel_tol=1e-9, abs_tol=1e-6)
    return one.calibration == other.calibration and near


# -- the history file -------------------------------------------------------------------------------------------------

_TEXTS = ("taken_on", "stack", "calibration")
_TITLES = tuple(one.name for one in fields(Check))


def read_history(path: Path) -> list[Check]:
    """The checks in a CSV file, oldest first; none when there is no such file yet."""
    if not path.exists():
        return []
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise BadInput(f"{path} cannot be read ({error.strerror}); check the path") from error
    except UnicodeDecodeError:
        raise BadInput(f"{path} is not text; give the CSV file that earlier checks wrote") from None
    rows = csv.DictReader(io.StringIO(text))
    if tuple(rows.fieldnames or ()) != _TITLES:
        raise BadInput(f"{path} is no history of checks; its first line must be {','.join(_TITLES)}")
    checks = []
    for row in rows:
        values: dict[str, Any] = {name: row[name] for name in _TEXTS}
        for name in _TITLES[len(_TEXTS) :]:
            try:
                values[name] = float(row[name])
            except (TypeError, ValueError):
                values[name] = math.nan
            if not math.isfinite(values[name]):
                raise BadInput(f"{path}, line {rows.line_num}: {name} is no number; correct or delete the line")
        checks.append(Check(**values))
    return checks


def write_history(path: Path, checks: Sequence[Check]) -> None:
    """Write all checks, oldest first; the file appears whole or not at all."""
    with whole_file(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(_TITLES)
        for check in checks:
            writer.writerow([getattr(check, name) for name in _TITLES])
