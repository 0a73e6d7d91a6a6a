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

from scanning.rig.simulated.gcode import GcodeError
from scanning.rig.simulated.motion import Steps
from scanning.rig.simulated.reports import Reporter, Seen, modal_state, offsets
from scanning.rig.simulated.screw import Float3, Screw
from scanning.rig.simulated.settings import DEFAULT_SETTINGS, Settings, listing, store
from scanning.rig.simulated.statement import (
    DWELL,
    SET_OFFSET,
    SHIFT_ORIGIN,
    UNSHIFT_ORIGIN,
    Modal,
    Statement,
    read_statement,
)
from scanning.rig.simulated.uart import Uart

RX_BYTES = 128
PLANNER_BLOCKS = 15
LINE_CHARACTERS = 80
VERSION = "1.1h"
BUILD = "20190830"
#: How long the firmware waits after a critical ALARM line; a reset that comes meanwhile is forgotten.
ALARM_MESSAGE_S = 0.5
#: Bootloader and start-up of an Arduino board after a hardware reset, in seconds; bytes sent meanwhile are lost.
BOOT_S = 1.5

_RESET, _STATUS, _HOLD, _RESUME, _JOG_CANCEL = 0x18, ord("?"), ord("!"), ord("~"), 0x85

Until = Callable[[], bool]
Program = Generator[Until, None, None]


class _Aborted(Exception):
    """The line under way ended in a reset and gets no answer."""


@dataclass
class Faults:
    """What goes wrong next. Each is used up when it has happened, except ``mute`` and ``dead_switch``."""

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

    def __init__(self, *, settings: Settings | None = None, baud: int = 115200, start_um: float = 7000.0) -> None:
        self.settings: Settings = DEFAULT_SETTINGS | (settings or {})
        self.faults = Faults()
        self.now = 0.0
        self.line = Uart(baud)
        self.screw = Screw(self.settings, start_um)
        self._motion = self.screw.motion
        self._plugged = True
        self._interlock = True
        self._boot_until: float | None = None
        self._fault_at: float | None = None
        self.sent: list[str] = []
        self.rx_overflows = 0
        self.max_rx_used = 0
        self._g54 = np.zeros(3, np.float32)
        self.state = "Idle"
        self._modal = Modal()
        self._rx: deque[int] = deque()
        self._line, self._line_overflow = "", False
        self._spindle_rpm = self._idle_scale = 0.0
        self._g92 = np.zeros(3, np.float32)
        self._gc = np.zeros(3, np.float32)
        self._dwell_until: float | None = None
        self._deaf_until: float | None = None
        self._critical = self._check = self._jog_cancelled = self._homing_hit = False
        self._reporter = Reporter()
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
        return self.screw.position_um(now)

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
        self.screw.lose_count(self.now)
        self.line.forget_out()
        self.line.forget_in()
        self._boot_until = self.now + BOOT_S
        self._start_fresh()
        self.state = "Alarm" if self.settings[22] else "Idle"

    def link_lost(self) -> None:
        """The host let go of the port (DTR dropped): light out, feed hold. See the module docstring."""
        self._interlock = False
        self._modal.spindle = 5
        self.line.forget_out()
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
        self.screw.lose_count(self.now)
        self._start_fresh()
        self.line.forget_in()
        self.line.forget_out()

    def replug(self) -> None:
        self._plugged = True
        self.hard_reset()

    def trip_alarm(self, code: int = 1) -> None:
        """An alarm raised from outside, as by a hard limit switch."""
        self._critical_alarm(code)

    # ---- the wire -----------------------------------------------------------------------------------------------

    def receive(self, data: bytes) -> None:
        """Bytes the host sends at ``self.now``."""
        if self._plugged:
            self.line.from_host(data, self.now)

    def transmit(self) -> bytes:
        """Bytes whose last bit has reached the host by ``self.now``."""
        return self.line.sent(self.now)

    def next_event(self) -> float | None:
        """The next instant at which something happens by itself."""
        times = [t for t in (self._next_internal(), self.line.line_ready()) if t is not None]
        return min(times) if times else None

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
        due.append(self.line.next_byte_in())
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
        while (byte := self.line.take(now)) is not None:
            self._take_byte(byte)

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
        self.line.to_host(self.faults.garbage + (text + "\r\n").encode(), self.now)
        self.faults.garbage = b""

    # ---- resets, holds, alarms ----------------------------------------------------------------------------------

    def _start_fresh(self) -> None:
        """What a reset of the processor leaves of the program's state; settings, G54 and the count survive."""
        self._modal = Modal()
        self._rx.clear()
        self._line, self._line_overflow = "", False
        self._spindle_rpm = self._idle_scale = 0.0
        self._g92 = np.zeros(3, np.float32)
        self._gc = self.screw.machine_mm(self._motion.end)
        self._dwell_until = self._deaf_until = None
        self._critical = self._check = self._jog_cancelled = self._homing_hit = False
        self._reporter.restart()
        self._restart_program()
        self._fault_at = None

    def _restart_program(self) -> None:
        self._program = self._main()
        self._waiting = None

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
        self.line.cut_short(self.now)
        if (under_way and not self._motion.idle) or self.state == "Home":
            self.screw.drop(self.now)
            self._say(f"ALARM:{code}")
            self.state = "Alarm"
        else:
            self.screw.drop(self.now)
        locked = self.state == "Alarm"
        self._start_fresh()
        self.state = "Alarm" if locked else "Idle"
        self._greet()

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
            self.screw.drop(self.now)
            self._gc = self.screw.machine_mm(self._motion.end)
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
        self.screw.drop(self.now)
        self._gc = self.screw.machine_mm(self._motion.end)
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
        self.screw.drop(self.now)
        self._gc = self.screw.machine_mm(self._motion.end)
        self.state = "Alarm"
        self._say(f"ALARM:{code}")

    # ---- limit switch -------------------------------------------------------------------------------------------

    def _pressed(self) -> bool:
        return not self.faults.dead_switch and self.screw.pressed(self.now)

    def _switch_time(self) -> float | None:
        """When the carriage will run onto a switch, if anything happens then."""
        if self.faults.dead_switch or self._homing_hit:
            return None
        if self.state != "Home" and not self.settings[21]:
            return None
        return self.screw.switch_time()

    def _switch_hit(self) -> None:
        if self.state == "Home":
            self._homing_hit = True
            self.screw.drop(self.now)
        else:
            self._critical_alarm(1)

    # ---- motion bookkeeping -------------------------------------------------------------------------------------

    def _block_ended(self) -> None:
        self.screw.stall(self.now)
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
            yield from self._jog(rest[2:])
            return
        if rest == "":
            self._say("[HLP:$$ $# $G $I $N $x=val $Nx=line $J=line $SLP $C $X $H ~ ! ? ctrl-x]")
        elif rest == "G":
            self._say(modal_state(self._modal))
        elif rest == "X":
            if self.state == "Alarm":
                self._say("[MSG:Caution: Unlocked]")
                self.state = "Idle"
        elif rest == "C":
            self._check_mode()
        elif self.state not in ("Idle", "Alarm"):
            raise GcodeError(8)
        elif rest == "$":
            for text in listing(self.settings):
                self._say(text)
        elif rest == "#":
            for text in offsets(self._g54, self._g92):
                self._say(text)
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
            store(self.settings, int(match[1]), match[2])
        else:
            raise GcodeError(3)

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
            toward = -1 if self.screw.homes_to_beginning else 1
            target = x + round(reach_mm * steps_per_mm) * (-toward if away else toward)
            block = self.screw.block((target, y, z), speed / 60)
            if block is None:  # a pull-off of nothing
                continue
            self._motion.add(block, self.now)
            yield lambda: self._motion.idle
            if not away and not self._homing_hit:
                self._homing_failed(9)
            self._dwell_until = self.now + self.settings[26] / 1000
            yield lambda: self._dwell_until is None
        self.screw.count_from_switch(self.now)
        self._gc = self.screw.machine_mm(self._motion.end)
        self.state = "Idle"

    # ---- G-code -------------------------------------------------------------------------------------------------

    def _gcode(self, line: str) -> Program:
        statement = read_statement(line, self._modal)
        modal = statement.modal
        lit = modal.motion == 1 or not self.settings[32]
        respun = modal.spindle_speed != self._modal.spindle_speed and not statement.moves
        if modal.spindle != self._modal.spindle or respun:
            yield self._drained()
        self._spindle_rpm = modal.spindle_speed
        if not self._check:
            self._modal.spindle = modal.spindle
        modal.spindle = self._modal.spindle
        if not statement.moves:
            self._idle_scale = 1.0 if lit else 0.0
        self._modal = modal

        if statement.nonmodal == DWELL:
            yield self._drained()
            self._dwell_until = self.now + statement.values["P"]
            yield lambda: self._dwell_until is None
        elif statement.nonmodal in (SET_OFFSET, SHIFT_ORIGIN):
            self._shift(statement)
        elif statement.nonmodal == UNSHIFT_ORIGIN:
            self._g92[:] = 0
        elif statement.moves:
            target = self._target(statement)
            if self.settings[20] and self.screw.outside(target):
                yield from self._soft_limit()
                return
            speed = modal.feed_mm_min / 60 if modal.motion == 1 else 1e9
            yield from self._move(target, speed, 1.0 if lit else 0.0)

    def _jog(self, line: str) -> Program:
        statement = read_statement(line, self._modal, jog=True)
        target = self._target(statement)
        if self.settings[20] and self.screw.outside(target):
            raise GcodeError(15)
        yield from self._move(target, statement.values["F"] * float(statement.scale) / 60, 1.0, jog=True)

    def _shift(self, statement: Statement) -> None:
        """G92 and G10: move the origin."""
        for axis, value in statement.axes.items():
            mm = np.float32(value) * statement.scale
            if statement.nonmodal == SHIFT_ORIGIN:
                self._g92[axis] = self._gc[axis] - self._g54[axis] - mm
            elif statement.values["L"] == 20:
                self._g54[axis] = self._gc[axis] - self._g92[axis] - mm
            else:
                self._g54[axis] = mm

    def _target(self, statement: Statement) -> Float3:
        target = self._gc.copy()
        for axis, value in statement.axes.items():
            mm = np.float32(np.float32(value) * statement.scale)
            if statement.machine:
                target[axis] = mm
            elif statement.modal.absolute:
                target[axis] = np.float32(mm + np.float32(self._g54[axis] + self._g92[axis]))
            else:
                target[axis] = np.float32(target[axis] + mm)
        return target

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
        block = self.screw.block(self.screw.steps(target), mm_s, laser_scale)
        self._gc = target
        if block is None:
            return
        self._motion.add(block, self.now)
        self.state = "Jog" if jog else "Run"
        self._arm_fault()

    # ---- reports ------------------------------------------------------------------------------------------------

    def _report(self) -> None:
        """`?`"""
        now, state = self.now, self.state
        if state == "Hold":
            state = "Hold:0" if self._motion.stopped_in_hold(now) else "Hold:1"
        elif self._check and state == "Idle":
            state = "Check"
        seen = Seen(
            state=state,
            busy=self.state in ("Run", "Jog", "Hold", "Home"),
            machine_mm=self.screw.machine_mm(self._motion.position(now)),
            offset_mm=self._g54 + self._g92,
            speed_mm_s=self._motion.speed(now),
            spindle=self._modal.spindle,
            spindle_rpm=self._spindle_rpm,
            on_switch=self._pressed(),
            free_blocks=PLANNER_BLOCKS - len(self._motion.blocks),
            free_bytes=RX_BYTES - len(self._rx),
        )
        self._say(self._reporter.status(seen, int(self.settings[10])))
