"""How much light each spot of the part sends to the camera: over decades, as on real steel.

A uniformly bright tool never needs more than one exposure, so it would hide what high dynamic range imaging is for.
Here grinding marks, stains of dark oxide and bright facets share one surface. All of it varies over distances longer
than the laser line is wide: reflectivity within the line would move its centroid, which is a different error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from scanning.rig.simulated.randomness import SmoothNoise

Float64 = NDArray[np.float64]


class Reflectivity(Protocol):
    """Share of light returned, relative to plain ground steel (1)."""

    def __call__(self, s_um: Float64, y_um: Float64) -> Float64: ...


@dataclass(frozen=True)
class Uniform:
    value: float = 1.0

    def __call__(self, s_um: Float64, y_um: Float64) -> Float64:
        return np.full(np.broadcast(s_um, y_um).shape, self.value)


@dataclass(frozen=True)
class Treads:
    """One value per tread of a step gauge: feeler gauges are never equally bright."""

    values: tuple[float, ...]
    tread_um: float

    def __call__(self, s_um: Float64, y_um: Float64) -> Float64:
        index = np.clip(np.floor(np.asarray(y_um) / self.tread_um), 0, len(self.values) - 1).astype(np.int64)
        return np.broadcast_to(np.asarray(self.values)[index], np.broadcast(s_um, y_um).shape).copy()


@dataclass(frozen=True)
class GroundSteel:
    """Ground steel in service.

    ``decades`` scales everything: 0 is uniform, 1 the default in which stains reach 1/20 and facets 6 times the plain
    surface. ``lay_deg`` is the direction of the grinding marks to the edge.
    """

    seed: int
    decades: float = 1.0
    lay_deg: float = 78.0
    _marks: SmoothNoise = field(init=False, repr=False, compare=False)
    _patches: SmoothNoise = field(init=False, repr=False, compare=False)
    _stains: SmoothNoise = field(init=False, repr=False, compare=False)
    _facets: SmoothNoise = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_marks", SmoothNoise((self.seed, 21), 90.0, 1500.0))
        object.__setattr__(self, "_patches", SmoothNoise((self.seed, 22), 700.0))
        object.__setattr__(self, "_stains", SmoothNoise((self.seed, 23), 420.0))
        object.__setattr__(self, "_facets", SmoothNoise((self.seed, 24), 110.0, 260.0))

    def __call__(self, s_um: Float64, y_um: Float64) -> Float64:
        s, y = np.broadcast_arrays(np.asarray(s_um, dtype=np.float64), np.asarray(y_um, dtype=np.float64))
        lay = math.radians(self.lay_deg)
        across = s * math.sin(lay) - y * math.cos(lay)
        along = s * math.cos(lay) + y * math.sin(lay)
        log10 = 0.10 * self._marks(across, along) + 0.18 * self._patches(s, y)
        # A logistic step turns the smooth field into patches with soft rims.
        log10 -= 1.2 / (1.0 + np.exp(-12.0 * (self._stains(s, y) - 1.35)))
        log10 += 0.8 / (1.0 + np.exp(-10.0 * (self._facets(across, along) - 2.0)))
        return np.asarray(10.0 ** (self.decades * log10))
