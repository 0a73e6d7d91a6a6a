"""Space-time analysis: where the line was on each point of the surface, instead of where it seems to be in each image.

In one image a bright spot of the surface, or a bright grain of speckle, on one flank of the line pulls the centre of
gravity to its side. But the spot moves on with the stage, ``px_per_step`` pixels per step, and the line passes over it:
followed along this diagonal through the images, the light of one surface point rises and falls as the line itself does,
whatever the point's brightness. The centre of gravity in time says when the line was on the point, so where the point
was (Curless and Levoy, "Better optical triangulation through spacetime analysis", 1995).

A pixel sees no point, though, but a patch as wide as the lens blurs, and the brighter side of the patch is lit sooner
or later than its middle. So where brightness rises by a share g per pixel, the centre of gravity in the image is off by
+g (line)^2 and the one in time by -g (blur)^2, with standard deviations in px: the two errors are opposite, and the
column that lies between them in the ratio of the squares has none. Neither answer contains more of the height than the
other, so going only a ``share`` of the way from one to the other leaves the response at 1.00. The share, (line)^2 over
(line)^2 + (blur)^2, is seen from the images: with it neighbouring rows agree best. Simulated coherent speckle, cell
42 x 7 um, sigma of the mean image, in time, and between them: f/4 3.4, 2.1, 1.6 um; f/5.6 4.4, 3.0, 2.2 um; f/8 5.5,
4.4, 2.9 um; the best shares were 0.68, 0.63, 0.57.

Around the column that SCI, MSNN and COG found at profile n, one diagonal per image of the SCI window is followed,
through the columns of the line's base, less the pedestal (see centroid.py); light between columns is interpolated. The
light-weighted mean of their centres is the column in time (once: repeated it only adds noise and the pixels' grid).

A diagonal needs images before and behind its own. Near the ends of a scan it is cut on both sides alike, for a line cut
on one side would seem to have moved; cut diagonals tell less and have shares of their own. Which way the surface moves
is seen from the first profile whose diagonals are whole: the way that makes neighbouring rows agree better.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from scanning.pipeline.grey import grey

MOST_STEPS = 12
"""Images looked at on each side of a point's own; with smaller steps than this reaches, the gain is not worth it."""
TIE_PX = 1e-9
"""Rounding must not decide which way the surface moves."""
USUAL_SHARE = 0.6
USUAL_ROWS = 30
"""What the share is before any row was seen, and how many rows it takes to outweigh that."""
OUTLIER = 4.0
"""Rows that differ by more than this many standard deviations from the next are a step, a damage or a wrong peak."""
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]


def px_per_step(step_um: float, mm_per_pixel: float, angle_deg: float) -> float:
    """How far a surface point moves on the sensor per step, px: step x tan(angle) / height per pixel.

    With height p / (M cos a) and way along the scan p / (M sin a) per pixel, a the angle between laser plane and
    viewing direction's normal (60 degrees on the paper's rig: 8.33 um are 1.009 px).
    """
    return step_um * math.tan(math.radians(angle_deg)) / (mm_per_pixel * 1000.0)


@nb.njit(cache=True, nogil=True)
def follow_points(  # type: ignore[no-untyped-def]
    images, centre, before, behind, half_window, steps, speed, column_px, base, pedestal, top, scale, dark, corrected
):
    """Write the columns in time, NaN where ``column_px`` is.

    ``images`` is a ring: image n of the scan lies at n modulo its length; ``centre`` is the profile's own, with
    ``before`` images before and ``behind`` images behind it. ``speed`` in px per step with its sign; base (rows, 2)
    first and last column; pedestal (rows,) in light of one image.
    """
    count, _, columns = images.shape
    for r in range(column_px.size):
        corrected[r] = column_px[r]
        if np.isnan(column_px[r]):
            continue
        lowest = max(0.0, base[r, 0] - 1.0)
        highest = min(columns - 1.0, base[r, 1] + 1.0)
        total = 0.0
        moment = 0.0
        for k in range(-steps, steps + 1):
            x = column_px[r] + speed * k
            if not lowest <= x <= highest:
                continue
            left = min(int(x), columns - 2)
            share = x - left
            # The diagonal of image j is cut to equal lengths on both sides.
            for j in range(max(-half_window, abs(k) - before), min(half_window, behind - abs(k)) + 1):
                image = (centre + j + k) % count
                light = (1.0 - share) * grey(images[image, r, left], top, scale, dark)
                light += share * grey(images[image, r, left + 1], top, scale, dark)
                light -= pedestal[r]
                if light > 0.0:
                    total += light
                    moment += light * k
        if total > 0.0:
            corrected[r] += speed * moment / total


def roughness(column_px: Float64) -> float:
    """Median difference between neighbouring rows, px; NaN when there are none."""
    steps = np.abs(np.diff(column_px))
    steps = steps[np.isfinite(steps)]
    return float(np.median(steps)) if steps.size else math.nan


@dataclass
class Share:
    """How far to go from the centre of gravity in the image towards the one in time: least squares over row steps.

    From row to row the surface hardly changes, so what changes is error. The share is the one with which the errors of
    all rows so far add up to least; ``given`` fixes it.
    """

    given: float | None = None
    together: float = 0.0
    alone: float = 0.0
    rows: int = 0

    @property
    def value(self) -> float:
        if self.given is not None:
            return self.given
        if self.alone <= 0.0:
            return USUAL_SHARE
        seen = min(1.0, max(0.0, self.together / self.alone))
        return (seen * self.rows + USUAL_SHARE * USUAL_ROWS) / (self.rows + USUAL_ROWS)

    def learn(self, in_image_px: Float64, in_time_px: Float64) -> None:
        """Add the rows of one profile."""
        steps, apart = np.diff(in_image_px), np.diff(in_time_px - in_image_px)
        good = np.isfinite(steps) & np.isfinite(apart)
        for values in (steps, apart):
            if good.any():
                good &= np.abs(np.nan_to_num(values)) <= OUTLIER * 1.4826 * np.median(np.abs(values[good]))
        self.together -= float(np.dot(steps[good], apart[good]))
        self.alone += float(np.dot(apart[good], apart[good]))
        self.rows += int(np.count_nonzero(good))


@dataclass
class Waiting:
    """A profile whose later images are not there yet: its line, and what else comes out with it."""

    image: int
    column_px: Float64
    base: Int64
    pedestal: Float64
    rest: Any


class SpaceTime:
    """Keep the last images and correct each profile as soon as its last image is in.

    ``speed_px`` per step, above 0; ``direction`` 1: the surface moves to higher columns, -1: to lower, 0: to be seen.
    ``window`` images of SCI (odd), ``reach_px`` to how far from the line its light is followed, ``share`` of the way
    to the centre of gravity in time (None: to be seen).
    """

    def __init__(
        self, rows: int, columns: int, window: int, speed_px: float, direction: int, reach_px: float,
        top: int, scale: int, dark: int, share: float | None = None,
    ) -> None:  # fmt: skip
        self._half = window // 2
        self._speed = speed_px
        self.direction = direction
        self._given = share
        self._shares: dict[int, Share] = {}
        self._steps = min(MOST_STEPS, max(1, math.ceil(reach_px / speed_px)))
        self._ring: NDArray[Any] | None = None
        self._shape = (2 * (self._half + self._steps) + 1, rows, columns)
        self._grey = (top, scale, dark)
        self._seen = 0
        self._waiting: deque[Waiting] = deque()

    @property
    def share(self) -> float:
        """Of the way to the centre of gravity in time, as seen so far from whole diagonals."""
        return self._share_of(self._half + self._steps).value

    def _share_of(self, reach: int) -> Share:
        return self._shares.setdefault(reach, Share(self._given))

    def add(self, image: NDArray[Any]) -> None:
        """Keep a copy of the next image."""
        if self._ring is None:
            self._ring = np.zeros(self._shape, image.dtype)
        self._ring[self._seen % self._shape[0]] = image
        self._seen += 1

    def wait(self, column_px: Float64, base: Int64, pedestal: Float64, rest: Any) -> None:
        """Hand over the profile of the window that ends with the image added last."""
        self._waiting.append(Waiting(self._seen - 1 - self._half, column_px, base, pedestal, rest))

    def ready(self, *, end: bool = False) -> list[tuple[Float64, Any]]:
        """(column_px, rest) of the profiles whose images are all there; at the ``end`` of all others too."""
        out: list[tuple[Float64, Any]] = []
        need = self._half + self._steps
        while self._waiting:
            wanted = self._waiting[0].image + need
            if self.direction == 0:
                # The first ones wait for the first whole diagonals, which show the way.
                wanted = max(wanted, 2 * need)
            if not end and self._seen - 1 < wanted:
                break
            if self.direction == 0:
                self.direction = self._way()
            one = self._waiting.popleft()
            out.append((self._corrected(one), one.rest))
        return out

    def _reach(self, one: Waiting) -> tuple[int, int]:
        need = self._half + self._steps
        return min(need, one.image), min(need, self._seen - 1 - one.image)

    def _way(self) -> int:
        """Which way the surface moves, from the waiting profile with the longest diagonals; 0 when it has no rows."""
        one = max(self._waiting, key=lambda waiting: min(self._reach(waiting)))
        rough = {way: roughness(self._followed(one, way)) for way in (-1, 1)}
        if math.isnan(rough[1]):
            return 0
        return -1 if rough[-1] <= rough[1] + TIE_PX else 1

    def _corrected(self, one: Waiting) -> Float64:
        if self.direction == 0:
            return one.column_px
        in_time_px = self._followed(one, self.direction)
        share = self._share_of(min(self._reach(one)))
        share.learn(one.column_px, in_time_px)
        return one.column_px + share.value * (in_time_px - one.column_px)

    def _followed(self, one: Waiting, way: int) -> Float64:
        assert self._ring is not None
        out = np.empty_like(one.column_px)
        follow_points(
            self._ring, one.image, *self._reach(one), self._half, self._steps, way * self._speed, one.column_px,
            one.base, one.pedestal, *self._grey, out,
        )  # fmt: skip
        return out
