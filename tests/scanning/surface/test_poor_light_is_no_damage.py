"""Dark places and sharp changes of brightness make heights uncertain; that is not damage, and damage there is found."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from scanning.range_image import RangeImage
from scanning.surface import inspect_surface
from scanning.surface.uneven import by_light
from tests.scanning.surface.surfaces import Pit, surface

ROWS, PROFILES = 400, 300


def stripes() -> NDArray[np.bool_]:
    """Dark stripes across the scan, each some 100 um wide."""
    profile = np.arange(PROFILES)
    return np.broadcast_to((profile // 12) % 6 == 3, (ROWS, PROFILES))


def lit(image: RangeImage, *, known: bool = True, seed: int = 3) -> RangeImage:
    """The image with dark stripes, whose heights lie up to 10 um off in patches of a few pixels."""
    rng = np.random.default_rng(seed)
    patches = np.kron(rng.choice([-10.0, 0.0, 10.0], (ROWS // 8, PROFILES // 6)), np.ones((8, 6)))
    dark = stripes()
    intensity = np.where(dark, 4.0, 120.0) if known else np.full((ROWS, PROFILES), np.nan)
    return dataclasses.replace(
        image,
        height_um=(image.height_um + np.where(dark, patches, 0.0)).astype(np.float32),
        intensity=intensity.astype(np.float32),
    )


@pytest.mark.parametrize("seed", range(3))
def test_errors_in_dark_stripes_are_damage_only_to_one_who_does_not_know_the_light(seed: int) -> None:
    plain = surface((ROWS, PROFILES), sigma_um=2.3, seed=seed)
    assert len(inspect_surface(lit(plain, known=False, seed=seed)).damages) > 3
    assert inspect_surface(lit(plain, seed=seed)).damages == []


def test_a_pit_in_a_dark_stripe_is_still_found() -> None:
    profile_um = (3 * 12 + 6) * 8.33
    pitted = surface((ROWS, PROFILES), sigma_um=2.3, pits=(Pit("cap", 1400.0, profile_um, 200.0, 60.0),))
    (found,) = inspect_surface(lit(pitted)).damages
    assert found.depth_um == pytest.approx(60.0, abs=15.0)


def test_a_pit_that_is_itself_dark_does_not_excuse_itself() -> None:
    pit = Pit("cap", 1400.0, 1250.0, 300.0, 25.0)
    image = surface((ROWS, PROFILES), sigma_um=2.3, pits=(pit,))
    row, profile = np.arange(ROWS)[:, None] * 7.15, np.arange(PROFILES)[None, :] * 8.33
    dark = np.where(pit.depth_at(row, profile) > 0, 3.0, 120.0).astype(np.float32)
    (found,) = inspect_surface(dataclasses.replace(image, intensity=dark)).damages
    assert found.volume_mm3 == pytest.approx(pit.volume_mm3, rel=0.15)


@pytest.mark.parametrize("light", [np.nan, 0.0, 120.0])
def test_without_light_or_with_even_light_every_place_counts_the_same(light: float) -> None:
    rng = np.random.default_rng(1)
    lost = rng.normal(size=(ROWS, PROFILES)).astype(np.float32)
    ratio = by_light(lost, np.full_like(lost, light), np.ones(lost.shape, bool), 7.15, 8.33)
    assert np.all(ratio == 1.0)
