"""Grey values: linear in time, Poisson in spread, clipped at full well, logarithmic on the second system."""

from __future__ import annotations

import numpy as np
import pytest

from scanning.errors import BadInput
from scanning.rig.simulated.sensor import LinearSensor, LogarithmicSensor


def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def test_mean_grey_value_grows_in_proportion_to_exposure() -> None:
    light = np.full((200, 200), 5.0, dtype=np.float32)
    sensor = LinearSensor()
    net = [float(sensor.expose(light, e, rng()).mean()) - sensor.dark_level for e in (100.0, 300.0, 900.0)]
    assert net[1] / net[0] == pytest.approx(3.0, rel=0.01)
    assert net[2] / net[0] == pytest.approx(9.0, rel=0.01)


@pytest.mark.parametrize("electrons", [0.0, 20.0, 160.0, 1500.0, 7000.0])
def test_mean_and_spread_are_those_of_counted_photons_and_read_noise(electrons: float) -> None:
    sensor = LinearSensor(bits=16, gain_spread=0.0, offset_spread_e=0.0, dark_current_e_per_us=0.0)
    image = sensor.expose(np.full((400, 400), electrons / 100.0, dtype=np.float32), 100.0, rng()).astype(float)
    counted = rng().poisson(electrons, 160_000) + rng().normal(0.0, 9.0, 160_000)
    assert (image.mean() - sensor.dark_level) / sensor.codes_per_e == pytest.approx(counted.mean(), abs=0.6)
    assert image.std() / sensor.codes_per_e == pytest.approx(counted.std(), rel=0.015)
    for share in (0.01, 0.99):
        drawn = (np.quantile(image, share) - sensor.dark_level) / sensor.codes_per_e
        assert drawn == pytest.approx(np.quantile(counted, share), abs=0.04 * counted.std() + 1.0)


def test_a_full_pixel_saturates_and_does_not_spill() -> None:
    light = np.full((5, 5), 1.0, dtype=np.float32)
    light[2, 2] = 1e5
    image = LinearSensor().expose(light, 300.0, rng())
    assert image[2, 2] == 255
    assert np.sort(image.ravel())[-2] < 20


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_other_depths_use_their_whole_range(bits: int) -> None:
    sensor = LinearSensor(bits=bits)
    image = sensor.expose(np.full((10, 10), 1e4, dtype=np.float32), 300.0, rng())
    assert image.dtype == (np.uint8 if bits == 8 else np.uint16)
    assert int(image.min()) == sensor.saturation == 2**bits - 1


def test_the_dynamic_range_is_the_papers_60_db() -> None:
    sensor = LinearSensor()
    assert 20 * np.log10(sensor.full_well_e / sensor.read_noise_e) == pytest.approx(60.0)


def test_the_same_draw_gives_the_same_image_and_another_draw_another() -> None:
    light = np.full((50, 50), 3.0, dtype=np.float32)
    sensor = LinearSensor()
    assert np.array_equal(sensor.expose(light, 300.0, rng()), sensor.expose(light, 300.0, rng()))
    assert not np.array_equal(sensor.expose(light, 300.0, rng()), sensor.expose(light, 300.0, np.random.default_rng(8)))


def test_the_logarithmic_pixel_gives_equal_codes_per_decade_over_120_db_and_no_time() -> None:
    sensor = LogarithmicSensor()
    codes = []
    for decade in range(2, 7):
        image = sensor.expose(np.full((100, 100), 0.01 * 10.0**decade, dtype=np.float32), 0.0, rng())
        codes.append(float(image.mean()))
    assert np.diff(codes[:-1]) == pytest.approx([42.5] * 3, abs=0.4)
    assert codes[-1] == pytest.approx(255.0, abs=0.6)
    light = np.full((20, 20), 2.0, dtype=np.float32)
    assert np.array_equal(sensor.expose(light, 100.0, rng()), sensor.expose(light, 900.0, rng()))


def test_impossible_exposures_and_shapes_are_refused() -> None:
    light = np.ones((4, 4), dtype=np.float32)
    for exposure in (0.0, -5.0, float("nan")):
        with pytest.raises(BadInput):
            LinearSensor().expose(light, exposure, rng())
    with pytest.raises(BadInput, match="rows, columns"):
        LinearSensor().expose(light.ravel(), 100.0, rng())
    with pytest.raises(BadInput, match="bits"):
        LinearSensor(bits=9)
