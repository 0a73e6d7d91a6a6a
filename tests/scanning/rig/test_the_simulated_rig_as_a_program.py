"""``python -m scanning.rig.simulated`` with the real optics: a separate process, a real scan, a clean end."""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from scanning.errors import CameraFault
from scanning.rig.protocols import Frame, SensorMode
from scanning.rig.rig import open_rig
from scanning.rig.session import Order, ScanPlan, acquire
from scanning.rig.simulated.bench import Bench
from scanning.rig.simulated.camera import SimulatedCamera

ROOT = Path(__file__).resolve().parents[3]


class Run:
    def read(self) -> Order:
        return "run"


@pytest.fixture
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="rig") as name:
        yield Path(name)


def start(folder: Path, *options: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "scanning.rig.simulated", "--dir", str(folder), *options]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_it_serves_a_scan_of_a_knife_and_ends_cleanly(folder: Path) -> None:
    process = start(folder, "--speed-up", "100", "--scene", "R1")
    try:
        assert process.stdout is not None
        assert "Simulated rig ready" in process.stdout.readline()
        got: list[list[Frame]] = []
        config = {
            "stage": {"driver": "grbl", "port": str(folder / "stage.tty"), "travel_mm": 100},
            "camera": {"driver": "simulated", "address": str(folder / "camera.sock")},
        }
        plan = ScanPlan(10.0, 5, (100.0, 1000.0), SensorMode(rows=120, columns=256), frame_timeout_s=60.0)
        with open_rig(config) as rig:
            assert isinstance(rig.camera, SimulatedCamera)
            rig.camera.load_part("R2", seed=3)
            summary = acquire(rig, plan, on_frames=lambda _, frames: got.append(frames), control=Run())
            with pytest.raises(CameraFault, match="R9"):
                rig.camera.load_part("R9")
        assert summary.dark_level < 10
        assert len(got) == 5
        bright = [frames[1].image.max(axis=1) for frames in got]
        assert np.mean([np.median(rows) for rows in bright]) > 100  # the line is there
        assert not np.array_equal(got[0][0].image, got[1][0].image)
        assert got[0][1].image.astype(float).sum() > 3 * (got[0][0].image.astype(float).sum() - 2.5 * 120 * 256)
    finally:
        process.send_signal(signal.SIGTERM)
        _, trouble = process.communicate(timeout=10)
    assert process.returncode == 0, trouble
    assert not (folder / "stage.tty").exists()
    assert not (folder / "camera.sock").exists()


def test_a_wrong_speed_is_one_sentence(folder: Path) -> None:
    process = start(folder, "--speed-up", "0")
    _, trouble = process.communicate(timeout=20)
    assert process.returncode == 1
    assert trouble.strip() == "The speed-up is 0.0; it must be above 0."


def test_a_directory_too_deep_for_a_socket_works_all_the_same(folder: Path) -> None:
    """The kernel takes socket paths of 107 bytes; a clone may lie anywhere."""
    deep = folder / ("deep" * 20) / ("er" * 30)
    with Bench(deep, speed_up=1000.0) as bench:
        camera = SimulatedCamera(bench.camera_address)
        assert camera.bench_state()["laser"] == 0.0
        camera.close()
    assert not list(deep.iterdir())
