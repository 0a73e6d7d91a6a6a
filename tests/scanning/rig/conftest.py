"""A bench with cheap light for tests: the picture says where the stage was and whether the laser shone."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scanning.rig.grbl import GrblLaser, GrblStage
from scanning.rig.protocols import SensorMode
from scanning.rig.simulated.bench import Bench, Optics, Part
from scanning.rig.simulated.controller import Controller

SPEED_UP = 300.0
STEP_UM = 0.49


class PositionLight:
    """Pixel (0, 0) holds the stage position in motor steps, pixel (0, 1) the laser, pixel (0, 2) the exposure in us."""

    def __init__(self, mode: SensorMode) -> None:
        self.mode = mode

    def irradiance(self, position_um: float, laser_on: bool = True) -> np.ndarray:
        field = np.zeros((self.mode.rows, self.mode.columns), np.float32)
        field[0, 0], field[0, 1] = position_um, laser_on
        return field

    def expose(self, irradiance: np.ndarray, exposure_us: float, rng: np.random.Generator) -> np.ndarray:
        image = np.zeros(irradiance.shape, np.uint16)
        image[0, 0] = round(float(irradiance[0, 0]) / STEP_UM)
        image[0, 1] = round(float(irradiance[0, 1]))
        image[0, 2] = round(exposure_us)
        return image


def position_lighting(part: Part, mode: SensorMode) -> Optics:
    return Optics(PositionLight(mode), 65535, "linear")


MODE = SensorMode(rows=4, columns=8, bits=16)


@pytest.fixture
def make_bench() -> Iterator[Callable[..., Bench]]:
    benches: list[tuple[Bench, tempfile.TemporaryDirectory[str]]] = []

    def make(*, speed_up: float = SPEED_UP, settings: dict[int, float] | None = None, **options: Any) -> Bench:
        folder = tempfile.TemporaryDirectory(prefix="rig")  # short: a socket's path has room for 107 characters
        bench = Bench(
            Path(folder.name),
            speed_up=speed_up,
            part=Part("position", start_mm=0.0),
            controller=Controller(settings=settings),
            lighting=position_lighting,
            **options,
        )
        bench.start()
        benches.append((bench, folder))
        return bench

    yield make
    for bench, folder in benches:
        bench.stop()
        folder.cleanup()


@pytest.fixture
def bench(make_bench: Callable[..., Bench]) -> Bench:
    return make_bench()


@pytest.fixture
def stage(bench: Bench) -> Iterator[GrblStage]:
    """An open, homed stage on the bench."""
    stage = GrblStage(bench.port, travel_mm=100.0)
    stage.open()
    stage.home()
    yield stage
    stage.close()


@pytest.fixture
def laser(stage: GrblStage) -> GrblLaser:
    return GrblLaser(stage)


def laser_of(bench: Bench) -> float:
    return float(bench.state()["laser"])


def wait_until(condition: Callable[[], bool], *, within_s: float = 2.0) -> bool:
    """Whether something another thread does comes true in time; blocks on nothing longer than 2 ms."""
    import threading
    import time

    pause, end = threading.Event(), time.monotonic() + within_s
    while time.monotonic() < end:
        if condition():
            return True
        pause.wait(0.002)
    return condition()
