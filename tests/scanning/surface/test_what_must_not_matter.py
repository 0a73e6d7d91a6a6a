"""Tilt, offset, mirroring and units: properties that hold for any surface."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from scanning.surface import inspect_surface
from tests.scanning.surface.surfaces import Pit, range_image, surface

PITS = (Pit("cap", 420.0, 500.0, 260.0, 60.0), Pit("box", 1000.0, 1250.0, 220.0, 90.0))
IMAGE = surface((200, 220), pits=PITS, missing=0.01, tilt_um_per_mm=(0.0, 0.0), seed=7)
BASE = inspect_surface(IMAGE)

quick = settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.too_slow])


def summary(report):
    return np.array([[one.volume_mm3 * 1e3, one.depth_um, one.area_mm2 * 100] for one in report.damages])


@quick
@given(st.floats(-60, 60), st.floats(-60, 60), st.floats(-2000, 2000))
def test_a_tilt_and_an_offset_change_nothing(rows, profiles, offset):
    row = np.arange(200)[:, None] * 7.15e-3
    profile = np.arange(220)[None, :] * 8.33e-3
    report = inspect_surface(range_image(IMAGE.height_um + rows * row + profiles * profile + offset))
    assert summary(report) == pytest.approx(summary(BASE), rel=0.02)


@quick
@given(st.booleans(), st.booleans())
def test_a_mirrored_image_gives_mirrored_damages(up, left):
    height = IMAGE.height_um[:: -1 if up else 1, :: -1 if left else 1]
    report = inspect_surface(range_image(np.ascontiguousarray(height)))
    expected = BASE.damages[::-1] if left else BASE.damages
    assert len(report.damages) == len(expected)
    for found, other in zip(report.damages, expected, strict=True):
        assert found.volume_mm3 == pytest.approx(other.volume_mm3, rel=0.02)
        profiles = tuple(220 - edge for edge in reversed(other.profiles)) if left else other.profiles
        rows = tuple(200 - edge for edge in reversed(other.rows)) if up else other.rows
        assert found.profiles == pytest.approx(profiles, abs=1)
        assert found.rows == pytest.approx(rows, abs=1)


@quick
@given(st.floats(0.5, 4.0))
def test_scaling_the_heights_scales_volume_and_depth(factor):
    report = inspect_surface(range_image(IMAGE.height_um * factor))
    for found, other in zip(report.damages, BASE.damages, strict=True):
        assert found.volume_mm3 == pytest.approx(other.volume_mm3 * factor, rel=0.02)
        assert found.depth_um == pytest.approx(other.depth_um * factor, rel=0.02)
        assert found.length_mm == pytest.approx(other.length_mm, abs=0.02)


@quick
@given(st.floats(0.5, 3.0))
def test_scaling_the_pitches_scales_the_volume_by_the_square(factor):
    report = inspect_surface(range_image(IMAGE.height_um, (7.15 * factor, 8.33 * factor)))
    assert report.measurement("V-").value == pytest.approx(BASE.measurement("V-").value * factor**2, rel=0.06)


def test_the_same_image_gives_the_same_report_twice():
    assert inspect_surface(IMAGE).to_json() == BASE.to_json()
