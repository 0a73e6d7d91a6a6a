"""A pitch or a height in another unit is refused in one sentence, before a filter of that size is asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scanning.errors import BadInput
from scanning.range_image import RangeImage
from scanning.surface import inspect_surface

Z = np.random.default_rng(1).normal(0.0, 4.0, (60, 50)).astype(np.float32)
IMAGE = RangeImage(
    column_px=Z, height_um=Z, row_pitch_um=7.15, profile_pitch_um=8.33, intensity=Z, width_px=np.ones_like(Z)
)


@pytest.mark.parametrize("pitch_um", [7.15e-6, 1e12])
@pytest.mark.parametrize("name", ["row_pitch_um", "profile_pitch_um"])
def test_a_pitch_in_another_unit_is_refused(name: str, pitch_um: float) -> None:
    with pytest.raises(BadInput, match=f"range image has {name} .* check its unit"):
        inspect_surface(replace(IMAGE, **{name: pitch_um}))


def test_heights_of_kilometres_are_refused() -> None:
    with pytest.raises(BadInput, match=r"holds a height of .* check its unit"):
        inspect_surface(replace(IMAGE, height_um=Z * np.float32(1e30)))


def test_the_baseline_is_held_to_the_same() -> None:
    with pytest.raises(BadInput, match="baseline has row_pitch_um"):
        inspect_surface(IMAGE, baseline=replace(IMAGE, row_pitch_um=1e12))
