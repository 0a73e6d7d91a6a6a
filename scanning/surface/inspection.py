"""One range image in, the numbers a foreman decides on out: the composition of everything in this folder.

The order matters and is the same for every caller (page, command, reprocessing): clean, reference, baseline, edge,
damage, noise, numbers. Two callers with two orders would report two volumes for one chip.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from scanning.errors import BadInput
from scanning.range_image import RangeImage
from scanning.surface.damage import DamageFinding, Detection, detect, findings, lost_at_edge, without_brink
from scanning.surface.edge import distance_to_edge_um, expected_surface, find_edge, roll_off
from scanning.surface.filters import Float32, Float64, Mask, dilate, label, too_narrow_to_see, wild_pixels
from scanning.surface.noise import Noise, local_noise, measure_noise, robust_sigma
from scanning.surface.numbers import burr_numbers, damage_numbers, edge_numbers, quality_numbers, roughness_numbers
from scanning.surface.plane import fit_plane
from scanning.surface.registration import Registration, check_comparable, find_shift, resample
from scanning.surface.report import SurfaceReport
from scanning.surface.roughness import Roughness, nesting_indices, parameters, scale_limited
from scanning.surface.settings import InspectionSettings
from scanning.surface.uncertainty import budget

#: The roughness patch keeps this distance from damage and from the edge.
SMALLEST_PITCH_UM, LARGEST_PITCH_UM = 0.01, 10_000.0
"""Outside these no laser line scans a tool; a pitch in metres or nanometres would ask for filters of any size."""
LARGEST_HEIGHT_UM = 1e6
"""A metre: beyond it a height is in another unit, and its squares leave the range of numbers."""
KEEP_AWAY_UM = 100.0
#: A damage deeper than this whose floor is flat is remarked on.
CLIFF_UM = 300.0
#: Scatter of single heights above which the heights themselves are in doubt.
LOUD_UM = 50.0
#: A damage across the whole bevel narrower than this is remarked on.
ACROSS_MM = 0.1
#: Smallest group of undefined pixels at the edge worth a remark: length along the edge, depth behind the line.
REMARK_LOST_UM = (100.0, 50.0)


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
        if not SMALLEST_PITCH_UM <= pitch <= LARGEST_PITCH_UM:
            raise BadInput(
                f"The {name} has {pitch_name} {pitch:g}, but a pitch lies between {SMALLEST_PITCH_UM:g} and "
                f"{LARGEST_PITCH_UM:g} um; check its unit."
            )
    if not np.isfinite(image.height_um).any():
        raise BadInput(f"No pixel of the {name} was measured; check that the laser line lay on the tool.")
    tallest = float(np.abs(image.height_um[np.isfinite(image.height_um)]).max())
    if tallest > LARGEST_HEIGHT_UM:
        raise BadInput(
            f"The {name} holds a height of {tallest:.3g} um, more than {LARGEST_HEIGHT_UM:g}; check its unit."
        )


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
    # The camera's view is tilted along the scan, whichever way the edge runs.
    aspect = settings.visible_aspect if settings.edge_axis == 1 else 0.0
    residual = _without_wild(residual, row_pitch, profile_pitch, aspect, warnings)

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

    def search(sign: int) -> Detection:
        found = detect(residual, valid, row_pitch, profile_pitch, settings, intensity=image.intensity, sign=sign)
        return found if edge is None else without_brink(found, residual, valid, edge.side, row_pitch)

    missing, raised = search(-1), search(+1)
    touched = (missing.labels > 0) | (raised.labels > 0)
    if touched.any():
        # Damage shallower than the fit's tolerance has pulled the reference a little towards itself: fit once more
        # without it, and look again.
        calm = valid & ~dilate(touched, 2.0 * settings.wide_scale_um, row_pitch, profile_pitch)
        if np.count_nonzero(calm) > max(1000, 0.2 * np.count_nonzero(valid)):
            again = fit_plane(residual, row_pitch, profile_pitch, form=settings.form, use=calm)
            residual = residual - again.height_um()
            plane = plane.shifted(again)
            missing, raised = search(-1), search(+1)
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
    _remark(image, residual, valid, expected, labels, damages, noise, settings, calibration, warnings)

    away = valid & ~dilate(touched, KEEP_AWAY_UM, row_pitch, profile_pitch)
    if distance is not None:
        away &= distance > KEEP_AWAY_UM
    roughness = _roughness(residual, away, row_pitch, profile_pitch, settings)

    measurements = [
        *damage_numbers(damages, labels, valid, expected, profile_pitch, figures, settings),
        *burr_numbers(raised, residual, valid, row_pitch, profile_pitch, figures),
        *edge_numbers(edge, edge_reference is not None, profile_pitch, figures),
        *roughness_numbers(roughness, noise, instrument_noise, figures),
        *quality_numbers(image, valid, expected, plane, noise, row_pitch, profile_pitch),
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


def _without_wild(
    residual: Float32, row_pitch: float, profile_pitch: float, visible_aspect: float, warnings: list[str] | None
) -> Float32:
    valid = np.isfinite(residual)
    noise = local_noise(residual, row_pitch, profile_pitch)
    if not noise > 0.0:
        return residual
    wild = wild_pixels(residual, valid, noise_um=noise, row_pitch_um=row_pitch, profile_pitch_um=profile_pitch)
    wild |= too_narrow_to_see(
        residual, valid & ~wild, noise_um=noise, profile_pitch_um=profile_pitch, aspect=visible_aspect
    )
    count = int(np.count_nonzero(wild))
    if not count:
        return residual
    if warnings is not None:
        share = 100.0 * count / int(np.count_nonzero(valid))
        warnings.append(
            f"{count} wild pixels ({share:.2f} % of the measured) were set aside: wrong peaks smaller than the laser "
            "line can resolve, without order, or deeper than a camera at 60 degrees can look into so narrow a gap."
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
        (other - other_plane.height_um()).astype(np.float32),
        baseline.row_pitch_um,
        baseline.profile_pitch_um,
        settings.visible_aspect,
        None,
    )
    own_pitches = (baseline.row_pitch_um, baseline.profile_pitch_um)
    shape = (residual.shape[0], residual.shape[1])
    on_grid = resample(other, own_pitches, shape, pitches)
    both = np.isfinite(residual) & np.isfinite(on_grid)
    check_comparable(shape, other.shape, np.count_nonzero(both) / max(int(np.count_nonzero(np.isfinite(residual))), 1))
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
        overlap_share=float(np.count_nonzero(measured) / max(int(np.count_nonzero(np.isfinite(residual))), 1)),
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
    damages: list[DamageFinding],
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
    if noise.sigma_um > LOUD_UM:
        warnings.append(
            f"Single heights scatter by {noise.sigma_um:.0f} um, far more than a laser line on metal: most of them may "
            "be wrong peaks. Look at the scan images before trusting any number here."
        )
    bevel_rows = np.count_nonzero(expected.any(axis=1))
    for one in damages:
        if one.rows[1] - one.rows[0] > 0.9 * bevel_rows and one.length_mm < ACROSS_MM:
            warnings.append(
                f"Damage {one.number} crosses the whole bevel but is only {1e3 * one.length_mm:.0f} um wide; a jump of "
                "the stage looks the same. Scan again before acting on it."
            )
    for one in damages:
        if one.depth_um > CLIFF_UM and one.mean_depth_um > 0.8 * one.depth_um:
            warnings.append(
                f"Damage {one.number} is a flat floor {one.depth_um:.0f} um down without slopes; a reflection taken "
                "for the laser line looks the same. Look at the scan images there before acting on it."
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
        residual.shape[0], residual.shape[1], row_pitch, profile_pitch, settings.s_filter_um, settings.l_filter_um
    )
    surface = scale_limited(residual, sound, row_pitch, profile_pitch, s_index, l_index)
    return parameters(surface, row_pitch, profile_pitch, s_index=s_index, l_index=l_index)
