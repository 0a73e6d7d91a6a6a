"""The shape of the parts that lie on the simulated rig: a knife's bevel with damage and wear, a plate, a step gauge.

Damage has to have a known volume, and it has to look like damage: a chip that touches the edge takes the edge with
it. Both follow from one picture. The knife is a wedge of 55 degrees seen from above its bevel; at the distance y from
the edge it is t(y) = y tan 55 thick. A damage removes the material down to the depth d(s, y), an elliptic paraboloid;
where d exceeds t nothing is left and the edge has receded.

Coordinates of the part: s along the edge (and along the scan), y from the as-new edge into the bevel, depths positive
into the material, everything in micrometres. The bevel is z = 0; where no material is left the height is NaN.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from scanning.errors import BadInput
from scanning.rig.simulated.randomness import SmoothNoise

Float64 = NDArray[np.float64]

WEDGE_DEG = 55.0
_STEEPEST = 1.6
"""Steepest slope along the scan that a camera 60 degrees above the surface still sees without hidden parts (tan 58)."""


@dataclass(frozen=True)
class Damage:
    """One chip (on the edge) or dent (inside the bevel): an elliptic paraboloid.

    ``length_um`` along the edge and ``reach_um`` across it (semi-axis; from the edge for a chip) are the extent at the
    surface, ``depth_um`` the depth in its middle. ``reflectivity`` multiplies the bevel's: a fresh fracture scatters
    more than a ground face, a dirty dent less.
    """

    kind: Literal["chip", "dent"]
    s_um: float
    length_um: float
    reach_um: float
    depth_um: float
    y_um: float = 0.0
    reflectivity: float = 1.0

    def __post_init__(self) -> None:
        if min(self.length_um, self.reach_um, self.depth_um, self.reflectivity) <= 0:
            raise BadInput("A damage needs a positive length, reach, depth and reflectivity.")
        if self.kind == "chip" and self.y_um != 0.0:
            raise BadInput("A chip lies on the edge, so its y_um is 0; use kind 'dent' inside the bevel.")
        if self.kind == "dent" and self.y_um < self.reach_um:
            raise BadInput(f"The dent at s = {self.s_um:g} um reaches over the edge; use kind 'chip' or a larger y_um.")
        if 4.0 * self.depth_um / self.length_um > _STEEPEST:
            raise BadInput(
                f"The damage at s = {self.s_um:g} um is steeper than the camera can see into; "
                f"make it longer than {4.0 * self.depth_um / _STEEPEST:.0f} um or shallower."
            )

    def depth_at(self, s_um: Float64, y_um: Float64) -> Float64:
        """Return the depth below the as-new bevel (0 outside), ignoring that the wedge may be thinner than that."""
        inside = 1.0 - ((s_um - self.s_um) / (0.5 * self.length_um)) ** 2 - ((y_um - self.y_um) / self.reach_um) ** 2
        return np.asarray(self.depth_um * np.maximum(inside, 0.0))


@dataclass(frozen=True)
class DamageTruth:
    """What there is to measure of one damage, from closed forms in y and a fine midpoint sum in s.

    ``volume_mm3`` is the missing material above the surface that is left, the part a camera above the bevel can see;
    ``volume_removed_mm3`` adds the tip of the wedge that is gone. ``depth_um`` is the greatest visible depth and
    ``recession_um`` how far the edge has moved back at worst.
    """

    volume_mm3: float
    volume_removed_mm3: float
    depth_um: float
    recession_um: float


def measure_damage(damage: Damage, worn_to_um: Float64 | float = 0.0, samples: int = 4001) -> DamageTruth:
    """Return the true numbers of ``damage`` on a 55 degree wedge whose edge is already worn back to ``worn_to_um``.

    ``worn_to_um`` is a number or one value per sample of s (midpoints of ``samples`` equal parts of the length).
    Relative error of the volumes below 1e-6 at the default number of samples.
    """
    x = (np.arange(samples) + 0.5) / samples * 2.0 - 1.0
    ds = damage.length_um / samples
    top = damage.depth_um * (1.0 - x**2)
    curve = damage.depth_um / damage.reach_um**2
    tau = math.tan(math.radians(WEDGE_DEG))
    extent = damage.reach_um * np.sqrt(1.0 - x**2)
    upper = damage.y_um + extent
    lower = damage.y_um - extent
    if damage.kind == "chip":
        # t(y) = d(y): curve y^2 + tau y - top = 0
        cut = (-tau + np.sqrt(tau**2 + 4.0 * curve * top)) / (2.0 * curve)
        lower = cut
    else:
        if damage.depth_um >= tau * (damage.y_um - damage.reach_um) and np.any(
            damage.depth_at(np.asarray(damage.s_um), np.linspace(0, damage.y_um, 2001))
            > tau * np.linspace(0, damage.y_um, 2001)
        ):
            raise BadInput(f"The dent at s = {damage.s_um:g} um breaks through the back of the wedge; move it inwards.")
        cut = np.zeros_like(x)
    worn = np.broadcast_to(np.asarray(worn_to_um, dtype=np.float64), x.shape)
    low = np.minimum(np.maximum(lower, worn), upper)

    def integral(y: Float64) -> Float64:
        return np.asarray(top * y - curve * (y - damage.y_um) ** 3 / 3.0)

    seen = integral(upper) - integral(low)
    tip = 0.5 * tau * cut**2 if damage.kind == "chip" else np.zeros_like(x)
    removed = integral(upper) - integral(lower) + tip
    deepest_y = np.maximum(low, damage.y_um) if damage.kind == "dent" else low
    depth = np.where(low < upper, top - curve * (deepest_y - damage.y_um) ** 2, 0.0)
    return DamageTruth(
        volume_mm3=float(seen.sum() * ds * 1e-9),
        volume_removed_mm3=float(removed.sum() * ds * 1e-9),
        depth_um=float(depth.max()),
        recession_um=float(np.maximum(cut, worn).max()),
    )


class Shape(Protocol):
    """A part's surface in its own coordinates."""

    def height_um(self, s_um: Float64, y_um: Float64) -> Float64:
        """Return the height over the as-new surface, NaN where there is no material; inputs broadcast."""
        ...

    def nominal_um(self, s_um: Float64, y_um: Float64) -> Float64:
        """Return the as-new height without damage, wear and texture."""
        ...

    def damage_number(self, s_um: Float64, y_um: Float64) -> NDArray[np.int16]:
        """Return 0 on sound material, i + 1 inside the i-th damage."""
        ...


@dataclass(frozen=True)
class Bevel:
    """A ground bevel that ends in a sharp edge at y = 0.

    ``wear_um`` is the mean recession of the edge; it varies by some 12 % along the edge, and the bevel rolls off
    towards the worn edge over twice the recession. ``texture_um`` is the Sq of the grinding marks (a ground bevel:
    < 1 um), which run at ``lay_deg`` to the edge.
    """

    seed: int
    damages: tuple[Damage, ...] = ()
    wear_um: float = 0.0
    texture_um: float = 0.35
    lay_deg: float = 78.0
    _texture: SmoothNoise = field(init=False, repr=False, compare=False)
    _wear: SmoothNoise = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not 0.0 <= self.wear_um <= 2000.0:
            raise BadInput(f"wear_um must lie between 0 and 2000 um, not {self.wear_um:g}.")
        object.__setattr__(self, "_texture", SmoothNoise((self.seed, 11), 25.0, 900.0))
        object.__setattr__(self, "_wear", SmoothNoise((self.seed, 12), 220.0))

    def recession_um(self, s_um: Float64) -> Float64:
        """Return how far wear alone has moved the edge back at s."""
        if self.wear_um == 0.0:
            return np.zeros_like(np.asarray(s_um, dtype=np.float64))
        return self.wear_um * np.clip(1.0 + 0.12 * self._wear(s_um, np.zeros_like(s_um)), 0.3, 1.7)

    def depth_um(self, s_um: Float64, y_um: Float64) -> Float64:
        """Return the depth of damage and wear together, without texture."""
        s, y = np.broadcast_arrays(np.asarray(s_um, dtype=np.float64), np.asarray(y_um, dtype=np.float64))
        depth = np.zeros(s.shape)
        for damage in self.damages:
            np.maximum(depth, damage.depth_at(s, y), out=depth)
        if self.wear_um > 0.0:
            recession = self.recession_um(np.asarray(s_um, dtype=np.float64))
            beyond = np.clip((y - recession) / (2.0 * recession), 0.0, 1.0)
            np.maximum(depth, 0.25 * recession * (1.0 - beyond) ** 2, out=depth)
        return depth

    def height_um(self, s_um: Float64, y_um: Float64) -> Float64:
        s, y = np.broadcast_arrays(np.asarray(s_um, dtype=np.float64), np.asarray(y_um, dtype=np.float64))
        depth = self.depth_um(s_um, y_um)
        lay = math.radians(self.lay_deg)
        texture = self.texture_um * self._texture(
            s * math.sin(lay) - y * math.cos(lay), s * math.cos(lay) + y * math.sin(lay)
        )
        gone = (y < self.recession_um(np.asarray(s_um, dtype=np.float64))) | (
            depth > y * math.tan(math.radians(WEDGE_DEG))
        )
        return np.where(gone, np.nan, texture - depth)

    def nominal_um(self, s_um: Float64, y_um: Float64) -> Float64:
        return np.zeros(np.broadcast(s_um, y_um).shape)

    def damage_number(self, s_um: Float64, y_um: Float64) -> NDArray[np.int16]:
        number = np.zeros(np.broadcast(s_um, y_um).shape, dtype=np.int16)
        for i, damage in enumerate(self.damages):
            number[damage.depth_at(s_um, y_um) > 0.0] = i + 1
        return number


@dataclass(frozen=True)
class Plate:
    """A flat plate without an edge; ``texture_um`` is its Sq."""

    seed: int
    texture_um: float = 0.0
    _texture: SmoothNoise = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_texture", SmoothNoise((self.seed, 11), 25.0, 900.0))

    def height_um(self, s_um: Float64, y_um: Float64) -> Float64:
        if self.texture_um == 0.0:
            return self.nominal_um(s_um, y_um)
        return self.texture_um * self._texture(np.asarray(s_um), np.asarray(y_um))

    def nominal_um(self, s_um: Float64, y_um: Float64) -> Float64:
        return np.zeros(np.broadcast(s_um, y_um).shape)

    def damage_number(self, s_um: Float64, y_um: Float64) -> NDArray[np.int16]:
        return np.zeros(np.broadcast(s_um, y_um).shape, dtype=np.int16)


@dataclass(frozen=True)
class Staircase:
    """A step gauge of feeler gauges: treads of ``tread_um`` along the laser line, each one height, walls upright.

    ``heights_um`` are counted from the rig's datum, in the order of y; the last tread goes on for ever.
    """

    heights_um: tuple[float, ...]
    tread_um: float

    def tread(self, y_um: Float64) -> NDArray[np.int64]:
        return np.clip(np.floor(np.asarray(y_um) / self.tread_um), 0, len(self.heights_um) - 1).astype(np.int64)

    def height_um(self, s_um: Float64, y_um: Float64) -> Float64:
        heights = np.asarray(self.heights_um)[self.tread(y_um)]
        return np.broadcast_to(heights, np.broadcast(s_um, y_um).shape).copy()

    def nominal_um(self, s_um: Float64, y_um: Float64) -> Float64:
        return self.height_um(s_um, y_um)

    def damage_number(self, s_um: Float64, y_um: Float64) -> NDArray[np.int16]:
        return np.zeros(np.broadcast(s_um, y_um).shape, dtype=np.int16)
