"""The reference a damage is measured from: a plane (or a shallow bowl) that ignores the damage.

An ordinary least-squares plane is pulled into every chip and makes the sound surface around it look raised. This one
weighs points by how well they agree (Tukey's bisquare), starts from two places so that a half-ruined bevel does not
capture it, and says how much of the surface agrees. Below half it refuses: then no plane is the right one.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal

import numpy as np

from scanning.errors import BadInput
from scanning.surface.filters import Float32, Float64, Mask
from scanning.surface.noise import MAD_TO_SIGMA, local_noise

Form = Literal["plane", "quadratic"]

#: Tukey's tuning constant: 95 % efficiency on Gaussian noise.
TUKEY_C = 4.685
ITERATIONS = 10
RANSAC_DRAWS = 300
#: More points than this do not make the fit better, only slower.
FIT_POINTS = 200_000
#: A sound bevel may deviate this much from a plane and still count as agreeing with it.
FLATNESS_UM = 20.0
LEAST_INLIERS = 0.5


@dataclass(frozen=True)
class Plane:
    """z = offset + slope_rows * y + slope_profiles * x (+ quadratic terms), y and x in mm from the image centre.

    Slopes are in um per mm. ``quadratic`` holds the coefficients of y^2, x y and x^2 in um per mm^2, empty for a
    plane. ``inlier_fraction`` is the share of measured pixels within 3 noise standard deviations (or 20 um, a sound
    bevel's own shape); ``points`` how many measured pixels there were.
    """

    offset_um: float
    slope_rows_um_per_mm: float
    slope_profiles_um_per_mm: float
    quadratic: tuple[float, ...]
    sigma_um: float
    inlier_fraction: float
    points: int
    start: Literal["least squares", "ransac"]
    shape: tuple[int, int]
    row_pitch_um: float
    profile_pitch_um: float

    @property
    def coefficients(self) -> Float64:
        return np.array([self.offset_um, self.slope_rows_um_per_mm, self.slope_profiles_um_per_mm, *self.quadratic])

    def height_um(self) -> Float32:
        """Return the reference heights, shape (rows, profiles)."""
        y, x = _axes(self.shape, self.row_pitch_um, self.profile_pitch_um)
        height = self.offset_um + self.slope_rows_um_per_mm * y[:, None] + self.slope_profiles_um_per_mm * x[None, :]
        if self.quadratic:
            yy, xy, xx = self.quadratic
            height = height + yy * y[:, None] ** 2 + xy * y[:, None] * x[None, :] + xx * x[None, :] ** 2
        return height.astype(np.float32)

    def shifted(self, correction: Plane) -> Plane:
        """Return this reference plus the one fitted to what it left over."""
        return dataclasses.replace(
            self,
            offset_um=self.offset_um + correction.offset_um,
            slope_rows_um_per_mm=self.slope_rows_um_per_mm + correction.slope_rows_um_per_mm,
            slope_profiles_um_per_mm=self.slope_profiles_um_per_mm + correction.slope_profiles_um_per_mm,
            quadratic=tuple(a + b for a, b in zip(self.quadratic, correction.quadratic, strict=True)),
            sigma_um=correction.sigma_um,
        )

    @property
    def area_factor(self) -> float:
        """True area over projected area, sqrt(1 + p^2 + q^2)."""
        return float(np.sqrt(1.0 + (self.slope_rows_um_per_mm / 1e3) ** 2 + (self.slope_profiles_um_per_mm / 1e3) ** 2))


def _axes(shape: tuple[int, int], row_pitch_um: float, profile_pitch_um: float) -> tuple[Float64, Float64]:
    """Positions in mm from the centre of the image, so that the normal equations stay well conditioned."""
    y = (np.arange(shape[0]) - (shape[0] - 1) / 2) * row_pitch_um / 1e3
    x = (np.arange(shape[1]) - (shape[1] - 1) / 2) * profile_pitch_um / 1e3
    return np.asarray(y, dtype=np.float64), np.asarray(x, dtype=np.float64)


def _design(y: Float64, x: Float64, form: Form) -> Float64:
    columns = [np.ones_like(y), y, x]
    if form == "quadratic":
        columns += [y * y, y * x, x * x]
    return np.stack(columns, axis=1)


def _solve(design: Float64, z: Float64) -> Float64:
    return np.asarray(np.linalg.lstsq(design, z, rcond=None)[0], dtype=np.float64)


def least_squares_plane(
    height_um: Float32, row_pitch_um: float, profile_pitch_um: float, *, form: Form = "plane"
) -> Float64:
    """Ordinary least-squares coefficients (offset um, um/mm along rows, um/mm along profiles[, quadratic]).

    The plane of eq. (9) of the paper and of every roughness program; use it on undamaged patches only.
    """
    rows, profiles = np.nonzero(np.isfinite(height_um))
    y, x = _axes(height_um.shape[:2], row_pitch_um, profile_pitch_um)
    design = _design(y[rows], x[profiles], form)
    return _solve(design, height_um[rows, profiles].astype(np.float64))


def fit_plane(
    height_um: Float32, row_pitch_um: float, profile_pitch_um: float, *, form: Form = "plane", use: Mask | None = None
) -> Plane:
    """Fit the robust reference to the finite pixels (of ``use``, when given) of ``height_um`` (rows, profiles).

    Raises BadInput when fewer than 200 pixels are measured, when they lie on one line, or when less than half of
    them agree with the best reference found.
    """
    valid = np.isfinite(height_um) if use is None else np.isfinite(height_um) & use
    points = int(np.count_nonzero(valid))
    if points < 200:
        raise BadInput(
            f"Only {points} of {height_um.size} pixels of the range image were measured, too few for a reference "
            "plane; scan again with a longer exposure or check that the line lies on the tool."
        )
    rows, profiles = np.nonzero(valid)
    if points > FIT_POINTS:
        # An odd stride walks through all rows and profiles; a random draw would make results hard to repeat.
        stride = points // FIT_POINTS | 1
        rows, profiles = rows[::stride], profiles[::stride]
    if np.ptp(rows) < 4 or np.ptp(profiles) < 4:
        raise BadInput(
            f"The measured pixels span only {np.ptp(rows) + 1} rows and {np.ptp(profiles) + 1} profiles, "
            "which defines no reference plane; scan a larger region."
        )
    y, x = _axes(height_um.shape[:2], row_pitch_um, profile_pitch_um)
    design = _design(y[rows], x[profiles], form)
    z = height_um[rows, profiles].astype(np.float64)
    noise = max(local_noise(np.where(valid, height_um, np.float32(np.nan)), row_pitch_um, profile_pitch_um), 1e-9)
    if not np.isfinite(noise):
        noise = 1e-9
    block_design, block_z = _block_medians(height_um, valid, y, x, form)

    first = _solve(block_design, block_z)
    fits: list[tuple[float, Float64, float, Literal["least squares", "ransac"]]] = []
    tolerance = max(3.0 * noise, 1e-6)
    coefficients, sigma = _reweighted(design, z, first)
    fits.append((_share(design, z, coefficients, tolerance), coefficients, sigma, "least squares"))
    if fits[0][0] < 0.9:
        drawn = _ransac(block_design, block_z, tolerance)
        coefficients, sigma = _reweighted(design, z, drawn)
        fits.append((_share(design, z, coefficients, tolerance), coefficients, sigma, "ransac"))
    # The second start must be clearly better: on a sound surface both end in the same place.
    best = fits[1] if len(fits) > 1 and fits[1][0] > fits[0][0] * 1.01 else fits[0]
    share, coefficients, sigma, start = best
    share = _share(design, z, coefficients, max(tolerance, FLATNESS_UM))
    if share < LEAST_INLIERS:
        raise BadInput(
            f"Only {100 * share:.0f} % of the measured pixels lie within {max(tolerance, FLATNESS_UM):.0f} um of the "
            "best reference plane, so damage has nothing to be measured from; inspect against a baseline scan of the "
            "new tool, or choose a region with more sound surface."
        )
    return Plane(
        offset_um=float(coefficients[0]),
        slope_rows_um_per_mm=float(coefficients[1]),
        slope_profiles_um_per_mm=float(coefficients[2]),
        quadratic=tuple(float(value) for value in coefficients[3:]),
        sigma_um=sigma,
        inlier_fraction=share,
        points=points,
        start=start,
        shape=(height_um.shape[0], height_um.shape[1]),
        row_pitch_um=row_pitch_um,
        profile_pitch_um=profile_pitch_um,
    )


def _block_medians(height_um: Float32, valid: Mask, y: Float64, x: Float64, form: Form) -> tuple[Float64, Float64]:
    """Median height per block of a grid of at most 48 x 48: spikes are gone, and starts are cheap to try."""
    size = tuple(max(1, min(length // 8, -(-length // 48))) for length in height_um.shape)
    count = tuple(length // step for length, step in zip(height_um.shape, size, strict=True))
    inner = tuple(n * step for n, step in zip(count, size, strict=True))
    split = (count[0], size[0], count[1], size[1])
    blocks = np.where(valid, height_um, np.float32(np.nan))[: inner[0], : inner[1]]
    blocks = np.sort(blocks.reshape(split).transpose(0, 2, 1, 3).reshape(count[0] * count[1], -1), axis=1)
    measured = np.count_nonzero(np.isfinite(blocks), axis=1)  # np.sort puts NaN last
    full = measured * 2 >= blocks.shape[1]
    if np.count_nonzero(full) < 12:
        full = measured > 0
    median = np.take_along_axis(blocks, np.maximum(measured - 1, 0)[:, None] // 2, axis=1)[:, 0]
    centre_y = np.repeat(y[: inner[0]].reshape(count[0], -1).mean(axis=1), count[1])
    centre_x = np.tile(x[: inner[1]].reshape(count[1], -1).mean(axis=1), count[0])
    return _design(centre_y[full], centre_x[full], form), median[full].astype(np.float64)


def _reweighted(design: Float64, z: Float64, coefficients: Float64) -> tuple[Float64, float]:
    """Iteratively reweighted least squares with Tukey's weights; returns coefficients and the robust sigma."""
    sigma = 0.0
    for _ in range(ITERATIONS):
        residual = z - design @ coefficients
        sigma = float(MAD_TO_SIGMA * np.median(np.abs(residual)))
        if sigma <= 1e-12:
            break
        weight = np.clip(1.0 - (residual / (TUKEY_C * sigma)) ** 2, 0.0, None) ** 2
        normal = design.T @ (design * weight[:, None])
        updated = _solve(normal, design.T @ (weight * z))
        if np.max(np.abs(updated - coefficients)) < 1e-9 * max(1.0, sigma):
            coefficients = updated
            break
        coefficients = updated
    return coefficients, sigma


def _ransac(design: Float64, z: Float64, tolerance: float) -> Float64:
    """Best of 300 references through as many points as they have parameters, by number of agreeing blocks.

    The seed is fixed: the same image must give the same numbers every time.
    """
    rng = np.random.default_rng(20170925)
    parameters = design.shape[1]
    best, best_count = _solve(design, z), -1
    for _ in range(RANSAC_DRAWS):
        chosen = rng.choice(z.size, size=parameters, replace=False)
        if np.linalg.matrix_rank(design[chosen]) < parameters:
            continue
        candidate = _solve(design[chosen], z[chosen])
        count = int(np.count_nonzero(np.abs(z - design @ candidate) <= tolerance))
        if count > best_count:
            best, best_count = candidate, count
    agreeing = np.abs(z - design @ best) <= tolerance
    if np.count_nonzero(agreeing) >= parameters:
        best = _solve(design[agreeing], z[agreeing])
    return best


def _share(design: Float64, z: Float64, coefficients: Float64, tolerance: float) -> float:
    return float(np.mean(np.abs(z - design @ coefficients) <= tolerance))
