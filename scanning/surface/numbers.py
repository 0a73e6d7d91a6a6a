"""The list of measurements: every metric's code, unit, uncertainty and one sentence of origin, in one place.

Codes are those of the metric set (V-, A, d_max, ER_mean, Sa ...). A new metric is one more entry here; pages, exports
and limits find it by its code.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from scanning.range_image import RangeImage
from scanning.surface.damage import DamageFinding, Detection, owners
from scanning.surface.edge import Edge
from scanning.surface.filters import Float32, Mask
from scanning.surface.noise import Noise
from scanning.surface.plane import Plane
from scanning.surface.report import Measurement
from scanning.surface.roughness import Roughness
from scanning.surface.settings import InspectionSettings
from scanning.surface.uncertainty import Budget

#: Below this ratio to the instrument's noise a roughness is not resolvable.
RESOLVABLE = 1.5


def damage_numbers(
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
            f"Deepest point inside the damage masks: of the residual smoothed with {settings.small_scale_um:g} um, "
            "freed of noise, plus what smoothing filled in"
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


def burr_numbers(
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


def edge_numbers(edge: Edge | None, from_baseline: bool, profile_pitch: float, figures: Budget) -> list[Measurement]:
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
    u_point = edge.sigma_um

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


def roughness_numbers(
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


def quality_numbers(
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
            f"Share of measured pixels within 3 noise standard deviations or 20 um of it; start {plane.start}.",
        ),
    ]
