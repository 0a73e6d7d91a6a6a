"""The GenTL adapter against the simulator producer in the genicam wheel; skipped where harvesters is not installed.

That simulator has neither trigger nor exposure and shows a bouncing ball, so what is proven is the path: producer file,
device, region, buffers, formats, time-outs.
"""

from __future__ import annotations

import importlib
import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scanning.errors import BadInput, CameraFault
from scanning.rig.gentl import GenTLCamera
from scanning.rig.protocols import Camera, Frame, OverlappingCamera, SensorMode
from scanning.rig.rig import open_rig
from scanning.rig.session import ScanPlan, acquire
from scanning.rig.simulated.bench import Bench

genicam = pytest.importorskip("genicam")
pytest.importorskip("harvesters")

PRODUCER = str(Path(genicam.__file__).with_name("viky.cti"))
MODE = SensorMode(rows=120, columns=160)
FREE_RUNNING: dict[str, Any] = {"trigger": "none", "fixed_exposure_us": 1000.0}


@pytest.fixture
def open_camera() -> Iterator[Callable[..., GenTLCamera]]:
    cameras: list[GenTLCamera] = []

    def make(**options: Any) -> GenTLCamera:
        settings: dict[str, Any] = {"serial": "1"} | FREE_RUNNING | options
        cameras.append(GenTLCamera(PRODUCER, **settings))
        cameras[-1].open()
        return cameras[-1]

    yield make
    for camera in cameras:
        camera.close()


def test_frames_arrive_with_the_size_asked_for_and_rising_numbers(open_camera: Callable[..., GenTLCamera]) -> None:
    camera: Camera = open_camera(features={"AcquisitionFrameRate": 100.0})
    assert not isinstance(camera, OverlappingCamera)
    camera.configure(MODE)
    frames = [camera.grab(1000.0, timeout_s=2.0) for _ in range(3)]
    assert all(frame.image.shape == (120, 160) and frame.image.dtype == np.uint8 for frame in frames)
    assert [frame.frame_id for frame in frames] == [1, 2, 3]
    assert all(frame.image.max() == 255 for frame in frames)
    camera.configure(SensorMode(rows=100, columns=200))
    assert camera.grab(1000.0, timeout_s=2.0).image.shape == (100, 200)


def test_a_frame_owns_its_memory(open_camera: Callable[..., GenTLCamera]) -> None:
    camera = open_camera(features={"AcquisitionFrameRate": 100.0})
    camera.configure(MODE)
    first = camera.grab(1000.0, timeout_s=2.0)
    kept = first.image.copy()
    for _ in range(3):
        camera.grab(1000.0, timeout_s=2.0)
    assert np.array_equal(first.image, kept)


def test_a_frame_that_does_not_come_in_time(open_camera: Callable[..., GenTLCamera]) -> None:
    camera = open_camera(features={"AcquisitionFrameRate": 1.0})
    camera.configure(MODE)
    camera.grab(1000.0, timeout_s=3.0)
    with pytest.raises(CameraFault, match=r"sent nothing within 0\.05 s; check its supply, cable and trigger"):
        camera.grab(1000.0, timeout_s=0.05)


def test_a_frame_with_parts_lost_is_told(
    open_camera: Callable[..., GenTLCamera], monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = open_camera(features={"AcquisitionFrameRate": 100.0})
    camera.configure(MODE)
    logging.getLogger("harvesters").setLevel(logging.ERROR)
    with monkeypatch.context() as patch:
        patch.setattr(genicam.gentl.Buffer, "is_complete", lambda self: False)
        with pytest.raises(CameraFault, match="sent an incomplete frame; check its cable and the load on its network"):
            camera.grab(1000.0, timeout_s=2.0)
    assert camera.grab(1000.0, timeout_s=2.0).image.shape == (120, 160)


def test_what_cannot_be_is_one_sentence(open_camera: Callable[..., GenTLCamera]) -> None:
    with pytest.raises(CameraFault, match=r"3 cameras fit the GenTL camera \(found: 0, 1, 2\); .* serial number"):
        open_camera(serial=None)
    with pytest.raises(CameraFault, match="has no TriggerSelector; correct the rig's camera settings"):
        open_camera(trigger="software")
    with pytest.raises(
        CameraFault, match=r"There is no GenTL producer /nowhere\.cti; install the camera maker's driver"
    ):
        GenTLCamera("/nowhere.cti").open()
    with pytest.raises(BadInput, match="set it to 'software' or 'none'"):
        GenTLCamera(PRODUCER, trigger="hardware")
    camera = open_camera()
    with pytest.raises(CameraFault, match="refuses Height = 5000"):
        camera.configure(SensorMode(rows=5000, columns=160))
    camera.configure(MODE)
    with pytest.raises(CameraFault, match="exposes for 1000 us when asked for 300 us"):
        camera.grab(300.0, timeout_s=1.0)
    camera = open_camera(serial="2", fixed_exposure_us=None)
    camera.configure(MODE)
    with pytest.raises(CameraFault, match="has no exposure setting; state its exposure as fixed_exposure_us"):
        camera.grab(300.0, timeout_s=1.0)


def test_without_harvesters_the_sentence_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> Any:
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", absent)
    with pytest.raises(CameraFault, match="not installed here; run 'pip install --require-hashes -r requirements-cam"):
        GenTLCamera(PRODUCER).open()


class _Run:
    def read(self) -> Any:
        return "run"


def test_a_scan_with_a_stage_and_this_camera(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench()
    config = {
        "name": "Rig 1",
        "stage": {"driver": "grbl", "port": bench.port, "travel_mm": 100.0},
        "camera": {
            "driver": "gentl", "producer": PRODUCER, "serial": "1", "features": {"AcquisitionFrameRate": 100.0},
            **FREE_RUNNING,
        },
    }  # fmt: skip
    seen: list[tuple[int, list[Frame]]] = []
    plan = ScanPlan(start_mm=1.0, steps=4, exposures_us=(1000.0,), mode=MODE)
    with open_rig(config) as rig:
        done = acquire(rig, plan, on_frames=lambda step, frames: seen.append((step, frames)), control=_Run())
    assert done.steps_done == 4
    assert [step for step, _ in seen] == [0, 1, 2, 3]
