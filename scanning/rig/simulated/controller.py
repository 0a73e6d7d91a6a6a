"""A GRBL 1.1h motion controller, as it behaves on the wire and on the screw.

The driver is written against the real firmware; this stands in for it wherever a board is not at hand: same answers,
same buffer of 128 bytes, same 15 planner blocks, same float32 arithmetic (which drifts in G91), same alarms. It also
does what the firmware repository cannot: it has limit switches, a laser, faults on demand, and time that can run
faster.

No clock, no thread, no file lives here. Whoever owns the wire (`wire.py`) says what time it is, hands over bytes and
asks for bytes; so every test can be exact.

The laser's dead-man. GRBL switches its spindle output off on reset and on any alarm, but it does not notice a host
that died. Rigs therefore lead the serial adapter's DTR line, which the host's kernel drops when the process holding
the port ends in whatever way, through the laser's enable input and the controller's feed-hold pin (GRBL A1). That is
what `link_lost` models: light out at once, feed hold, and a full reset when a host opens the port again, because the
rising DTR pulses the reset pin of Arduino boards. On a board without that wire a killed host leaves the laser on until
the port is opened again: fit the wire."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Generator
from dataclasses import dataclass, field

import numpy as np

from scanning.rig.simulated.gcode import GcodeError, read_float, words
from scanning.rig.simulated.motion import Block, Motion, Steps

RX_BYTES = 128
PLANNER_BLOCKS = 15
LINE_CHARACTERS = 80
#: How far beyond its limit switch the carriage runs against the end of the screw.
END_STOP_MM = 0.5
#: GRBL moves no slower than 1 mm/min.
MINIMUM_FEED_MM_S = 1 / 60
VERSION = "1.1h"
BUILD = "20190830"
#: How long the firmware waits after a critical ALARM line; a reset that comes meanwhile is forgotten.
ALARM_MESSAGE_S = 0.5
#: Bootloader and start-up of an Arduino board after a hardware reset, in seconds; bytes sent meanwhile are lost.
BOOT_S = 1.5

#: What a fresh rig's controller holds: 0.49 um steps, 120 mm of screw, homing to the negative end, motor always on.
DEFAULT_SETTINGS: dict[int, float] = {
    0: 10, 1: 255, 2: 0, 3: 0, 4: 0, 5: 0, 6: 0, 10: 3, 11: 0.010, 12: 0.002, 13: 0,
    20: 1, 21: 1, 22: 1, 23: 1, 24: 30.0, 25: 600.0, 26: 25, 27: 1.0, 30: 1000, 31: 0, 32: 0,
    100: 2040.8163, 101: 250.0, 102: 250.0, 110: 720.0, 111: 500.0, 112: 500.0,
    120: 200.0, 121: 10.0, 122: 10.0, 130: 120.0, 131: 200.0, 132: 200.0,
}  # fmt: skip
_INTEGER_SETTINGS = frozenset((0, 1, 2, 3, 4, 5, 6, 10, 13, 20, 21, 22, 23, 26, 30, 31, 32))
_RESET, _STATUS, _HOLD, _RESUME, _JOG_CANCEL = 0x18, ord("?"), ord("!"), ord("~"), 0x85

Until = Callable[[], bool]
Program = Generator[Until, None, None]
Float3 = np.ndarray  # float32 (3,): the firmware's own precision, on purpose


class _Aborted(Exception):
    """The line under way ended in a reset and gets no answer."""


@dataclass
class _Modal:
    motion: int = 0
    absolute: bool = True
    inches: bool = False
    spindle: int = 5
    feed_mm_min: float = 0.0
    spindle_speed: float = 0.0


@dataclass
class Faults:
    """What goes wrong next. Each is used up when it has happened, except ``mute`` and ``dead_switch``."""

    drop_to_host: int = 0
    """So many of the next bytes towards the host are lost."""
    drop_to_controller: int = 0
    """So many of the next bytes from the host are lost."""
    garbage: bytes = b""
    """Line noise put before the next bytes towards the host."""
    mute: bool = False
    """The controller hangs: nothing is read, nothing is sent. The carriage finishes what it has."""
    dead_switch: bool = False
    """The limit switch never closes."""
    in_move: Callable[[], None] | None = field(default=None, repr=False)
    """Called once in the middle of the next move: unplug, reset, alarm, whatever the test wants."""


class Controller:
    """GRBL and the stage screwed to it.

    ``now`` is always machine time in seconds and never goes back. Truth is ``position_um`` (from the point where homing
    leaves the carriage) and ``laser_power`` (0..1); what the controller believes is its own affair.
    """

    def __init__(
        self, *, settings: dict[int, float] | None = None, baud: int = 115200, start_um: float = 7000.0
    ) -> None:
        self.settings = DEFAULT_SETTINGS | (settings or {})
        self.faults = Faults()
        self.now = 0.0
        self._byte_s = 10.0 / baud
        self._motion = Motion()
        # Where step 0 of the controller's count lies on the screw, in steps from the limit switch.
        self._zero_on_screw = round((start_um / 1000 + self.settings[27]) * self.settings[100])
        self._incoming: deque[tuple[float, int]] = deque()
        self._outgoing: deque[tuple[float, int]] = deque()
        self._wire_in_free = self._wire_out_free = 0.0
        self._plugged = True
        self._interlock = True
        self._boot_until: float | None = None
        self._fault_at: float | None = None
        self.sent: list[str] = []
        self.rx_overflows = 0
        self.max_rx_used = 0
        self._g54 = np.zeros(3, np.float32)
        self.state = "Idle"
        self._modal = _Modal()
        self._rx: deque[int] = deque()
        self._line, self._line_overflow = "", False
        self._spindle_rpm = self._idle_scale = 0.0
        self._g92 = np.zeros(3, np.float32)
        self._gc = np.zeros(3, np.float32)
        self._dwell_until: float | None = None
        self._deaf_until: float | None = None
        self._critical = self._check = self._jog_cancelled = self._homing_hit = False
        self._wco_in = self._ov_in = 0
        self._program: Program = self._main()
        self._waiting: Until | None = None
        self._start_fresh()
        if self.settings[22]:
            self.state = "Alarm"

    # ---- truth about the physical world -------------------------------------------------------------------------

    @property
    def step_um(self) -> float:
        return 1000.0 / self.settings[100]

    def position_um(self, now: float) -> float:
        """Position of the carriage in micrometres from where homing leaves it."""
        pull_off = round(self.settings[27] * self.settings[100])
        on_screw = self._on_screw(now)
        steps = on_screw - pull_off if self._homes_to_beginning else self._far_switch - pull_off - on_screw
        return steps * self.step_um

    @property
    def _homes_to_beginning(self) -> bool:
        return bool(int(self.settings[23]) & 1)

    def _on_screw(self, now: float) -> int:
        """Where the carriage is, in steps from the first switch; the ends of the screw stop it in any case."""
        end_stop = round(END_STOP_MM * self.settings[100])
        at = self._zero_on_screw + self._motion.position(now)[0]
        return min(max(at, -end_stop), self._far_switch + end_stop)

    def _stall(self) -> None:
        """Steps made against an end of the screw are lost: the count runs away from the truth."""
        self._zero_on_screw = self._on_screw(self.now) - self._motion.position(self.now)[0]

    @property
    def _far_switch(self) -> int:
        """The switch at the end of the screw, 1 mm beyond the travel, in steps from the first switch."""
        return round((self.settings[130] + 1.0) * self.settings[100])

    def position_steps(self, now: float) -> Steps:
        """The controller's own count."""
        return self._motion.position(now)

    def moving(self, now: float) -> bool:
        return self._motion.speed(now) > 0.0

    def laser_power(self, now: float) -> float:
        """Optical power as a share of full power, at this instant."""
        if not self._plugged or not self._interlock or self._boot_until is not None or self._modal.spindle == 5:
            return 0.0
        laser_mode = bool(self.settings[32])
        if laser_mode and self.state == "Hold" and self._motion.stopped_in_hold(now):
            return 0.0
        power = min(self._spindle_rpm / self.settings[30], 1.0) if self.settings[30] > 0 else 1.0
        if not laser_mode:
            return power
        if self._motion.idle:
            return power * self._idle_scale if self._modal.spindle == 3 else 0.0
        block = self._motion.blocks[0]
        if self._modal.spindle == 4:
            power *= self._motion.speed(now) / block.nominal_mm_s
        return power * block.laser_scale

    # ---- power and link -----------------------------------------------------------------------------------------

    def hard_reset(self) -> None:
        """Reset pin or power-up: count lost, laser off, motor dead, bootloader first."""
        self._lose_count()
        self._outgoing.clear()
        self._incoming.clear()
        self._boot_until = self.now + BOOT_S
        self._start_fresh()
        self.state = "Alarm" if self.settings[22] else "Idle"

    def link_lost(self) -> None:
        """The host let go of the port (DTR dropped): light out, feed hold. See the module docstring."""
        self._interlock = False
        self._modal.spindle = 5
        self._outgoing.clear()
        if self.state == "Home":
            self._alarm(6)
            self._restart_program()
        elif self._boot_until is None:
            self._feed_hold()

    def link_found(self) -> None:
        """A host opened the port (DTR rose): the board resets."""
        self._interlock = True
        self.hard_reset()

    def unplug(self) -> None:
        """The USB cable, which also powers the board, is pulled."""
        self._plugged = False
        self._lose_count()
        self._start_fresh()
        self._incoming.clear()
        self._outgoing.clear()

    def replug(self) -> None:
        self._plugged = True
        self.hard_reset()

    def trip_alarm(self, code: int = 1) -> None:
        """An alarm raised from outside, as by a hard limit switch."""
        self._critical_alarm(code)

    # ---- the wire -----------------------------------------------------------------------------------------------

    def receive(self, data: bytes) -> None:
        """Bytes the host sends at ``self.now``; each takes its time on the wire."""
        if not self._plugged:
            return
        for byte in data:
            if self.faults.drop_to_controller > 0:
                self.faults.drop_to_controller -= 1
                continue
            self._wire_in_free = max(self._wire_in_free, self.now) + self._byte_s
            self._incoming.append((self._wire_in_free, byte))

    def transmit(self) -> bytes:
        """Bytes whose last bit has reached the host by ``self.now``."""
        out = bytearray()
        while self._outgoing and self._outgoing[0][0] <= self.now:
            out.append(self._outgoing.popleft()[1])
        return bytes(out)

    def next_event(self) -> float | None:
        """The next instant at which something happens by itself."""
        times = [t for t in (self._next_internal(), self._line_ready()) if t is not None]
        return min(times) if times else None

    def _line_ready(self) -> float | None:
        """When the next whole line will have left: handing lines over whole spares a wake-up per byte."""
        for due, byte in self._outgoing:
            if byte == 10:
                return due
        return self._outgoing[-1][0] if self._outgoing else None

    def advance(self, now: float) -> None:
        """Let everything happen that is due up to ``now``."""
        while True:
            self._run()
            due = self._next_internal()
            if due is None or due > now:
                break
            self.now = max(self.now, due)
            self._happen()
        self.now = max(self.now, now)
        self._run()

    def _next_internal(self) -> float | None:
        due = [self._motion.next_event(), self._boot_until, self._fault_at, self._switch_time(), self._dwell_until]
        due.append(self._deaf_until)
        if self._incoming:
            due.append(self._incoming[0][0])
        return min((t for t in due if t is not None), default=None)

    def _happen(self) -> None:
        now = self.now
        if self._boot_until is not None and now >= self._boot_until:
            self._boot_until = None
            self._greet()
        if self._dwell_until is not None and now >= self._dwell_until:
            self._dwell_until = None
        if self._deaf_until is not None and now >= self._deaf_until:
            self._deaf_until = None
            self._say("[MSG:Reset to continue]")
        if self._fault_at is not None and now >= self._fault_at:
            self._fault_at, fire = None, self.faults.in_move
            self.faults.in_move = None
            if fire:
                fire()
        switch = self._switch_time()
        if switch is not None and now >= switch:
            self._switch_hit()
        if self._motion.finish_due(now):
            self._block_ended()
        while self._incoming and self._incoming[0][0] <= now:
            self._take_byte(self._incoming.popleft()[1])

    def _take_byte(self, byte: int) -> None:
        if self.faults.mute or self._boot_until is not None:
            return
        if byte == _RESET and self._deaf_until is not None:
            return
        if byte == _RESET:
            self._soft_reset()
        elif self._critical:
            return
        elif byte == _STATUS:
            # Homing answers no status requests (limits.c), everything else does at once.
            if self.state != "Home":
                self._report()
        elif byte == _HOLD:
            self._feed_hold()
        elif byte == _RESUME:
            self._resume()
        elif byte == _JOG_CANCEL:
            if self.state == "Jog":
                self._jog_cancelled = True
                self._motion.hold(self.now)
                self._settle_hold()
        elif byte > 0x7F:
            return  # overrides, safety door: accepted and without effect here
        elif len(self._rx) >= RX_BYTES:
            self.rx_overflows += 1
        else:
            self._rx.append(byte)
            self.max_rx_used = max(self.max_rx_used, len(self._rx))

    def _say(self, text: str) -> None:
        if self.faults.mute or not self._interlock or not self._plugged:
            return
        self.sent.append(text)
        del self.sent[:-200]
        data = self.faults.garbage + (text + "\r\n").encode()
        self.faults.garbage = b""
        for byte in data:
            self._wire_out_free = max(self._wire_out_free, self.now) + self._byte_s
            if self.faults.drop_to_host > 0:
                self.faults.drop_to_host -= 1
            else:
                self._outgoing.append((self._wire_out_free, byte))

    # ---- resets, holds, alarms ----------------------------------------------------------------------------------

    def _start_fresh(self) -> None:
        """What a reset of the processor leaves of the program's state; settings, G54 and the count survive."""
        self._modal = _Modal()
        self._rx.clear()
        self._line, self._line_overflow = "", False
        self._spindle_rpm = self._idle_scale = 0.0
        self._g92 = np.zeros(3, np.float32)
        self._gc = self._mpos(self._motion.end)
        self._dwell_until = self._deaf_until = None
        self._critical = self._check = self._jog_cancelled = self._homing_hit = False
        self._wco_in = self._ov_in = 0
        self._restart_program()
        self._fault_at = None

    def _restart_program(self) -> None:
        self._program = self._main()
        self._waiting = None

    def _lose_count(self) -> None:
        self._drop()
        self._zero_on_screw += self._motion.position(self.now)[0]
        self._motion.place((0, 0, 0))

    def _greet(self) -> None:
        self._say("")
        self._say(f"Grbl {VERSION} ['$' for help]")
        if self.state == "Alarm":
            self._say("[MSG:'$H'|'$X' to unlock]")

    def _soft_reset(self) -> None:
        """0x18: spindle off in the interrupt, then ALARM:3 (6 while homing) if the carriage was under way."""
        self._modal.spindle = 5
        under_way = self.state in ("Run", "Jog", "Home") or (
            self.state == "Hold" and not self._motion.stopped_in_hold(self.now)
        )
        code = 6 if self.state == "Home" else 3
        self._outgoing_before_reset()
        if (under_way and not self._motion.idle) or self.state == "Home":
            self._drop()
            self._say(f"ALARM:{code}")
            self.state = "Alarm"
        else:
            self._drop()
        locked = self.state == "Alarm"
        self._start_fresh()
        self.state = "Alarm" if locked else "Idle"
        self._greet()

    def _outgoing_before_reset(self) -> None:
        """The serial buffers are emptied by a reset; the byte on the wire is not called back."""
        while len(self._outgoing) > 1:
            self._outgoing.pop()
        self._wire_out_free = self._outgoing[-1][0] if self._outgoing else self.now

    def _feed_hold(self) -> None:
        if self.state in ("Run", "Jog", "Idle", "Hold"):
            if self.state == "Jog":
                self._jog_cancelled = True
            else:
                self.state = "Hold"
            self._motion.hold(self.now)
            self._settle_hold()

    def _settle_hold(self) -> None:
        if self._jog_cancelled and self._motion.stopped_in_hold(self.now):
            self._drop()
            self._gc = self._mpos(self._motion.end)
            self._jog_cancelled = False
            self.state = "Idle"

    def _resume(self) -> None:
        if self.state == "Hold" and self._motion.stopped_in_hold(self.now):
            self._motion.resume(self.now)
            self.state = "Idle" if self._motion.idle else "Run"
            self._arm_fault()

    def _critical_alarm(self, code: int) -> None:
        """Hard or soft limit: everything off, and deaf to all but a reset."""
        self._modal.spindle = 5
        self._drop()
        self._gc = self._mpos(self._motion.end)
        self.state = "Alarm"
        self._critical = True
        self._restart_program()
        self._say(f"ALARM:{code}")
        self._deaf_until = self.now + ALARM_MESSAGE_S

    def _homing_failed(self, code: int) -> None:
        """The firmware alarms, resets itself and greets; the $H gets no answer."""
        self._alarm(code)
        self._start_fresh()
        self._greet()
        raise _Aborted

    def _alarm(self, code: int) -> None:
        self._modal.spindle = 5
        self._drop()
        self._gc = self._mpos(self._motion.end)
        self.state = "Alarm"
        self._say(f"ALARM:{code}")

    # ---- limit switch -------------------------------------------------------------------------------------------

    def _pressed(self) -> bool:
        on_screw = self._on_screw(self.now)
        return not self.faults.dead_switch and not 0 < on_screw < self._far_switch

    def _switch_time(self) -> float | None:
        """When the carriage will run onto the switch it is heading for, if anything happens then."""
        if self.faults.dead_switch or self._motion.idle or self._homing_hit:
            return None
        if self.state != "Home" and not self.settings[21]:
            return None
        block = self._motion.blocks[0]
        if block.end[0] < block.start[0]:
            return self._motion.when_reached(0, -self._zero_on_screw)
        return self._motion.when_reached(0, self._far_switch - self._zero_on_screw)

    def _switch_hit(self) -> None:
        if self.state == "Home":
            self._homing_hit = True
            self._drop()
        else:
            self._critical_alarm(1)

    # ---- motion bookkeeping -------------------------------------------------------------------------------------

    def _drop(self) -> None:
        """Step pulses cease: the carriage stays where it is, the queue is gone."""
        self._stall()
        self._motion.drop(self.now)

    def _block_ended(self) -> None:
        self._stall()
        if self._motion.idle and self.state in ("Run", "Jog"):
            self.state = "Idle"
        self._settle_hold()
        self._arm_fault()

    def _arm_fault(self) -> None:
        """Put an armed fault into the middle of the move that is under way."""
        end = self._motion.next_event()
        if end is None or self.faults.in_move is None or self._fault_at is not None:
            return
        if self.state in ("Run", "Jog"):
            self._fault_at = self.now + 0.5 * (end - self.now)

    def _mpos(self, steps: Steps) -> Float3:
        per_mm = np.array([self.settings[100 + axis] for axis in range(3)], np.float32)
        return (np.array(steps, np.float32) / per_mm).astype(np.float32)

    def _steps(self, mm: Float3) -> Steps:
        x, y, z = (int(np.rint(np.float32(mm[a]) * np.float32(self.settings[100 + a]))) for a in range(3))
        return x, y, z

    def _block(self, end: Steps, mm_s: float, laser_scale: float = 1.0) -> Block | None:
        start = self._motion.end
        delta = [(end[a] - start[a]) / self.settings[100 + a] for a in range(3)]
        length = float(np.sqrt(sum(d * d for d in delta)))
        if end == start:
            return None
        unit = (delta[0] / length, delta[1] / length, delta[2] / length)
        top = min(self.settings[110 + a] / 60 / abs(unit[a]) for a in range(3) if unit[a])
        accel = min(self.settings[120 + a] / abs(unit[a]) for a in range(3) if unit[a])
        return Block(start, end, length, unit, min(max(mm_s, MINIMUM_FEED_MM_S), top), accel, laser_scale)

    # ---- the firmware's main loop -------------------------------------------------------------------------------

    def _run(self) -> None:
        """Run the main program until it waits for something that has not happened yet."""
        while True:
            asleep = self._boot_until is not None or not self._plugged or self.faults.mute
            if asleep or self._critical or self.state == "Hold":
                return
            if self._waiting is not None and not self._waiting():
                return
            program = self._program
            waiting = next(program, None)
            if program is self._program:  # an alarm inside the step starts a fresh program
                self._waiting = waiting

    def _main(self) -> Program:
        while True:
            yield lambda: bool(self._rx)
            char = chr(self._rx.popleft())
            if char not in "\r\n":
                if len(self._line) >= LINE_CHARACTERS - 1:
                    self._line_overflow = True
                elif char > " ":
                    self._line += char.upper()
                continue
            line, overflow = re.sub(r"\([^)]*\)?|;.*", "", self._line), self._line_overflow
            self._line, self._line_overflow = "", False
            try:
                if overflow:
                    raise GcodeError(11)
                if line.startswith("$"):
                    yield from self._system(line)
                elif line:
                    if self.state in ("Alarm", "Jog"):
                        raise GcodeError(9)
                    yield from self._gcode(line)
            except _Aborted:
                return  # a fresh program has taken over
            except GcodeError as error:
                self._say(f"error:{error.code}")
            else:
                if not self._critical:
                    self._say("ok")

    def _drained(self) -> Until:
        return lambda: self._motion.idle and self.state != "Hold"

    # ---- $ commands ---------------------------------------------------------------------------------------------

    def _system(self, line: str) -> Program:
        rest = line[1:]
        if rest.startswith("J="):
            if self.state not in ("Idle", "Jog"):
                raise GcodeError(8)
            yield from self._gcode(rest[2:], jog=True)
            return
        if rest == "":
            self._say("[HLP:$$ $# $G $I $N $x=val $Nx=line $J=line $SLP $C $X $H ~ ! ? ctrl-x]")
        elif rest == "G":
            self._report_modal()
        elif rest == "X":
            if self.state == "Alarm":
                self._say("[MSG:Caution: Unlocked]")
                self.state = "Idle"
        elif rest == "C":
            self._check_mode()
        elif self.state not in ("Idle", "Alarm"):
            raise GcodeError(8)
        elif rest == "$":
            for number in sorted(self.settings):
                value = self.settings[number]
                self._say(f"${number}={int(value)}" if number in _INTEGER_SETTINGS else f"${number}={value:.3f}")
        elif rest == "#":
            self._report_offsets()
        elif rest == "I":
            self._say(f"[VER:{VERSION}.{BUILD}:]")
            self._say(f"[OPT:V,{PLANNER_BLOCKS},{RX_BYTES}]")
        elif rest == "N":
            self._say("$N0=")
            self._say("$N1=")
        elif rest == "H":
            if not self.settings[22]:
                raise GcodeError(5)
            yield from self._home()
        elif match := re.fullmatch(r"(\d+)=([-+]?\d*\.?\d*)", rest):
            self._store(int(match[1]), match[2])
        else:
            raise GcodeError(3)

    def _store(self, number: int, text: str) -> None:
        if not any(c.isdigit() for c in text):
            raise GcodeError(2)
        value = read_float(text)
        if number not in self.settings:
            raise GcodeError(3)
        if value < 0 or (value == 0 and number >= 100):  # the firmware would divide by this zero
            raise GcodeError(4)
        if number == 0 and value < 3:
            raise GcodeError(6)
        if number == 20 and value and not self.settings[22]:
            raise GcodeError(10)
        self.settings[number] = int(value) if number in _INTEGER_SETTINGS else value
        if number == 22 and not value:
            self.settings[20] = 0

    def _check_mode(self) -> None:
        if self._check:
            self._check = False
            self._say("[MSG:Disabled]")
            self._soft_reset()
        elif self.state != "Idle":
            raise GcodeError(8)
        else:
            self._check = True
            self._say("[MSG:Enabled]")

    def _home(self) -> Program:
        """Seek the switch fast, back off, find it again slowly, back off; then the count is defined."""
        self.state = "Home"
        backed_off = False
        steps_per_mm, pull_off = self.settings[100], self.settings[27]
        for reach_mm, speed, away in (
            (1.5 * self.settings[130], self.settings[25], False),
            (pull_off, self.settings[25], True),
            (5 * pull_off, self.settings[24], False),
            (pull_off, self.settings[24], True),
        ):
            self._homing_hit = False
            if not away and self._pressed():
                if backed_off:  # and yet the switch has not opened
                    self._homing_failed(8)
                continue  # standing on the switch counts as having found it
            backed_off = away
            x, y, z = self._motion.end
            toward = -1 if self._homes_to_beginning else 1
            target = x + round(reach_mm * steps_per_mm) * (-toward if away else toward)
            block = self._block((target, y, z), speed / 60)
            if block is None:  # a pull-off of nothing
                continue
            self._motion.add(block, self.now)
            yield lambda: self._motion.idle
            if not away and not self._homing_hit:
                self._homing_failed(9)
            self._dwell_until = self.now + self.settings[26] / 1000
            yield lambda: self._dwell_until is None
        _, y, z = self._motion.position(self.now)
        on_screw = self._zero_on_screw + self._motion.position(self.now)[0]
        machine_mm = -self.settings[130] + pull_off if self._homes_to_beginning else -pull_off
        count = round(machine_mm * steps_per_mm)
        self._zero_on_screw = on_screw - count
        self._motion.place((count, y, z))
        self._gc = self._mpos((count, y, z))
        self.state = "Idle"

    # ---- G-code -------------------------------------------------------------------------------------------------

    def _gcode(self, line: str, *, jog: bool = False) -> Program:
        found = words(line)
        modal = _Modal(**vars(self._modal))
        axes: dict[int, float] = {}
        values: dict[str, float] = {}
        nonmodal: int | None = None
        motion_word = False
        machine = False
        seen: set[str] = set()
        spindle_word = False

        def group(name: str) -> None:
            if name in seen:
                raise GcodeError(21)
            seen.add(name)

        for letter, value in found:
            if letter == "G":
                code = round(value * 10)
                if code in (0, 10):
                    group("motion")
                    modal.motion, motion_word = code // 10, True
                elif code == 800:
                    group("motion")
                    modal.motion = 80
                elif code in (40, 100, 920, 921):
                    group("nonmodal")
                    nonmodal = code
                elif code == 530:
                    group("nonmodal")
                    machine = True
                elif code in (200, 210):
                    group("units")
                    modal.inches = code == 200
                elif code in (900, 910):
                    group("distance")
                    modal.absolute = code == 900
                elif code in (170, 400, 490, 540, 610, 940, 911):
                    group(f"g{code}")
                else:
                    raise GcodeError(20)
            elif letter == "M":
                code = round(value)
                if value != code:
                    raise GcodeError(23)
                if code in (3, 4, 5):
                    group("spindle")
                    modal.spindle, spindle_word = code, True
                elif code in (0, 1, 2, 7, 8, 9, 30):
                    group("program")
                else:
                    raise GcodeError(20)
            elif letter in "XYZ":
                if "XYZ".index(letter) in axes:
                    raise GcodeError(25)
                axes["XYZ".index(letter)] = value
            elif letter in "FSPLNT":
                if letter in values:
                    raise GcodeError(25)
                if value < 0:
                    raise GcodeError(4)
                values[letter] = value
            else:
                raise GcodeError(20)
        scale = np.float32(25.4) if modal.inches else np.float32(1.0)

        if jog:
            if seen - {"units", "distance", "nonmodal"} or spindle_word or nonmodal is not None or not axes:
                raise GcodeError(16)
            if "F" not in values:
                raise GcodeError(22)
            target = self._target(axes, modal.absolute, machine, scale)
            if self.settings[20] and self._outside(target):
                raise GcodeError(15)
            yield from self._move(target, values["F"] * float(scale) / 60, 1.0, jog=True)
            return

        moves = bool(axes) and nonmodal is None
        if motion_word and axes and nonmodal is not None:
            raise GcodeError(24)
        if nonmodal in (100, 920) and not axes:
            raise GcodeError(26)
        if nonmodal == 40 and "P" not in values:
            raise GcodeError(28)
        if nonmodal == 100 and (values.get("L") not in (2, 20) or values.get("P") not in (0, 1)):
            raise GcodeError(20 if "L" in values else 28)
        if axes and moves and modal.motion == 80:
            raise GcodeError(31)
        if "P" in values and nonmodal not in (40, 100):
            raise GcodeError(36)
        if "F" in values:
            modal.feed_mm_min = values["F"] * float(scale)
        if moves and modal.motion == 1 and modal.feed_mm_min <= 0:
            raise GcodeError(22)
        if "S" in values:
            modal.spindle_speed = values["S"]

        lit = modal.motion == 1 or not self.settings[32]
        if modal.spindle != self._modal.spindle or (modal.spindle_speed != self._modal.spindle_speed and not moves):
            yield self._drained()
        self._spindle_rpm = modal.spindle_speed
        if not self._check:
            self._modal.spindle = modal.spindle
        modal.spindle = self._modal.spindle
        if not moves:
            self._idle_scale = 1.0 if lit else 0.0
        self._modal = modal

        if nonmodal == 40:
            yield self._drained()
            self._dwell_until = self.now + values["P"]
            yield lambda: self._dwell_until is None
        elif nonmodal in (100, 920):
            for axis, value in axes.items():
                mm = np.float32(value) * scale
                if nonmodal == 920:
                    self._g92[axis] = self._gc[axis] - self._g54[axis] - mm
                elif values["L"] == 20:
                    self._g54[axis] = self._gc[axis] - self._g92[axis] - mm
                else:
                    self._g54[axis] = mm
        elif nonmodal == 921:
            self._g92[:] = 0
        elif moves:
            target = self._target(axes, modal.absolute, machine, scale)
            if self.settings[20] and self._outside(target):
                yield from self._soft_limit()
                return
            speed = modal.feed_mm_min / 60 if modal.motion == 1 else 1e9
            yield from self._move(target, speed, 1.0 if lit else 0.0)

    def _target(self, axes: dict[int, float], absolute: bool, machine: bool, scale: np.float32) -> Float3:
        target = self._gc.copy()
        for axis, value in axes.items():
            mm = np.float32(np.float32(value) * scale)
            if machine:
                target[axis] = mm
            elif absolute:
                target[axis] = np.float32(mm + np.float32(self._g54[axis] + self._g92[axis]))
            else:
                target[axis] = np.float32(target[axis] + mm)
        return target

    def _outside(self, target: Float3) -> bool:
        return any(target[a] > 0 or target[a] < -self.settings[130 + a] for a in range(3))

    def _soft_limit(self) -> Program:
        """Stop what is moving first, so the position survives, then lock up."""
        self._motion.hold(self.now)
        yield lambda: self._motion.stopped_in_hold(self.now)
        self._critical_alarm(2)

    def _move(self, target: Float3, mm_s: float, laser_scale: float, *, jog: bool = False) -> Program:
        if self._check:
            self._gc = target
            return
        yield lambda: len(self._motion.blocks) < PLANNER_BLOCKS
        block = self._block(self._steps(target), mm_s, laser_scale)
        self._gc = target
        if block is None:
            return
        self._motion.add(block, self.now)
        self.state = "Jog" if jog else "Run"
        self._arm_fault()

    # ---- reports ------------------------------------------------------------------------------------------------

    def _report(self) -> None:
        """`?`: the fields and their rhythm as in report.c."""
        now = self.now
        state = self.state
        if state == "Hold":
            state = "Hold:0" if self._motion.stopped_in_hold(now) else "Hold:1"
        elif self._check and state == "Idle":
            state = "Check"
        mask = int(self.settings[10])
        mpos = self._mpos(self._motion.position(now))
        wco = self._g54 + self._g92
        fields = [state, f"MPos:{_triple(mpos)}" if mask & 1 else f"WPos:{_triple(mpos - wco)}"]
        if mask & 2:
            fields.append(f"Bf:{PLANNER_BLOCKS - len(self._motion.blocks)},{RX_BYTES - len(self._rx)}")
        rpm = self._spindle_rpm if self._modal.spindle != 5 else 0.0
        fields.append(f"FS:{self._motion.speed(now) * 60:.0f},{rpm:.0f}")
        if self._pressed():
            fields.append("Pn:X")
        busy = self.state in ("Run", "Jog", "Hold", "Home")
        if self._wco_in > 0:
            self._wco_in -= 1
        else:
            self._wco_in = 29 if busy else 9
            self._ov_in = self._ov_in or 1
            fields.append(f"WCO:{_triple(wco)}")
        if self._ov_in > 0:
            self._ov_in -= 1
        else:
            self._ov_in = 19 if busy else 9
            fields.append("Ov:100,100,100")
            if self._modal.spindle != 5:
                fields.append("A:S" if self._modal.spindle == 3 else "A:C")
        self._say("<" + "|".join(fields) + ">")

    def _report_modal(self) -> None:
        m = self._modal
        self._say(
            f"[GC:G{m.motion} G54 G17 G{20 if m.inches else 21} G{90 if m.absolute else 91} G94 "
            f"M{m.spindle} M9 T0 F{m.feed_mm_min:.0f} S{m.spindle_speed:.0f}]"
        )

    def _report_offsets(self) -> None:
        zero = _triple(np.zeros(3, np.float32))
        for name in ("G54", "G55", "G56", "G57", "G58", "G59", "G28", "G30"):
            self._say(f"[{name}:{_triple(self._g54) if name == 'G54' else zero}]")
        self._say(f"[G92:{_triple(self._g92)}]")
        self._say("[TLO:0.000]")
        self._say(f"[PRB:{zero}:0]")


def _triple(mm: Float3) -> str:
    return ",".join(f"{float(v):.3f}" for v in mm)
