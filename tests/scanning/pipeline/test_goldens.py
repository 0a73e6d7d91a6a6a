"""The paper's own numbers, recomputed elsewhere in exact arithmetic, come out of the product's operations."""

from __future__ import annotations

import numpy as np
import pytest

from scanning.errors import BadInput
from scanning.pipeline.centroid import centre_of_gravity
from scanning.pipeline.exposure import exposure_grey, extension_db
from scanning.pipeline.tone import broadening, fixed_point, grey_bits, tone
from scanning.recipe import Recipe


@pytest.mark.parametrize(
    ("grey", "p", "expected"),
    [
        (0, 0.5, 0.0),
        (255, 0.5, 255.0),
        (1, 0.5, 90.1561146),
        (10, 0.5, 167.6862923),
        (10, 1.0, 110.2693828),
        (10, 2.0, 47.6836737),
        (100, 0.5, 232.634424),
        (127, 0.5, 238.5306584),
        (127, 1.0, 223.125),
    ],
)
def test_tone_follows_equation_7(grey: float, p: float, expected: float) -> None:
    assert tone(np.array([float(grey)]), p)[0] == pytest.approx(expected, abs=1e-6)


def test_centre_of_gravity_follows_equation_8_with_columns_from_0() -> None:
    row = np.array([0, 10, 40, 30, 20, 0], np.uint8)
    assert centre_of_gravity(row, 0, 5, 255, 1024, 0) == pytest.approx(2.6, abs=1e-12)


def test_centre_of_gravity_of_no_light_is_not_a_number() -> None:
    assert np.isnan(centre_of_gravity(np.zeros(6, np.uint8), 0, 5, 255, 1024, 0))


def test_the_brackets_of_the_paper_extend_the_range_by_19_and_39_db() -> None:
    assert extension_db([100, 300, 500, 700, 900]) == pytest.approx(19.0849, abs=5e-5)
    assert extension_db([100, 500, 1000, 5000, 9000]) == pytest.approx(39.0849, abs=5e-5)


def test_a_bracket_with_a_time_of_zero_has_no_extension() -> None:
    with pytest.raises(BadInput, match="above zero"):
        extension_db([0, 100])


def test_fused_grey_is_code_over_time_in_units_of_the_shortest_saturation() -> None:
    grey = exposure_grey(np.array([0.0, 30.0, 255.0]), [100.0, 300.0], [0.0, 0.0], 255)
    assert grey[0].tolist() == pytest.approx([0.0, 30.0, 255.0])
    assert grey[1, 1] == pytest.approx(10.0)


def test_the_dark_level_is_subtracted_before_dividing() -> None:
    grey = exposure_grey(np.array([5.0, 35.0]), [100.0, 300.0], [5.0, 5.0], 255)
    assert grey[1, 0] == 0.0
    assert grey[1, 1] == pytest.approx(255.0 * 30.0 / 3.0 / 250.0)


def test_black_stays_black_through_tone() -> None:
    grey = exposure_grey(np.array([3.0]), [100.0, 300.0], [3.0, 3.0], 255)
    assert tone(grey, 0.5).max() == 0.0


@pytest.mark.parametrize("window", [1, 5, 8, 9, 16, 17, 33, 64])
def test_sums_of_the_brightest_grey_fit_32_bits(window: int) -> None:
    assert int(fixed_point(np.array([255.0]), grey_bits(window))[0]) * window < 2**31


def test_1205_images_give_241_profiles_of_41_65_um_in_blocks_of_five() -> None:
    block = Recipe.named("SCI")
    assert block.profiles(1205) == 241
    assert block.profile_pitch_um(8.33) == pytest.approx(41.65)
    sliding = block.with_settings({"sci.mode": "sliding"})
    assert sliding.profiles(1205) == 1201
    assert sliding.profile_pitch_um(8.33) == 8.33


@pytest.mark.parametrize("p", [0.5, 1.0, 2.0])
def test_tone_broadens_a_gaussian_line_as_the_width_check_expects(p: float) -> None:
    x = np.linspace(-40.0, 40.0, 80_001)
    lifted = tone(64.0 * np.exp(-4.0 * np.log(2.0) * (x / 5.0) ** 2), p)
    seen = x[lifted >= lifted.max() / 2.0]
    assert seen[-1] - seen[0] == pytest.approx(5.0 * broadening(p), abs=0.01)
