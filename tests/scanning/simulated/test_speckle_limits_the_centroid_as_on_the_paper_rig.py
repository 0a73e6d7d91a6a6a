"""Only speckle, no camera: the spread of line positions must be that of coherent imaging (measuring.md 5.1)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import numpy as np
import pytest

from scanning.rig.simulated.illumination import LaserLine
from scanning.rig.simulated.render import Renderer
from scanning.rig.simulated.scenes import scene
from tests.scanning.simulated.looking import centroid, correlation, scan


@dataclass(frozen=True)
class Spread:
    one_um: float
    five_um: float
    steps: tuple[float, float]
    rows: tuple[float, float]


@cache
def spread(f_number: float, width_is: Literal["fwhm", "1/e2"] = "fwhm", system: str = "IS1") -> Spread:
    plate = scene("flat", seed=1, system=system, f_number=f_number, line=LaserLine(25.0, width_is))
    frames = scan(Renderer(plate, rows=400, columns=64), 60)
    um = plate.system.um_per_pixel
    one = np.stack([centroid(frame, 31.5) for frame in frames], axis=1) * um
    five = np.stack([centroid(frames[i : i + 5].mean(axis=0), 31.5) for i in range(56)], axis=1) * um
    error = one - one.mean()
    return Spread(
        float(one.std()),
        float(five.std()),
        (correlation(error, 1, 1), correlation(error, 2, 1)),
        (correlation(error, 1, 0), correlation(error, 2, 0)),
    )


def test_one_scan_image_spreads_by_7_and_a_half_micrometres() -> None:
    assert spread(5.6).one_um == pytest.approx(7.5, abs=0.4)


def test_averaging_five_scan_images_gains_1_7_and_not_the_square_root_of_five() -> None:
    result = spread(5.6)
    assert 1.6 <= result.one_um / result.five_um <= 1.9
    assert result.five_um == pytest.approx(4.3, abs=0.3)


def test_the_error_of_one_step_is_half_known_from_the_step_before() -> None:
    first, second = spread(5.6).steps
    assert 0.55 <= first <= 0.70
    assert abs(second) < 0.1


def test_neighbouring_rows_share_speckle_and_the_next_ones_hardly() -> None:
    first, second = spread(5.6).rows
    assert first == pytest.approx(0.43, abs=0.06)
    assert second == pytest.approx(0.07, abs=0.06)


@pytest.mark.parametrize(
    ("f_number", "width_is", "one_um", "five_um"),
    [
        (4.0, "fwhm", 6.0, 3.4),
        (8.0, "fwhm", 9.4, 5.6),
        (4.0, "1/e2", 4.6, 1.9),
        (5.6, "1/e2", 5.8, 2.5),
        (8.0, "1/e2", 7.5, 3.4),
    ],
)
def test_other_apertures_and_lines_follow_the_table(
    f_number: float, width_is: Any, one_um: float, five_um: float
) -> None:
    result = spread(f_number, width_is)
    assert result.one_um == pytest.approx(one_um, rel=0.07)
    assert result.five_um == pytest.approx(five_um, rel=0.09)


@pytest.mark.parametrize(("f_number", "one_um", "five_um"), [(8.0, 6.4, 3.6), (11.0, 8.0, 4.7)])
def test_the_second_system_follows_its_own_figures(f_number: float, one_um: float, five_um: float) -> None:
    result = spread(f_number, system="IS2")
    assert result.one_um == pytest.approx(one_um, rel=0.06)
    assert result.five_um == pytest.approx(five_um, rel=0.08)


def test_repeating_a_scan_without_moving_the_part_hides_most_of_the_error() -> None:
    """measuring.md fact 7: the static repeat shows 0.9 um where the truth is 8; a displaced repeat shows the truth."""
    plate = scene("flat", seed=2)
    renderer = Renderer(plate, rows=300, columns=64)

    def profile(position_um: float, draw: int) -> np.ndarray[Any, np.dtype[np.float64]]:
        image = renderer.expose(renderer.irradiance(position_um), 300.0, np.random.default_rng(draw))
        light = np.clip(image.astype(np.float32) - 2.0, 0.0, None)
        return centroid(light, 31.5) * plate.system.um_per_pixel

    static, displaced = [], []
    for step in range(12):
        here = profile(100.0 * step, 2 * step)
        static.append(here - profile(100.0 * step, 2 * step + 1))
        displaced.append(here[3:] - here[:-3])
    still = float(np.std(np.concatenate(static))) / np.sqrt(2)
    moved = float(np.std(np.concatenate(displaced))) / np.sqrt(2)
    assert moved == pytest.approx(7.8, abs=0.8)
    assert still < moved / 4
