"""What holds for every recipe on any frames: the answer moves with the frame, does not depend on the light, is a number
or NaN, never infinite and never outside the image; where nothing was seen nothing is said."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from scanning.frames import StackHeader
from scanning.pipeline.stream import Profile, ProfileStream
from scanning.recipe import Recipe
from tests.scanning.pipeline.agreement import Steps
from tests.scanning.pipeline.scenes import line, speckle

ROWS, COLUMNS, BORDER, DARK, TOP = 24, 128, 30, 3, 255
MORE = settings(max_examples=8, deadline=None, suppress_health_check=list(HealthCheck))
NAMES = pytest.mark.parametrize("name", Recipe.NAMES)


def recipe_of(name: str) -> Recipe:
    recipe = Recipe.named(name)
    return recipe.with_settings({"sci.window": "3", "sci.mode": "sliding"}) if recipe.compound is not None else recipe


def frames(name: str, seed: int) -> Steps:
    """A line in speckle, ghosts and noise amid a border without light; as many steps and exposures as are needed."""
    rng = np.random.default_rng(seed)
    gains = (1.0, 3.0) if Recipe.named(name).hdre is not None else (1.0,)
    centre = COLUMNS / 2 + rng.uniform(-6, 6) + rng.uniform(-0.3, 0.3) * np.arange(ROWS)
    light = line(centre, COLUMNS, 3.0, float(rng.uniform(20, 200)))
    light += line(np.full(ROWS, rng.uniform(40, 90)), COLUMNS, 5.0, 150.0) * (rng.random((ROWS, 1)) < 0.3)
    steps: Steps = []
    for _ in range(16 if name == "PRECISE" else 4):
        one = speckle(light, rng)
        step = []
        for gain in gains:
            codes = np.clip(np.rint(one * gain + DARK + rng.normal(0.0, 1.0, one.shape)), 0, TOP)
            codes[:, :BORDER] = codes[:, -BORDER:] = DARK
            step.append(codes.astype(np.uint16))
        steps.append(step)
    return steps


def profiles(name: str, steps: Steps, times: int = 1) -> list[Profile]:
    """The profiles of frames whose codes were multiplied by ``times``."""
    recipe = recipe_of(name)
    exposures = (0.0,) if recipe.response == "logarithmic" else (100.0, 300.0)[: len(steps[0])]
    header = StackHeader(
        rows=ROWS, columns=COLUMNS, steps=len(steps), exposures_us=exposures, step_um=8.33, row_pitch_um=7.15,
        mm_per_pixel=0.0142, saturation=TOP * times, line_width_px=3.0, dark_level=float(DARK * times),
        response="logarithmic" if recipe.response == "logarithmic" else "linear", bits=16,
    )  # fmt: skip
    stream = ProfileStream(recipe, header)
    return [p for images in steps for p in stream.push([i * np.uint16(times) for i in images])] + stream.finish()


def columns(name: str, steps: Steps, times: int = 1) -> NDArray[Any]:
    return np.stack([p.column_px for p in profiles(name, steps, times)], axis=1)


@NAMES
@MORE
@given(seed=st.integers(0, 2**32), by=st.integers(-12, 12))
def test_a_frame_moved_to_the_side_moves_the_answer(name: str, seed: int, by: int) -> None:
    steps = frames(name, seed)
    moved = [[np.roll(image, by, axis=1) for image in images] for images in steps]
    np.testing.assert_allclose(columns(name, moved), columns(name, steps) + by, atol=1e-4)


@NAMES
@MORE
@given(seed=st.integers(0, 2**32), times=st.sampled_from([2, 3, 16, 250]))
def test_more_light_is_the_same_line(name: str, seed: int, times: int) -> None:
    steps = frames(name, seed)
    np.testing.assert_allclose(columns(name, steps, times), columns(name, steps), atol=1e-3)


@NAMES
@MORE
@given(seed=st.integers(0, 2**32))
def test_an_answer_is_a_place_in_the_image_or_nothing(name: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    steps = frames(name, seed)
    noise = [[rng.integers(0, TOP + 1, (ROWS, COLUMNS)).astype(np.uint16) for _ in images] for images in steps]
    full = [[np.full((ROWS, COLUMNS), TOP, np.uint16) for _ in images] for images in steps]
    for some in (steps, noise, full):
        for profile in profiles(name, some):
            seen = np.isfinite(profile.column_px)
            assert not np.isinf(profile.column_px).any()
            assert np.all((profile.column_px[seen] >= 0) & (profile.column_px[seen] <= COLUMNS - 1))
            assert np.all(np.isfinite(profile.intensity[seen]) & np.isfinite(profile.width_px[seen]))


@NAMES
@MORE
@given(seed=st.integers(0, 2**32), dark_rows=st.integers(4, ROWS))
def test_rows_without_light_have_no_answer(name: str, seed: int, dark_rows: int) -> None:
    steps = frames(name, seed)
    for images in steps:
        for image in images:
            image[:dark_rows] = DARK
    # The smoothing over three rows must not lend a dark row its neighbour's line either.
    assert np.isnan(columns(name, steps)[:dark_rows]).all()
