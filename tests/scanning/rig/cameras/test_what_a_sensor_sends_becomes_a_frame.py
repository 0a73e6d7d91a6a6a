"""Pixel formats, regions and frame numbers: the same for every maker, so tested without any of them."""

from __future__ import annotations

import numpy as np
import pytest

from scanning.errors import BadInput, CameraFault
from scanning.rig.frame_numbers import FrameNumbers
from scanning.rig.protocols import SensorMode
from scanning.rig.sensor_pixels import frame_image, sensor_format, sensor_region

CELLS = {  # the first two pixels of the first two rows, as the PFNC names say
    "BayerRG8": ["RG", "GB"],
    "BayerGR8": ["GR", "BG"],
    "BayerGB8": ["GB", "RG"],
    "BayerBG8": ["BG", "GR"],
}


@pytest.mark.parametrize(("name", "cell"), CELLS.items())
def test_a_bayer_frame_is_its_red_sites(name: str, cell: list[str]) -> None:
    mode = SensorMode(rows=3, columns=4, row_offset=5, column_offset=7)
    pixels = sensor_format(name)
    region = sensor_region(mode, pixels)
    assert (region.height, region.width, region.top, region.left) == (6, 8, 10, 14)  # even: the mosaic's phase is kept
    light = np.arange(12, dtype=np.uint8).reshape(3, 4) + 100
    sensor = np.zeros((6, 8), np.uint8)
    for row in range(6):
        for column in range(8):
            if cell[row % 2][column % 2] == "R":
                sensor[row, column] = light[row // 2, column // 2]
    assert np.array_equal(frame_image(sensor, region, pixels), light)
    assert pixels.pitch_factor == 2


def test_a_monochrome_frame_is_what_was_sent_and_its_own_memory() -> None:
    pixels = sensor_format("Mono12")
    mode = SensorMode(rows=2, columns=3, bits=12)
    sent = np.array([[0, 1, 4095], [7, 8, 9]], np.uint16)
    frame = frame_image(sent, sensor_region(mode, pixels), pixels)
    sent[:] = 0
    assert frame.tolist() == [[0, 1, 4095], [7, 8, 9]]
    assert (pixels.saturation, pixels.pitch_factor) == (4095, 1)


def test_a_camera_that_lies_on_its_side() -> None:
    pixels = sensor_format("Mono8")
    mode = SensorMode(rows=4, columns=2, row_offset=10, column_offset=20)
    region = sensor_region(mode, pixels, turned=True)
    assert (region.height, region.width, region.top, region.left) == (2, 4, 20, 10)
    sent = np.arange(8, dtype=np.uint8).reshape(2, 4)
    frame = frame_image(sent, region, pixels, turned=True)
    assert frame.tolist() == [[0, 4], [1, 5], [2, 6], [3, 7]]
    assert frame.flags.c_contiguous


def test_a_frame_of_another_size_or_type_is_refused() -> None:
    pixels = sensor_format("Mono8")
    region = sensor_region(SensorMode(rows=4, columns=2), pixels)
    with pytest.raises(CameraFault, match="a frame of 4x3 pixels instead of 4x2; check the camera's region"):
        frame_image(np.zeros((4, 3), np.uint8), region, pixels)
    with pytest.raises(CameraFault, match="pixels of type uint16 in format Mono8"):
        frame_image(np.zeros((4, 2), np.uint16), region, pixels)


@pytest.mark.parametrize("name", ["Mono12Packed", "Mono10p", "RGB8", "BayerXY8", "mono8", ""])
def test_formats_that_hold_no_plain_grey_values_are_refused(name: str) -> None:
    with pytest.raises(BadInput, match="choose Mono8, Mono10, Mono12, Mono16 or a Bayer format"):
        sensor_format(name)


@pytest.mark.parametrize(("name", "bits"), [("Mono8", 12), ("Mono12", 8)])
def test_bits_that_do_not_fit_the_format_are_refused(name: str, bits: int) -> None:
    with pytest.raises(BadInput, match="make the rig's bits and the pixel format agree"):
        sensor_region(SensorMode(rows=1, columns=1, bits=bits), sensor_format(name))


def test_numbers_rise_over_a_wrap_a_loss_and_a_restart_and_stand_still_for_a_stuck_camera() -> None:
    numbers = FrameNumbers()
    assert [numbers.number(k) for k in (65533, 65534, 65535, 1, 2)] == [1, 2, 3, 4, 5]  # GigE Vision skips 0
    assert numbers.number(5) == 8  # two frames were lost on the way
    numbers.restart()
    assert numbers.number(1) == 9
    assert numbers.number(1) == 9
    numbers.restart()
    assert numbers.number(1) == 10
