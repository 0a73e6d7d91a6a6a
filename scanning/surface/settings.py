"""What an inspection of a surface may be told: judgements with a name, a unit and a reason.

They travel with every result, so that a number from last year can be computed again with last year's judgement.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Literal

from scanning.errors import BadInput

EdgeSide = Literal["auto", "first", "last", "none"]


@dataclass(frozen=True)
class Severity:
    """A class of damage: it applies while both the length along the edge and the depth stay below its bounds."""

    name: str
    length_mm: float
    depth_um: float


#: Our proposal, to be agreed with the plant; the paper names the classes without sizes. Beyond the last: large.
SEVERITIES = (Severity("minor", 0.2, 50.0), Severity("medium", 1.0, 150.0))


@dataclass(frozen=True)
class InspectionSettings:
    """Judgements behind the surface numbers. Lengths in um unless the name says otherwise.

    ``edge_axis``: 1 when the edge runs along the scan (profiles), 0 when it runs along the laser line (rows).
    ``edge_side``: at which end of the rows the edge is; "auto" looks for the side where the surface ends.
    ``form``: "plane", or "quadratic" only for a bevel known to be hollow ground: a bowl also swallows broad wear.
    ``small_scale_um``, ``wide_scale_um``: Gaussian standard deviations of the two detection images; the first also
    defines the smoothed depth. ``seed_k``, ``grow_k``: hysteresis thresholds in standard deviations.
    ``least_depth_um``: nothing shallower is called damage, however quiet the image.
    ``start_mm``: position of the first profile along the edge, from the tool's datum.
    ``u_scale_relative``, ``u_pitch_relative``: relative standard uncertainty of the height scale and of the pitches
    when known from elsewhere; None means not known, and every affected number says so.
    ``u_linearity_um``: what a straight calibration line leaves out inside its range (0.6 um on IS1).
    ``blur_um``: standard deviation of a height's lateral blur; a line of 25 um full width at half maximum has 10.6.
    ``instrument_noise_um``: Sq of the instrument's own noise on the scale-limited surface, from a displaced repeat.
    ``visible_aspect``: gaps narrower than this times their depth cannot be seen by the camera (0.58 at 60 degrees) and
    are reflections; 0 for surfaces measured from straight above.
    ``saturation_level``: pixels whose peak intensity reaches it are not used; None uses all.
    """

    edge_axis: Literal[0, 1] = 1
    edge_side: EdgeSide = "auto"
    form: Literal["plane", "quadratic"] = "plane"
    small_scale_um: float = 15.0
    wide_scale_um: float = 30.0
    seed_k: float = 5.0
    grow_k: float = 3.0
    min_area_um2: float = 2500.0
    min_pixels: int = 6
    join_um: float = 50.0
    least_depth_um: float = 0.5
    severities: tuple[Severity, ...] = SEVERITIES
    start_mm: float = 0.0
    u_scale_relative: float | None = None
    u_pitch_relative: float | None = None
    u_linearity_um: float = 0.6
    blur_um: float = 10.6
    instrument_noise_um: float | None = None
    saturation_level: float | None = None
    visible_aspect: float = 0.5
    s_filter_um: float | None = None
    l_filter_um: float | None = None

    def __post_init__(self) -> None:
        if self.edge_axis not in (0, 1):
            raise BadInput(f"edge_axis is {self.edge_axis!r}; use 1 (edge along the scan) or 0 (along the laser line).")
        if self.edge_side not in ("auto", "first", "last", "none"):
            raise BadInput(f"edge_side is {self.edge_side!r}; use auto, first, last or none.")
        if self.form not in ("plane", "quadratic"):
            raise BadInput(f"form is {self.form!r}; use plane or quadratic.")
        for name in ("small_scale_um", "wide_scale_um", "seed_k", "grow_k", "min_area_um2"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise BadInput(f"{name} is {value!r}; give a positive number.")
        if self.grow_k > self.seed_k:
            raise BadInput(
                f"grow_k {self.grow_k} is above seed_k {self.seed_k}; a damage could not grow from its seed."
            )

    def severity(self, length_mm: float, depth_um: float) -> str:
        """Return the first class whose bounds hold, "large" beyond them all."""
        for bound in self.severities:
            if length_mm < bound.length_mm and depth_um < bound.depth_um:
                return bound.name
        return "large"

    def to_json(self) -> dict[str, Any]:
        return asdict(self)
