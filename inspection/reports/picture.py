"""A range image as a picture on paper: millimetres on both axes, micrometres in the colours, undefined hatched.

What was not measured must look like nothing else, or a blind spot passes for a flat one. The colours (cividis) are
those that a colour-blind reader and a black-and-white copier keep in order, and they never span less than 50 um, so
that noise on a sound edge does not look like damage.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from inspection.reports.svg import INK, Drawing, tick_text, ticks
from scanning.errors import BadInput
from scanning.range_image import RangeImage
from scanning.surface.plane import fit_plane

#: Room on the paper, mm.
WIDE, TALL = 84.0, 54.0
LEAST_SIDE = 16.0
DOTS_PER_MM = 8
LEAST_SPAN_UM = 50.0
Float32 = NDArray[np.float32]
Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class Outline:
    """A damage's bounding box in pixels (half open), with its number in the table."""

    number: int
    rows: tuple[float, float]
    profiles: tuple[float, float]
    depth_um: float = 0.0


@dataclass(frozen=True)
class Picture:
    """``svg`` with its size on paper in mm, the text for readers who cannot see it, and what its colours mean."""

    svg: str
    width_mm: float
    height_mm: float
    alt: str
    caption: str


def outlines(damages: Sequence[Any]) -> list[Outline]:
    """The boxes of stored damages; a damage without one is listed but not drawn."""
    found = []
    for damage in damages:
        rows, profiles = damage.detail.get("rows"), damage.detail.get("profiles")
        if rows and profiles:
            found.append(Outline(damage.number, (rows[0], rows[1]), (profiles[0], profiles[1]), damage.depth_um))
    return found


def levelled(image: RangeImage) -> tuple[Float32, str]:
    """Heights over the robust plane in um, and how they were levelled in words."""
    try:
        plane = fit_plane(image.height_um, image.row_pitch_um, image.profile_pitch_um)
    except BadInput as fault:
        if not np.isfinite(image.height_um).any():
            return image.height_um, "Nothing was measured in this region."
        middle = np.float32(np.nanmedian(image.height_um))
        return image.height_um - middle, f"Heights over their median, not over a plane: {fault}"
    return image.height_um - plane.height_um(), "Heights over the robust plane through the sound surface."


def draw(image: RangeImage, damages: Sequence[Outline], *, start_mm: float = 0.0, name: str = "") -> Picture:
    """Draw ``image`` with its damages; the scan runs to the right from ``start_mm``, the laser line downwards."""
    height, how = levelled(image)
    rows, profiles = height.shape
    across, down = profiles * image.profile_pitch_um / 1e3, rows * image.row_pitch_um / 1e3
    scale = min(WIDE / across, TALL / down)
    w, h = max(across * scale, LEAST_SIDE), max(down * scale, LEAST_SIDE)
    equal = abs(w / across - h / down) < 0.02 * scale
    low, high = colour_range(height, max((damage.depth_um for damage in damages), default=0.0))
    left, top, right, bottom = 9.5, 1.5, 17.0, 8.5
    paper = Drawing(left + w + right, top + h + bottom)
    paper.picture(left, top, w, h, png(height, low, high, (round(w * DOTS_PER_MM), round(h * DOTS_PER_MM))))
    paper.box(left, top, w, h)
    for x in ticks(start_mm, start_mm + across, max(2, int(w / 12))):
        at = left + (x - start_mm) / across * w
        paper.line(at, top + h, at, top + h + 1)
        paper.text(at, top + h + 3.6, tick_text(x), anchor="middle")
    for y in ticks(0, down, max(2, int(h / 10))):
        at = top + y / down * h
        paper.line(left - 1, at, left, at)
        paper.text(left - 1.5, at + 0.8, tick_text(y), anchor="end")
    paper.text(left + w / 2, top + h + 7.2, "along the edge, mm", anchor="middle")
    paper.text(2.4, top + h / 2, "along the laser line, mm", anchor="middle", turn=-90)
    for damage in damages:
        x1, x2 = (left + p / profiles * w for p in damage.profiles)
        y1, y2 = (top + r / rows * h for r in damage.rows)
        pad = 0.6
        for colour, width in (("#ffffff", 0.7), ("#c1121f", 0.35)):
            paper.box(x1 - pad, y1 - pad, x2 - x1 + 2 * pad, y2 - y1 + 2 * pad, colour, width)
        above = y1 - pad - 0.8 > top + 2.5
        paper.text(
            x1 - pad, y1 - pad - 0.8 if above else y2 + pad + 2.6, str(damage.number), 2.8, colour="#c1121f", halo=True,
            bold=True,
        )  # fmt: skip
    bar_x, bar_w = left + w + 3, 3.0
    ramp = np.linspace(high, low, 128, dtype=np.float32)[:, None].repeat(4, axis=1)
    paper.picture(bar_x, top, bar_w, h, _encoded(_coloured(ramp, low, high)))
    paper.box(bar_x, top, bar_w, h)
    for z in ticks(low, high, max(2, int(h / 9))):
        at = top + (high - z) / (high - low) * h
        paper.line(bar_x + bar_w, at, bar_x + bar_w + 0.8, at)
        paper.text(bar_x + bar_w + 1.3, at + 0.8, tick_text(z))
    paper.text(left + w + right - 1, top + h / 2, "height, µm", anchor="middle", turn=-90, colour=INK)
    share = 100.0 * image.undefined_share
    caption = f"{how} Hatched grey: not measured ({share:.1f} %)."
    finite = height[np.isfinite(height)]
    beyond = np.count_nonzero((finite < low) | (finite > high)) / finite.size if finite.size else 0.0
    if beyond > 0.005:
        caption += f" {100 * beyond:.1f} % lie beyond the colour bar and take its end colour."
    if not equal:
        caption += " The two axes are not to the same scale."
    alt = (
        f"Range image of {name or 'the region'}: {across:.2f} mm along the edge by {down:.2f} mm along the laser line, "
        f"{len(damages)} damages outlined, {share:.1f} % not measured."
    )
    return Picture(paper.svg(), paper.width, paper.height, alt, caption)


def colour_range(height_um: Float32, deepest_um: float = 0.0) -> tuple[float, float]:
    """The heights at the two ends of the colours, never less than 50 um apart.

    They span the noise and the deepest damage; a few wild pixels, hundreds of um off where the detector took a wrong
    peak, would otherwise leave one colour for everything real.
    """
    finite = height_um[np.isfinite(height_um)]
    if not finite.size:
        return -LEAST_SPAN_UM / 2, LEAST_SPAN_UM / 2
    lowest, middle, highest = (float(value) for value in np.percentile(finite, [0.05, 50, 99.8]))
    noise = 1.4826 * float(np.median(np.abs(finite - middle)))
    reach = max(LEAST_SPAN_UM / 2, 8 * noise)
    low = max(lowest, middle - max(reach, 1.1 * deepest_um))
    high = min(highest, middle + reach)
    if high - low < LEAST_SPAN_UM:
        centre = (low + high) / 2
        low, high = centre - LEAST_SPAN_UM / 2, centre + LEAST_SPAN_UM / 2
    return low, high


def png(height_um: Float32, low: float, high: float, size: tuple[int, int]) -> str:
    """The heights as a base64 PNG of ``size`` (width, height) dots, undefined pixels hatched.

    Shrinking averages the measured pixels only; a dot is undefined where less than half of it was measured.
    """
    valid = np.isfinite(height_um)
    filled = np.where(valid, height_um, np.float32(0))
    way = cv2.INTER_AREA if size[0] < height_um.shape[1] or size[1] < height_um.shape[0] else cv2.INTER_NEAREST
    share = cv2.resize(valid.astype(np.float32), size, interpolation=way)
    total = cv2.resize(filled, size, interpolation=way)
    known = share >= 0.5
    picture = _coloured(np.where(known, total / np.where(known, share, 1), low).astype(np.float32), low, high)
    y, x = np.mgrid[0 : size[1], 0 : size[0]]
    stripe = ((x + y) // 4) % 2 == 0
    picture[~known] = (222, 222, 222)
    picture[~known & stripe] = (176, 176, 176)
    return _encoded(picture)


def _coloured(height_um: Float32, low: float, high: float) -> Bytes:
    grey = np.clip((height_um - low) / (high - low) * 255, 0, 255).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(grey, cv2.COLORMAP_CIVIDIS), dtype=np.uint8)


def _encoded(picture: Bytes) -> str:
    done, buffer = cv2.imencode(".png", picture)
    if not done:
        raise RuntimeError("OpenCV could not encode the picture as PNG.")
    return base64.b64encode(buffer.tobytes()).decode()
