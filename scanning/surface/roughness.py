"""Areal roughness (ISO 25178-2) of the sound part of a bevel, on a scale-limited surface.

The parameters mean nothing without their filters and without knowing the instrument's own noise: at 4 to 8 um noise a
ground bevel (Sq below 1 um) is NOT measurable with such a rig, and the report has to say so instead of printing 4 um.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanning.surface.filters import ISO_SIGMA_PER_INDEX, Float32, Float64, Mask, smooth


@dataclass(frozen=True)
class Roughness:
    """ISO 25178-2 height and hybrid parameters: heights in um, Sdr in %, Ssk, Sku and Sdq without unit.

    Sku is the fourth moment itself (3 for a Gaussian), not the excess. Sdq and Sdr come from the triangulated
    surface, the mean over both ways of halving each cell.
    """

    Sa: float
    Sq: float
    Sz: float
    Sp: float
    Sv: float
    Ssk: float
    Sku: float
    Sdq: float
    Sdr: float
    points: int
    s_filter_um: float
    l_filter_um: float


def nesting_indices(
    rows: int, profiles: int, row_pitch_um: float, profile_pitch_um: float, s_um: float | None, l_um: float | None
) -> tuple[float, float]:
    """S- and L-filter nesting indices in um: at least 3 pitches and 25 um; 0.8 mm, or 0.25 mm below 2 mm width."""
    s_index = s_um if s_um is not None else max(25.0, 3.0 * max(row_pitch_um, profile_pitch_um))
    narrow = min(rows * row_pitch_um, profiles * profile_pitch_um) < 2000.0
    l_index = l_um if l_um is not None else (250.0 if narrow else 800.0)
    # A band needs room: with coarse pitches 0.25 mm would leave less than an octave between the two.
    return s_index, max(l_index, 2.0 * s_index)


def scale_limited(
    residual_um: Float32, sound: Mask, row_pitch_um: float, profile_pitch_um: float, s_index: float, l_index: float
) -> Float32:
    """Gaussian S-filter, then L-filter (ISO 16610-61) over the sound pixels; NaN elsewhere.

    The reference plane (F-operation) has been taken out already. An index of 0 skips its filter.
    """

    def px(index: float) -> tuple[float, float]:
        return ISO_SIGMA_PER_INDEX * index / row_pitch_um, ISO_SIGMA_PER_INDEX * index / profile_pitch_um

    surface = residual_um
    if s_index > 0:
        surface = smooth(surface, sound, px(s_index)).value
    if l_index > 0:
        surface = surface - smooth(surface, sound, px(l_index)).value
    return np.where(sound, surface, np.float32(np.nan)).astype(np.float32)


def parameters(
    surface_um: Float32, row_pitch_um: float, profile_pitch_um: float, *, s_index: float = 0.0, l_index: float = 0.0
) -> Roughness:
    """Compute the parameters of a levelled surface (rows, profiles), NaN not counted. The mean is taken out."""
    z = surface_um[np.isfinite(surface_um)].astype(np.float64)
    z = z - z.mean()
    sq = float(np.sqrt(np.mean(z**2)))
    slope_squared, area = _facets(surface_um.astype(np.float64), row_pitch_um, profile_pitch_um)
    sp, sv = float(z.max()), float(-z.min())
    return Roughness(
        Sa=float(np.mean(np.abs(z))),
        Sq=sq,
        Sz=sp + sv,
        Sp=sp,
        Sv=sv,
        Ssk=float(np.mean(z**3) / sq**3) if sq > 0 else float("nan"),
        Sku=float(np.mean(z**4) / sq**4) if sq > 0 else float("nan"),
        Sdq=float(np.sqrt(slope_squared)),
        Sdr=float(100.0 * (area - 1.0)),
        points=int(z.size),
        s_filter_um=s_index,
        l_filter_um=l_index,
    )


def _facets(z: Float64, row_pitch_um: float, profile_pitch_um: float) -> tuple[float, float]:
    """Mean squared slope and mean area ratio over the triangles of all fully measured cells.

    Each cell of four pixels is halved along either diagonal; the mean of both does not depend on which way the image
    was mirrored.
    """
    top = np.diff(z[:-1], axis=1) / profile_pitch_um
    bottom = np.diff(z[1:], axis=1) / profile_pitch_um
    left = np.diff(z[:, :-1], axis=0) / row_pitch_um
    right = np.diff(z[:, 1:], axis=0) / row_pitch_um
    slopes: list[float] = []
    areas: list[float] = []
    for along, across in ((top, left), (bottom, right), (top, right), (bottom, left)):
        squared = along**2 + across**2
        squared = squared[np.isfinite(top + bottom + left + right)]
        if squared.size == 0:
            return float("nan"), float("nan")
        slopes.append(float(squared.mean()))
        areas.append(float(np.sqrt(1.0 + squared).mean()))
    return float(np.mean(slopes)), float(np.mean(areas))
