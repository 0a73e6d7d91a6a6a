"""What the operations work with: what the header says, and where it says nothing what the first images show.

The constants that a recipe leaves open depend on the camera and on the light's width. Settled once, at the start of a
scan, and reported with the result; without that two scans with the same recipe would not be comparable.
"""

from __future__ import annotations

from dataclasses import dataclass

from scanning.frames import StackHeader
from scanning.pipeline import estimate
from scanning.pipeline.grey import DARK_UNIT
from scanning.pipeline.tone import broadening, light_share
from scanning.recipe import Recipe
from scanning.rig.protocols import Image

RAW_FLOOR = 0.1
FOOT_FLOOR = 0.02
"""Where the base of a candidate standing out of the noise ends: this share of its own light."""
LOGARITHMIC_FLOOR = 0.6
RAW_SNR, COMPRESSED_SNR = 4.0, 3.0
GRAIN_PX = 3.0
WIDE_PX = 12.0
VERY_WIDE_PX = 30.0
"""Wider lines than this come from lamp-lit pictures of others: what they must stand out of is structure, not noise."""


@dataclass(frozen=True)
class Settled:
    """What the stream worked with: from the header where it said so, estimated from the first steps elsewhere."""

    exposures_us: tuple[float, ...]
    dark_levels: tuple[float, ...]
    line_width_px: float | None
    expected_width_px: float | None
    k: float
    floor: float
    snr: float
    grain_px: float
    candidates: str
    continuity: str
    estimated: tuple[str, ...]


def measures_width(recipe: Recipe, header: StackHeader) -> bool:
    """A header's width is that of the light; a logarithmic camera shows the line wider by an unknown amount."""
    known = header.line_width_px is not None and header.response == "linear"
    return recipe.line.width_px is None and not known


def chooses_exposure(recipe: Recipe, header: StackHeader) -> bool:
    """Whether one exposure of a bracket has to be chosen."""
    return recipe.hdre is None and recipe.exposure == "auto" and len(header.exposures_us) > 1


def has_unknowns(recipe: Recipe, header: StackHeader) -> bool:
    """Whether images are needed before `settle` can say everything."""
    return header.dark_level is None or measures_width(recipe, header) or chooses_exposure(recipe, header)


def settle(recipe: Recipe, header: StackHeader, steps: list[list[Image]]) -> tuple[Settled, list[int]]:
    """What to work with, and which of the header's exposures are read (indices).

    ``steps`` are the images of the first stage positions; none are needed when nothing is unknown.
    """
    h, line = header, recipe.line
    estimated: list[str] = []
    if h.dark_level is not None:
        darks = [float(h.dark_level)] * len(h.exposures_us)
    else:
        estimated.append("dark_level")
        darks = [estimate.dark_level([images[e] for images in steps], h.saturation) for e in range(len(h.exposures_us))]
    darks = [min(round(d * DARK_UNIT) / DARK_UNIT, h.saturation - 1.0) for d in darks]
    if recipe.hdre is not None:
        selected = [h.exposures_us.index(t) for t in recipe.exposures_us or h.exposures_us]
    elif chooses_exposure(recipe, h):
        estimated.append("exposure")
        selected = [estimate.best_exposure(steps, darks, h.saturation)]
    else:
        selected = [0 if recipe.exposure == "auto" else h.exposures_us.index(float(recipe.exposure))]
    compressed = recipe.tone is not None or h.response == "logarithmic"
    k = line.k if line.k is not None else (1.5 if compressed else 3.0)
    width = h.line_width_px
    if measures_width(recipe, h):
        estimated.append("line_width_px")
        e = selected[0] if len(selected) == 1 else estimate.best_exposure(steps, darks, h.saturation)
        raw_k = 3.0 if h.response == "linear" else k
        seen = [images[e] for images in steps]
        width = estimate.line_width_px(seen, h.saturation, darks[e], raw_k, RAW_FLOOR, line.ceiling)
    wide = (line.width_px or width or 0.0) > WIDE_PX
    very_wide = (line.width_px or width or 0.0) > VERY_WIDE_PX
    candidates = line.candidates if line.candidates != "auto" else ("threshold" if wide else "noise")
    # Candidates standing out of the noise are looked for in the light before GLT.
    toned = recipe.tone if candidates == "threshold" else None
    expected = line.width_px
    if expected is None and width is not None:
        expected = width * broadening(toned.p) if toned is not None else width
    floor = line.floor
    if floor is None:
        share = FOOT_FLOOR if candidates == "noise" else RAW_FLOOR
        if toned is not None:
            floor = light_share(RAW_FLOOR / 2.0, toned.p)
        else:
            floor = share if h.response == "linear" else LOGARITHMIC_FLOOR
    default_snr = COMPRESSED_SNR if toned is not None or h.response == "logarithmic" else RAW_SNR
    settled = Settled(
        exposures_us=tuple(h.exposures_us[e] for e in selected),
        dark_levels=tuple(darks[e] for e in selected),
        line_width_px=width,
        expected_width_px=expected,
        k=k,
        floor=floor,
        snr=line.snr if line.snr is not None else default_snr,
        grain_px=line.grain_px if line.grain_px is not None else max(GRAIN_PX, (line.width_px or width or 0.0) / 4.0),
        candidates=candidates,
        continuity=line.continuity if line.continuity != "auto" else ("nearest" if very_wide else "path"),
        estimated=tuple(estimated),
    )
    return settled, selected
