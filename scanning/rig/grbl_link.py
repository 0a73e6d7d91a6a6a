"""One conversation with a GRBL controller: lines out, answers in, nothing lost without being noticed.

GRBL has no checksums and no addresses; the only defence is bookkeeping. This file owns it: every line is answered
before the receive buffer of the controller could overflow (character counting), a greeting in mid-conversation is a
reset, an ALARM may come at any time, bytes that make no sense are counted. Without it a dropped ``ok`` would hang a
scan for ever and a controller that restarted by itself would be believed to stand where it does not.

Every wait ends: by an answer, or by a `StageFault` within the time the caller gave.
"""

from __future__ import annotations

import errno
import re
import select
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace

import serial

from scanning.errors import StageFault
from scanning.rig.grbl_messages import alarm_sentence, error_sentence
from scanning.rig.protocols import LinkQuality

#: Longest wait for the answer to a line that needs no motion, in seconds. GRBL answers in milliseconds; writing its
#: EEPROM takes 20 ms; a USB adapter that was suspended may take half a second.
ANSWER_S = 2.0
#: How long a controller may take from a reset to its greeting: Arduino bootloaders take 1.6 to 2 s.
GREETING_S = 3.0
#: How long to wait for the greeting after each reset that is sent, in seconds. A controller that is free greets in
#: milliseconds; only one that did not heed the first reset gets a second.
RESET_PATIENCE_S = (0.7, 0.7, 1.0, 1.0, 1.0, 1.0)
#: How long the answer to a question asked in passing may take, in seconds. The firmware answers in milliseconds; a busy
#: host or a slow adapter may take longer, and that is no fault of the line.
ASKED_S = 0.5
#: Silence that means the controller has said all it had to say, in seconds.
QUIET_S = 0.05
#: Longest stretch of waiting before looking whether another thread called a halt, in seconds.
HALT_S = 0.05
#: Errors that correct lines never provoke: the line was damaged on its way, sending it again is right.
NOISE_ERRORS = frozenset((1, 2, 3, 11, 20, 21, 22, 23, 24, 25, 26, 27, 28, 31, 32, 33, 34, 35, 36))
#: Attempts at one line before the link is called unusable.
ATTEMPTS = 3

_STATUS = re.compile(r"<([A-Za-z]+)(?::(\d+))?((?:\|[A-Za-z]*:?[^|<>]*)*)>")
_SETTING = re.compile(r"\$(\d+)=([-+]?[0-9.]+)")


@dataclass(frozen=True)
class Status:
    """A status report. Positions in mm; ``machine_mm`` is None while only work position and no offset were reported.

    ``fields`` keeps everything, also what only dialects report, as text.
    """

    state: str
    sub: int | None = None
    machine_mm: float | None = None
    work_mm: float | None = None
    free_blocks: int | None = None
    fields: dict[str, str] = field(default_factory=dict)


class GrblLink:
    """Serial line to one controller. Not thread-safe except `realtime` and `halt`."""

    def __init__(self, port: str, *, baud: int = 115200, clock: Callable[[], float] = time.monotonic) -> None:
        self.port = port
        self.baud = baud
        self.rx_bytes = 128
        self.quality = LinkQuality()
        self.banner = ""
        self.max_outstanding_bytes = 0
        self._clock = clock
        self._serial: serial.SerialBase | None = None
        self._buffer = bytearray()
        self._halted: str | None = None
        self._writing = threading.Lock()
        self._wco_mm: float | None = None
        self._expecting_greeting = False
        # An exchange was broken off (a signal, a fault): its answer may still come and must not answer the next line.
        self._unsettled = False
        self._asked = False

    # ---- open and close -----------------------------------------------------------------------------------------

    @property
    def is_open(self) -> bool:
        return self._serial is not None

    @property
    def halted(self) -> str | None:
        """Why nothing may be done until the next `reset`, or None."""
        return self._halted

    def open(self) -> None:
        """Open the port for us alone, reset the controller and wait until it is ready to talk."""
        try:
            self._serial = serial.serial_for_url(
                self.port, baudrate=self.baud, timeout=0.02, write_timeout=2.0, exclusive=True
            )
        except (serial.SerialException, OSError, ValueError) as fault:
            raise StageFault(_cannot_open(self.port, fault)) from fault
        self._buffer.clear()
        self._halted = None
        try:
            self._find_controller()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Let go of the port. Never raises."""
        port, self._serial = self._serial, None
        if port is not None:
            with suppress(Exception):  # a cable that is gone cannot be closed, and that is fine
                port.close()

    def _find_controller(self) -> None:
        """A board may reset when the port opens, or not; may greet, or not. All of these end in a known state."""
        # Some boards are still in their bootloader, which swallows bytes: hence more than one attempt.
        for patience in (0.15, 0.5, GREETING_S):
            if self._await_greeting(patience):
                break
            self.realtime(b"\x18")
        else:
            if not self._await_greeting(1.0) and not self._answers_status():
                raise StageFault(
                    f"{self.port} is open at {self.baud} baud but no GRBL controller answers; "
                    "check that it is the stage's port, the baud rate and the controller's supply."
                )
        # Whatever we found it doing, from here on it does nothing: laser off, queue empty.
        self.reset()

    def _await_greeting(self, patience_s: float) -> bool:
        self._expecting_greeting = True
        try:
            deadline = self._clock() + patience_s
            while (line := self._read_line(deadline)) is not None:
                if _is_greeting(line):
                    self.banner = line
                    return True
            return False
        finally:
            self._expecting_greeting = False

    def _catches_up(self) -> bool:
        """Whether the controller answers a status request, and with it everything it was asked before.

        A slow board, or one in its bootloader, may greet twice: once for itself, once for the reset sent meanwhile. The
        second greeting must not come in the middle of the talk that follows. What is heard before the answer is old.
        """
        self._expecting_greeting = True
        try:
            for _ in range(ATTEMPTS):
                self.realtime(b"?")
                deadline = self._clock() + ASKED_S
                while (line := self._read_line(deadline)) is not None:
                    if self._parse_status(line) is not None:
                        return True
            return False
        finally:
            self._expecting_greeting = False

    def _answers_status(self) -> bool:
        try:
            self.status(timeout_s=0.5)
        except StageFault:
            return False
        return True

    def reset(self) -> None:
        """Soft reset: laser off, planner empty, position lost if it moved. Returns when the controller is ready."""
        self._halted = None
        self._buffer.clear()
        # After a limit alarm the firmware spends half a second on its message and then forgets the resets of that time.
        greeted = False
        for patience in RESET_PATIENCE_S:
            self.realtime(b"\x18")
            if greeted := self._await_greeting(patience):
                break
        self.drain()
        if not self._catches_up() and not greeted:
            raise StageFault(
                f"The stage controller on {self.port} did not come back after a reset; switch it off and on."
            )

    def drain(self) -> None:
        """Read away what is still under way, until the line is quiet."""
        self._expecting_greeting = True
        try:
            while self._read_line(self._clock() + QUIET_S) is not None:
                pass
        finally:
            self._expecting_greeting = False
        self._buffer.clear()
        self._unsettled = self._asked = False

    # ---- talking ------------------------------------------------------------------------------------------------

    def realtime(self, data: bytes) -> None:
        """Send real-time bytes at once, past every queue, from any thread."""
        with self._trouble("writing to"), self._writing:
            self._port().write(data)

    def halt(self, reason: str) -> None:
        """Make the wait that is running in another thread, and all later ones, end with ``reason``."""
        self._halted = reason

    def command(self, line: str, *, timeout_s: float = ANSWER_S, repeatable: bool = True) -> list[str]:
        """Send one line, wait for its ok, return what the controller said before it.

        ``repeatable`` lines mean the same when sent twice (absolute moves, settings); they are repeated when noise
        ate them. Raises `StageFault` for a refusal, an alarm, a reset or silence.
        """
        attempts = ATTEMPTS if repeatable else 1
        for attempt in range(1, attempts + 1):
            said = self.attempt([line], timeout_s=timeout_s, last=attempt == attempts)
            if said is not None:
                return said
            # An ok that was lost is as silent as a controller that hangs; a status answer tells them apart.
            if attempt == attempts or not self._answers_status():
                break
        raise StageFault(
            f"The stage controller on {self.port} did not answer '{line}' within {timeout_s:g} s; "
            "check its cable and supply, then home the stage."
        )

    def attempt(
        self, lines: list[str], *, timeout_s: float, last: bool = False, meanwhile: Callable[[], None] | None = None
    ) -> list[str] | None:
        """Send ``lines`` together and wait for all answers; None when noise ate one, so the caller may try again.

        ``timeout_s`` is the longest silence allowed between two answers. The ``last`` attempt takes a refusal at its
        word. ``meanwhile`` is called when the lines are out; it must not use this link. Raises `StageFault` for a
        refusal that correct lines can provoke, an alarm, a reset, a lost port.
        """
        said: list[str] = []
        try:
            self._send(lines, said, timeout_s, meanwhile)
        except _Refused as refusal:
            if last or refusal.number not in NOISE_ERRORS:
                raise StageFault(f"Stage on {self.port}: {error_sentence(refusal.number)}.") from refusal
            self._count(bad_lines=1, retries=1)
            return None
        except _Silent:
            self._count(retries=1)
            return None
        return said

    def stream(self, lines: Iterable[str], *, timeout_s: float = ANSWER_S) -> None:
        """Send many lines as fast as the controller takes them, never more than its buffer holds.

        ``timeout_s`` is the longest silence allowed between two answers.
        """
        try:
            self._send(lines, [], timeout_s)
        except _Refused as refusal:
            raise StageFault(f"Stage on {self.port}: '{refusal.line}': {error_sentence(refusal.number)}.") from refusal
        except _Silent as silence:
            raise StageFault(
                f"The stage controller on {self.port} fell silent for {timeout_s:g} s; "
                "check its cable and supply, then home the stage."
            ) from silence

    def _send(
        self, lines: Iterable[str], said: list[str], timeout_s: float, meanwhile: Callable[[], None] | None = None
    ) -> None:
        self._settle()
        self._unsettled = True
        waiting: deque[str] = deque()
        used = 0
        for line in lines:
            size = len(line) + 1
            while waiting and used + size > self.rx_bytes - 1:
                used -= self._answered(waiting, said, timeout_s)
            with self._trouble("writing to"), self._writing:
                self._port().write(line.encode("ascii") + b"\n")
            self._count(lines_sent=1)
            waiting.append(line)
            used += size
            self.max_outstanding_bytes = max(self.max_outstanding_bytes, used)
        if meanwhile is not None:
            meanwhile()
        while waiting:
            self._answered(waiting, said, timeout_s)
        self._unsettled = False

    def _settle(self) -> None:
        self.asked_status()
        if self._unsettled:
            if self._halted is not None:
                raise StageFault(self._halted)
            self.drain()

    def _answered(self, waiting: deque[str], said: list[str], timeout_s: float) -> int:
        """Wait for the answer to the oldest line; return the buffer space it frees."""
        deadline = self._clock() + timeout_s
        while True:
            text = self._next(deadline)
            if text is None:
                raise _Silent
            if text == "ok":
                return len(waiting.popleft()) + 1
            if text.startswith("error:"):
                number = text[6:]
                raise _Refused(waiting[0], int(number) if number.isdigit() else 0)
            said.append(text)

    def status(self, *, timeout_s: float = 1.0, attempts: int = ATTEMPTS) -> Status:
        """Ask ``?`` and return the report. Asks again when noise ate the question or the answer."""
        self._settle()
        self._unsettled = True
        for attempt in range(attempts):
            if attempt:
                self._count(retries=1)
            self.realtime(b"?")
            deadline = self._clock() + timeout_s
            while (text := self._next(deadline)) is not None:
                if text.startswith("<") and (status := self._parse_status(text)) is not None:
                    self._unsettled = False
                    return status
        raise StageFault(
            f"The stage controller on {self.port} does not answer status requests; check its cable and supply, "
            "then home the stage."
        )

    def ask_status(self) -> None:
        """Send ``?`` and do not wait; the next `status` or line takes the answer in passing."""
        self.realtime(b"?")
        self._asked = True

    def asked_status(self) -> Status | None:
        """The answer to `ask_status`, or None when nothing was asked or noise ate the answer."""
        if not self._asked:
            return None
        self._asked = False
        deadline = self._clock() + ASKED_S
        while (text := self._next(deadline)) is not None:
            if text.startswith("<"):
                return self._parse_status(text)
        self._count(bad_lines=1)
        return None

    def listen(self, duration_s: float) -> None:
        """Wait, but notice alarms, resets and a pulled cable at once."""
        deadline = self._clock() + duration_s
        while self._next(deadline) is not None:
            pass

    # ---- hearing ------------------------------------------------------------------------------------------------

    def _next(self, deadline: float) -> str | None:
        """The next meaningful line (ok, error:n, <status>, [info], $n=v), or None at the deadline.

        Raises `StageFault` for an alarm or a reset, whenever they come.
        """
        while (line := self._read_line(deadline)) is not None:
            if line == "ok" or re.fullmatch(r"error:\d+", line):
                return line
            if match := re.fullmatch(r"ALARM:(\d+)", line):
                raise StageFault(f"Stage on {self.port}: {alarm_sentence(int(match[1]))}.")
            if _is_greeting(line):
                self._count(resets=1)
                raise StageFault(
                    f"The stage controller on {self.port} restarted by itself, so its position is lost; "
                    "check its supply and cable, then home the stage."
                )
            if line.startswith("<"):
                if self._parse_status(line) is not None:
                    return line
                self._count(bad_lines=1)
            elif (line.startswith("[") and line.endswith("]")) or line.startswith(("$", ">")):
                return line
            else:
                self._count(bad_lines=1)
        return None

    def _read_line(self, deadline: float) -> str | None:
        while True:
            if self._halted is not None and not self._expecting_greeting:
                raise StageFault(self._halted)
            end = self._buffer.find(b"\n")
            if end >= 0:
                raw = bytes(self._buffer[:end])
                del self._buffer[: end + 1]
                line = raw.strip(b"\r \t").decode("ascii", errors="replace")
                if line:
                    return line
                continue
            if len(self._buffer) > 4096:  # a baud rate that does not match produces endless noise without line ends
                self._buffer.clear()
                self._count(bad_lines=1)
            with self._trouble("reading from"):
                self._buffer += self._available(deadline - self._clock())
            if self._clock() >= deadline and b"\n" not in self._buffer:
                return None

    def _available(self, wait_s: float) -> bytes:
        """What the port holds, after waiting for something for at most ``wait_s`` (and `HALT_S`, to see a halt)."""
        port = self._port()
        wait_s = min(max(wait_s, 0.0), HALT_S)
        try:
            handle = port.fileno()
        except (AttributeError, OSError):  # ports without a file behind them wait in steps of their own timeout
            return bytes(port.read(max(1, port.in_waiting)))
        if not select.select([handle], [], [], wait_s)[0]:
            return b""
        return bytes(port.read(max(1, port.in_waiting)))

    def _parse_status(self, text: str) -> Status | None:
        match = _STATUS.fullmatch(text)
        if match is None:
            return None
        fields = dict(part.partition(":")[::2] for part in match[3].split("|") if part)
        try:
            if "WCO" in fields:
                self._wco_mm = float(fields["WCO"].split(",")[0])
            machine = float(fields["MPos"].split(",")[0]) if "MPos" in fields else None
            work = float(fields["WPos"].split(",")[0]) if "WPos" in fields else None
            free = int(fields["Bf"].split(",")[0]) if "Bf" in fields else None
        except ValueError:
            return None
        if machine is None and work is None:  # every report tells one of them; one without was damaged on its way
            return None
        if machine is None and work is not None and self._wco_mm is not None:
            machine = work + self._wco_mm
        if work is None and machine is not None and self._wco_mm is not None:
            work = machine - self._wco_mm
        sub = int(match[2]) if match[2] else None
        return Status(match[1], sub, machine, work, free, fields)

    def settings(self) -> dict[int, float]:
        """The controller's ``$$`` settings by number."""
        found: dict[int, float] = {}
        for line in self.command("$$", timeout_s=5.0):
            if match := _SETTING.match(line):
                found[int(match[1])] = float(match[2])
        return found

    def _count(self, *, lines_sent: int = 0, bad_lines: int = 0, retries: int = 0, resets: int = 0) -> None:
        q = self.quality
        self.quality = replace(
            q,
            lines_sent=q.lines_sent + lines_sent,
            bad_lines=q.bad_lines + bad_lines,
            retries=q.retries + retries,
            resets=q.resets + resets,
        )

    def _port(self) -> serial.SerialBase:
        if self._serial is None:
            raise StageFault(f"The stage's port {self.port} is not open; open the rig first.")
        return self._serial

    @contextmanager
    def _trouble(self, doing: str) -> Iterator[None]:
        """A pulled cable comes out of pyserial in many ways: its own error, OSError, termios.error, TypeError."""
        try:
            yield
        except StageFault:
            raise
        except Exception as fault:
            raise StageFault(
                f"The connection to the stage on {self.port} broke while {doing} it ({fault}); "
                "check the USB cable and the controller's supply, then home the stage."
            ) from fault


class _Refused(Exception):
    def __init__(self, line: str, number: int) -> None:
        super().__init__(line, number)
        self.line, self.number = line, number


class _Silent(Exception):
    pass


def _is_greeting(line: str) -> bool:
    return bool(re.match(r"grbl(hal)?\s+v?\d", line, re.IGNORECASE))


def _cannot_open(port: str, fault: Exception) -> str:
    number = getattr(fault, "errno", None)
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return f"There is no serial port {port}; check that the stage is plugged in and the rig's port is right."
    if number in (errno.EACCES, errno.EPERM):
        return f"No permission to open the serial port {port}; add this user to the port's group (often 'dialout')."
    if number in (errno.EAGAIN, errno.EBUSY):
        return f"The serial port {port} is in use by another program; close that program, or stop the other worker."
    if number in (errno.ECONNREFUSED, errno.EHOSTUNREACH, errno.ETIMEDOUT):
        return f"Nothing answers at {port}; check that the serial server is running and reachable."
    return f"The serial port {port} cannot be opened ({fault}); check the rig's port setting."
