"""One range image in, the numbers a foreman decides on out: the composition of everything in this folder.

The order matters and is the same for every caller (page, command, reprocessing): clean, reference, baseline, edge,
damage, noise, numbers. Two callers with two orders would report two volumes for one chip.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanning.errors import BadInput
from scanning.range_image import RangeImage
from scanning.surface.damage import (
    DamageFinding,
    Detection,
    detect,
    findings,
    lost_at_edge,
    owners,
)
from scanning.surface.edge import Edge, distance_to_edge_um, expected_surface, find_edge, roll_off
from scanning.surface.filters import Float32, Float64, Mask, dilate, label, wild_pixels
from scanning.surface.noise import Noise, local_noise, measure_noise, robust_sigma
from scanning.surface.plane import Plane, fit_plane
from scanning.surface.registration import Registration, check_comparable, find_shift, resample
from scanning.surface.roughness import Roughness, nesting_indices, parameters, scale_limited
from scanning.surface.settings import InspectionSettings
from scanning.surface.uncertainty import Budget, budget

#: The roughness patch keeps this distance from damage and from the edge.
KEEP_AWAY_UM = 100.0
#: Below this ratio to the instrument's noise a roughness is not resolvable.
RESOLVABLE = 1.5
#: Smallest group of undefined pixels at the edge worth a remark: length along the edge, depth behind the line.
REMARK_LOST_UM = (100.0, 50.0)


@dataclass(frozen=True)
class Measurement:
    """One number: code and label, value (None when it cannot be known), unit, standard uncertainty in the same unit.

    ``source`` says in one sentence (at most 300 characters) where the number came from and which uncertainty inputs
    were unknown. ``scope`` is "region", or "damage n".
    """

    code: str
    label: str
    value: float | None
    unit: str
    u: float | None
    source: str
    scope: str = "region"


@dataclass(frozen=True)
class SurfaceReport:
    """Everything found on one surface. Arrays are (rows, profiles) of the image as it was given.

    ``residual_um`` is height minus reference (plane, or plane and baseline), positive out of the material, NaN where
    not measured or not trusted. ``damage_labels`` holds the damage number per pixel, 0 elsewhere. ``edge_um`` is the
    edge recession per position along the edge, None without an edge.
    """

    measurements: list[Measurement]
    damages: list[DamageFinding]
    plane: Plane
    noise: Noise
    edge: Edge | None
    registration: Registration | None
    roughness: Roughness | None
    residual_um: Float32
    damage_labels: NDArray[np.int32]
    edge_um: Float64 | None
    edge_pitch_um: float
    settings: InspectionSettings
    row_pitch_um: float
    profile_pitch_um: float
    warnings: list[str] = field(default_factory=list)

    @property
    def sigma_um(self) -> float:
        """Robust standard deviation of single pixels about the reference, in um."""
        return self.noise.sigma_um

    @property
    def kappa(self) -> float:
        """Sum of the two-dimensional noise autocorrelation, measured from this image."""
        return self.noise.kappa

    @property
    def damage_mask(self) -> Mask:
        return np.asarray(self.damage_labels > 0)

    def measurement(self, code: str) -> Measurement:
        """Return the region's measurement of that code; KeyError when this surface has none."""
        for one in self.measurements:
            if one.code == code:
                return one
        raise KeyError(code)

    def to_json(self) -> dict[str, Any]:
        """Return the report without its images as plain JSON values; what is not known is null, never NaN."""
        edge = None
        if self.edge is not None:
            edge = {
                "side": self.edge.side,
                "straightness_um": self.edge.straightness_um,
                "sigma_um": self.edge.sigma_um,
                "rounded_um": self.edge.rounded_um,
                "points": self.edge.points,
                "pitch_um": self.edge_pitch_um,
                "recession_um": np.round(self.edge.recession_um, 2),
            }
        report: dict[str, Any] = {
            "format": "edgewatch-surface/1",
            "shape": list(self.residual_um.shape),
            "row_pitch_um": self.row_pitch_um,
            "profile_pitch_um": self.profile_pitch_um,
            "sigma_um": self.sigma_um,
            "kappa": self.kappa,
            "noise": dataclasses.asdict(self.noise),
            "plane": {
                "offset_um": self.plane.offset_um,
                "slope_rows_um_per_mm": self.plane.slope_rows_um_per_mm,
                "slope_profiles_um_per_mm": self.plane.slope_profiles_um_per_mm,
                "quadratic_um_per_mm2": list(self.plane.quadratic),
                "inlier_fraction": self.plane.inlier_fraction,
                "points": self.plane.points,
                "start": self.plane.start,
            },
            "measurements": [dataclasses.asdict(one) for one in self.measurements],
            "damages": [dataclasses.asdict(one) for one in self.damages],
            "edge": edge,
            "registration": dataclasses.asdict(self.registration) if self.registration else None,
            "settings": self.settings.to_json(),
            "warnings": list(self.warnings),
        }
        plain = _plain(report)
        assert isinstance(plain, dict)
        return plain


def inspect_surface(
    image: RangeImage,
    *,
    baseline: RangeImage | None = None,
    settings: InspectionSettings | None = None,
    calibration: object | None = None,
) -> SurfaceReport:
    """Measure wear and damage on one range image.

    ``baseline`` is a scan of the same region of the new tool; ``calibration`` anything with ``slope_mm_per_px`` and
    ``u_slope_mm_per_px`` (else the image's provenance is asked). Raises BadInput when the image cannot be measured:
    nothing measured, no plane agreed on by half of it, a baseline of another region. Cost: about 1 s per million
    pixels on one core.
    """
    settings = settings or InspectionSettings()
    _check(image, "range image")
    if baseline is not None:
        _check(baseline, "baseline")
    if settings.edge_axis == 0:
        turned = _inspect(_turn(image), _turn(baseline) if baseline else None, settings, calibration)
        return _turn_back(turned)
    return _inspect(image, baseline, settings, calibration)


def _check(image: RangeImage, name: str) -> None:
    if image.height_um.ndim != 2 or min(image.height_um.shape) < 8:
        raise BadInput(
            f"The {name} has shape {image.height_um.shape}; at least 8 rows and 8 profiles are needed to measure it."
        )
    for pitch_name in ("row_pitch_um", "profile_pitch_um"):
        pitch = getattr(image, pitch_name)
        if not (math.isfinite(pitch) and pitch > 0):
            raise BadInput(f"The {name} has {pitch_name} {pitch}; without a positive pitch nothing has a size.")
    if not np.isfinite(image.height_um).any():
        raise BadInput(f"No pixel of the {name} was measured; check that the laser line lay on the tool.")


def _turn(image: RangeImage) -> RangeImage:
    return dataclasses.replace(
        image,
        column_px=image.column_px.T,
        height_um=image.height_um.T,
        intensity=image.intensity.T,
        width_px=image.width_px.T,
        row_pitch_um=image.profile_pitch_um,
        profile_pitch_um=image.row_pitch_um,
    )


def _turn_back(report: SurfaceReport) -> SurfaceReport:
    """Give arrays and pixel indices back in the orientation of the image; lengths already run along the edge."""
    damages = [
        dataclasses.replace(
            one,
            rows=one.profiles,
            profiles=one.rows,
            mask_runs=tuple((first + step, row, 1) for row, first, length in one.mask_runs for step in range(length)),
        )
        for one in report.damages
    ]
    return dataclasses.replace(
        report,
        damages=damages,
        residual_um=np.ascontiguousarray(report.residual_um.T),
        damage_labels=np.ascontiguousarray(report.damage_labels.T),
        row_pitch_um=report.profile_pitch_um,
        profile_pitch_um=report.row_pitch_um,
    )


def _inspect(
    image: RangeImage, baseline: RangeImage | None, settings: InspectionSettings, calibration: object | None
) -> SurfaceReport:
    row_pitch, profile_pitch = image.row_pitch_um, image.profile_pitch_um
    warnings: list[str] = []
    height = _clean(image, settings, warnings)
    plane = fit_plane(height, row_pitch, profile_pitch, form=settings.form)
    residual = (height - plane.height_um()).astype(np.float32)
    residual = _without_wild(residual, row_pitch, profile_pitch, warnings)

    edge_reference: Float64 | None = None
    registration: Registration | None = None
    instrument_noise = settings.instrument_noise_um
    own_residual = residual
    if baseline is not None:
        residual, registration, edge_reference = _against_baseline(
            residual, baseline, (row_pitch, profile_pitch), settings, warnings
        )
    edge, remarks = find_edge(
        own_residual,
        np.isfinite(own_residual),
        row_pitch,
        profile_pitch,
        side=settings.edge_side,
        reference_row=edge_reference,
    )
    warnings += remarks

    rows = residual.shape[0]
    expected = expected_surface(edge, rows) if edge is not None else np.ones(residual.shape, dtype=bool)
    valid = np.isfinite(residual) & expected
    if np.count_nonzero(valid) < 200:
        raise BadInput(
            f"Only {np.count_nonzero(valid)} measured pixels remain on the bevel; check edge_side and the region."
        )
    noise = measure_noise(residual, valid, row_pitch, profile_pitch)
    if edge is not None and baseline is None:
        rounding = roll_off(residual, valid, edge, row_pitch, profile_pitch, noise.kappa)
        if rounding is not None:
            residual = residual - rounding
            warnings.append(
                "The surface falls away along the whole edge (rounding, or light lost at the brink); damage is "
                "measured from that prevailing shape, and the recession and rounded length describe the shape itself."
            )

    missing = detect(residual, valid, row_pitch, profile_pitch, settings, sign=-1)
    raised = detect(residual, valid, row_pitch, profile_pitch, settings, sign=+1)
    touched = (missing.labels > 0) | (raised.labels > 0)
    if touched.any():
        # Damage shallower than the fit's tolerance has pulled the reference a little towards itself: fit once more
        # without it, and look again.
        calm = valid & ~dilate(touched, 2.0 * settings.wide_scale_um, row_pitch, profile_pitch)
        if np.count_nonzero(calm) > max(1000, 0.2 * np.count_nonzero(valid)):
            again = fit_plane(residual, row_pitch, profile_pitch, form=settings.form, use=calm)
            residual = residual - again.height_um()
            plane = plane.shifted(again)
            missing = detect(residual, valid, row_pitch, profile_pitch, settings, sign=-1)
            raised = detect(residual, valid, row_pitch, profile_pitch, settings, sign=+1)
            touched = (missing.labels > 0) | (raised.labels > 0)
    sound = valid & ~dilate(touched, 2.0 * settings.wide_scale_um, row_pitch, profile_pitch)
    if np.count_nonzero(sound) < max(200, 0.05 * np.count_nonzero(valid)):
        sound = valid & ~touched
    if np.count_nonzero(sound) < 200:
        sound = valid
        warnings.append("Almost no undamaged surface is left; noise and uncertainties are upper bounds.")
    noise = measure_noise(residual, sound, row_pitch, profile_pitch)
    figures = budget(image, noise, int(np.count_nonzero(sound)), settings, calibration)

    distance = distance_to_edge_um(edge, rows, row_pitch) if edge is not None else None
    damages, labels = findings(
        missing,
        residual,
        valid,
        expected,
        distance,
        edge.recession_um.astype(np.float32) if edge is not None else None,
        row_pitch,
        profile_pitch,
        settings,
        figures,
    )
    _remark(image, residual, valid, expected, labels, noise, settings, calibration, warnings)

    away = valid & ~dilate(touched, KEEP_AWAY_UM, row_pitch, profile_pitch)
    if distance is not None:
        away &= distance > KEEP_AWAY_UM
    roughness = _roughness(residual, away, row_pitch, profile_pitch, settings)

    measurements = [
        *_damage_numbers(damages, labels, valid, expected, profile_pitch, figures, settings),
        *_burr_numbers(raised, residual, valid, row_pitch, profile_pitch, figures),
        *_edge_numbers(edge, edge_reference is not None, profile_pitch, figures),
        *_roughness_numbers(roughness, noise, instrument_noise, figures),
        *_quality_numbers(image, valid, expected, plane, noise, row_pitch, profile_pitch),
    ]
    return SurfaceReport(
        measurements=measurements,
        damages=damages,
        plane=plane,
        noise=noise,
        edge=edge,
        registration=registration,
        roughness=roughness,
        residual_um=np.where(valid, residual, np.float32(np.nan)).astype(np.float32),
        damage_labels=labels,
        edge_um=edge.recession_um if edge is not None else None,
        edge_pitch_um=profile_pitch,
        settings=settings,
        row_pitch_um=row_pitch,
        profile_pitch_um=profile_pitch,
        warnings=warnings,
    )


def _clean(image: RangeImage, settings: InspectionSettings, warnings: list[str]) -> Float32:
    """Heights with everything that is no measurement set to NaN (infinities as some X3P writers leave them)."""
    height = np.where(np.isfinite(image.height_um), image.height_um, np.float32(np.nan)).astype(np.float32)
    if settings.saturation_level is not None:
        saturated = np.isfinite(height) & (image.intensity >= settings.saturation_level)
        count = int(np.count_nonzero(saturated))
        if count:
            height[saturated] = np.nan
            warnings.append(f"{count} pixels with a saturated line ({100 * count / height.size:.1f} %) were not used.")
    return height


def _without_wild(residual: Float32, row_pitch: float, profile_pitch: float, warnings: list[str] | None) -> Float32:
    valid = np.isfinite(residual)
    noise = local_noise(residual, row_pitch, profile_pitch)
    if not noise > 0.0:
        return residual
    wild = wild_pixels(residual, valid, noise_um=noise, row_pitch_um=row_pitch, profile_pitch_um=profile_pitch)
    count = int(np.count_nonzero(wild))
    if not count:
        return residual
    if warnings is not None:
        warnings.append(
            f"{count} isolated wild pixels ({100 * count / max(np.count_nonzero(valid), 1):.2f} % of the measured) "
            "were set aside: wrong peaks smaller than the laser line can resolve."
        )
    return np.where(wild, np.float32(np.nan), residual).astype(np.float32)


def _against_baseline(
    residual: Float32,
    baseline: RangeImage,
    pitches: tuple[float, float],
    settings: InspectionSettings,
    warnings: list[str],
) -> tuple[Float32, Registration, Float64 | None]:
    """Residual against the registered baseline, how it was registered, and the baseline's edge line in today's rows."""
    other = np.where(np.isfinite(baseline.height_um), baseline.height_um, np.float32(np.nan)).astype(np.float32)
    other_plane = fit_plane(other, baseline.row_pitch_um, baseline.profile_pitch_um, form=settings.form)
    other = _without_wild(
        (other - other_plane.height_um()).astype(np.float32), baseline.row_pitch_um, baseline.profile_pitch_um, None
    )
    own_pitches = (baseline.row_pitch_um, baseline.profile_pitch_um)
    shape = (residual.shape[0], residual.shape[1])
    on_grid = resample(other, own_pitches, shape, pitches)
    both = np.isfinite(residual) & np.isfinite(on_grid)
    check_comparable(shape, other.shape, np.count_nonzero(both) / max(np.count_nonzero(np.isfinite(residual)), 1))
    calm = both & (np.abs(residual) < 6.0 * robust_sigma(residual[both]))
    calm &= np.abs(on_grid) < 6.0 * max(robust_sigma(on_grid[both]), 1e-6)
    row, profile, correlation, ratio, accepted = find_shift(residual, on_grid, calm, *pitches)
    if accepted:
        on_grid = resample(other, own_pitches, shape, pitches, (row, profile))
    else:
        row = profile = 0.0
        warnings.append(
            "The baseline was laid under this scan by its stage position only: the texture of a smooth bevel does not "
            "prove a shift along the edge."
        )
    difference = (residual - on_grid).astype(np.float32)
    plane = fit_plane(difference, *pitches, form="plane")
    difference = (difference - plane.height_um()).astype(np.float32)
    measured = np.isfinite(difference)
    registration = Registration(
        shift_rows_um=row,
        shift_profiles_um=profile,
        accepted=accepted,
        correlation=correlation,
        peak_ratio=ratio,
        overlap_share=float(np.count_nonzero(measured) / max(np.count_nonzero(np.isfinite(residual)), 1)),
        rms_um=robust_sigma(difference),
    )
    edge, _ = find_edge(other, np.isfinite(other), *own_pitches, side=settings.edge_side)
    if edge is None:
        return difference, registration, None
    index = (np.arange(shape[1]) * pitches[1] - profile) / own_pitches[1]
    line = np.polyfit(np.arange(edge.reference_row.size), edge.reference_row, 1)
    return difference, registration, (np.polyval(line, index) * own_pitches[0] + row) / pitches[0]


def _remark(
    image: RangeImage,
    residual: Float32,
    valid: Mask,
    expected: Mask,
    labels: NDArray[np.int32],
    noise: Noise,
    settings: InspectionSettings,
    calibration: object | None,
    warnings: list[str],
) -> None:
    """Say what a reader of the numbers must know and no number shows."""
    lost = lost_at_edge(valid, expected) & (labels == 0)
    groups, count = label(lost)
    pixel_area = image.row_pitch_um * image.profile_pitch_um
    for number in range(1, count + 1) if count <= 2000 else ():
        rows, profiles = np.nonzero(groups == number) if count <= 50 else (np.array([]), np.array([]))
        if rows.size == 0:
            continue
        length, depth = np.ptp(profiles) * image.profile_pitch_um, np.ptp(rows) * image.row_pitch_um
        if length >= REMARK_LOST_UM[0] and depth >= REMARK_LOST_UM[1] and rows.size * pixel_area > 1e4:
            start = settings.start_mm + float(profiles.min()) * image.profile_pitch_um / 1e3
            warnings.append(
                f"From {start:.2f} to {start + length / 1e3:.2f} mm along the edge nothing was measured over "
                f"{depth:.0f} um behind the edge line: material is gone or no light came back. It counts as edge "
                "recession, not as volume."
            )
    if noise.shape_um > max(1.0, 0.5 * noise.sigma_um):
        warnings.append(
            f"The surface is not flat: {noise.shape_um:.1f} um (standard deviation) remain after the reference is "
            "taken out. Small damage may hide in it; a baseline scan of the new tool removes it."
        )
    inside = getattr(calibration, "inside_range", None)
    if callable(inside):
        outside = np.isfinite(image.column_px) & np.isfinite(image.height_um) & ~np.asarray(inside(image.column_px))
        share = float(np.count_nonzero(outside)) / max(int(np.count_nonzero(np.isfinite(image.height_um))), 1)
        if share > 0:
            warnings.append(
                f"{100 * share:.1f} % of the heights lie outside the calibrated range; there the straight line of "
                "the calibration is an extrapolation."
            )


def _roughness(
    residual: Float32, sound: Mask, row_pitch: float, profile_pitch: float, settings: InspectionSettings
) -> Roughness | None:
    if np.count_nonzero(sound) < 500:
        return None
    s_index, l_index = nesting_indices(
        *residual.shape, row_pitch, profile_pitch, settings.s_filter_um, settings.l_filter_um
    )
    surface = scale_limited(residual, sound, row_pitch, profile_pitch, s_index, l_index)
    return parameters(surface, row_pitch, profile_pitch, s_index=s_index, l_index=l_index)


def _damage_numbers(
    damages: list[DamageFinding],
    labels: NDArray[np.int32],
    valid: Mask,
    expected: Mask,
    profile_pitch: float,
    figures: Budget,
    settings: InspectionSettings,
) -> list[Measurement]:
    length_mm = labels.shape[1] * profile_pitch / 1e3
    volume = sum(one.volume_mm3 for one in damages)
    # Noise is independent from damage to damage, the scale is common to all.
    scale = figures.scale or 0.0
    own = [math.sqrt(max(0.0, one.u_volume_mm3**2 - (one.volume_mm3 * scale) ** 2)) for one in damages]
    u_volume = math.hypot(*own, volume * scale)
    lower = sum(one.volume_lower_bound_mm3 for one in damages)
    area = sum(one.area_mm2 for one in damages)
    deepest = max(damages, key=lambda one: one.depth_um, default=None)
    covered = float(np.count_nonzero((labels > 0).any(axis=0))) * profile_pitch / 1e3
    found = f"{len(damages)} damages" if len(damages) != 1 else "1 damage"
    u_zero = figures.noise.sigma_um
    numbers = [
        Measurement(
            "V-",
            "Missing volume",
            volume,
            "mm3",
            u_volume,
            f"Signed sum of the residual over the widened mask of {found}; {figures.sentence}.",
        ),
        Measurement(
            "V-_lower",
            "Missing volume, measured pixels only",
            lower,
            "mm3",
            u_volume,
            "As V-, without any undefined pixel: at least this much is gone.",
        ),
        Measurement(
            "A",
            "Damaged area",
            area,
            "mm2",
            math.hypot(*(one.u_area_mm2 for one in damages)),
            "Projected area of all damage masks, undefined pixels inside counted.",
        ),
        Measurement(
            "d_max",
            "Largest damage depth",
            deepest.depth_um if deepest else 0.0,
            "um",
            deepest.u_depth_um if deepest else u_zero,
            f"Deepest point of the residual smoothed with {settings.small_scale_um:g} um inside the damage masks"
            + (f", damage {deepest.number}; " if deepest else "; no damage found; ")
            + f"{figures.sentence}.",
        ),
        Measurement(
            "n",
            "Number of damages",
            float(len(damages)),
            "1",
            None,
            f"Connected areas beyond {settings.seed_k:g} standard deviations of the smoothed image, at least "
            f"{settings.min_area_um2:g} um2, closer than {settings.join_um:g} um joined.",
        ),
        Measurement(
            "n_10mm",
            "Damages per 10 mm of edge",
            10.0 * len(damages) / length_mm,
            "1",
            None,
            f"n over {length_mm:.3f} mm of edge.",
        ),
        Measurement(
            "cov",
            "Damaged share of the edge",
            100.0 * covered / length_mm,
            "%",
            100.0 * math.hypot(*(one.u_length_mm for one in damages)) / length_mm,
            "Union of the damages' extents along the edge over its length.",
        ),
    ]
    if damages:
        longest = max(damages, key=lambda one: one.length_mm)
        numbers += [
            Measurement(
                "L_max",
                "Longest damage along the edge",
                longest.length_mm,
                "mm",
                longest.u_length_mm,
                f"Extent of damage {longest.number} along the edge.",
            ),
            Measurement(
                "d_99",
                "Damage depth, 99th percentile",
                max(one.d99_um for one in damages),
                "um",
                deepest.u_depth_um if deepest else None,
                f"Largest 99th percentile of the smoothed depth inside a damage mask; {figures.sentence}.",
            ),
            Measurement(
                "d_mean",
                "Mean damage depth",
                volume / area * 1e3,
                "um",
                u_volume / area * 1e3,
                f"V- over A; {figures.sentence}.",
            ),
        ]
    for one in damages:
        scope = f"damage {one.number}"
        where = f"Damage {one.number} at {one.s_start_mm:.3f} to {one.s_end_mm:.3f} mm along the edge"
        numbers += [
            Measurement(
                "V-", "Missing volume", one.volume_mm3, "mm3", one.u_volume_mm3, f"{where}; {figures.sentence}.", scope
            ),
            Measurement("d_max", "Depth", one.depth_um, "um", one.u_depth_um, f"{where}; {figures.sentence}.", scope),
            Measurement("A", "Area", one.area_mm2, "mm2", one.u_area_mm2, f"{where}.", scope),
            Measurement("L", "Length along the edge", one.length_mm, "mm", one.u_length_mm, f"{where}.", scope),
        ]
    return numbers


def _burr_numbers(
    raised: Detection, residual: Float32, valid: Mask, row_pitch: float, profile_pitch: float, figures: Budget
) -> list[Measurement]:
    pixel_area = row_pitch * profile_pitch
    if raised.count == 0:
        return [
            Measurement("V+", "Raised volume (burr)", 0.0, "mm3", 0.0, "No raised area was found."),
        ]
    owner = owners(raised, row_pitch, profile_pitch)
    inside = (owner > 0) & valid
    volume = float(residual[inside].sum(dtype=np.float64)) * pixel_area * 1e-9
    u_volume = figures.volume_mm3(volume, int(np.count_nonzero(inside)), pixel_area)
    height = float(np.nanmax(np.where((raised.labels > 0) & valid, raised.depth_image.value, np.nan)))
    profiles = (raised.labels > 0).any(axis=0)
    return [
        Measurement(
            "V+",
            "Raised volume (burr)",
            volume,
            "mm3",
            u_volume,
            f"Signed sum over the widened mask of {raised.count} raised areas; {figures.sentence}.",
        ),
        Measurement(
            "h_b",
            "Burr height",
            height,
            "um",
            figures.depth_um(height, raised.sigma_depth_um),
            f"Highest point of the smoothed residual in raised areas; {figures.sentence}.",
        ),
        Measurement(
            "L_b",
            "Burr length along the edge",
            float(np.count_nonzero(profiles)) * profile_pitch / 1e3,
            "mm",
            profile_pitch / 1e3,
            "Union of the raised areas' extents along the edge.",
        ),
    ]


def _edge_numbers(edge: Edge | None, from_baseline: bool, profile_pitch: float, figures: Budget) -> list[Measurement]:
    if edge is None:
        return []
    recession = edge.recession_um[np.isfinite(edge.recession_um)]
    if recession.size == 0:
        return []
    origin = (
        "against the edge line of the baseline scan"
        if from_baseline
        else "against the line through this scan's own undamaged edge, so uniform wear does not show"
    )
    pitch = figures.pitch or 0.0
    # Neighbouring edge points share speckle: about one independent point per 50 um.
    independent = max(1.0, recession.size * min(1.0, profile_pitch / 50.0))
    u_point = math.hypot(edge.sigma_um, 0.0)

    def u(value: float, points: float) -> float:
        return math.hypot(u_point / math.sqrt(points), value * pitch)

    mean, largest = float(recession.mean()), float(recession.max())
    p95, rms = float(np.percentile(recession, 95.0)), float(np.sqrt(np.mean(recession**2)))
    numbers = [
        Measurement(
            "ER_mean", "Edge recession, mean", mean, "um", u(mean, independent), f"Mean over the edge {origin}."
        ),
        Measurement(
            "ER_max", "Edge recession, largest", largest, "um", u(largest, 1.0), f"Largest 50 um median {origin}."
        ),
        Measurement("ER_p95", "Edge recession, 95th percentile", p95, "um", u(p95, 1.0), f"95th percentile {origin}."),
        Measurement("ER_rms", "Edge recession, rms", rms, "um", u(rms, independent), f"Root mean square {origin}."),
        Measurement(
            "EL",
            "Edge line straightness",
            edge.straightness_um,
            "um",
            u(edge.straightness_um, 1.0) * math.sqrt(2.0),
            "Span of the edge about its own robust line.",
        ),
    ]
    if math.isfinite(edge.rounded_um):
        numbers.append(
            Measurement(
                "l_r",
                "Rounded length at the edge",
                edge.rounded_um,
                "um",
                u(edge.rounded_um, independent),
                "Distance from the edge line to where the median surface stays within 3 standard deviations of the "
                "reference for 50 um; a substitute for an edge radius, which needs both faces.",
            )
        )
    return numbers


def _roughness_numbers(
    roughness: Roughness | None, noise: Noise, instrument_noise: float | None, figures: Budget
) -> list[Measurement]:
    if roughness is None:
        return []
    filters = f"S-filter {roughness.s_filter_um:g} um, L-filter {roughness.l_filter_um:g} um, damage and edge left out"
    # Independent points of the filtered surface: at least one per kappa pixels.
    independent = max(1.0, roughness.points / noise.kappa)
    scale = figures.scale or 0.0

    def u(value: float) -> float:
        return math.hypot(value / math.sqrt(2.0 * independent), value * scale)

    numbers = [
        Measurement(
            name,
            title,
            float(getattr(roughness, name)),
            "um",
            u(float(getattr(roughness, name))),
            f"ISO 25178-2; {filters}; instrument noise included.",
        )
        for name, title in (
            ("Sa", "Arithmetic mean height"),
            ("Sq", "Root mean square height"),
        )
    ]
    # Extremes carry the noise of single points of the filtered surface.
    numbers += [
        Measurement(
            name,
            title,
            float(getattr(roughness, name)),
            "um",
            math.hypot(roughness.Sq, float(getattr(roughness, name)) * scale),
            f"ISO 25178-2; {filters}; extremes of all points, noise peaks included.",
        )
        for name, title in (("Sz", "Maximum height"), ("Sp", "Maximum peak height"), ("Sv", "Maximum pit depth"))
    ]
    numbers += [
        Measurement("Ssk", "Skewness", roughness.Ssk, "1", math.sqrt(6.0 / independent), f"ISO 25178-2; {filters}."),
        Measurement(
            "Sku",
            "Kurtosis",
            roughness.Sku,
            "1",
            math.sqrt(24.0 / independent),
            f"ISO 25178-2, 3 for a Gaussian; {filters}.",
        ),
        Measurement(
            "Sdq",
            "Root mean square gradient",
            roughness.Sdq,
            "1",
            u(roughness.Sdq),
            f"ISO 25178-2, triangulated; {filters}.",
        ),
        Measurement(
            "Sdr",
            "Developed area ratio",
            roughness.Sdr,
            "%",
            2.0 * u(roughness.Sdr),
            f"ISO 25178-2, triangulated; {filters}.",
        ),
    ]
    title = "Root mean square height, noise corrected"
    if instrument_noise is None:
        text = (
            "Not resolvable: without the instrument's noise from a displaced repeat scan, Sq cannot be told from noise."
        )
        numbers.append(Measurement("Sq_c", title, None, "um", None, text))
    elif roughness.Sq < RESOLVABLE * instrument_noise:
        text = (
            f"Not resolvable: Sq {roughness.Sq:.2f} um is below {RESOLVABLE:g} times the instrument's noise of "
            f"{instrument_noise:.2f} um."
        )
        numbers.append(Measurement("Sq_c", title, None, "um", None, text))
    else:
        corrected = math.sqrt(roughness.Sq**2 - instrument_noise**2)
        text = f"Square root of Sq^2 - {instrument_noise:.2f}^2 (instrument noise from a displaced repeat); {filters}."
        numbers.append(Measurement("Sq_c", title, corrected, "um", u(roughness.Sq) * roughness.Sq / corrected, text))
    return numbers


def _quality_numbers(
    image: RangeImage,
    valid: Mask,
    expected: Mask,
    plane: Plane,
    noise: Noise,
    row_pitch: float,
    profile_pitch: float,
) -> list[Measurement]:
    on_bevel = int(np.count_nonzero(expected))
    undefined = 100.0 * float(np.count_nonzero(expected & ~valid)) / max(on_bevel, 1)
    inliers = 100.0 * plane.inlier_fraction
    independent = max(1.0, np.count_nonzero(valid) / noise.kappa)
    return [
        Measurement(
            "q_undef",
            "Undefined pixels",
            100.0 * image.undefined_share,
            "%",
            None,
            f"{image.undefined} of {image.height_um.size} pixels of the whole range image.",
        ),
        Measurement(
            "q_undef_bevel",
            "Undefined pixels on the bevel",
            undefined,
            "%",
            None,
            "Not measured or set aside as wild, on the tool's side of the edge line.",
        ),
        Measurement(
            "sigma",
            "Noise about the reference",
            noise.sigma_um,
            "um",
            noise.sigma_um / math.sqrt(2.0 * independent),
            f"1.4826 MAD of single pixels off damage, cell {profile_pitch:.4g} x {row_pitch:.4g} um; kappa "
            f"{noise.kappa:.2f}.",
        ),
        Measurement(
            "q_plane",
            "Surface agreeing with the plane",
            inliers,
            "%",
            None,
            f"Share of measured pixels within 3 noise standard deviations or 20 um of the reference; start {plane.start}.",
        ),
    ]


def _plain(value: Any) -> Any:
    """JSON values only: arrays to lists, numpy scalars to Python, NaN and infinities to null."""
    if isinstance(value, dict):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    if isinstance(value, np.ndarray):
        return [_plain(one) for one in value.tolist()]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
