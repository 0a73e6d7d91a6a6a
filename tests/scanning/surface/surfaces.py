"""Surfaces whose truth is known in closed form, under noise correlated as speckle is.

The pits' volumes are integrals, not sums over the pixels that are later measured, so a test cannot agree with itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanning.range_image import RangeImage

#: Correlations of the COG error from the coherent Monte Carlo (measuring.md 5.1): along rows, along steps.
ROWS = (1.0, 0.43, 0.07)
STEPS = (1.0, 0.64, 0.03, -0.28)
WHITE = (1.0,)


@dataclass(frozen=True)
class Pit:
    """Centre in um from the first pixel's centre, diameter and depth in um; a box is square with that side."""

    kind: str
    row_um: float
    profile_um: float
    size_um: float
    depth_um: float

    @property
    def volume_mm3(self) -> float:
        radius = self.size_um / 2.0
        if self.kind == "cone":
            return math.pi * radius**2 * self.depth_um / 3.0 * 1e-9
        if self.kind == "cap":
            return math.pi * self.depth_um * (3.0 * radius**2 + self.depth_um**2) / 6.0 * 1e-9
        return self.size_um**2 * self.depth_um * 1e-9

    def depth_at(self, row_um: NDArray[np.float64], profile_um: NDArray[np.float64]) -> NDArray[np.float64]:
        dr, dp = row_um - self.row_um, profile_um - self.profile_um
        radius = self.size_um / 2.0
        distance = np.hypot(dr, dp)
        if self.kind == "cone":
            return self.depth_um * np.clip(1.0 - distance / radius, 0.0, None)
        if self.kind == "cap":
            sphere = (radius**2 + self.depth_um**2) / (2.0 * self.depth_um)
            inside = np.sqrt(np.clip(sphere**2 - distance**2, 0.0, None)) - (sphere - self.depth_um)
            return np.where(distance < radius, np.clip(inside, 0.0, None), 0.0)
        return np.where((np.abs(dr) <= radius) & (np.abs(dp) <= radius), self.depth_um, 0.0)


def correlated_noise(
    shape: tuple[int, int],
    sigma_um: float,
    rng: np.random.Generator,
    *,
    rows: tuple[float, ...] = ROWS,
    profiles: tuple[float, ...] = WHITE,
    sliding: int = 1,
) -> NDArray[np.float64]:
    """Gaussian noise with the given lag correlations; ``sliding`` averages that many profiles, then rescales."""
    padded = (shape[0] + 32, shape[1] + 32 + sliding)

    def spectrum(length: int, rho: tuple[float, ...]) -> NDArray[np.float64]:
        line = np.zeros(length)
        line[: len(rho)] = rho
        for lag in range(1, len(rho)):
            line[-lag] = rho[lag]
        return np.sqrt(np.clip(np.fft.fft(line).real, 0.0, None))

    white = np.fft.fft2(rng.standard_normal(padded))
    noise = np.fft.ifft2(white * spectrum(padded[0], rows)[:, None] * spectrum(padded[1], profiles)[None, :]).real
    if sliding > 1:
        total = np.cumsum(noise, axis=1)
        noise = (total[:, sliding:] - total[:, :-sliding]) / sliding
    noise = noise[: shape[0], : shape[1]]
    return noise / noise.std() * sigma_um


def surface(
    shape: tuple[int, int] = (400, 300),
    pitches_um: tuple[float, float] = (7.15, 8.33),
    *,
    pits: tuple[Pit, ...] = (),
    tilt_um_per_mm: tuple[float, float] = (12.0, -7.0),
    sigma_um: float = 4.2,
    missing: float = 0.0,
    seed: int = 0,
    profiles: tuple[float, ...] = WHITE,
    sliding: int = 1,
    oversample: int = 4,
) -> RangeImage:
    """A tilted plate with pits, noise and randomly missing pixels. Pixels average the surface over their own area."""
    rng = np.random.default_rng(seed)
    fine_r = (np.arange(shape[0] * oversample) + 0.5) / oversample - 0.5
    fine_p = (np.arange(shape[1] * oversample) + 0.5) / oversample - 0.5
    height = np.zeros(shape)
    row = np.arange(shape[0])[:, None] * pitches_um[0]
    profile = np.arange(shape[1])[None, :] * pitches_um[1]
    for pit in pits:
        if pit.kind == "box":
            # Straight walls need the exact share of each pixel they cover: points on a grid would be 1 % off.
            covered_r = _covered(row[:, 0], pitches_um[0], pit.row_um, pit.size_um)
            covered_p = _covered(profile[0], pitches_um[1], pit.profile_um, pit.size_um)
            height -= pit.depth_um * covered_r[:, None] * covered_p[None, :]
            continue
        deep = np.zeros((fine_r.size, fine_p.size), dtype=np.float32)
        near_r = np.abs(fine_r * pitches_um[0] - pit.row_um) <= pit.size_um
        near_p = np.abs(fine_p * pitches_um[1] - pit.profile_um) <= pit.size_um
        deep[np.ix_(near_r, near_p)] = pit.depth_at(
            (fine_r[near_r] * pitches_um[0])[:, None], (fine_p[near_p] * pitches_um[1])[None, :]
        )
        height -= deep.reshape(shape[0], oversample, shape[1], oversample).mean(axis=(1, 3))
    height = height + tilt_um_per_mm[0] * row / 1e3 + tilt_um_per_mm[1] * profile / 1e3 + 250.0
    if sigma_um > 0:
        height = height + correlated_noise(shape, sigma_um, rng, profiles=profiles, sliding=sliding)
    if missing > 0:
        height[rng.random(shape) < missing] = np.nan
    return range_image(height, pitches_um)


def _covered(centre_um: NDArray[np.float64], pitch_um: float, middle_um: float, size_um: float) -> NDArray[np.float64]:
    low = np.maximum(centre_um - pitch_um / 2.0, middle_um - size_um / 2.0)
    high = np.minimum(centre_um + pitch_um / 2.0, middle_um + size_um / 2.0)
    return np.clip((high - low) / pitch_um, 0.0, 1.0)


def range_image(height_um: NDArray[np.floating], pitches_um: tuple[float, float] = (7.15, 8.33)) -> RangeImage:
    height = height_um.astype(np.float32)
    return RangeImage(
        column_px=height / np.float32(14.2),
        height_um=height,
        row_pitch_um=pitches_um[0],
        profile_pitch_um=pitches_um[1],
        intensity=np.full(height.shape, 120.0, dtype=np.float32),
        width_px=np.full(height.shape, 3.0, dtype=np.float32),
    )


@dataclass(frozen=True)
class Chip:
    """A notch at the edge: half an ellipsoid along the edge line, ``reach_um`` into the bevel, ``depth_um`` deep."""

    profile_um: float
    length_um: float
    reach_um: float
    depth_um: float

    @property
    def volume_mm3(self) -> float:
        return math.pi / 3.0 * (self.length_um / 2.0) * self.reach_um * self.depth_um * 1e-9

    def depth_at(self, from_edge_um: NDArray[np.float64], profile_um: NDArray[np.float64]) -> NDArray[np.float64]:
        inside = (
            1.0 - (from_edge_um / self.reach_um) ** 2 - ((profile_um - self.profile_um) / (self.length_um / 2)) ** 2
        )
        return self.depth_um * np.sqrt(np.clip(inside, 0.0, None))


def knife(
    shape: tuple[int, int] = (1000, 241),
    pitches_um: tuple[float, float] = (7.15, 8.33),
    *,
    chips: tuple[Chip, ...] = (),
    pits: tuple[Pit, ...] = (),
    edge_row: float = 930.0,
    edge_slope_rows: float = 4.0,
    sigma_um: float = 4.2,
    missing: float = 0.01,
    stray: float = 0.02,
    spikes: float = 0.0,
    rounding_um: float = 0.0,
    recession_um: float = 0.0,
    seed: int = 0,
    side: str = "last",
    profiles: tuple[float, ...] = STEPS,
    sliding: int = 5,
) -> RangeImage:
    """A bevel that ends at a sharp edge; beyond it no light but ``stray`` wrong heights. Chips bite into the edge."""
    plate = surface(shape, pitches_um, pits=pits, sigma_um=sigma_um, seed=seed, profiles=profiles, sliding=sliding)
    rng = np.random.default_rng(seed + 1)
    height = plate.height_um.astype(np.float64)
    row = np.arange(shape[0])[:, None]
    profile = np.arange(shape[1])[None, :] * pitches_um[1]
    line = edge_row + edge_slope_rows * np.arange(shape[1])[None, :] / shape[1] - recession_um / pitches_um[0]
    from_edge = (line - row) * pitches_um[0]
    for chip in chips:
        height -= chip.depth_at(np.maximum(from_edge, 0.0), profile)
    if rounding_um:
        height -= np.clip(rounding_um - from_edge, 0.0, None) ** 2 / (2.0 * rounding_um)
    height[rng.random(shape) < missing] = np.nan
    beyond = from_edge < 0
    height[beyond & (rng.random(shape) >= stray)] = np.nan
    wrong = (beyond & np.isfinite(height)) | (rng.random(shape) < spikes)
    height[wrong & np.isfinite(height)] += rng.uniform(-400, 400, int(np.count_nonzero(wrong & np.isfinite(height))))
    if side == "first":
        height = height[::-1]
    return range_image(np.ascontiguousarray(height), pitches_um)
