"""A stage and a laser driven by a GRBL 1.1 controller (also grblHAL), over any port pyserial can open.

Positions are whole motor steps counted by the host. Each move is absolute (G90) with four decimals: in the real
firmware relative moves drift by one step after 1784 moves of 8.33 um, absolute ones stay exact over 100 mm. The
controller's own position report has three decimals, coarser than a 0.49 um step, so it serves as a plausibility check
only: a stage is where it was sent when it reports Idle there within `SANITY_MM`.

Standstill is learnt from the firmware itself: a dwell of no length (``G4 P0``) sent behind the move is answered when
the queue is empty, so the exposure starts within a millisecond of it. Polling ``?`` alone costs 6 ms of 115200 baud
per step. The report that confirms Idle and position is asked for in the same breath and read before the next move,
while the camera exposes; whenever an answer is missing, the slow way (polling) decides.

The laser hangs on the spindle output. M3 (constant), never M4: in laser mode ($32=1) M4 is dark at standstill, and a
scan exposes at standstill. With $32=1 an M3 given while the modal motion is G0 stays dark as well, so the laser is
switched on in one line with ``G1`` and no move ever uses G0; with $32=0 the same line means the same. A feed hold
darkens an M3 laser only when $32=1; therefore nothing here relies on a hold to make light go out: emergency stop is
hold followed at once by a reset, which switches the output off in the firmware's interrupt.

If this process dies the controller must darken the laser by itself; GRBL alone does not notice. The rig leads the
serial adapter's DTR (dropped by the kernel with the process) through the laser's enable: see
`simulated/controller.py`."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from contextlib import suppress

from scanning.errors import BadInput, Fault, StageFault
from scanning.rig.grbl_link import ATTEMPTS, GrblLink, Status
from scanning.rig.protocols import LinkQuality

#: GRBL on an 8-bit board makes at most 30,000 step pulses a second and does not check it (grbl/grbl#1284).
MAX_STEP_RATE_HZ = 30_000
#: The controller reports whole micrometres; two of them cover rounding on both sides. A corrupted digit is far larger.
SANITY_MM = 0.0025
#: Largest share of one step by which the controller's step length may be off over the whole travel.
MAX_STEP_ERROR = 0.25
#: Pause between two looks at a stage that has not come to rest, in seconds.
POLL_S = 0.05


class GrblStage:
    """`Stage` on one axis (X) of a GRBL controller.

    ``zero="homing"`` uses the home switch. ``zero="here"`` is for stages without one: the first `home` after opening
    takes the place where the carriage stands as zero; after a controller reset that zero is gone and the stage refuses
    to move until the rig is opened again. ``settings`` are $ settings the controller must have; differing ones are
    written at open. ``feed_mm_min`` None uses the controller's maximum.
    """

    def __init__(
        self,
        port: str,
        *,
        baud: int = 115200,
        step_um: float = 0.49,
        travel_mm: float | None = None,
        feed_mm_min: float | None = None,
        park_mm: float = 0.0,
        zero: str = "homing",
        direction: int | None = None,
        settings: Mapping[int, float] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if zero not in ("homing", "here"):
            raise BadInput(f"The stage's zero is {zero!r}; set it to 'homing' or 'here'.")
        if not (math.isfinite(step_um) and step_um > 0):
            raise BadInput(f"The stage's step length is {step_um} um; set a positive length.")
        self.step_um = step_um
        self.travel_mm = travel_mm or 0.0
        self.link = GrblLink(port, baud=baud, clock=clock)
        self.controller_settings: dict[int, float] = {}
        self._wanted_travel_mm = travel_mm
        self._wanted_feed = feed_mm_min
        self._wanted_direction = direction
        self._wanted_settings = dict(settings or {})
        self._park_mm = park_mm
        self._zero = zero
        self._clock = clock
        self._direction = 1
        self._feed_mm_min = 0.0
        self._feed_sent = False
        self._count: int | None = None
        self._zero_machine_mm = 0.0
        self._zero_given = False
        self._held = False
        self._expected_machine_mm: float | None = None

    # ---- Stage --------------------------------------------------------------------------------------------------

    def open(self) -> None:
        self.link.open()
        self._forget()
        self._zero_given = False
        try:
            self._read_settings()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Laser off, then let go of the port; safe in every state, never raises."""
        if self.link.is_open:
            with suppress(Fault):
                self.link.realtime(b"\x18")  # off whatever else is going on; the position is not needed any more
                self.link.drain()
        self._count = None
        self.link.close()

    def home(self) -> None:
        """Find the zero, from whatever state the controller is in (alarm, hold, emergency stop included).

        With a home switch this moves. Without one see ``zero="here"``; while that zero is still known, this goes to it.
        """
        if self._zero == "here":
            self._go_to_given_zero()
            return
        self._forget()
        # Clears holds and jogs, and wakes a controller that is deaf after a limit alarm.
        self.link.reset()
        if self.controller_settings.get(22, 0.0) == 0:
            raise StageFault(
                f"The controller on {self.link.port} has homing switched off ($22=0); set $22=1 if the stage has a "
                "home switch, or set the rig's zero to 'here'."
            )
        self.link.command("$H", timeout_s=self._homing_timeout_s(), repeatable=False)
        self._set_zero()

    def _go_to_given_zero(self) -> None:
        if self._count is not None:
            self.move_to(0)
        elif self._zero_given:
            raise StageFault(
                "The stage has no home switch and its controller was reset, so its zero is lost; "
                "put the carriage at its zero and open the rig again."
            )
        else:
            self.set_zero_here()

    def move_to(self, steps: int) -> None:
        """Move to ``steps`` from zero and return at standstill. Refuses positions outside the travel before moving."""
        self.move_to_while(steps, _nothing)

    def move_to_while(self, steps: int, meanwhile: Callable[[], None]) -> None:
        """`move_to`, doing ``meanwhile`` on the way."""
        here = self.position_steps
        target_mm = steps * self.step_um / 1000
        if not -1e-9 <= target_mm <= self.travel_mm + 1e-9:
            raise StageFault(
                f"Position {target_mm:.3f} mm is outside the stage's travel of 0 to {self.travel_mm:g} mm; "
                "move the region or the start of the scan."
            )
        self.confirm()
        if steps == here:
            meanwhile()
            return
        on_the_way = _Once(meanwhile)
        self._count = None  # until it is proven to be there again
        machine_mm = self._zero_machine_mm + self._direction * target_mm
        feed = "" if self._feed_sent else f"F{self._feed_mm_min:.3f}"
        lines = [f"G1X{self._direction * target_mm:.4f}{feed}", "G4P0"]  # no spaces: 87 us a byte
        distance_mm = abs(steps - here) * self.step_um / 1000
        expected_s = _travel_time_s(distance_mm, self._feed_mm_min / 60, self.controller_settings[120])
        for attempt in range(1, ATTEMPTS + 1):
            last = attempt == ATTEMPTS
            sent = self.link.attempt(lines, timeout_s=1.0 + 1.5 * expected_s, last=last, meanwhile=on_the_way)
            if sent is not None:
                self.link.ask_status()
                self._expected_machine_mm = machine_mm
                break
            if self._reached(machine_mm, expected_s):
                break
            if last:
                raise StageFault(
                    f"The stage on {self.link.port} did not go to {target_mm:.3f} mm in {ATTEMPTS} attempts because "
                    "lines were lost on the way; check cable and shielding, then home the stage."
                )
        self._feed_sent = True
        self._count = steps
        on_the_way.end()

    def confirm(self) -> None:
        """Check that the last move ended where it should: Idle, and at the place within the report's resolution."""
        expected, self._expected_machine_mm = self._expected_machine_mm, None
        if expected is None:
            return
        status = self.link.asked_status()
        if status is not None and status.state == "Idle" and self._is_at(status, expected):
            return
        if not self._reached(expected, 0.0):
            self._count = None
            where = self.link.status().machine_mm
            raise StageFault(
                f"The stage stands at {where} mm instead of {expected:.3f} mm (machine position); "
                "check the serial line and the mechanics, then home the stage."
            )

    @property
    def position_steps(self) -> int:
        if self._count is None:
            raise StageFault(self.link.halted or "The stage does not know where it is; home it first.")
        return self._count

    def park(self) -> None:
        self.move_to(round(self._park_mm * 1000 / self.step_um))

    def emergency_stop(self) -> None:
        """Hold and reset in one write: motion and laser end within the milliseconds two bytes take. Any thread."""
        self._forget()
        self.link.halt("Emergency stop: the stage was halted and the laser is off; home the stage when it is safe.")
        self.link.realtime(b"!\x18")

    def link_quality(self) -> LinkQuality:
        return self.link.quality

    # ---- beyond the protocol ------------------------------------------------------------------------------------

    @property
    def is_homed(self) -> bool:
        return self._count is not None

    def set_zero_here(self) -> None:
        """Take the place where the carriage stands as zero, after a person put it there (no home switch)."""
        if self.link.status().state == "Alarm":
            self.link.command("$X")
        self._set_zero()

    def hold(self) -> None:
        """Feed hold: the stage stops and keeps its position. Any thread. The laser stays as it is."""
        self._held = True
        self.link.realtime(b"!")

    def resume(self) -> None:
        self.link.realtime(b"~")
        self._held = False

    def reset(self) -> None:
        """Soft reset: laser off; the stage must be homed again."""
        self._forget()
        self.link.reset()

    def unlock(self) -> None:
        """Leave the alarm state without homing (to free a carriage by jogging)."""
        self.link.command("$X")

    def jog(self, delta_steps: int, *, feed_mm_min: float | None = None) -> None:
        """Start a relative jog and return at once. The count is lost until the next `home`; for loading and freeing."""
        self._count = None
        feed = min(feed_mm_min or self._feed_mm_min, self._feed_mm_min)
        mm = self._direction * delta_steps * self.step_um / 1000
        self.link.command(f"$J=G91 G21 X{mm:.4f} F{feed:.3f}", repeatable=False)

    def cancel_jog(self) -> None:
        self.link.realtime(b"\x85")

    def _forget(self) -> None:
        self._count, self._expected_machine_mm = None, None
        self._held = self._feed_sent = False

    # ---- how ----------------------------------------------------------------------------------------------------

    def _read_settings(self) -> None:
        found = self.link.settings()
        self._check_settings(found | self._wanted_settings)  # before anything is written that cannot work
        # Soft limits ($20) are refused while homing ($22) is off, so they come last.
        for number, value in sorted(self._wanted_settings.items(), key=lambda item: (item[0] == 20, item[0])):
            if number not in found or abs(found[number] - value) > 0.001:
                self.link.command(f"${number}={value:g}" if value == int(value) else f"${number}={value:.4f}")
        if self._wanted_settings:
            found = self.link.settings()
        self._check_settings(found)
        self.controller_settings = found
        homes_negative = bool(int(found.get(23, 0)) & 1)
        if self._zero == "homing":
            self._direction = 1 if homes_negative else -1
        else:
            self._direction = self._wanted_direction or 1
        for line in self.link.command("$I"):
            if line.startswith("[OPT:"):
                sizes = [part for part in line[5:-1].split(",")[1:] if part.isdigit()]
                if len(sizes) >= 2:
                    self.link.rx_bytes = min(int(sizes[1]), 128)

    def _check_settings(self, found: Mapping[int, float]) -> None:
        """Raise `StageFault` for settings that a scan cannot be made with; take feed and travel from them."""
        port = self.link.port
        missing = [number for number in (100, 110, 120, 130) if number not in found]
        if missing:
            raise StageFault(
                f"The controller on {port} does not tell its setting ${missing[0]}; "
                "it does not speak GRBL 1.1: check the rig's controller."
            )
        impossible = [
            number for number in (100, 110, 120, 130) if not (math.isfinite(found[number]) and found[number] > 0)
        ]
        if impossible:
            raise StageFault(
                f"The controller on {port} has ${impossible[0]} = {found[impossible[0]]:g}; set it above 0."
            )
        rate = found[100] * found[110] / 60
        if rate > MAX_STEP_RATE_HZ:
            raise StageFault(
                f"The controller on {port} is set to {rate:.0f} steps a second ($100 x $110 / 60), more than the "
                f"{MAX_STEP_RATE_HZ} it can do; lower $110 to {int(MAX_STEP_RATE_HZ * 60 / found[100])} mm/min or less."
            )
        self._feed_mm_min = found[110] if self._wanted_feed is None else self._wanted_feed
        if not 1 <= self._feed_mm_min <= found[110]:
            raise StageFault(
                f"The rig's feed is {self._feed_mm_min:g} mm/min but the controller on {port} moves at 1 to "
                f"{found[110]:g} mm/min ($110); correct the rig's feed or $110."
            )
        usable = found[130] - (found.get(27, 0.0) if self._zero == "homing" else 0.0)
        self.travel_mm = usable if self._wanted_travel_mm is None else self._wanted_travel_mm
        if found.get(20) and self.travel_mm > usable + 1e-6:
            raise StageFault(
                f"The rig's travel is {self.travel_mm:g} mm but the controller on {port} allows {usable:g} mm "
                "($130 less the pull-off $27); correct the rig's travel or $130."
            )
        travel_steps = self.travel_mm * 1000 / self.step_um
        # $$ prints three decimals, half of the last one is not the controller's fault.
        off = max(abs(found[100] * self.step_um / 1000 - 1) - 0.0005 / found[100], 0.0) * travel_steps
        if off > MAX_STEP_ERROR:
            raise StageFault(
                f"The controller on {port} is set to {found[100]:g} steps per mm ($100) but a step of "
                f"{self.step_um:g} um needs {1000 / self.step_um:.4f}; correct $100 or the rig's step length."
            )

    def _homing_timeout_s(self) -> float:
        s = self.controller_settings
        seek, feed, travel, pull = s.get(25, 500.0), s.get(24, 25.0), s[130], s.get(27, 1.0)
        return 10 + 60 * (1.5 * travel + pull) / max(seek, 1) + 60 * 6 * pull / max(feed, 1)

    def _set_zero(self) -> None:
        self.link.command("G21 G90 G94 G17 G54")
        self.link.command("G92 X0", repeatable=True)
        status = self.link.status()
        self._zero_machine_mm = status.machine_mm if status.machine_mm is not None else 0.0
        self._count, self._zero_given = 0, True

    def _reached(self, machine_mm: float, expected_s: float) -> bool:
        """Poll until the controller is idle. True when it stands at ``machine_mm``; bounded by physics, not by hope."""
        began = self._clock()
        limit_s = 5 + 3 * expected_s
        idle = 0
        while True:
            status = self.link.status()
            if status.state == "Idle":
                if self._is_at(status, machine_mm):
                    return True
                idle += 1  # Idle may be reported once between planning and starting
                if idle >= 3:
                    return False
            elif status.state == "Alarm":
                raise StageFault(f"The stage controller on {self.link.port} is in alarm; find the cause, then home.")
            elif self._held:
                began = self._clock()  # held on purpose: the time does not count
            elif status.state in ("Hold", "Door"):
                raise StageFault(
                    "The stage was put on hold from outside (feed hold button or safety door); "
                    "release it, then home the stage."
                )
            if self._clock() - began > limit_s:
                raise StageFault(
                    f"The stage did not come to rest within {limit_s:.1f} s; "
                    "check the mechanics and the controller, then home the stage."
                )
            self.link.listen(POLL_S)

    def _is_at(self, status: Status, machine_mm: float) -> bool:
        # What was reported is compared, not what was derived from an offset that only some reports carry.
        where = status.machine_mm
        if "WPos" in status.fields and status.work_mm is not None:
            where = self._zero_machine_mm + status.work_mm
        return where is not None and abs(where - machine_mm) <= SANITY_MM


def _nothing() -> None:
    pass


class _Once:
    """Calls ``act`` the first time only, and keeps what it raises until `end`: the move must be seen through."""

    def __init__(self, act: Callable[[], None]) -> None:
        self._act: Callable[[], None] | None = act
        self._raised: Exception | None = None

    def __call__(self) -> None:
        act, self._act = self._act, None
        if act is not None:
            try:
                act()
            except Exception as fault:
                self._raised = fault

    def end(self) -> None:
        if self._raised is not None:
            raise self._raised


class GrblLaser:
    """The line laser on the spindle output of the stage's controller. ``power`` is a share of full power."""

    def __init__(self, stage: GrblStage, *, power: float = 1.0) -> None:
        if not 0 < power <= 1:
            raise BadInput(f"The laser power is {power}; set a share above 0 and up to 1.")
        self._stage = stage
        self._power = power

    def on(self) -> None:
        full = self._stage.controller_settings.get(30, 1000.0)
        feed = self._stage._feed_mm_min
        self._stage.link.command(f"G1 F{feed:.3f} M3 S{max(self._power * full, 1):.0f}")

    def off(self) -> None:
        """Dark on return, in any state. M5 if the controller listens, else a reset, which also loses the position."""
        link = self._stage.link
        if not link.is_open:
            return  # `close` has reset the controller already
        try:
            state = link.status(attempts=1).state
            if state in ("Idle", "Run", "Check"):
                # M5 waits for the move under way; a step takes milliseconds, a long move is cut short by the reset.
                link.command("M5", timeout_s=1.0, repeatable=False)
                return
            if state == "Alarm":
                return  # every alarm resets the output in the firmware, and a locked controller takes no M3
        except StageFault:
            pass
        # Hold or door: M5 would wait until resumed. Silence or noise: only a reset is sure.
        self._stage._forget()
        try:
            link.realtime(b"!\x18")
            link.reset()
        except StageFault as fault:
            raise StageFault(
                "The laser could not be confirmed off because the controller does not answer; switch the laser off by "
                f"its key before reaching into the rig ({fault})"
            ) from fault


def _travel_time_s(distance_mm: float, speed_mm_s: float, accel_mm_s2: float) -> float:
    """Duration of a straight move from rest to rest with trapezoidal speed."""
    if distance_mm <= 0 or speed_mm_s <= 0 or accel_mm_s2 <= 0:
        return 0.0
    if distance_mm < speed_mm_s**2 / accel_mm_s2:
        return 2 * math.sqrt(distance_mm / accel_mm_s2)
    return distance_mm / speed_mm_s + speed_mm_s / accel_mm_s2
