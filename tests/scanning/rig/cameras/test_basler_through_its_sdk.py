"""The pylon adapter against the camera emulator in Basler's own SDK; skipped where pypylon is not installed.

The emulator sends the PNG files of a folder in the order of their names, bit by bit, whatever the exposure is.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from scanning.errors import BadInput, CameraFault
from scanning.rig.protocols import Camera, Frame, OverlappingCamera, SensorMode
from scanning.rig.pylon import PylonCamera
from scanning.rig.rig import open_rig
from scanning.rig.session import ScanPlan, acquire
from scanning.rig.simulated.bench import Bench

os.environ["PYLON_CAMEMU"] = "1"  # read by the SDK when it first looks for cameras
pytest.importorskip("pypylon")

EMULATED = "0815-0000"
MODE = SensorMode(rows=48, columns=64)


@pytest.fixture
def open_camera() -> Iterator[Callable[..., PylonCamera]]:
    cameras: list[PylonCamera] = []

    def make(**options: Any) -> PylonCamera:
        cameras.append(PylonCamera(EMULATED, **options))
        cameras[-1].open()
        return cameras[-1]

    yield make
    for camera in cameras:
        camera.close()


def pictures(folder: Path, count: int, *, top: int = 200) -> list[np.ndarray]:
    """A laser line that wanders and grows brighter, as PNG files."""
    rows, columns = np.mgrid[0 : MODE.rows, 0 : MODE.columns]
    made = []
    for k in range(count):
        line = (k + 1) / count * top * np.exp(-(((columns - 20 - k - rows / 8) / 2.5) ** 2))
        made.append(np.round(line).astype(np.uint8))
        assert cv2.imwrite(str(folder / f"{k:03d}.png"), made[-1])
    return made


def showing(folder: Path) -> dict[str, str]:
    return {"TestImageSelector": "Off", "ImageFilename": str(folder), "ImageFileMode": "On"}


def test_it_is_a_camera_that_can_overlap(open_camera: Callable[..., PylonCamera]) -> None:
    camera: Camera = open_camera()
    assert isinstance(camera, OverlappingCamera)


def test_frames_come_bit_by_bit_in_order(open_camera: Callable[..., PylonCamera], tmp_path: Path) -> None:
    shown = pictures(tmp_path, 6)
    camera = open_camera(features=showing(tmp_path))
    camera.configure(MODE)
    frames = [camera.grab(100.0 * (1 + k), timeout_s=2.0) for k in range(3)]
    for exposure in (400.0, 500.0, 600.0):  # a bracket exposed first and read out later
        camera.expose(exposure, timeout_s=2.0)
    frames += [camera.read_out(timeout_s=2.0) for _ in range(3)]
    assert [frame.exposure_us for frame in frames] == [100.0, 200.0, 300.0, 400.0, 500.0, 600.0]
    assert all(np.array_equal(frame.image, picture) for frame, picture in zip(frames, shown, strict=True))
    assert [frame.frame_id for frame in frames] == [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize(
    ("pixel_format", "bits", "kind", "saturation", "pitch"),
    [("Mono12", 12, np.uint16, 4095, 1), ("Mono16", 16, np.uint16, 65535, 1), ("BayerRG8", 8, np.uint8, 255, 2),
     ("BayerGB12", 12, np.uint16, 4095, 2)],
)  # fmt: skip
def test_pixel_formats(
    open_camera: Callable[..., PylonCamera],
    pixel_format: str,
    bits: int,
    kind: type[np.generic],
    saturation: int,
    pitch: int,
) -> None:
    camera = open_camera(pixel_format=pixel_format)
    camera.configure(SensorMode(rows=48, columns=64, row_offset=3, column_offset=5, bits=bits))
    frame = camera.grab(1000.0, timeout_s=2.0)
    assert frame.image.shape == (48, 64)
    assert frame.image.dtype == np.dtype(kind)
    assert (camera.saturation, camera.pitch_factor) == (saturation, pitch)


def test_an_incomplete_frame_is_told_and_the_next_one_is_good(open_camera: Callable[..., PylonCamera]) -> None:
    camera = open_camera(features={"ForceFailedBufferCount": 1})
    camera.configure(MODE)
    camera.grab(100.0, timeout_s=2.0)
    camera._set("ForceFailedBufferCount", 1)
    camera._node("ForceFailedBuffer").Execute()  # type: ignore[union-attr]
    with pytest.raises(CameraFault, match=r"incomplete frame .* check its cable and the load on its network"):
        camera.grab(100.0, timeout_s=2.0)
    assert camera.grab(100.0, timeout_s=2.0).image.shape == (48, 64)


def test_a_camera_that_sends_nothing_is_told_in_time_and_the_late_frame_is_not_believed(
    open_camera: Callable[..., PylonCamera], tmp_path: Path
) -> None:
    shown = pictures(tmp_path, 3)
    camera = open_camera(features=showing(tmp_path))
    camera.configure(MODE)
    camera._trigger(100.0, 1.0)  # exposed, but the answer is not waited for
    camera._unread.append(100.0)
    camera.read_out(timeout_s=1.0)
    with pytest.raises(CameraFault, match=r"sent nothing within 0\.10 s; check its supply, cable and trigger"):
        camera.read_out(timeout_s=0.1)  # nobody triggered
    frame = camera.grab(100.0, timeout_s=1.0)
    assert any(np.array_equal(frame.image, picture) for picture in shown)
    assert frame.frame_id == 2


def test_what_cannot_be_set_is_one_sentence(open_camera: Callable[..., PylonCamera]) -> None:
    camera = open_camera()
    with pytest.raises(CameraFault, match=r"refuses Height = 5000 \(.*\); correct the rig's camera settings"):
        camera.configure(SensorMode(rows=5000, columns=64))
    camera.configure(MODE)
    with pytest.raises(CameraFault, match=r"refuses ExposureTime = 0\.3 "):
        camera.grab(0.3, timeout_s=1.0)
    with pytest.raises(CameraFault, match="holds no exposed frame; expose first"):
        camera.read_out(timeout_s=1.0)
    with pytest.raises(BadInput, match="bits and the pixel format agree"):
        camera.configure(SensorMode(rows=48, columns=64, bits=12))
    with pytest.raises(CameraFault, match="cannot set Nonsense to 1"):
        PylonCamera(EMULATED, features={"Nonsense": 1}).open()


def test_a_camera_that_is_not_there() -> None:
    with pytest.raises(CameraFault, match=r"0 cameras fit the Basler camera 4711 \(found: 0815-0000\); check"):
        PylonCamera("4711").open()


def test_a_camera_that_is_unplugged(open_camera: Callable[..., PylonCamera]) -> None:
    camera = open_camera()
    camera.configure(MODE)
    sdk = camera._camera

    class Unplugged:
        """The SDK's behaviour when a device vanishes: every call fails, and it knows why."""

        def __getattr__(self, name: str) -> Any:
            raise camera._genicam.RuntimeException("The device has been removed.")

        def IsGrabbing(self) -> bool:
            return True

        def IsCameraDeviceRemoved(self) -> bool:
            return True

    camera._camera = Unplugged()
    with pytest.raises(CameraFault, match="was disconnected; check its cable and supply, then open the rig again"):
        camera.grab(100.0, timeout_s=1.0)
    sdk.Close()
    camera.open()
    camera.configure(MODE)
    assert camera.grab(100.0, timeout_s=2.0).image.shape == (48, 64)


def test_without_the_driver_the_sentence_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> Any:
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", absent)
    with pytest.raises(CameraFault, match="not installed here; run 'pip install --require-hashes -r requirements-cam"):
        PylonCamera().open()


class _Run:
    def read(self) -> Any:
        return "run"


def test_a_scan_with_a_stage_and_this_camera(make_bench: Callable[..., Bench], tmp_path: Path) -> None:
    """The whole loop: a GRBL stage, a laser, a Basler camera, brackets of two."""
    shown = pictures(tmp_path, 13)  # the first is the frame with the laser off
    bench = make_bench()
    config = {
        "name": "Rig 1",
        "stage": {"driver": "grbl", "port": bench.port, "travel_mm": 100.0},
        "camera": {
            "driver": "pylon", "serial": EMULATED, "shutter_margin_us": 500.0,
            "features": showing(tmp_path),
        },
    }  # fmt: skip
    seen: list[tuple[int, list[Frame]]] = []
    plan = ScanPlan(start_mm=1.0, steps=6, exposures_us=(200.0, 900.0), mode=MODE)
    with open_rig(config) as rig:
        done = acquire(rig, plan, on_frames=lambda step, frames: seen.append((step, frames)), control=_Run())
    assert done.steps_done == 6
    assert done.retaken_frames == 0
    images = [frame.image for _, frames in seen for frame in frames]
    assert all(np.array_equal(image, picture) for image, picture in zip(images, shown[1:], strict=True))
