"""Where material is missing, and how much.

Two Gaussian images of the residual are searched (15 um for small pits, 30 um for shallow wide ones), each threshold
scaled by the noise that applies at that pixel. The volume is the SIGNED sum over a widened mask: adding up only what
lies below the plane would find 0.024 mm3, a large damage, on a flawless plate (measuring.md, fact 9), and the raw
minimum of 2000 noisy pixels is 14 um deep on a surface without a scratch.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, stats

from scanning.surface.filters import (
    EIGHT,
    Float32,
    Mask,
    Smoothed,
    dilate,
    gaussian_kernel,
    hysteresis,
    label,
    sigma_px,
    smooth,
)
from scanning.surface.noise import Noise, robust_sigma
from scanning.surface.settings import InspectionSettings
from scanning.surface.uncertainty import Budget
from scanning.surface.uneven import by_light, by_place

Labels = NDArray[np.int32]

#: The lightest smoothing: enough to tame single pixels, too little to move a wall.
LIGHT_UM = 7.0
#: A kernel narrower than this many pixels does not smooth: wide pitches get this much.
LEAST_PX = 0.7
#: A smoothed value counts only where this share of the kernel was measured.
LEAST_DENSITY = 0.25
#: Chance of a false alarm per image and scale; a larger image has more places where noise can look like damage.
FALSE_ALARMS = 0.001
#: A shallow rim is followed outward in rings this wide, while their mean loss is this many times its uncertainty.
RING_UM = 15.0
RING_K = 3.0
RING_SHARE = 0.05
FURTHEST_RING_UM = 150.0
#: Missing material that reaches no further than this behind the end of the light is the edge's own wear.
BRINK_UM = 60.0
#: Relative standard uncertainty of what is added to a depth for smoothing: damages are rounded, conical or stepped.
U_FILLED_IN = 0.75
#: Brightness of damage against the surface around it, logarithm: usually up to half or double.
U_LOG_CONTRAST = 0.4
#: Draws of noise with which the excess of a largest value over the true one is estimated.
NOISE_DRAWS = 24
#: Enclosed sound islands up to this many times the least damage area belong to the damage.
ISLAND_AREAS = 20.0


@dataclass(frozen=True)
class DamageFinding:
    """One damage. Rows and profiles are pixel indices, half open; s runs along the edge from the tool's datum.

    ``volume_mm3`` includes undefined pixels enclosed by the damage, interpolated; ``volume_lower_bound_mm3`` only
    what was measured; ``volume_interpolated_mm3`` also undefined pixels open to the edge. ``depth_um`` is the deepest
    point: of the residual smoothed with 15 um, less what noise adds to a largest value, plus what smoothing filled in;
    ``d99_um`` the 99th percentile of the smoothed residual inside the mask.
    ``mask_runs`` lists the mask as [row, first profile, length].
    """

    number: int
    severity: str
    volume_mm3: float
    u_volume_mm3: float
    volume_lower_bound_mm3: float
    volume_interpolated_mm3: float
    depth_um: float
    u_depth_um: float
    d99_um: float
    mean_depth_um: float
    area_mm2: float
    u_area_mm2: float
    length_mm: float
    u_length_mm: float
    s_start_mm: float
    s_end_mm: float
    s_centroid_mm: float
    width_mm: float
    touches_edge: bool
    edge_recession_um: float | None
    undefined_pixels: int
    pixels: int
    rows: tuple[int, int]
    profiles: tuple[int, int]
    mask_runs: tuple[tuple[int, int, int], ...]


def without_brink(
    found: Detection, residual_um: Float32, valid: Mask, side: Literal["first", "last"], row_pitch_um: float
) -> Detection:
    """Leave out what lies at the very edge only, within some two line widths of where the light ends.

    There the line's image is cut off by the edge and by the worn rounding, so single heights are off by tens of
    micrometres; a chip that matters reaches further into the bevel. What is left out here still counts as edge
    recession. ``side`` is the end of the rows at which the edge is.
    """
    if found.count == 0:
        return found
    rows = residual_um.shape[0]
    seen = valid if side == "first" else valid[::-1]
    behind = np.arange(rows)[:, None] - np.argmax(seen, axis=0)[None, :]
    distance_um = (behind if side == "first" else behind[::-1]) * row_pitch_um
    clear = valid & (np.abs(residual_um) > 3.0 * found.sigma_depth_um)
    furthest = ndimage.maximum(np.where(clear, distance_um, -1.0), found.labels, index=np.arange(1, found.count + 1))
    kept = np.flatnonzero(np.asarray(furthest) > BRINK_UM) + 1
    renumbered = np.zeros(found.count + 1, dtype=np.int32)
    renumbered[kept] = np.arange(1, kept.size + 1)
    return dataclasses.replace(
        found,
        labels=renumbered[found.labels],
        count=int(kept.size),
        reach_um=tuple(found.reach_um[number - 1] for number in kept),
    )


@dataclass(frozen=True)
class Detection:
    """Numbered masks of one sign. ``reach_um`` is how far each must be widened before its volume is summed."""

    labels: Labels
    count: int
    reach_um: tuple[float, ...]
    depth_image: Smoothed
    wide_image: Smoothed
    sigma_depth_um: float
    sigma_wide_um: float


def detect(
    residual_um: Float32,
    valid: Mask,
    row_pitch_um: float,
    profile_pitch_um: float,
    settings: InspectionSettings,
    *,
    intensity: Float32 | None = None,
    sign: int = -1,
) -> Detection:
    """Find connected areas of missing (sign -1) or raised (sign +1) material in a residual image (rows, profiles).

    ``valid`` marks the pixels that may be judged, ``intensity`` is the line's where it is
    known. Threshold: seed_k sigma_g to start, grow_k sigma_g to spread, with
    sigma_g the robust standard deviation of the smoothed image itself, so correlated noise and leftover form raise it.
    """
    lost = (sign * residual_um).astype(np.float32)
    pixel_area = row_pitch_um * profile_pitch_um

    def px(scale_um: float) -> tuple[float, float]:
        rows, profiles = sigma_px(scale_um, row_pitch_um, profile_pitch_um)
        return max(rows, LEAST_PX), max(profiles, LEAST_PX)

    exact = sigma_px(settings.small_scale_um, row_pitch_um, profile_pitch_um)
    light = smooth(lost, valid, sigma_px(LIGHT_UM, row_pitch_um, profile_pitch_um))
    small = smooth(lost, valid, px(settings.small_scale_um))
    wide = smooth(lost, valid, px(settings.wide_scale_um))
    depth = small if px(settings.small_scale_um) == exact else smooth(lost, valid, exact)

    sound = valid
    sigmas = [0.0, 0.0, 0.0]
    found = np.zeros_like(valid)
    scales = (light, small, wide)
    uneven = by_place(lost, small.value, valid)
    if intensity is not None:
        uneven = np.maximum(uneven, by_light(small.value, intensity, valid, row_pitch_um, profile_pitch_um))
    # The second pass measures the noise again without what the first pass found.
    for _ in range(2):
        field = [sound & (image.density > 0.6) for image in scales]
        sigmas = [_tail_sigma(image.value[use]) for image, use in zip(scales, field, strict=True)]
        found = np.zeros_like(valid)
        for image, sigma, scale_um in zip(
            scales[1:], sigmas[1:], (settings.small_scale_um, settings.wide_scale_um), strict=True
        ):
            if not np.isfinite(sigma):
                continue
            kernel_px = 4.0 * math.pi * px(scale_um)[0] * px(scale_um)[1]
            seed_k = max(settings.seed_k, float(stats.norm.isf(FALSE_ALARMS * kernel_px / valid.size)))
            unit = np.maximum(sigma * image.spread * uneven, settings.least_depth_um / settings.grow_k)
            ratio = np.where(valid & (image.density >= LEAST_DENSITY), image.value / unit, np.float32(0.0))
            found |= hysteresis(ratio > seed_k, ratio > settings.grow_k)
        if not found.any():
            break
        sound = valid & ~dilate(found, settings.wide_scale_um, row_pitch_um, profile_pitch_um)
        if np.count_nonzero(sound) < 0.1 * np.count_nonzero(valid):
            break
    sigma_depth = robust_sigma(depth.value[sound & (depth.density > 0.6)])

    labels, count = label(found)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    enough = (sizes * pixel_area >= settings.min_area_um2) & (sizes >= settings.min_pixels)
    enough[0] = False
    if not enough.any():
        return Detection(np.zeros_like(labels), 0, (), depth, wide, sigma_depth, sigmas[2])

    mask, scale_of = _outline(labels, enough, scales, sigmas, uneven, valid, settings)
    mask = _fill(mask, valid, ISLAND_AREAS * settings.min_area_um2 / pixel_area)
    joined, count = label(dilate(mask, settings.join_um / 2.0, row_pitch_um, profile_pitch_um))
    labels = np.where(mask, joined, 0).astype(np.int32)
    widest = ndimage.maximum(scale_of, labels, index=np.arange(1, count + 1))
    reach = tuple(2.0 * (settings.wide_scale_um if level >= 2 else settings.small_scale_um) for level in widest)
    return Detection(labels, count, reach, depth, wide, sigma_depth, sigmas[2])


def _tail_sigma(lost_um: Float32) -> float:
    """Robust standard deviation of a smoothed image, raised (twofold at most) when its sound side has heavy tails.

    Uneven reflectance shifts the line in patches, up as often as down. The side on which no damage of the wanted sign
    can lie shows how far such patches reach: its 99th percentile would be 2.33 standard deviations on Gaussian noise.
    """
    sigma = robust_sigma(lost_um)
    if not (np.isfinite(sigma) and sigma > 0.0):
        return sigma
    tail = -float(np.percentile(lost_um, 1.0) - np.median(lost_um)) / 2.326
    return float(np.clip(tail, sigma, 2.0 * sigma))


def _outline(
    labels: Labels,
    enough: Mask,
    scales: Sequence[Smoothed],
    sigmas: Sequence[float],
    uneven: Float32,
    valid: Mask,
    settings: InspectionSettings,
) -> tuple[Mask, NDArray[np.int8]]:
    """Redraw each found area at the lightest smoothing its depth allows, and say which one that was (0, 1, 2).

    A 100 um deep pit is visible in the 30 um image up to 57 um outside its rim: length and area would be far too
    large. Only damage too shallow for the light image keeps the heavy outline.
    """
    numbers = np.arange(enough.size)
    level_of = np.full(enough.size, 2, dtype=np.int8)
    peaks = [np.asarray(ndimage.maximum(image.value, labels, index=numbers)) for image in scales]
    level_of[peaks[1] > 6.0 * sigmas[1]] = 1
    level_of[peaks[1] > 8.0 * sigmas[0]] = 0
    level_of[0] = -1
    level_of[~enough] = -1
    level = level_of[labels]
    mask = np.zeros_like(valid)
    for index, (image, sigma) in enumerate(zip(scales, sigmas, strict=True)):
        here = level == index
        if not here.any():
            continue
        unit = np.maximum(sigma * image.spread * uneven, settings.least_depth_um / settings.grow_k)
        ratio = np.where(here & valid, image.value / unit, np.float32(0.0))
        seed = ratio > (settings.seed_k if index < 2 else settings.grow_k)
        mask |= hysteresis(seed, ratio > settings.grow_k)
    return mask, np.where(mask, level, np.int8(-1)).astype(np.int8)


def _fill(mask: Mask, valid: Mask, island_px: float) -> Mask:
    """Add what a mask encloses: undefined pixels always, sound islands up to ``island_px`` pixels."""
    count, labels, _, _ = cv2.connectedComponentsWithStats((~mask).astype(np.uint8), connectivity=4)
    inside = np.ones(count, dtype=bool)
    border = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    inside[border] = False
    inside[0] = False
    sound_area = np.bincount(labels[valid], minlength=count)
    inside &= sound_area <= island_px
    return np.asarray(mask | inside[labels])


def follow_rims(
    detection: Detection,
    lost_um: Float32,
    valid: Mask,
    noise: Noise,
    row_pitch_um: float,
    profile_pitch_um: float,
) -> Detection:
    """Widen each mask, ring by ring, while the ring as a whole is still certainly below the reference.

    The outline of a wide shallow pit ends where single smoothed pixels drown in noise, well inside its true rim; up
    to a fifth of its volume lies outside. A ring of a thousand pixels sees twenty times less.
    """
    labels = detection.labels.copy()
    for number, place in enumerate(ndimage.find_objects(detection.labels), start=1):
        crop = _widen(place, FURTHEST_RING_UM, row_pitch_um, profile_pitch_um, labels.shape)
        mask = detection.labels[crop] == number
        distance = ndimage.distance_transform_edt(~mask, sampling=(row_pitch_um, profile_pitch_um))
        free = (labels[crop] == 0) | mask
        deepest = float(np.nanmax(np.where(mask, detection.depth_image.value[crop], np.float32(0.0))))
        inner = 0.0
        while inner < FURTHEST_RING_UM:
            ring = (distance > inner) & (distance <= inner + RING_UM) & free
            heights = lost_um[crop][ring & valid[crop]]
            if heights.size < 5:
                break
            chance = np.hypot(noise.sigma_um * np.sqrt(noise.kappa / heights.size), noise.shape_um)
            # A steep wall needs no following: what blurring leaves beyond it is a few per cent of the depth.
            if float(heights.mean(dtype=np.float64)) <= max(RING_K * chance, RING_SHARE * deepest):
                break
            inner += RING_UM
        if inner > 0.0:
            grown = (distance <= inner) & free & (valid[crop] | mask)
            labels[crop][grown] = number
    return dataclasses.replace(detection, labels=labels)


def owners(detection: Detection, row_pitch_um: float, profile_pitch_um: float) -> Labels:
    """Widen every mask by its reach; a pixel in the reach of two belongs to the larger, so none is summed twice."""
    owner = detection.labels.copy()
    places = ndimage.find_objects(detection.labels)
    sizes = np.bincount(detection.labels.ravel(), minlength=detection.count + 1)
    for number in sorted(range(1, detection.count + 1), key=lambda n: -int(sizes[n])):
        place = places[number - 1]
        reach = detection.reach_um[number - 1]
        crop = _widen(place, reach, row_pitch_um, profile_pitch_um, owner.shape)
        grown = dilate(detection.labels[crop] == number, reach, row_pitch_um, profile_pitch_um)
        owner[crop][grown & (owner[crop] == 0)] = number
    return owner


def _widen(
    place: tuple[slice, ...], reach_um: float, row_pitch_um: float, profile_pitch_um: float, shape: tuple[int, ...]
) -> tuple[slice, slice]:
    rows, profiles = int(reach_um / row_pitch_um) + 2, int(reach_um / profile_pitch_um) + 2
    return (
        slice(max(place[0].start - rows, 0), min(place[0].stop + rows, shape[0])),
        slice(max(place[1].start - profiles, 0), min(place[1].stop + profiles, shape[1])),
    )


def lost_at_edge(valid: Mask, expected: Mask) -> Mask:
    """Undefined pixels where the bevel should be, open to the space beyond the edge: no light came back."""
    missing = ~valid
    return hysteresis(missing & ~expected, missing) & expected


def findings(
    detection: Detection,
    residual_um: Float32,
    valid: Mask,
    expected: Mask,
    edge_distance_um: Float32 | None,
    recession_um: Float32 | None,
    row_pitch_um: float,
    profile_pitch_um: float,
    settings: InspectionSettings,
    budget: Budget,
) -> tuple[list[DamageFinding], Labels]:
    """Measure every detected damage; returns them in order along the edge, and labels renumbered to match.

    ``expected`` marks where the bevel should be (all True without an edge), ``edge_distance_um`` the distance of each
    pixel to the reference edge line, ``recession_um`` the edge recession per profile.
    """
    pixel_area = row_pitch_um * profile_pitch_um
    lost = -residual_um
    detection = follow_rims(detection, lost, valid, budget.noise, row_pitch_um, profile_pitch_um)
    owner = owners(detection, row_pitch_um, profile_pitch_um)
    open_pixels = lost_at_edge(valid, expected)
    places = ndimage.find_objects(detection.labels)
    order = sorted((place[1].start, place[0].start, number) for number, place in enumerate(places, start=1))
    new_labels = np.zeros_like(detection.labels)
    found: list[DamageFinding] = []
    for _, _, old in order:
        place = places[old - 1]
        crop = _widen(place, detection.reach_um[old - 1] + 50.0, row_pitch_um, profile_pitch_um, valid.shape)
        mask = detection.labels[crop] == old
        around = (owner[crop] == old) & expected[crop]
        measured = around & valid[crop]
        if not (mask & valid[crop]).any():
            continue
        depth = detection.depth_image.value[crop]
        density = detection.depth_image.density[crop]

        missing = ~valid[crop] & expected[crop]
        at_edge = missing & open_pixels[crop] & around
        enclosed = _undefined_of(mask, missing & ~open_pixels[crop]) | (mask & missing & ~open_pixels[crop])
        whole = mask | enclosed | at_edge

        lower = float(lost[crop][measured].sum(dtype=np.float64)) * pixel_area * 1e-9
        # Undefined pixels in the widened rim are filled like enclosed ones: leaving them out would count them as sound.
        holes = enclosed | (missing & around & ~at_edge)
        filled, u_filled = _interpolated(depth, density, holes, mask, lost[crop], valid[crop])
        extended, _ = _interpolated(depth, density, at_edge, mask, lost[crop], valid[crop])
        volume = lower + filled * pixel_area * 1e-9
        open_mm3 = extended * pixel_area * 1e-9
        u_volume = budget.volume_mm3(volume, int(np.count_nonzero(measured)), pixel_area, u_filled * pixel_area * 1e-9)
        u_volume = math.hypot(u_volume, volume * rim_relative(float(np.count_nonzero(mask)) * pixel_area, settings))

        judged = mask & valid[crop] & (density >= LEAST_DENSITY)
        if not judged.any():
            judged = mask & valid[crop]
        flat = np.where(judged, depth, -np.inf)
        deepest = np.unravel_index(int(np.argmax(flat)), flat.shape)
        depth_um = float(flat[deepest])
        sigma_here = detection.sigma_depth_um * float(detection.depth_image.spread[crop][deepest])
        excess = excess_of_largest(
            np.where(judged, detection.wide_image.value[crop], np.float32(np.nan)),
            detection.sigma_wide_um,
            sigma_here,
            math.hypot(settings.small_scale_um, noise_reach_um(budget.noise, pixel_area)),
            row_pitch_um,
            profile_pitch_um,
        )
        depth_um = max(depth_um - excess, 0.0)
        wider = np.where(judged, detection.wide_image.value[crop], -np.inf)
        filled_um, share = filled_in(depth_um, float(wider.max()), settings)
        u_depth = budget.depth_um(
            depth_um, math.hypot((1.0 + share) * sigma_here, 0.3 * excess, U_FILLED_IN * filled_um)
        )
        depth_um += filled_um

        rows_at, profiles_at = np.nonzero(whole)
        row_range = (int(rows_at.min()) + crop[0].start, int(rows_at.max()) + crop[0].start + 1)
        profile_range = (int(profiles_at.min()) + crop[1].start, int(profiles_at.max()) + crop[1].start + 1)
        length_mm = (profile_range[1] - profile_range[0]) * profile_pitch_um / 1e3
        weight = np.where(mask & valid[crop], np.maximum(lost[crop], 0.0), 0.0).astype(np.float64)
        along = (np.arange(weight.shape[1]) + crop[1].start + 0.5) * profile_pitch_um / 1e3
        centroid = float((weight.sum(axis=0) * along).sum() / weight.sum()) if weight.sum() > 0 else float(along.mean())

        area_mm2 = float(np.count_nonzero(whole)) * pixel_area * 1e-6
        outline_px = float(np.count_nonzero(whole & ~cv2.erode(whole.astype(np.uint8), np.ones((3, 3))).astype(bool)))
        # Each outline pixel is in or out by chance of position: half a pixel of reach either way, fully correlated
        # around the outline in the worst case.
        u_area_mm2 = outline_px * pixel_area * 1e-6 / np.sqrt(12.0) * 2.0
        u_area_mm2 = float(np.hypot(u_area_mm2, 2.0 * (settings.u_pitch_relative or 0.0) * area_mm2))
        u_length = float(
            np.hypot(profile_pitch_um / 1e3 / np.sqrt(6.0), (settings.u_pitch_relative or 0.0) * length_mm)
        )
        near_edge = False
        recession: float | None = None
        if edge_distance_um is not None:
            limit = max(2.0 * row_pitch_um, 2.0 * settings.small_scale_um)
            near_edge = bool((edge_distance_um[crop][whole] <= limit).any())
            if near_edge and recession_um is not None:
                piece = recession_um[profile_range[0] : profile_range[1]]
                recession = float(np.nanmax(piece)) if np.isfinite(piece).any() else None
        number = len(found) + 1
        new_labels[crop][whole & (new_labels[crop] == 0)] = number
        found.append(
            DamageFinding(
                number=number,
                severity=settings.severity(length_mm, depth_um),
                volume_mm3=volume,
                u_volume_mm3=u_volume,
                volume_lower_bound_mm3=lower,
                volume_interpolated_mm3=volume + open_mm3,
                depth_um=depth_um,
                u_depth_um=u_depth,
                d99_um=float(np.percentile(depth[judged], 99.0)),
                mean_depth_um=volume / area_mm2 * 1e3 if area_mm2 > 0 else float("nan"),
                area_mm2=area_mm2,
                u_area_mm2=u_area_mm2,
                length_mm=length_mm,
                u_length_mm=u_length,
                s_start_mm=settings.start_mm + profile_range[0] * profile_pitch_um / 1e3,
                s_end_mm=settings.start_mm + profile_range[1] * profile_pitch_um / 1e3,
                s_centroid_mm=settings.start_mm + centroid,
                width_mm=(row_range[1] - row_range[0]) * row_pitch_um / 1e3,
                touches_edge=near_edge,
                edge_recession_um=recession,
                undefined_pixels=int(np.count_nonzero(whole & ~valid[crop])),
                pixels=int(np.count_nonzero(whole)),
                rows=row_range,
                profiles=profile_range,
                mask_runs=_runs(whole, crop[0].start, crop[1].start),
            )
        )
    return found, new_labels


def _undefined_of(mask: Mask, missing: Mask) -> Mask:
    """Undefined groups whose rim lies mostly in the mask: they are part of the damage, a passing dropout is not."""
    touching = hysteresis(dilate(mask, 1.0, 1.0, 1.0) & missing, missing)
    labels, count = label(touching)
    if not count:
        return touching
    grown = cv2.dilate(labels.astype(np.float32), np.ones((3, 3), np.uint8)).astype(np.int32)
    rim = np.where(missing, 0, grown)
    total = np.bincount(rim.ravel(), minlength=count + 1)
    inside = np.bincount(rim[mask & ~missing], minlength=count + 1)
    mine = inside * 2 > total
    mine[0] = False
    return mine[labels]


def _interpolated(
    depth: Float32, density: Float32, where: Mask, mask: Mask, lost: Float32, valid: Mask
) -> tuple[float, float]:
    """Sum of depths over undefined pixels, and its standard uncertainty, both in um times pixels.

    Taken from the smoothed surroundings, or the mask's median where they do not reach. Each undefined pixel may lie
    anywhere between the lowest and the highest of its measured 3 x 3 surroundings; within one connected hole these
    errors go together.
    """
    if not where.any():
        return 0.0, 0.0
    near = where & (density > 0.02)
    total = float(depth[near].sum(dtype=np.float64))
    far = where & ~near
    inside = depth[mask & np.isfinite(depth)]
    if far.any():
        total += int(np.count_nonzero(far)) * (float(np.median(inside)) if inside.size else 0.0)
    big = np.float32(1e9)
    highest = cv2.dilate(np.where(valid, lost, -big), EIGHT)
    lowest = cv2.erode(np.where(valid, lost, big), EIGHT)
    half = np.where(highest > lowest, 0.5 * (highest - lowest), np.float32(inside.max() / 2.0 if inside.size else 0.0))
    labels, count = label(where)
    per_hole = np.bincount(labels[where], weights=half[where].astype(np.float64), minlength=count + 1)
    return total, float(np.sqrt(np.sum(per_hole**2) / 3.0))


def noise_reach_um(noise: Noise, pixel_area_um2: float) -> float:
    """Standard deviation of the Gaussian kernel that would give white noise the measured kappa."""
    return math.sqrt(noise.kappa * pixel_area_um2 / (4.0 * math.pi))


def excess_of_largest(
    shape_um: Float32,
    sigma_shape_um: float,
    sigma_um: float,
    reach_um: float,
    row_pitch_um: float,
    profile_pitch_um: float,
) -> float:
    """How far the largest value of a noisy surface exceeds the largest of the surface itself, on average, in um.

    The deepest of many noisy pixels is too deep: by 1.5 standard deviations on the flat floor of a wide pit, hardly
    at all at the tip of a cone. The same noise (standard deviation ``sigma_um``, Gaussian correlation of ``reach_um``)
    is laid over the more strongly smoothed ``shape_um`` (NaN outside the damage) 24 times and the excess averaged.
    What of that shape lies within 1.5 of its own standard deviations ``sigma_shape_um`` of its top is taken as flat.
    The seed is fixed: the same damage must get the same depth every time.
    """
    top = float(np.nanmax(shape_um)) if np.isfinite(shape_um).any() else float("nan")
    if not (math.isfinite(top) and sigma_um > 0.0):
        return 0.0
    top -= 1.5 * sigma_shape_um
    shape_um = np.minimum(shape_um, np.float32(top))
    near = np.isfinite(shape_um) & (shape_um > top - 5.0 * sigma_um)
    rows, profiles = np.nonzero(near)
    core = shape_um[rows.min() : rows.max() + 1, profiles.min() : profiles.max() + 1]
    inside = near[rows.min() : rows.max() + 1, profiles.min() : profiles.max() + 1]
    # A floor of millions of pixels needs no finer grid than the noise itself has.
    stride = tuple(max(1, int(0.5 * reach_um / pitch)) for pitch in (row_pitch_um, profile_pitch_um))
    core, inside = core[:: stride[0], :: stride[1]], inside[:: stride[0], :: stride[1]]
    if not inside.any():
        return 0.0
    kernel = tuple(
        gaussian_kernel(reach_um / (pitch * step))
        for pitch, step in zip((row_pitch_um, profile_pitch_um), stride, strict=True)
    )
    margin = (kernel[0].size // 2, kernel[1].size // 2)
    rng = np.random.default_rng(20170925)
    largest = np.empty(NOISE_DRAWS)
    scale = sigma_um / math.sqrt(float(np.sum(kernel[0] ** 2)) * float(np.sum(kernel[1] ** 2)))
    for draw in range(NOISE_DRAWS):
        white = rng.standard_normal((core.shape[0] + 2 * margin[0], core.shape[1] + 2 * margin[1]), dtype=np.float32)
        noise = cv2.sepFilter2D(white, cv2.CV_32F, kernel[1], kernel[0])
        noise = noise[margin[0] : margin[0] + core.shape[0], margin[1] : margin[1] + core.shape[1]] * scale
        largest[draw] = float((core + noise)[inside].max())
    return max(0.0, float(largest.mean()) - top)


def filled_in(depth_um: float, wider_um: float, settings: InspectionSettings) -> tuple[float, float]:
    """How much of the depth smoothing and the laser line's own width have filled in, um, and the share it rests on.

    On a rounded floor the loss grows with the square of the width of the kernel, so the heavier smoothing, which made
    ``wider_um`` of the same damage, tells what the lighter one took. A narrow or one-sided damage follows no such law:
    at most a quarter of the depth is added.
    """
    small, wide, blur = settings.small_scale_um**2, settings.wide_scale_um**2, settings.blur_um**2
    if wide <= small:
        return 0.0, 0.0
    share = (small + blur) / (wide - small)
    return float(np.clip(share * (depth_um - wider_um), 0.0, 0.25 * depth_um)), share


def rim_relative(area_um2: float, settings: InspectionSettings) -> float:
    """Relative standard uncertainty of a volume from its rim: where bright meets dark, the bright height counts more.

    A height is the mean over the laser line's width, weighted by the light. For a paraboloid of area pi a^2 whose
    brightness differs from its surroundings by u(ln C), blurred with standard deviation s: 8 s^2 u(ln C) / a^2.
    """
    if area_um2 <= 0:
        return 0.0
    return min(0.5, 8.0 * settings.blur_um**2 * U_LOG_CONTRAST * math.pi / area_um2)


def _runs(mask: Mask, first_row: int, first_profile: int) -> tuple[tuple[int, int, int], ...]:
    padded = np.pad(mask.astype(np.int8), ((0, 0), (1, 1)))
    change = np.diff(padded, axis=1)
    starts, ends = np.argwhere(change == 1), np.argwhere(change == -1)
    return tuple(
        (int(start[0]) + first_row, int(start[1]) + first_profile, int(end[1] - start[1]))
        for start, end in zip(starts, ends, strict=True)
    )
