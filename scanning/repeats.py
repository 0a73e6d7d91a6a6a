"""How noisy the instrument is, from two scans of the same flat part, the second one displaced.

Repeating a scan without moving the part says almost nothing: speckle, the largest error of a laser line on metal, comes
out the same again. On simulated scans at f/5.6 the difference of two such scans gives 0.5 um where heights are wrong by
8.0 um. The part has to lie elsewhere, so that another piece of its surface is under every pixel.

And the two scans must then NOT be aligned on the part: speckle belongs to the surface and travels with it, so the
heights of one surface point are wrong by the same amount in both scans, wherever the point lies (0.6 um aligned, the
same as without moving). So heights are compared pixel by pixel of the instrument, after the plane of their difference
is taken out. On a flat, fine part the rest is noise; roughness of the part counts as noise too, so the figure is an
upper bound. The aligned figure stands beside it: it is how well one surface point repeats.

Source: ISO 25178-700 6.5, N_M = Sq(z1 - z2) / sqrt 2; the displacement is what coherent light asks for.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from scanning.errors import BadInput
from scanning.optics import LINE_WIDTH_UM
from scanning.precision import FlatRegion, find_flat, lateral_cell_um, plane_residual
from scanning.range_image import RangeImage

Float64 = NDArray[np.float64]
Along = Literal["scan", "rows"]

LEAST_ROWS = 3
"""Errors of rows two apart are still correlated by 0.07."""
FEWEST_PIXELS = 1000
_MAD = 1.4826


@dataclass(frozen=True)
class RepeatNoise:
    """Noise of a single height, in um, with the lateral cell it belongs to (along the scan, along the rows).

    ``noise_um``: Sq of the difference over sqrt 2, pixel by pixel; ``robust_um``: the same by 1.4826 MAD.
    ``same_point_um``: surface point by surface point, to the nearest pixel (``left_um`` are then left unaligned); None
    when the scans do not overlap enough. ``pixels`` both scans measured, in ``flat_region``.
    """

    noise_um: float
    robust_um: float
    same_point_um: float | None
    moved_um: float
    along: Along
    left_um: float
    lateral_cell_um: tuple[float, float]
    pixels: int
    flat_region: FlatRegion

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def repeat_noise(
    first: RangeImage,
    second: RangeImage,
    moved_um: float,
    along: Along = "rows",
    flat: FlatRegion | None = None,
) -> RepeatNoise:
    """Noise from two range images of one flat part that lay ``moved_um`` further ``along`` in the second.

    Refused: no displacement or too small a one, scans of different size, pitch or recipe, too little in common.
    """
    cell = lateral_cell_um(first)
    _check_pair(first, second)
    _check_displacement(moved_um, along, first, cell)
    region = flat or find_flat(first.height_um)
    if region is None:
        raise BadInput("nothing flat was measured in the first scan; scan a flat part for the noise")
    a, b = (np.asarray(one.height_um, dtype=np.float64) for one in (first, second))
    noise, robust, pixels = sq_of_difference(a[region.slices], b[region.slices])
    if pixels < FEWEST_PIXELS:
        raise BadInput(
            f"both scans measured only {pixels} pixels in common; noise needs {FEWEST_PIXELS}, so scan a larger flat "
            "part"
        )
    pitch = first.row_pitch_um if along == "rows" else first.profile_pitch_um
    places = round(moved_um / pitch)
    points = [_aligned(a, b, region, sign * places, along) for sign in (1, -1)]
    seen = [one for one in points if one is not None]
    return RepeatNoise(
        noise_um=noise,
        robust_um=robust,
        same_point_um=min(seen) if seen else None,
        moved_um=moved_um,
        along=along,
        left_um=moved_um - places * pitch,
        lateral_cell_um=cell,
        pixels=pixels,
        flat_region=region,
    )


def sq_of_difference(first_um: Float64, second_um: Float64) -> tuple[float, float, int]:
    """(Sq / sqrt 2, the same by MAD, pixels) of two height maps' difference about its own plane, NaN left out."""
    left = plane_residual(second_um - first_um)
    left = left[np.isfinite(left)]
    if left.size < 4:
        return math.nan, math.nan, int(left.size)
    sq = math.sqrt(float(left @ left) / (left.size - 3) / 2.0)
    return sq, _MAD * float(np.median(np.abs(left - np.median(left)))) / math.sqrt(2.0), int(left.size)


def _aligned(a: Float64, b: Float64, region: FlatRegion, places: int, along: Along) -> float | None:
    axis = 0 if along == "rows" else 1
    moved = np.full_like(b, np.nan)
    size = b.shape[axis]
    if abs(places) >= size:
        return None
    to, of = slice(max(0, -places), size - max(0, places)), slice(max(0, places), size - max(0, -places))
    whole = slice(None)
    moved[(to, whole) if axis == 0 else (whole, to)] = b[(of, whole) if axis == 0 else (whole, of)]
    sq, _, pixels = sq_of_difference(a[region.slices], moved[region.slices])
    return sq if pixels >= FEWEST_PIXELS else None


def _check_pair(first: RangeImage, second: RangeImage) -> None:
    if first.height_um.shape != second.height_um.shape:
        sizes = [" x ".join(map(str, one.height_um.shape)) for one in (first, second)]
        raise BadInput(f"the two scans are {sizes[0]} and {sizes[1]} range pixels; scan the same region twice")
    for name in ("row_pitch_um", "profile_pitch_um"):
        one, other = getattr(first, name), getattr(second, name)
        if not math.isclose(one, other, rel_tol=1e-6):
            raise BadInput(f"the two scans differ in {name} ({one:g} and {other:g} um); repeat with the same settings")
    recipes = [one.provenance.get("recipe_sha256") for one in (first, second)]
    if recipes[0] != recipes[1]:
        raise BadInput("the two range images were made by different recipes; process both with the same one")


def refuse_static(moved_um: float) -> None:
    """Raise `BadInput` for a displacement that is none."""
    if not math.isfinite(moved_um):
        raise BadInput(f"the displacement is {moved_um} um; it must be a number of micrometres")
    if moved_um == 0:
        raise BadInput(
            "a repeat without moving the part shows the same speckle twice and understates the noise many times over; "
            "move the part between the scans and say by how much"
        )


def _check_displacement(moved_um: float, along: Along, image: RangeImage, cell: tuple[float, float]) -> None:
    refuse_static(moved_um)
    if along == "rows":
        least, why = LEAST_ROWS * image.row_pitch_um, f"{LEAST_ROWS} rows"
    else:
        least, why = cell[0] + LINE_WIDTH_UM, "what one height is averaged over, and the laser line's width"
    if abs(moved_um) < least * (1.0 - 1e-9):
        raise BadInput(
            f"a displacement of {abs(moved_um):g} um along the {along} leaves the same speckle in both scans; move the "
            f"part by at least {least:.1f} um ({why})"
        )
