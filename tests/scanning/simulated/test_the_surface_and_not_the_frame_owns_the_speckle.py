"""Determinism: the same place looks the same, whenever and in whatever order the stage comes by."""

from __future__ import annotations

import numpy as np

from scanning.rig.simulated.illumination import LaserLine
from scanning.rig.simulated.render import Renderer
from scanning.rig.simulated.scenes import scene


def test_the_same_position_gives_the_same_light_in_any_order() -> None:
    forward, jumping = (Renderer(scene("R2", seed=3), rows=120, columns=128) for _ in range(2))
    wanted = [forward.irradiance(8.33 * i) for i in range(6)]
    for i in (5, 0, 3):
        jumping.irradiance(9000.0 - i)
        assert np.array_equal(jumping.irradiance(8.33 * i), wanted[i])


def test_another_part_has_other_speckle_and_the_same_part_in_another_frame_size_has_its_own() -> None:
    small = Renderer(scene("flat", seed=3), rows=600, columns=64).irradiance(500.0)
    large = Renderer(scene("flat", seed=3, line=LaserLine(unevenness=0.0)), rows=700, columns=96).irradiance(500.0)
    other = Renderer(scene("flat", seed=4), rows=600, columns=64).irradiance(500.0)

    def alike(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])

    line = (slice(0, 590), slice(29, 35))
    assert alike(small[line], large[0:590, 45:51]) > 0.999
    assert abs(alike(small[line] - small[line].mean(0), other[line] - other[line].mean(0))) < 0.1


def test_speckle_travels_with_the_tool_while_the_line_stands_still() -> None:
    renderer = Renderer(scene("flat", seed=5, line=LaserLine(400.0)), rows=100, columns=64)
    travel = 4 * renderer.scene.system.travel_per_pixel_um
    before, after = renderer.irradiance(0.0), renderer.irradiance(travel)
    inner = slice(16, 44)
    moved = np.corrcoef(before[:, 20:48].ravel(), after[:, inner].ravel())[0, 1]
    stood = np.corrcoef(before[:, inner].ravel(), after[:, inner].ravel())[0, 1]
    assert moved > 0.97
    assert abs(stood) < 0.1


def test_without_the_laser_there_is_only_the_room() -> None:
    renderer = Renderer(scene("R1", seed=3), rows=60, columns=64)
    dark = renderer.irradiance(100.0, laser_on=False)
    assert np.all(dark == np.float32(renderer.scene.ambient_e_per_us))
    image = renderer.expose(dark, 900.0, np.random.default_rng(0))
    assert int(image.max()) <= 5


def test_a_part_laid_shifted_takes_its_speckle_along() -> None:
    from dataclasses import replace

    plate = scene("flat", seed=7)
    shifted = replace(plate, pose=replace(plate.pose, shift_along_um=35.0))
    a = Renderer(plate, rows=80, columns=64).irradiance(500.0)
    b = Renderer(shifted, rows=80, columns=64).irradiance(535.0)
    assert np.allclose(a, b, rtol=1e-3, atol=1e-3)
