"""What a stage, a camera and a laser must be able to do, and nothing more.

The acquisition loop (`session.py`) talks only to these. A new controller or camera is one new file that satisfies one
of them; without this seam every vendor's habits would leak into the loop that must never leave the laser on.
Every call either returns, or raises a `RigFault` within a time it owns. Nothing waits for ever.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8] | NDArray[np.uint16]


@dataclass(frozen=True)
class Frame:
    """One camera image with what is needed to trust it.

    ``image`` is (rows, columns), rows along the laser line. ``frame_id`` counts up; the same id twice means a stuck
    camera. ``taken_at_s`` is the camera's or host's monotonic clock in seconds.
    """

    image: Image
    exposure_us: float
    frame_id: int
    taken_at_s: float


@dataclass(frozen=True)
class SensorMode:
    """The region of interest a camera is set to, in pixels, and what its grey values mean."""

    rows: int
    columns: int
    row_offset: int = 0
    column_offset: int = 0
    bits: int = 8


@dataclass(frozen=True)
class LinkQuality:
    """How clean the serial line was: lines sent, lines repeated or unreadable, controller resets seen."""

    lines_sent: int = 0
    bad_lines: int = 0
    retries: int = 0
    resets: int = 0


class Stage(Protocol):
    """A linear stage positioned in whole motor steps; the host keeps the count, so positions never drift."""

    step_um: float
    """Length of one motor step in micrometres (0.49 on the paper's stage)."""
    travel_mm: float
    """Usable travel from zero, in millimetres."""

    def open(self) -> None: ...
    def close(self) -> None: ...
    def home(self) -> None: ...
    def move_to(self, steps: int) -> None:
        """Move to an absolute position in motor steps and return when the stage stands still."""
        ...

    @property
    def position_steps(self) -> int: ...
    def park(self) -> None:
        """Go to the safe loading position. Never raises for a stage that is already there."""
        ...

    def emergency_stop(self) -> None:
        """Feed hold and laser off at once, from any thread."""
        ...

    def link_quality(self) -> LinkQuality: ...


@runtime_checkable
class OverlappingStage(Protocol):
    """A stage that lets the host do something else on the way: the camera's frames are read out while it moves."""

    def move_to_while(self, steps: int, meanwhile: Callable[[], None]) -> None:
        """`Stage.move_to`, calling ``meanwhile`` once when the move is under way, or at once where there is none.

        Before it sets out it makes sure that it stands where it was sent last; else it raises without ``meanwhile``.

        What ``meanwhile`` raises comes out when the stage stands still.
        """
        ...


class Laser(Protocol):
    """The line laser. `off` must work in any state and is called in every ``finally``."""

    def on(self) -> None: ...
    def off(self) -> None: ...


class Camera(Protocol):
    """A camera that is triggered by software for one exposure at a time."""

    saturation: int
    """The grey value at which a pixel says no more (255 for 8 bit)."""

    def open(self) -> None: ...
    def close(self) -> None: ...
    def configure(self, mode: SensorMode) -> None: ...
    def grab(self, exposure_us: float, *, timeout_s: float) -> Frame:
        """Expose once and return the frame, or raise `CameraFault` within ``timeout_s`` plus the exposure."""
        ...


@runtime_checkable
class OverlappingCamera(Protocol):
    """A camera that tells when the shutter has closed, so that the stage may move on while the frame is read out.

    Any number of exposures up to one bracket may be taken before they are read out, oldest first. A camera without this
    ability (plain `Camera`) still works; each step then takes its read-out time longer.
    """

    def expose(self, exposure_us: float, *, timeout_s: float) -> None:
        """Expose once and return when the shutter has closed."""
        ...

    def read_out(self, *, timeout_s: float) -> Frame:
        """Return the oldest frame not read yet, or raise `CameraFault` within ``timeout_s``."""
        ...
