"""Where the cutting edge runs, how far it has receded, and how straight it is.

Edge recession is the wear number to trend, and it is the one number the missing volume cannot replace: where a chip
has taken the material away altogether nothing is measured, so only the edge line knows that something is gone.
An image without an edge (a plate, an imported surface) must say so instead of calling its border an edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import ndimage, stats

from scanning.surface.filters import Float32, Float64, Mask, smooth
from scanning.surface.noise import MAD_TO_SIGMA, robust_sigma

#: The surface must end at least this far inside the image, in at least this share of the profiles.
LEAST_BAND_UM = 20.0
LEAST_SHARE = 0.7
#: Recession is averaged (median) over this length of edge, so that one dropout is not a chip.
ALONG_UM = 50.0
#: How far inside the edge the prevailing rounding is looked for.
ROLL_OFF_REACH_UM = 200.0


@dataclass(frozen=True)
class Edge:
    """The edge of one region; one entry per profile, NaN where none was found.

    ``row`` is the last sound row (sub-pixel), ``reference_row`` the line through the undamaged edge, ``recession_um``
    the distance between them, positive where material is gone. ``outermost_row`` is the line where the light ends: a
    rounded edge or the floor of a chip is still seen there. ``undamaged`` marks profiles whose edge is on the line.
    ``side`` says at which end of the rows the edge is. ``sigma_um`` is the scatter of single edge points from
    neighbour to neighbour; ``rounded_um`` the distance from the end of the light at which the undamaged surface
    meets the bevel again, 0 when it is sharp to the last row.
    """

    side: Literal["first", "last"]
    row: Float64
    reference_row: Float64
    outermost_row: Float64
    undamaged: Mask
    recession_um: Float64
    straightness_um: float
    sigma_um: float
    rounded_um: float
    points: int


def find_edge(
    residual_um: Float32,
    valid: Mask,
    row_pitch_um: float,
    profile_pitch_um: float,
    *,
    side: Literal["auto", "first", "last", "none"] = "auto",
    reference_row: Float64 | None = None,
) -> tuple[Edge | None, list[str]]:
    """Locate the edge in a residual image (rows, profiles); returns it, or None, and sentences for the reader.

    Per profile the edge is the last row, seen from inside, where the lightly smoothed surface is measured and not
    more than 3 of its standard deviations below the reference; sub-pixel by linear crossing where the surface dips
    away, half a pixel beyond the last measured row where the light ends. ``reference_row`` (from the baseline) replaces
    the line fitted through this scan's own undamaged edge.
    """
    remarks: list[str] = []
    if side == "none":
        return None, remarks
    light = smooth(residual_um, valid, (0.8, 0.8))
    sigma = robust_sigma(light.value[valid])
    limit = max(3.0 * sigma, 0.5)
    # Heights well above the bevel are no bevel either: a burr is lower than this, stray light is not.
    above = max(10.0 * sigma, 50.0)
    sound = valid & (light.value > -limit * np.maximum(light.spread, 1.0)) & (light.value < above)
    dense = ndimage.uniform_filter(sound.astype(np.float32), size=(5, 3), mode="nearest") >= 0.5
    body = sound & dense
    ends: dict[str, Float64] = {}
    for end in ("first", "last"):
        band = _band(body, end)
        share = float(np.mean(band * row_pitch_um >= LEAST_BAND_UM))
        if np.median(band) >= 2 and share >= LEAST_SHARE:
            ends[end] = band
    chosen: Literal["first", "last"]
    if side in ("first", "last"):
        if side not in ends:
            remarks.append(
                f"No edge was found at the {side} row: the surface is measured up to the border of the image."
            )
            return None, remarks
        chosen = "first" if side == "first" else "last"
    elif not ends:
        return None, remarks
    elif len(ends) == 2:
        chosen = "first" if float(np.median(ends["first"])) > float(np.median(ends["last"])) else "last"
        remarks.append(
            "The surface ends before both borders of the image; the side with the wider dark band "
            f"(the {chosen} rows) was taken for the cutting edge. Set edge_side if it is the other one."
        )
    else:
        chosen = "first" if "first" in ends else "last"

    flip = chosen == "first"
    seen = valid & (ndimage.uniform_filter(valid.astype(np.float32), size=(5, 3), mode="nearest") >= 0.5)
    row = _last_row(body[::-1] if flip else body, (light.value[::-1] if flip else light.value), limit)
    outline = (valid.shape[0] - 1 - _band(seen, chosen)).astype(np.float64) + 0.5
    height = residual_um.shape[0]
    line = _reference(row, outline)
    if line is None:
        remarks.append("Too few edge points for an edge line; edge recession is not reported.")
        return None, remarks
    own_line = line
    outermost = np.fmax(line, _fitted(outline, 75.0)) if np.isfinite(outline).any() else line
    if reference_row is not None:
        line = (height - 1 - reference_row) if flip else reference_row
    recession = (line - row) * row_pitch_um
    window = max(1, round(ALONG_UM / profile_pitch_um)) | 1
    steady = _running_median(recession, window)
    scatter = (row - own_line) * row_pitch_um
    sigma_edge = _point_scatter(row) * row_pitch_um
    undamaged = np.abs(scatter) < max(4.0 * sigma_edge, 3.0 * row_pitch_um)
    rolled = _running_median(scatter, window)
    straightness = float(np.nanmax(rolled) - np.nanmin(rolled))
    rounded = _rounded(
        (residual_um[::-1] if flip else residual_um)[:, undamaged],
        (valid[::-1] if flip else valid)[:, undamaged],
        outermost[undamaged],
        row_pitch_um,
        sigma,
    )
    edge = Edge(
        side=chosen,
        row=(height - 1 - row) if flip else row,
        reference_row=(height - 1 - line) if flip else line,
        outermost_row=(height - 1 - outermost) if flip else outermost,
        undamaged=undamaged,
        recession_um=steady,
        straightness_um=straightness,
        sigma_um=sigma_edge,
        rounded_um=rounded,
        points=int(np.count_nonzero(np.isfinite(row))),
    )
    return edge, remarks


def expected_surface(edge: Edge, rows: int) -> Mask:
    """Pixels on the bevel's side of the reference edge line, or of the end of the light where that is further out."""
    index = np.arange(rows)[:, None]
    if edge.side == "last":
        return np.asarray(index <= np.fmax(edge.reference_row, edge.outermost_row)[None, :])
    return np.asarray(index >= np.fmin(edge.reference_row, edge.outermost_row)[None, :])


def distance_to_edge_um(edge: Edge, rows: int, row_pitch_um: float) -> Float32:
    """Distance of every pixel from the reference edge line, into the bevel, in um; negative beyond the edge."""
    index = np.arange(rows, dtype=np.float32)[:, None]
    line = edge.reference_row[None, :].astype(np.float32)
    inward = line - index if edge.side == "last" else index - line
    return (inward * np.float32(row_pitch_um)).astype(np.float32)


def roll_off(
    residual_um: Float32, valid: Mask, edge: Edge, row_pitch_um: float, profile_pitch_um: float, kappa: float
) -> Float32 | None:
    """The shape common to the whole edge (rounding, light lost at the brink) as an image to subtract, or None.

    A rounded edge is wear, measured by ``rounded_um`` and the recession; left in, it would appear as one damage as
    long as the tool. The median over all profiles at each distance from the edge line knows nothing of single chips.
    Only profiles with an undamaged edge vote, and only distances whose median is certain (5 standard uncertainties)
    are used, in one stretch from the edge inward; where fewer than half of them are measured nothing is corrected.
    """
    rows, profiles = residual_um.shape
    steps = max(3, round(ROLL_OFF_REACH_UM / row_pitch_um))
    if profiles < 20 or rows < 2 * steps:
        return None
    nearest = np.rint(edge.outermost_row).astype(np.int64)
    whole = edge.undamaged
    if np.count_nonzero(whole) < max(20, 0.2 * profiles):
        return None
    shape = np.zeros(steps + 2)
    for step in range(-1, steps + 1):
        index = nearest - step if edge.side == "last" else nearest + step
        inside = (index >= 0) & (index < rows) & whole
        column = np.flatnonzero(inside)
        values = residual_um[index[inside], column][valid[index[inside], column]]
        if values.size < np.count_nonzero(whole) * 0.5:
            continue
        middle = float(np.median(values))
        u_middle = 1.2533 * robust_sigma(values) * np.sqrt(max(kappa, 1.0) / values.size)
        if abs(middle) > 5.0 * u_middle:
            shape[step + 1] = middle
    # The rounding is one stretch ending at the edge: two unremarkable rows in a row are its inner end.
    unremarkable = np.flatnonzero((shape[1:-1] == 0) & (shape[2:] == 0))
    if unremarkable.size:
        shape[unremarkable[0] + 1 :] = 0.0
    if not shape.any():
        return None
    image = np.zeros_like(residual_um)
    column = np.arange(profiles)
    for step in range(-1, steps + 1):
        if shape[step + 1]:
            index = nearest - step if edge.side == "last" else nearest + step
            inside = (index >= 0) & (index < rows)
            image[index[inside], column[inside]] = shape[step + 1]
    return image


def _band(body: Mask, end: str) -> Float64:
    """Rows between the border and the first row of sound surface, per profile; the whole height where there is none."""
    seen = body if end == "first" else body[::-1]
    first = np.argmax(seen, axis=0).astype(np.float64)
    first[~seen.any(axis=0)] = body.shape[0]
    return np.asarray(first, dtype=np.float64)


def _last_row(body: Mask, height: Float32, limit: float) -> Float64:
    """Sub-pixel last sound row per profile, the edge being at the last rows."""
    rows = body.shape[0]
    row = (rows - 1 - _band(body, "last")).astype(np.float64)
    row[row < 0] = np.nan
    found = np.flatnonzero(np.isfinite(row))
    index = row[found].astype(np.int64)
    beyond = np.minimum(index + 1, rows - 1)
    here, there = height[index, found].astype(np.float64), height[beyond, found].astype(np.float64)
    dips = np.isfinite(there) & (there < -limit) & (here > -limit)
    fraction = np.full(found.size, 0.5)
    fraction[dips] = (here + limit)[dips] / (here - there)[dips]
    row[found] = index + np.clip(fraction, 0.0, 1.0)
    return np.asarray(row, dtype=np.float64)


def _point_scatter(row: Float64) -> float:
    """Scatter of single edge points in rows, from neighbour to neighbour: chips and slopes hardly enter."""
    return max(robust_sigma(np.diff(row)) / np.sqrt(2.0), 0.3) if np.count_nonzero(np.isfinite(row)) > 2 else 0.3


def _reference(row: Float64, outline: Float64) -> Float64 | None:
    """The line the undamaged edge would follow, in rows (edge at the last rows), or None with too few points.

    Its direction is that of the end of the light, which most chips leave alone; its place that of the outermost
    cluster of sound edge points. A line fitted to the sound points themselves would follow the floor of any chip
    longer than half of the region.
    """
    good = np.isfinite(row)
    if np.count_nonzero(good) < max(10, 0.2 * row.size) or np.count_nonzero(np.isfinite(outline)) < 10:
        return None
    direction = _fitted(outline, 75.0)
    distance = row - direction
    outer = float(np.percentile(distance[good], 95.0))
    cluster = good & (distance >= outer - 4.0 * _point_scatter(row))
    if np.count_nonzero(cluster) >= 0.7 * row.size:
        return _fitted(np.where(cluster, row, np.nan), 50.0)
    return direction + float(np.median(distance[cluster]))


def _fitted(row: Float64, start_percentile: float) -> Float64:
    """Robust straight line through edge points.

    Damage only ever takes material away, so the start is a line through the given percentile of each of up to 24
    stretches (Theil-Sen); Tukey's weights then settle it on the points that agree.
    """
    profile = np.arange(row.size, dtype=np.float64)
    good = np.isfinite(row)
    stretches = np.array_split(np.flatnonzero(good), max(1, min(24, int(np.count_nonzero(good)) // 4)))
    centre = np.array([profile[piece].mean() for piece in stretches])
    outer = np.array([np.percentile(row[piece], start_percentile) for piece in stretches])
    if centre.size >= 3:
        slope, intercept, *_ = stats.theilslopes(outer, centre)
    else:
        slope, intercept = 0.0, float(np.median(outer))
    for _ in range(10):
        residual = row[good] - (intercept + slope * profile[good])
        # A third of a row is what whole-pixel ends of the light scatter by.
        sigma = max(float(MAD_TO_SIGMA * np.median(np.abs(residual))), 0.3)
        weight = np.clip(1.0 - (residual / (4.685 * sigma)) ** 2, 0.0, None) ** 2
        if np.count_nonzero(weight) < 5:
            break
        slope, intercept = np.polyfit(profile[good], row[good], 1, w=np.sqrt(weight))
    return np.asarray(intercept + slope * profile, dtype=np.float64)


def _running_median(values: Float64, window: int) -> Float64:
    if window <= 1:
        return values.copy()
    half = window // 2
    padded = np.pad(values, half, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, window)
    counted = np.count_nonzero(np.isfinite(windows), axis=1)
    ordered = np.sort(windows, axis=1)
    middle = np.take_along_axis(ordered, np.maximum((counted - 1) // 2, 0)[:, None], axis=1)[:, 0]
    upper = np.take_along_axis(ordered, np.maximum(counted // 2, 0)[:, None].clip(max=window - 1), axis=1)[:, 0]
    middle = np.where(counted % 2 == 0, 0.5 * (middle + upper), middle)
    return np.asarray(np.where(counted * 2 >= half + 1, middle, np.nan), dtype=np.float64)


def _rounded(residual_um: Float32, valid: Mask, line: Float64, row_pitch_um: float, sigma: float) -> float:
    """Distance from the edge line to where the median surface is back within 3 sigma for 50 um (edge at last rows)."""
    rows = residual_um.shape[0]
    nearest = np.rint(line).astype(np.int64)
    needed = max(1, round(50.0 / row_pitch_um))
    calm = 0
    for step in range(min(rows, round(2000.0 / row_pitch_um))):
        index = nearest - step
        inside = (index >= 0) & (index < rows)
        column = np.flatnonzero(inside)
        values = residual_um[index[inside], column][valid[index[inside], column]]
        calm = calm + 1 if values.size and abs(float(np.median(values))) < 3.0 * sigma else 0
        if calm >= needed:
            return float((step - needed + 1) * row_pitch_um)
    return float("nan")
