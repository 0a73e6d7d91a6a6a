"""Frames in, profiles out: the same numbers however they come, in constant memory, and clear words about bad frames."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from scanning.errors import BadInput
from scanning.frames import StackHeader
from scanning.pipeline.estimate import half_sample_mode
from scanning.pipeline.stream import ProfileStream
from scanning.pipeline.whole import extract_profile, process_stack
from scanning.recipe import Recipe
from scanning.rig.protocols import Image
from tests.scanning.pipeline.agreement import Steps, header_for, product
from tests.scanning.pipeline.scenes import line, shot

ROWS = np.arange(60)
CENTRE = 40.0 + 0.1 * ROWS


class StackInMemory:
    def __init__(self, header: StackHeader, steps: Steps) -> None:
        self.header = header
        self.steps = steps

    def step(self, index: int) -> list[Image]:
        return self.steps[index]

    def __iter__(self) -> Iterator[list[Image]]:
        return iter(self.steps)

    def sha256(self) -> str:
        return "0" * 64


class Doubling:
    def height_um(self, column_px: NDArray[np.float64]) -> NDArray[np.float64]:
        return 2.0 * column_px + 1.0

    def to_json(self) -> dict[str, float]:
        return {"slope": 2.0}


def scan(steps: int, gains: tuple[float, ...] = (1.0,), dark: float = 2.0) -> Steps:
    rng = np.random.default_rng(1)
    return [[shot(line(CENTRE, 128, 3.03, 120.0 * g), rng, dark) for g in gains] for _ in range(steps)]


def test_nf_gives_a_profile_for_every_step_at_once() -> None:
    steps = scan(3)
    stream = ProfileStream(Recipe.named("NF"), header_for(steps))
    counts = [len(stream.push(images)) for images in steps]
    assert counts == [1, 1, 1]
    assert stream.finish() == []


def test_only_full_windows_give_a_profile_and_its_place_is_their_middle() -> None:
    steps = scan(12)
    stream = ProfileStream(Recipe.named("SCI"), header_for(steps))
    profiles = [p for images in steps for p in stream.push(images)] + stream.finish()
    assert [p.index for p in profiles] == [0, 1]
    assert [p.position_um for p in profiles] == pytest.approx([2 * 8.33, 7 * 8.33])
    sliding = ProfileStream(Recipe.named("SCI").with_settings({"sci.mode": "sliding"}), header_for(steps))
    profiles = [p for images in steps for p in sliding.push(images)]
    assert [p.position_um for p in profiles] == pytest.approx([(i + 2) * 8.33 for i in range(8)])


@pytest.mark.parametrize("mode", ["block", "sliding"])
def test_a_stack_and_a_live_stream_give_the_same_numbers(mode: str) -> None:
    steps = scan(11, (1.0, 3.0))
    header = header_for(steps, (100.0, 300.0), dark=None, width=None)
    recipe = Recipe.named("HDRE-I").with_settings({"sci.mode": mode})
    image = process_stack(StackInMemory(header, steps), recipe)
    live = product(steps, header, recipe)
    assert image.column_px.shape == (60, 2 if mode == "block" else 7)
    assert np.array_equal(image.column_px, live.astype(np.float32), equal_nan=True)


def test_the_frames_given_are_not_changed_and_may_be_reused() -> None:
    steps = scan(1)
    before = steps[0][0].copy()
    recipe = Recipe.named("SCI").with_settings({"sci.mode": "sliding"})
    stream = ProfileStream(recipe, header_for(steps))
    buffer = np.empty_like(before)
    profiles = []
    for _ in range(7):
        buffer[:] = before
        profiles += stream.push([buffer])
        buffer[:] = 0
    assert np.array_equal(steps[0][0], before)
    assert len(profiles) == 3
    assert np.array_equal(profiles[0].column_px, profiles[2].column_px)


def test_read_only_and_foreign_byte_order_frames_are_read() -> None:
    frame = scan(1)[0][0]
    expected = extract_profile(frame, dark_level=2, line_width_px=3.0)
    frozen = frame.copy()
    frozen.flags.writeable = False
    assert np.array_equal(extract_profile(frozen, dark_level=2, line_width_px=3.0), expected, equal_nan=True)
    wide = (frame.astype(np.uint16) * 4).astype(">u2")
    found = extract_profile(wide, dark_level=8, line_width_px=3.0, saturation=1023)
    assert np.array_equal(found, expected, equal_nan=True)


def test_twice_the_light_is_the_same_line() -> None:
    frame = scan(1)[0][0].astype(np.uint16)
    once = extract_profile(frame, dark_level=2, line_width_px=3.0)
    assert np.array_equal(extract_profile(frame * 2, dark_level=4, line_width_px=3.0), once, equal_nan=True)


def test_a_frame_moved_by_five_columns_moves_the_line_by_five() -> None:
    frame = scan(1)[0][0]
    moved = np.roll(frame, 5, axis=1)
    apart = extract_profile(moved, dark_level=2, line_width_px=3.0) - extract_profile(
        frame, dark_level=2, line_width_px=3.0
    )
    assert np.allclose(apart, 5.0)


def test_heights_come_from_the_calibration_or_else_from_the_scale_of_the_header() -> None:
    steps = scan(2)
    stack = StackInMemory(header_for(steps), steps)
    plain = process_stack(stack, "NF")
    assert plain.height_um[0, 0] == pytest.approx(plain.column_px[0, 0] * 14.2, rel=1e-6)
    assert plain.provenance["calibration"]["source"] == "stack header"
    calibrated = process_stack(stack, "NF", calibration=Doubling())
    assert calibrated.height_um[0, 0] == pytest.approx(2.0 * plain.column_px[0, 0] + 1.0)
    assert calibrated.provenance["calibration"] == {"slope": 2.0}


def test_a_range_image_carries_everything_it_depends_on() -> None:
    steps = scan(6, (1.0, 3.0))
    told: list[tuple[int, int]] = []
    stack = StackInMemory(header_for(steps, (100.0, 300.0), dark=None), steps)
    image = process_stack(stack, "HDRE-II", progress=lambda done, total: told.append((done, total)))
    again = json.loads(json.dumps(image.provenance))
    assert Recipe.from_json(again["recipe"]) == Recipe.named("HDRE-II")
    assert again["exposures_used_us"] == [100.0, 300.0]
    assert again["estimated"] == ["dark_level"]
    assert again["dark_levels"] == pytest.approx([2.0, 2.0], abs=0.5)
    assert set(again["versions"]) == {"edgewatch", "python", "numpy", "numba"}
    assert told[-1] == (6, 6)
    assert image.profile_pitch_um == pytest.approx(41.65)
    assert image.frame_pixels == 60 * 128 * 2 * 5
    assert image.saturated == sum(int((f == 255).sum()) for s in steps[:5] for f in s)


def test_unknown_dark_level_and_width_are_estimated_and_said() -> None:
    steps = scan(6, dark=9.0)
    stream = ProfileStream(Recipe.named("NF"), header_for(steps, dark=None, width=None))
    profiles = [p for images in steps for p in stream.push(images)] + stream.finish()
    assert len(profiles) == 6
    settled = stream.settled
    assert settled is not None
    assert settled.estimated == ("dark_level", "line_width_px")
    assert settled.dark_levels[0] == pytest.approx(9.0, abs=0.5)
    assert settled.line_width_px == pytest.approx(3.03, abs=0.4)
    assert np.nanmax(np.abs(profiles[5].column_px - CENTRE)) < 0.2


def test_a_dark_stack_has_no_width_and_no_line_and_says_so() -> None:
    stream = ProfileStream(Recipe.named("NF"), header_for([[np.zeros((20, 64), np.uint8)]], dark=None, width=None))
    profiles = stream.push([np.zeros((20, 64), np.uint8)]) + stream.finish()
    assert np.isnan(profiles[0].column_px).all()
    assert "width is unknown" in stream.provenance()["notes"][0]


def test_without_hdre_the_exposure_with_most_usable_rows_is_read() -> None:
    steps = scan(2, (0.02, 1.0, 20.0))
    header = header_for(steps, (10.0, 500.0, 10_000.0))
    stream = ProfileStream(Recipe.named("NF"), header)
    found = [p for images in steps for p in stream.push(images)] + stream.finish()
    assert stream.settled is not None
    assert stream.settled.exposures_us == (500.0,)
    chosen = product(steps, header, Recipe.named("NF").with_settings({"exposure": "500"}))
    assert np.array_equal(found[0].column_px, chosen[:, 0], equal_nan=True)


def test_hdre_may_read_some_of_the_exposures() -> None:
    steps = scan(5, (1.0, 3.0, 9.0))
    part = [[images[0], images[2]] for images in steps]
    recipe = Recipe.named("HDRE-II")
    some = product(steps, header_for(steps, (1.0, 3.0, 9.0)), recipe.with_settings({"exposures": "1,9"}))
    assert np.array_equal(some, product(part, header_for(part, (1.0, 9.0)), recipe), equal_nan=True)


def test_fusing_restores_what_one_exposure_saturates_and_another_loses() -> None:
    rng = np.random.default_rng(2)
    height = np.where(ROWS < 30, 400.0, 4.0)
    steps = [[shot(line(CENTRE, 128, 3.03, height * g), rng) for g in (0.5, 4.0, 20.0)] for _ in range(5)]
    header = header_for(steps, (50.0, 400.0, 2000.0))
    found = product(steps, header, Recipe.named("HDRE-II"))[:, 0]
    assert np.isfinite(found).all()
    assert np.abs(found - CENTRE).max() < 0.5


def test_codes_at_the_headers_saturation_count_as_saturated() -> None:
    frame = np.full((4, 10), 250, np.uint8)
    stream = ProfileStream(Recipe.named("NF"), header_for([[frame]], saturation=250))
    assert stream.push([frame])[0].saturated == 40


@pytest.mark.parametrize(
    ("images", "sentence"),
    [
        ([], "has 0 images but the header lists 1 exposures"),
        ([np.zeros((60, 127), np.uint8)], "60 x 127 pixels but the header says 60 x 128"),
        ([np.zeros((60, 128), np.float32)], "pixels of type float32; use uint8 or uint16"),
        ([np.zeros((60, 128), np.int16)], "pixels of type int16"),
    ],
)
def test_a_step_that_does_not_fit_the_header_is_refused(images: list[Image], sentence: str) -> None:
    stream = ProfileStream(Recipe.named("NF"), header_for(scan(1)))
    with pytest.raises(BadInput, match=sentence):
        stream.push(images)


def test_stacks_that_are_too_short_are_refused() -> None:
    steps = scan(4)
    with pytest.raises(BadInput, match="averages 5 images but the stack has 4 steps"):
        process_stack(StackInMemory(header_for(steps), steps), "SCI")
    with pytest.raises(BadInput, match="ends after 4 of 9 steps"):
        process_stack(StackInMemory(replace(header_for(steps), steps=9), steps), "NF")
    with pytest.raises(BadInput, match="more steps than the 3"):
        process_stack(StackInMemory(replace(header_for(steps), steps=3), steps), "NF")


def test_a_dark_level_above_saturation_is_refused() -> None:
    with pytest.raises(BadInput, match="dark level 300"):
        ProfileStream(Recipe.named("NF"), header_for(scan(1), dark=300.0))


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"recipe": "SCI"}, "use process_stack"),
        ({"exposures_us": [1.0, 2.0]}, "one per frame"),
        ({"recipe": "HDRE-II"}, "fuses several exposures|averages 5"),
    ],
)
def test_one_frame_is_not_a_stack(arguments: dict[str, object], sentence: str) -> None:
    with pytest.raises(BadInput, match=sentence):
        extract_profile(scan(1)[0][0], **arguments)  # type: ignore[arg-type]


def test_a_bracket_of_frames_needs_its_times() -> None:
    frames = scan(1, (1.0, 3.0))[0]
    recipe = Recipe.named("HDRE-II").with_settings({"sci.window": "1"})
    with pytest.raises(BadInput, match="needs exposures_us"):
        extract_profile(frames, recipe)
    found = extract_profile(frames, recipe, exposures_us=[100, 300], dark_level=2, line_width_px=3.0)
    assert np.abs(found - CENTRE).max() < 0.5


def test_the_half_sample_mode_finds_the_crowd_and_not_the_average() -> None:
    rng = np.random.default_rng(0)
    values = np.concatenate([rng.normal(20.0, 1.0, 4000), rng.uniform(0.0, 255.0, 3000)])
    assert half_sample_mode(values) == pytest.approx(20.0, abs=1.0)
