"""PRECISE follows surface points through the images: the response stays true, the noise falls, and nothing is lost."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from scanning.errors import BadInput
from scanning.pipeline.space_time import px_per_step
from scanning.pipeline.stream import ProfileStream
from scanning.recipe import Centroid, Compound, Diagonals, Line, Recipe, Tone
from tests.scanning.pipeline.agreement import Steps, header_for, product
from tests.scanning.pipeline.scenes import shot

FINER, ROWS, COLUMNS, STEPS = 4, 96, 64, 26
PLACE, FWHM_PX, GRAIN_PX, UM_PER_PX = 30.0, 3.03, 1.67, 14.2
GAINS = (20.0, 60.0, 180.0)
TIMES = (100.0, 300.0, 900.0)
ENDS = 7  # profiles at each end of the scan with cut diagonals


@pytest.fixture(scope="module")
def light() -> NDArray[np.float64]:
    """(steps, rows x 4, columns x 4): a line on a rough surface that moves one pixel per step to higher columns."""
    rng = np.random.default_rng(21)
    rows, columns = ROWS * FINER, COLUMNS * FINER
    surface = np.exp(2j * np.pi * rng.random((rows, columns + FINER * STEPS)))
    x = (np.arange(columns) + 0.5) / FINER - 0.5
    amplitude = np.sqrt(np.exp(-4.0 * np.log(2.0) * ((x - PLACE) / FWHM_PX) ** 2))
    frequency = np.fft.fftfreq(rows, 1 / FINER)[:, None] ** 2 + np.fft.fftfreq(columns, 1 / FINER)[None, :] ** 2
    pupil = np.sqrt(frequency) <= 0.5 / GRAIN_PX
    steps = np.empty((STEPS, rows, columns))
    for s in range(STEPS):
        seen = surface[:, FINER * (STEPS - s) : FINER * (STEPS - s) + columns]
        steps[s] = np.abs(np.fft.ifft2(np.fft.fft2(seen * amplitude) * pupil)) ** 2
    return np.asarray(steps / steps.mean(axis=(0, 1)).max())


def recorded(light: NDArray[np.float64], quarters: int = 0) -> Steps:
    moved = np.roll(light, quarters, axis=2).reshape(STEPS, ROWS, FINER, COLUMNS, FINER).mean(axis=(2, 4))
    rng = np.random.default_rng(100 + quarters)
    return [[shot(step * gain, rng) for gain in GAINS] for step in moved]


def measured(steps: Steps, **settings: str) -> NDArray[np.float64]:
    recipe = Recipe.named("PRECISE").with_settings({f"sta.{k}": v for k, v in settings.items()})
    return product(steps, header_for(steps, TIMES, width=FWHM_PX), recipe)[:, ENDS:-ENDS]


def test_the_response_slope_is_one_for_half_and_whole_pixels(light: NDArray[np.float64]) -> None:
    found = {q: measured(recorded(light, q)) for q in (0, 1, 2, 4)}
    for quarters, tolerance in ((1, 0.05), (2, 0.02), (4, 0.01)):
        slope = np.mean(found[quarters] - found[0]) / (quarters / FINER)
        assert slope == pytest.approx(1.0, abs=tolerance)


def test_the_noise_is_little_more_than_half_that_of_the_mean_image(light: NDArray[np.float64]) -> None:
    steps = recorded(light)
    mean = Recipe("mean", (Recipe.named("PRECISE").operations[0], Compound("sliding"), Line(), Centroid()))
    plain = product(steps, header_for(steps, TIMES, width=FWHM_PX), mean)[:, ENDS:-ENDS]
    precise = measured(steps)
    assert np.isfinite(precise).all()
    assert np.std(precise - PLACE) < 0.6 * np.std(plain - PLACE)


def test_the_share_that_is_seen_is_the_one_that_leaves_least_noise(light: NDArray[np.float64]) -> None:
    steps = recorded(light)
    given = {share: np.std(measured(steps, share=str(share)) - PLACE) for share in np.linspace(0.0, 1.0, 11).round(1)}
    seen = np.std(measured(steps) - PLACE)
    assert seen < 1.02 * min(given.values())
    assert seen < 0.8 * given[1.0]


def test_which_way_the_surface_moves_is_seen(light: NDArray[np.float64]) -> None:
    steps = recorded(light)
    assert np.array_equal(measured(steps), measured(steps, direction="higher"))
    assert np.std(measured(steps, direction="lower") - PLACE) > 1.2 * np.std(measured(steps) - PLACE)
    backwards = steps[::-1]
    assert np.array_equal(measured(backwards), measured(backwards, direction="lower"))


@pytest.mark.parametrize(("direction", "first", "together"), [("higher", 11, 1), ("auto", 18, 8)])
def test_no_profile_is_lost_and_the_first_come_before_the_scan_ends(
    light: NDArray[np.float64], direction: str, first: int, together: int
) -> None:
    steps = recorded(light)
    recipe = Recipe.named("PRECISE").with_settings({"sta.direction": direction})
    stream = ProfileStream(recipe, header_for(steps, TIMES, width=FWHM_PX))
    counts = [len(stream.push(images)) for images in steps]
    ends = stream.finish()
    # With the way unknown the first ones wait until it shows.
    assert counts == [0] * first + [together] + [1] * (STEPS - first - 1)
    assert sum(counts) + len(ends) == STEPS - 4
    assert stream.finish() == []


def test_near_the_ends_of_a_scan_the_noise_grows_little_by_little(light: NDArray[np.float64]) -> None:
    steps = recorded(light)
    recipe = Recipe.named("PRECISE")
    whole = product(steps, header_for(steps, TIMES, width=FWHM_PX), recipe)
    plain = product(steps, header_for(steps, TIMES, width=FWHM_PX), recipe.with_settings({"sta.share": "0"}))
    noise = [1.4826 * np.median(np.abs(whole[:, [n, -1 - n]] - PLACE)) for n in range(ENDS)]
    before = 1.4826 * np.median(np.abs(plain - PLACE))
    assert noise[0] < 1.2 * before
    assert noise[3] < 0.8 * before
    assert noise[ENDS - 1] < 0.7 * before


def test_a_bright_spot_on_the_surface_does_not_pull_the_line() -> None:
    x = np.arange(COLUMNS)
    steps: Steps = []
    for s in range(STEPS):
        reflects = np.where(np.abs(x - 22.0 - s) < 1.5, 6.0, 1.0)  # passes the line at step 8
        row = 20.0 * reflects * np.exp(-4.0 * np.log(2.0) * ((x - PLACE) / FWHM_PX) ** 2)
        frame = np.clip(np.rint(np.tile(row, (12, 1)) + 2.0), 0, 255)
        steps.append([np.clip(np.rint((frame - 2.0) * g + 2.0), 0, 255).astype(np.uint8) for g in (0.5, 1.0, 2.0)])
    header = header_for(steps, (100.0, 200.0, 400.0), width=FWHM_PX)
    mean = Recipe("mean", (Recipe.named("PRECISE").operations[0], Compound("sliding"), Line(), Centroid()))
    plain = product(steps, header, mean)[:, ENDS:-ENDS]
    higher = Recipe.named("PRECISE").with_settings({"sta.direction": "higher", "sta.px_per_step": "1"})
    precise = product(steps, header, higher)[:, ENDS:-ENDS]
    assert np.abs(precise - PLACE).max() < 0.5 * np.abs(plain - PLACE).max()


def test_a_blurred_edge_between_dark_and_bright_surface_is_neither_followed_nor_overshot() -> None:
    x = np.arange(COLUMNS * FINER) / FINER
    blur = np.exp(-0.5 * ((np.arange(-16, 17) / FINER) / 0.75) ** 2)
    rng = np.random.default_rng(5)
    brightness = rng.uniform(1.5, 4.0, (24, 1))  # neighbouring rows differ, as on a real surface
    steps: Steps = []
    for s in range(STEPS):
        # The edge is inclined: its rows reach the line one after the other.
        edge = 22.0 + s - np.arange(24)[:, None] * 0.1
        reflects = np.where(x[None, :] < edge, 1.0, brightness)
        lit = reflects * np.exp(-4.0 * np.log(2.0) * ((x[None, :] - PLACE) / FWHM_PX) ** 2)
        seen = np.apply_along_axis(np.convolve, 1, lit, blur / blur.sum(), mode="same")[:, ::FINER]
        steps.append([np.clip(np.rint(seen * g + 2.0), 0, 255).astype(np.uint8) for g in (15.0, 30.0, 60.0)])
    header = header_for(steps, (100.0, 200.0, 400.0), width=FWHM_PX)
    off = {}
    for share in ("0", "1", "default"):
        recipe = Recipe.named("PRECISE").with_settings(
            {"sta.direction": "higher", "sta.px_per_step": "1", "sta.share": share}
        )
        off[share] = np.abs(product(steps, header, recipe)[:, ENDS:-ENDS] - PLACE)
    assert off["default"].max() < 0.5 * off["0"].max()
    assert off["default"].mean() < 0.5 * off["1"].mean()


def test_the_papers_step_is_one_pixel_on_the_sensor() -> None:
    assert px_per_step(8.33, 0.01430168, 60.0) == pytest.approx(1.0088, abs=2e-4)


def test_a_step_far_from_a_pixel_leaves_the_analysis_out_and_says_so(light: NDArray[np.float64]) -> None:
    steps = recorded(light)[:6]
    recipe = Recipe.named("PRECISE").with_settings({"sta.px_per_step": "5"})
    stream = ProfileStream(recipe, header_for(steps, TIMES, width=FWHM_PX))
    assert sum(len(stream.push(images)) for images in steps) + len(stream.finish()) == 2
    assert any("space-time" in note for note in stream.provenance()["notes"])


def test_one_exposure_is_enough() -> None:
    frame = np.full((12, 64), 2, np.uint8)
    frame[:, 30:33] = (60, 120, 60)
    steps: Steps = [[frame] for _ in range(6)]
    found = product(steps, header_for(steps), Recipe.named("PRECISE"))
    assert np.allclose(found, 31.0, atol=0.01)


def test_compressed_light_cannot_be_followed() -> None:
    with pytest.raises(BadInput, match="compressed by glt"):
        Recipe("bad", (Tone(), Compound("sliding"), Line(), Centroid(), Diagonals()))
    with pytest.raises(BadInput, match="odd sci window"):
        Recipe("bad", (Compound("sliding", 4), Line(), Centroid(), Diagonals()))
