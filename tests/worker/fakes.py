"""A stage, a laser and a camera that satisfy the protocols and can be told when to fail. No time passes on them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from scanning.errors import CameraFault, StageFault
from scanning.rig.protocols import Frame, Image, LinkQuality, SensorMode
from scanning.rig.rig import Rig

COLUMN_OF_LINE = 60.0


def line_image(rows: int, columns: int, step: int, exposure_us: float) -> Image:
    """A laser line that drifts with the step: Gaussian, 3 px wide, brighter the longer the exposure."""
    column = np.arange(columns)
    centre = COLUMN_OF_LINE + 0.1 * np.sin(np.arange(rows) / 9.0) + 0.02 * step
    peak = min(60.0 * exposure_us / 100.0, 1000.0)
    light = peak * np.exp(-((column - centre[:, None]) ** 2) / (2 * 1.3**2)) + 2.0
    image: Image = np.minimum(np.round(light), 255).astype(np.uint8)
    return image


class FakeRig:
    """`FakeRig().opening` stands in for `scanning.rig.rig.open_rig`. ``during`` is called before every grab."""

    step_um = 0.49
    travel_mm = 100.0
    saturation = 255

    def __init__(self, during: Callable[[FakeRig], None] = lambda rig: None) -> None:
        self.during = during
        self.lit = False
        self.halted = False
        self.parked = 0
        self.homed = 0
        self.position = 0
        self.frames = 0
        self.grabs = 0
        self.opened = 0
        self.mode = SensorMode(1, 1)

    @contextmanager
    def opening(self, config: Mapping[str, Any]) -> Iterator[Rig]:
        self.opened += 1
        yield Rig(self, self, self, str(config["name"]))

    # stage
    def open(self) -> None: ...
    def close(self) -> None: ...
    def home(self) -> None:
        self.halted = False
        self.homed += 1

    def move_to(self, steps: int) -> None:
        self._check()
        self.position = steps

    def _check(self) -> None:
        if self.halted:
            raise StageFault("Emergency stop: the stage was halted and the laser is off; home the stage.")

    @property
    def position_steps(self) -> int:
        self._check()
        return self.position

    def park(self) -> None:
        self.parked += 1

    def emergency_stop(self) -> None:
        self.lit, self.halted = False, True

    def link_quality(self) -> LinkQuality:
        return LinkQuality(lines_sent=self.grabs)

    # laser
    def on(self) -> None:
        self.lit = True

    def off(self) -> None:
        self.lit = False

    # camera
    def configure(self, mode: SensorMode) -> None:
        self.mode = mode

    def grab(self, exposure_us: float, *, timeout_s: float) -> Frame:
        self.grabs += 1
        self.during(self)
        self.frames += 1
        if self.lit:
            image = line_image(self.mode.rows, self.mode.columns, self.position // 17, exposure_us)
        else:
            image = np.full((self.mode.rows, self.mode.columns), 2, np.uint8)
        return Frame(image, exposure_us, self.frames, 0.0)


def at_grab(number: int, act: Callable[[], None]) -> Callable[[FakeRig], None]:
    """Do ``act`` once, at the camera's ``number``-th grab (the first is the dark one)."""

    def during(rig: FakeRig) -> None:
        if rig.grabs == number:
            act()

    return during


def camera_falls_silent() -> None:
    raise CameraFault("The camera sent nothing within 5 s; check its cable and power.")
