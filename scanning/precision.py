"""How good a range image is: undefined and saturated pixels, noise with its lateral cell, cost per pixel.

The four figures are the paper's, but a standard deviation without the lateral cell it belongs to is meaningless (any
noise can be averaged away), and one over the whole image measures the tool, not the instrument. So the report says
which flat part it used, what one value stands for on the tool, and how neighbouring errors hang together.

Source: Amir and Thornberg 2017, section 4.5, eq. (9).
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanning.errors import BadInput
from scanning.range_image import RangeImage

Float64 = NDArray[np.float64]

# Shares of (rows, profiles) tried as flat sub-region, largest first; the paper's is 600 x 241 of 1000 x 241.
_SHARES = ((0.6, 1.0), (1.0, 0.6), (0.6, 0.6), (0.3, 1.0), (0.6, 0.3), (0.3, 0.6), (0.3, 0.3))
_SHARES_SMALL = ((0.15, 0.3), (0.3, 0.15), (0.15, 0.15), (0.1, 0.1))
_FLAT = 1.3
_DEFINED = 0.8
_WILD = 6.0
_MAD = 1.4826
#: A point this sure is on the laser line: of those above it fewer than 1 in 1000 are not.
CONFIDENT = 0.95


@dataclass(frozen=True)
class FlatRegion:
    """Half-open ranges of rows and profiles, and how they came about ("given", "found", or "none flat")."""

    first_row: int
    last_row: int
    first_profile: int
    last_profile: int
    chosen: str = "given"

    @property
    def slices(self) -> tuple[slice, slice]:
        return slice(self.first_row, self.last_row), slice(self.first_profile, self.last_profile)


@dataclass(frozen=True)
class PrecisionReport:
    """The figures of one range image. None means that it cannot be known (nothing measured, nothing timed).

    ``sigma_um``: standard deviation (n - 3) of the heights against their least-squares plane in ``flat_region``;
    ``sigma_robust_um``: 1.4826 x the median absolute deviation there, which wild pixels do not move; ``wild``: pixels
    there more than 6 robust sigmas off the plane. ``lateral_cell_um``: [along the scan, along the rows], what one value
    is averaged over. ``correlation_scan``, ``correlation_rows``: of the errors at lags 1, 2, 3.
    ``ns_per_range_pixel``: wall time; ``cpu_ns_per_range_pixel``: processor time. ``outside_calibrated``: heights
    beyond the gauge's range and ``outside_calibrated_share`` their share of the heights; None when they do not come
    from a gauge. ``confident_share``: measured points with a confidence above `CONFIDENT`; None when nothing said how
    sure the points are.
    """

    undefined: int
    undefined_share: float
    saturated: int
    saturated_share: float
    sigma_um: float | None
    sigma_robust_um: float | None
    wild: int
    lateral_cell_um: tuple[float, float]
    flat_region: FlatRegion | None
    correlation_scan: tuple[float | None, ...]
    correlation_rows: tuple[float | None, ...]
    ns_per_range_pixel: float | None
    cpu_ns_per_range_pixel: float | None
    outside_calibrated: int | None = None
    outside_calibrated_share: float | None = None
    confident_share: float | None = None

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values with the keys of contract 3."""
        return {
            "undefined": {"count": self.undefined, "share": self.undefined_share},
            "saturated": {"count": self.saturated, "share": self.saturated_share},
            "outside_calibrated": None
            if self.outside_calibrated is None
            else {"count": self.outside_calibrated, "share": self.outside_calibrated_share},
            "confident": None if self.confident_share is None else {"above": CONFIDENT, "share": self.confident_share},
            "sigma_um": self.sigma_um,
            "sigma_robust_um": self.sigma_robust_um,
            "wild_pixels_in_flat_region": self.wild,
            "lateral_cell_um": list(self.lateral_cell_um),
            "flat_region": None if self.flat_region is None else asdict(self.flat_region),
            "correlation_scan": list(self.correlation_scan),
            "correlation_rows": list(self.correlation_rows),
            "ns_per_range_pixel": self.ns_per_range_pixel,
            "cpu_ns_per_range_pixel": self.cpu_ns_per_range_pixel,
        }


def sigma_um(sd_px: float, slope_mm_per_px: float) -> float:
    """Eq. (9): height noise in um from the standard deviation of the columns in px and the calibrated slope."""
    return 1000.0 * slope_mm_per_px * sd_px


def precision_of(image: RangeImage, flat: FlatRegion | None = None) -> PrecisionReport:
    """Measure the precision of a range image.

    ``flat`` is the flat sub-region to use. Without one the largest part is taken that is as flat as its small tiles are
    noisy: first 60 % of the rows with all profiles, as in the paper, then ever smaller windows (see `find_flat`).
    """
    region = find_flat(image.height_um) if flat is None else _checked(flat, image)
    spread = robust = None
    wild = 0
    scan: tuple[float | None, ...] = (None, None, None)
    rows: tuple[float | None, ...] = (None, None, None)
    if region is not None:
        error = plane_residual(np.asarray(image.height_um[region.slices], dtype=np.float64))
        finite = error[np.isfinite(error)]
        if finite.size > 3:
            spread = math.sqrt(float(finite @ finite) / (finite.size - 3))
            robust = _MAD * float(np.median(np.abs(finite - np.median(finite))))
            wild = int(np.count_nonzero(np.abs(finite) > _WILD * robust)) if robust > 0 else 0
            tame = np.where(np.abs(error) <= _WILD * robust, error, np.nan) if robust > 0 else error
            scan = tuple(_correlation(tame[:, :-lag], tame[:, lag:]) for lag in (1, 2, 3))
            rows = tuple(_correlation(tame[:-lag], tame[lag:]) for lag in (1, 2, 3))
    size = image.height_um.size
    measured = size - image.undefined
    outside = image.outside_calibrated
    beyond = None if outside is None else int(np.count_nonzero(outside))
    return PrecisionReport(
        undefined=image.undefined,
        undefined_share=image.undefined_share,
        saturated=image.saturated,
        saturated_share=image.saturated_share,
        sigma_um=spread,
        sigma_robust_um=robust,
        wild=wild,
        lateral_cell_um=lateral_cell_um(image),
        flat_region=region,
        correlation_scan=scan,
        correlation_rows=rows,
        ns_per_range_pixel=1e9 * image.wall_s / size if size and image.wall_s > 0 else None,
        cpu_ns_per_range_pixel=1e9 * image.cpu_s / size if size and image.cpu_s > 0 else None,
        outside_calibrated=beyond,
        outside_calibrated_share=beyond / measured if beyond is not None and measured else None,
        confident_share=_confident_share(image),
    )


def _confident_share(image: RangeImage) -> float | None:
    """Share of the measured points above `CONFIDENT`; None when none of them says how sure it is."""
    if image.confidence is None:
        return None
    told = image.confidence[np.isfinite(image.height_um)]
    if not np.isfinite(told).any():
        return None
    return float(np.count_nonzero(told > CONFIDENT) / told.size)


def lateral_cell_um(image: RangeImage) -> tuple[float, float]:
    """What one value is averaged over, (along the scan, along the rows) in um.

    Sliding SCI keeps the step as pitch but still averages over its whole window; without SCI the pitch is the cell.
    """
    recipe = image.provenance.get("recipe")
    header = image.provenance.get("header")
    along_scan = image.profile_pitch_um
    if isinstance(recipe, dict) and isinstance(header, dict) and "step_um" in header:
        for operation in recipe.get("operations", []):
            if isinstance(operation, dict) and "window" in operation:
                along_scan = float(header["step_um"]) * int(operation["window"])
    return along_scan, image.row_pitch_um


def plane_residual(height_um: Float64) -> Float64:
    """Heights minus their least-squares plane (NaN stays NaN); fewer than three heights leave everything NaN."""
    rows, profiles = np.nonzero(np.isfinite(height_um))
    if rows.size < 3:
        return np.full_like(height_um, np.nan)
    values = height_um[rows, profiles]
    middle = float(values.mean())
    design = np.column_stack([np.ones(rows.size), rows - rows.mean(), profiles - profiles.mean()])
    plane, *_ = np.linalg.lstsq(design.T @ design, design.T @ (values - middle), rcond=None)
    residual = np.full_like(height_um, np.nan)
    residual[rows, profiles] = values - middle - design @ plane
    return residual


def find_flat(height_um: NDArray[np.float32]) -> FlatRegion | None:
    """The largest window in which the heights scatter about a plane hardly more than in small tiles.

    Small tiles (a twelfth of the image) give the noise, as the median of their own standard deviations. Windows are
    tried from large to small; among those of one size that are at least 80 % defined and scatter at most 1.3 x the
    noise, the best defined one is taken (not the quietest: that choice would flatter). When none is flat, the quietest
    small window is returned as "none flat". A window of at least 30 % x 30 % without wrong peaks is preferred; when
    there is none, wild pixels are left out of the search, but never out of the result. None when hardly anything was
    measured.
    """
    height = np.asarray(height_um, dtype=np.float64)
    rows, profiles = height.shape
    finite = np.isfinite(height)
    if np.count_nonzero(finite) < 4 or rows < 2 or profiles < 2:
        return None
    wild = _wild(height, finite)
    sums = _Sums(height, finite & ~wild)
    tile = max(min(rows, 8), rows // 12), max(min(profiles, 8), profiles // 12)
    tiles = sums.windows(tile, tile, 0.5)
    usable = tiles.spread[np.isfinite(tiles.spread)]
    noise = float(np.median(usable)) if usable.size else math.inf
    quietest: tuple[float, FlatRegion] | None = None
    tries = [(sums, share) for share in (*_SHARES, *_SHARES_SMALL)]
    if wild.any():
        everything = _Sums(height, finite)
        tries = [(everything, share) for share in _SHARES] + tries
    for kind, (row_share, profile_share) in tries:
        window = max(2, round(rows * row_share)), max(2, round(profiles * profile_share))
        tried = kind.windows(window, (max(1, rows // 20), max(1, profiles // 20)), _DEFINED)
        if not np.isfinite(tried.spread).any():
            continue
        flat = tried.spread <= _FLAT * noise
        if flat.any():
            best = int(np.lexsort((tried.spread, -np.where(flat, tried.count, -1.0)))[0])
            return tried.region(best, "found")
        best = int(np.nanargmin(tried.spread))
        if quietest is None or tried.spread[best] < quietest[0]:
            quietest = float(tried.spread[best]), tried.region(best, "none flat")
    return quietest[1] if quietest is not None else FlatRegion(0, rows, 0, profiles, "none flat")


@dataclass(frozen=True)
class _Windows:
    first_row: NDArray[np.int64]
    first_profile: NDArray[np.int64]
    size: tuple[int, int]
    count: Float64
    spread: Float64

    def region(self, index: int, chosen: str) -> FlatRegion:
        row, profile = int(self.first_row[index]), int(self.first_profile[index])
        return FlatRegion(row, row + self.size[0], profile, profile + self.size[1], chosen)


class _Sums:
    """Summed-area tables of all moments that a plane needs, so that any window's plane costs nothing."""

    def __init__(self, height: Float64, used: NDArray[np.bool_]) -> None:
        self.shape = height.shape
        rows, profiles = height.shape
        u = np.linspace(-1.0, 1.0, rows)[:, None] * np.ones((1, profiles))
        v = np.linspace(-1.0, 1.0, profiles)[None, :] * np.ones((rows, 1))
        z = np.where(used, height - float(np.median(height[used])) if used.any() else 0.0, 0.0)
        w = used.astype(np.float64)
        moments = (w, w * u, w * v, z, w * u * u, w * v * v, w * u * v, z * u, z * v, z * z)
        self.tables = [np.pad(np.cumsum(np.cumsum(one, axis=0), axis=1), ((1, 0), (1, 0))) for one in moments]

    def windows(self, size: tuple[int, int], stride: tuple[int, int], defined: float) -> _Windows:
        rows, profiles = self.shape
        starts_r = np.unique(np.append(np.arange(0, rows - size[0] + 1, stride[0]), rows - size[0]))
        starts_p = np.unique(np.append(np.arange(0, profiles - size[1] + 1, stride[1]), profiles - size[1]))
        r, p = (one.ravel() for one in np.meshgrid(starts_r, starts_p, indexing="ij"))
        low, right = r + size[0], p + size[1]
        n, su, sv, sz, suu, svv, suv, szu, szv, szz = (
            t[low, right] - t[r, right] - t[low, p] + t[r, p] for t in self.tables
        )
        spread = np.full(n.size, np.nan)
        enough = n >= max(4.0, defined * size[0] * size[1])
        if enough.any():
            normal = np.array([[n, su, sv], [su, suu, suv], [sv, suv, svv]])[:, :, enough].transpose(2, 0, 1)
            right_side = np.array([sz, szu, szv])[:, enough].T
            # A window one row or profile wide of defined pixels has no plane; the pseudo-inverse then fits what it can.
            plane = (np.linalg.pinv(normal, hermitian=True) @ right_side[:, :, None])[:, :, 0]
            sse = szz[enough] - (plane * right_side).sum(axis=1)
            spread[enough] = np.sqrt(np.maximum(sse, 0.0) / (n[enough] - 3.0))
        return _Windows(r, p, size, n, spread)


def _wild(height: Float64, finite: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels that stand far off the median of their 5 x 5 neighbours: wrong peaks, not the surface."""
    filled = np.where(finite, height, np.median(height[finite])).astype(np.float32)
    off = np.abs(filled - cv2.medianBlur(filled, 5))
    scale = _MAD * float(np.median(off[finite]))
    return np.asarray(off > _WILD * scale) if scale > 0 else np.zeros(height.shape, dtype=np.bool_)


def _correlation(one: Float64, other: Float64) -> float | None:
    both = np.isfinite(one) & np.isfinite(other)
    if np.count_nonzero(both) < 30:
        return None
    a, b = one[both] - one[both].mean(), other[both] - other[both].mean()
    scale = math.sqrt(float(a @ a) * float(b @ b))
    return float(a @ b) / scale if scale > 0 else None


def _checked(flat: FlatRegion, image: RangeImage) -> FlatRegion:
    rows, profiles = image.height_um.shape
    inside = 0 <= flat.first_row < flat.last_row <= rows and 0 <= flat.first_profile < flat.last_profile <= profiles
    if not inside:
        raise BadInput(
            f"the flat sub-region rows {flat.first_row}:{flat.last_row}, profiles {flat.first_profile}:"
            f"{flat.last_profile} is not inside the range image of {rows} rows and {profiles} profiles; choose another"
        )
    return flat


def read_flat(text: str) -> FlatRegion:
    """Parse "200:800,0:241" (rows, profiles, half open)."""
    try:
        (first_row, last_row), (first_profile, last_profile) = (
            tuple(int(end) for end in span.split(":")) for span in text.split(",")
        )
    except ValueError:
        raise BadInput(
            f'the flat sub-region "{text}" is not understood; write rows,profiles as 200:800,0:241'
        ) from None
    return FlatRegion(first_row, last_row, first_profile, last_profile)
