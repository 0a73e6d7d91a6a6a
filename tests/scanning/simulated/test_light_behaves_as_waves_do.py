"""The optics against closed formulas: Airy's disc, the contrast of speckle behind a circular pupil, radiometry."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import j1

from scanning.rig.simulated.geometry import IS1, SYSTEMS
from scanning.rig.simulated.illumination import LaserLine
from scanning.rig.simulated.render import Renderer
from scanning.rig.simulated.scenes import Scene, scene
from scanning.rig.simulated.speckle import GUARD, CoherentCamera
from tests.scanning.simulated.looking import scan


def airy_over_pixels(row_px: float, column_px: float, shape: tuple[int, int]) -> np.ndarray:
    """Return (2 J1(v)/v)^2 integrated over the pixels of a frame, v = pi r / (lambda N_w)."""
    sub = (np.arange(20) + 0.5) / 20 - 0.5
    rows = (np.arange(shape[0])[:, None] + sub[None, :]).ravel() - row_px
    columns = (np.arange(shape[1])[:, None] + sub[None, :]).ravel() - column_px
    v = np.pi * np.hypot(rows[:, None], columns[None, :]) * 3.2 / (0.660 * 5.6 * 1.4475)
    intensity = (2 * j1(v) / np.where(v == 0, 1, v)) ** 2
    return intensity.reshape(shape[0], 20, shape[1], 20).mean(axis=(1, 3))


@pytest.mark.parametrize("x_um", [0.0, 1.3, -2.9])
def test_a_single_grain_is_imaged_as_airys_disc_at_its_exact_place(x_um: float) -> None:
    camera = CoherentCamera(IS1, rows=33, columns=33, grain_um=4.0)
    grains = np.zeros((1, camera.grain_rows), dtype=np.complex64)
    grains[0, GUARD + 2 * 16] = 1.0
    frame = np.zeros((33, 33), dtype=np.float32)
    camera.expose(frame, grains, np.zeros(grains.shape, np.float32), np.array([x_um]), np.array([1.0]), 1.0)
    column = float(IS1.column_px(450.0, 33, x_um))
    expected = airy_over_pixels(16.0, column, frame.shape)
    inner = (slice(10, 23), slice(10, 23))
    expected *= frame[inner].sum() / expected[inner].sum()
    assert np.abs(frame - expected)[inner].max() < 0.015 * expected.max()
    seen, wanted = (float((f[inner] * np.arange(10, 23)).sum() / f[inner].sum()) for f in (frame, expected))
    assert seen == pytest.approx(wanted, abs=0.005)


def test_two_grains_of_opposite_phase_cancel_where_two_lamps_would_add() -> None:
    camera = CoherentCamera(IS1, rows=33, columns=33, grain_um=4.0)

    def brightest(second: complex) -> float:
        grains = np.zeros((2, camera.grain_rows), dtype=np.complex64)
        grains[0, GUARD + 32] = 1.0
        grains[1, GUARD + 32] = second
        frame = np.zeros((33, 33), dtype=np.float32)
        camera.expose(
            frame, grains, np.zeros(grains.shape, np.float32), np.array([-0.2, 0.2]), np.array([1.0, 1.0]), 1.0
        )
        return float(frame.max())

    alone = brightest(0.0)
    assert brightest(1.0) == pytest.approx(4.0 * alone, rel=0.02)
    assert brightest(-1.0) < 0.01 * alone


@pytest.mark.parametrize(("system", "f_number"), [("IS1", 4.0), ("IS1", 5.6), ("IS1", 8.0), ("IS2", 8.0)])
def test_speckle_contrast_over_pixels_is_that_of_a_circular_pupil(system: str, f_number: float) -> None:
    """C^2 = integral of tri(x) tri(y) (2 J1(v)/v)^2 over a pixel's autocorrelation (Goodman)."""
    wide = LaserLine(400.0, unevenness=0.0)
    plate = scene("flat", seed=3, system=system, f_number=f_number, line=wide)
    assert isinstance(plate, Scene)
    optics = SYSTEMS[system].with_f_number(f_number)
    g = (np.arange(-300, 300) + 0.5) / 300
    v = np.pi * np.hypot(g[:, None], g[None, :]) * optics.pixel_um / (0.660 * optics.working_f_number)
    triangle = 1 - np.abs(g)
    expected = np.sqrt((triangle[:, None] * triangle[None, :] * (2 * j1(v) / v) ** 2).mean() * 4.0)
    frames = scan(Renderer(plate, rows=300, columns=64), 40, step_um=100.0)[:, :, 24:40]
    relative = frames / frames.mean(axis=(0, 1))
    # The lens's glare lays an even 2 % under the speckle.
    assert float(relative.std()) * 1.018 == pytest.approx(float(expected), rel=0.02)


def test_contrast_in_the_middle_of_the_narrow_line_is_about_0_9() -> None:
    frames = scan(Renderer(scene("flat", seed=1), rows=400, columns=64), 60)[:, :, 31:33]
    assert float((frames.std(axis=(0, 1)) / frames.mean(axis=(0, 1))).mean()) == pytest.approx(0.91, abs=0.03)


def test_plain_steel_returns_the_stated_light() -> None:
    """Energy per row = peak x Gaussian area: 7 e-/us x 1.0645 x 3.0277 px, whatever the aperture does to the shape."""
    sums = []
    for seed in range(6):
        plate = scene("flat", seed=seed, line=LaserLine(unevenness=0.0))
        frames = scan(Renderer(plate, rows=300, columns=64), 15, step_um=60.0)
        sums.append(frames.sum(axis=2).mean())
    assert float(np.mean(sums)) == pytest.approx(7.0 * 1.0645 * 3.0277 * 1.012, rel=0.015)


def test_the_line_is_as_wide_as_blur_and_pixel_make_it() -> None:
    profile = scan(Renderer(scene("flat", seed=1), rows=400, columns=64), 60).mean(axis=(0, 1)).astype(np.float64)
    fine = np.interp(np.linspace(0, 63, 6301), np.arange(64), profile)
    fwhm = (fine > fine.max() / 2).sum() / 100
    assert 3.03 < fwhm < 4.2


def test_a_wider_pupil_than_the_samples_can_carry_is_refused() -> None:
    from scanning.errors import BadInput

    with pytest.raises(BadInput, match=r"f/2 is wider than IS1 can be simulated with; use f/3\.3"):
        scene("flat", f_number=2.0)
