"""How a stepper stage really gets from here to there: queued straight moves with finite acceleration.

GRBL 1.1's planner and stepper in closed form. Between events the stage has a constant acceleration, so its position at
any instant is one formula and the emulation needs no ticking. Without real trapezoids a 17-step move would take no
time, the laser line would never smear, and every timeout in the driver would go untested.

Times are machine seconds, lengths millimetres, positions whole motor steps of three axes.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

Steps = tuple[int, int, int]

#: Junction deviation, GRBL's $11 default in mm: how far a corner may be cut; only matters when the direction changes.
JUNCTION_DEVIATION_MM = 0.01


@dataclass(frozen=True)
class Block:
    """One straight move. ``laser_scale`` tells what the move does to the laser: 1 keep, 0 dark (G0 in laser mode)."""

    start: Steps
    end: Steps
    length_mm: float
    direction: tuple[float, float, float]
    nominal_mm_s: float
    accel_mm_s2: float
    laser_scale: float = 1.0


@dataclass(frozen=True)
class _Segment:
    """Constant acceleration from ``begin_s`` to ``end_s``; ``at_mm`` and ``speed`` hold at its beginning."""

    begin_s: float
    end_s: float
    at_mm: float
    speed: float
    accel: float

    def state(self, now: float) -> tuple[float, float]:
        dt = min(max(now - self.begin_s, 0.0), self.end_s - self.begin_s)
        return self.at_mm + self.speed * dt + 0.5 * self.accel * dt * dt, max(self.speed + self.accel * dt, 0.0)


class Motion:
    """The queue of moves and the carriage that executes it."""

    def __init__(self, at: Steps = (0, 0, 0)) -> None:
        self.blocks: deque[Block] = deque()
        self.holding = False
        self._rest: Steps = at
        self._segments: list[_Segment] = []
        self._at_mm = 0.0  # how far into the present block, while it has no segments

    @property
    def idle(self) -> bool:
        return not self.blocks

    @property
    def end(self) -> Steps:
        """Where the stage will stand when everything queued is done."""
        return self.blocks[-1].end if self.blocks else self._rest

    def place(self, at: Steps) -> None:
        """Declare the present position (homing, power-on). Only while idle."""
        self._rest = at

    def add(self, block: Block, now: float) -> None:
        self.blocks.append(block)
        if not self.holding:
            self._plan(now)

    def hold(self, now: float) -> None:
        """Decelerate to a stop, keep the queue."""
        self.holding = True
        if self.blocks:
            self._plan(now)

    def resume(self, now: float) -> None:
        self.holding = False
        if self.blocks:
            self._plan(now)

    def drop(self, now: float) -> None:
        """Forget the queue and stand still where the carriage is now: step pulses simply cease."""
        self._rest = self.position(now)
        self.blocks.clear()
        self._segments = []
        self._at_mm = 0.0
        self.holding = False

    def stopped_in_hold(self, now: float) -> bool:
        return self.holding and (not self._segments or now >= self._segments[-1].end_s)

    def next_event(self) -> float | None:
        """When the present block ends, or the hold has come to rest; None while nothing moves."""
        return self._segments[-1].end_s if self._segments else None

    def finish_due(self, now: float) -> bool:
        """Take the present block off the queue if it is done at ``now``. True when something ended."""
        if not self._segments or now < self._segments[-1].end_s:
            return False
        ended = self._segments[-1].end_s
        self._at_mm, speed = self._segments[-1].state(ended)
        self._segments = []
        if self._at_mm >= self.blocks[0].length_mm - 1e-9:
            self._rest = self.blocks.popleft().end
            self._at_mm = 0.0
            if self.blocks:
                self._plan(ended, speed)
        return True

    def speed(self, now: float) -> float:
        """Speed along the path in mm/s."""
        return self._state(now)[1]

    def position(self, now: float) -> Steps:
        if not self.blocks:
            return self._rest
        return self._along(self.blocks[0], self._state(now)[0])

    def when_reached(self, axis: int, steps: float) -> float | None:
        """When the present block takes ``axis`` to ``steps``, or None if it does not."""
        if not self.blocks or not self._segments:
            return None
        block = self.blocks[0]
        travel = block.end[axis] - block.start[axis]
        if travel == 0:
            return None
        target_mm = (steps - block.start[axis]) / travel * block.length_mm
        for part in self._segments:
            stop_mm = part.state(part.end_s)[0]
            if part.at_mm <= target_mm <= stop_mm + 1e-12:
                return part.begin_s + _time_to(target_mm - part.at_mm, part.speed, part.accel)
        return None

    @staticmethod
    def _along(block: Block, at_mm: float) -> Steps:
        share = min(max(at_mm / block.length_mm, 0.0), 1.0)
        a, b = block.start, block.end
        return (
            a[0] + math.floor((b[0] - a[0]) * share + 0.5),
            a[1] + math.floor((b[1] - a[1]) * share + 0.5),
            a[2] + math.floor((b[2] - a[2]) * share + 0.5),
        )

    def _state(self, now: float) -> tuple[float, float]:
        if not self.blocks:
            return 0.0, 0.0
        for part in self._segments:
            if now < part.end_s:
                return part.state(now)
        if self._segments:
            return self._segments[-1].state(now)
        return self._at_mm, 0.0

    def _plan(self, now: float, speed: float | None = None) -> None:
        """Lay out the present block from ``now`` on. A given ``speed`` means it is being entered at that speed."""
        if speed is None:
            at_mm, speed = self._state(now)
        else:
            at_mm = 0.0
        block = self.blocks[0]
        left = max(block.length_mm - at_mm, 0.0)
        accel = block.accel_mm_s2
        if self.holding:
            self._at_mm = at_mm
            if speed == 0.0:
                self._segments = []
                return
            stop_mm = speed * speed / (2 * accel)
            if stop_mm <= left:
                self._segments = [_Segment(now, now + speed / accel, at_mm, speed, -accel)]
            else:
                leave = math.sqrt(max(speed * speed - 2 * accel * left, 0.0))
                self._segments = [_Segment(now, now + (speed - leave) / accel, at_mm, speed, -accel)]
            return
        leave = self._leaving_speed()
        leave = min(leave, math.sqrt(speed * speed + 2 * accel * left))
        top = min(block.nominal_mm_s, math.sqrt(max((2 * accel * left + speed * speed + leave * leave) / 2, 0.0)))
        top = max(top, speed, leave)
        up, down = (top * top - speed * speed) / (2 * accel), (top * top - leave * leave) / (2 * accel)
        cruise = max(left - up - down, 0.0)
        parts: list[_Segment] = []
        t, s = now, at_mm
        for length, v, a, dt in (
            (up, speed, accel, (top - speed) / accel),
            (cruise, top, 0.0, cruise / top if top > 0 else 0.0),
            (down, top, -accel, (top - leave) / accel),
        ):
            if dt > 0:
                parts.append(_Segment(t, t + dt, s, v, a))
                t, s = t + dt, s + length
        self._segments = parts or [_Segment(now, now, block.length_mm, speed, 0.0)]

    def _leaving_speed(self) -> float:
        """Fastest speed at the end of the present block from which everything queued can still stop in time."""
        entry = 0.0
        queued = list(self.blocks)
        for before, block in zip(reversed(queued[:-1]), reversed(queued[1:]), strict=True):
            reach = math.sqrt(entry * entry + 2 * block.accel_mm_s2 * block.length_mm)
            entry = min(reach, block.nominal_mm_s, before.nominal_mm_s, _junction_speed(before, block))
        return entry


def _junction_speed(before: Block, after: Block) -> float:
    """Corner speed by GRBL's junction deviation (planner.c): unlimited straight on, 0 for a reversal."""
    cos = -sum(a * b for a, b in zip(before.direction, after.direction, strict=True))
    if cos > 0.999999:
        return 0.0
    if cos < -0.999999:
        return math.inf
    sin_half = math.sqrt(0.5 * (1 - cos))
    accel = min(before.accel_mm_s2, after.accel_mm_s2)
    return math.sqrt(accel * JUNCTION_DEVIATION_MM * sin_half / (1 - sin_half))


def _time_to(distance: float, speed: float, accel: float) -> float:
    if abs(accel) < 1e-12:
        return distance / speed if speed > 0 else 0.0
    root = math.sqrt(max(speed * speed + 2 * accel * distance, 0.0))
    return (root - speed) / accel
