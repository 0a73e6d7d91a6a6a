"""The mechanics: a carriage on a screw between two limit switches, and the controller's count of it.

What the controller believes (its step count) and where the carriage is are two things; they part when the carriage runs
against an end of the screw, or when the controller loses its count. A simulation that knew only one of them could not
show a lost step.
"""

from __future__ import annotations

import numpy as np

from scanning.rig.simulated.motion import Block, Motion, Steps
from scanning.rig.simulated.settings import Settings

#: How far beyond its limit switch the carriage runs against the end of the screw.
END_STOP_MM = 0.5
#: GRBL moves no slower than 1 mm/min.
MINIMUM_FEED_MM_S = 1 / 60

Float3 = np.ndarray  # float32 (3,): the firmware's own precision, on purpose


class Screw:
    """The X axis with its switches. ``settings`` are the controller's, read live."""

    def __init__(self, settings: Settings, start_um: float) -> None:
        self._settings = settings
        self.motion = Motion()
        # Where step 0 of the controller's count lies on the screw, in steps from the limit switch.
        self._zero = round((start_um / 1000 + settings[27]) * settings[100])

    # ---- truth ----------------------------------------------------------------------------------------------------

    @property
    def homes_to_beginning(self) -> bool:
        return bool(int(self._settings[23]) & 1)

    @property
    def far_switch(self) -> int:
        """The switch at the end of the screw, 1 mm beyond the travel, in steps from the first switch."""
        return round((self._settings[130] + 1.0) * self._settings[100])

    def on_screw(self, now: float) -> int:
        """Where the carriage is, in steps from the first switch; the ends of the screw stop it in any case."""
        end_stop = round(END_STOP_MM * self._settings[100])
        at = self._zero + self.motion.position(now)[0]
        return min(max(at, -end_stop), self.far_switch + end_stop)

    def position_um(self, now: float) -> float:
        """Position of the carriage in micrometres from where homing leaves it."""
        pull_off = round(self._settings[27] * self._settings[100])
        on_screw = self.on_screw(now)
        steps = on_screw - pull_off if self.homes_to_beginning else self.far_switch - pull_off - on_screw
        return steps * 1000.0 / self._settings[100]

    def pressed(self, now: float) -> bool:
        """Whether the carriage stands on a limit switch."""
        return not 0 < self.on_screw(now) < self.far_switch

    def switch_time(self) -> float | None:
        """When the carriage will run onto the switch it is heading for."""
        if self.motion.idle:
            return None
        block = self.motion.blocks[0]
        switch = 0 if block.end[0] < block.start[0] else self.far_switch
        return self.motion.when_reached(0, switch - self._zero)

    # ---- the count -------------------------------------------------------------------------------------------------

    def stall(self, now: float) -> None:
        """Steps made against an end of the screw are lost: the count runs away from the truth."""
        self._zero = self.on_screw(now) - self.motion.position(now)[0]

    def drop(self, now: float) -> None:
        """Step pulses cease: the carriage stays where it is, the queue is gone."""
        self.stall(now)
        self.motion.drop(now)

    def lose_count(self, now: float) -> None:
        self.drop(now)
        self._zero += self.motion.position(now)[0]
        self.motion.place((0, 0, 0))

    def count_from_switch(self, now: float) -> None:
        """The end of homing: from here the count is defined."""
        x, y, z = self.motion.position(now)
        on_screw = self._zero + x
        pull_off = self._settings[27]
        machine_mm = -self._settings[130] + pull_off if self.homes_to_beginning else -pull_off
        count = round(machine_mm * self._settings[100])
        self._zero = on_screw - count
        self.motion.place((count, y, z))

    # ---- planning --------------------------------------------------------------------------------------------------

    def machine_mm(self, steps: Steps) -> Float3:
        per_mm = np.array([self._settings[100 + axis] for axis in range(3)], np.float32)
        return (np.array(steps, np.float32) / per_mm).astype(np.float32)

    def steps(self, mm: Float3) -> Steps:
        x, y, z = (int(np.rint(np.float32(mm[a]) * np.float32(self._settings[100 + a]))) for a in range(3))
        return x, y, z

    def outside(self, target: Float3) -> bool:
        """Whether the soft limits forbid ``target`` (machine position, mm)."""
        return any(target[a] > 0 or target[a] < -self._settings[130 + a] for a in range(3))

    def block(self, end: Steps, mm_s: float, laser_scale: float = 1.0) -> Block | None:
        """The move from where the queue ends, or None when there is nothing to move."""
        start = self.motion.end
        delta = [(end[a] - start[a]) / self._settings[100 + a] for a in range(3)]
        length = float(np.sqrt(sum(d * d for d in delta)))
        if end == start:
            return None
        unit = (delta[0] / length, delta[1] / length, delta[2] / length)
        top = min(self._settings[110 + a] / 60 / abs(unit[a]) for a in range(3) if unit[a])
        accel = min(self._settings[120 + a] / abs(unit[a]) for a in range(3) if unit[a])
        return Block(start, end, length, unit, min(max(mm_s, MINIMUM_FEED_MM_S), top), accel, laser_scale)
