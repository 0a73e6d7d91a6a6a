"""The serial cable between a host and the emulated controller: a pseudo-terminal and the clock behind it.

The host opens `stage.tty` with pyserial exactly as it would open `/dev/serial/by-id/...`. One thread carries bytes both
ways and sleeps until the controller's next event; it wakes for nothing else. Only while no host holds the port does it
look every `UNATTENDED_LOOK_S`, because Linux does not announce the opening of a pseudo-terminal.
"""

from __future__ import annotations

import errno
import os
import select
import threading
import time
import tty
from collections.abc import Callable
from pathlib import Path

from scanning.rig.simulated.controller import Controller

#: How often the wire looks for a host while nobody has the port open, in seconds. Bounds the delay of the greeting.
UNATTENDED_LOOK_S = 0.01


class MachineClock:
    """Machine time: real seconds since the start, times the speed-up factor."""

    def __init__(self, speed_up: float = 1.0, now: Callable[[], float] = time.monotonic) -> None:
        self.speed_up = speed_up
        self._now = now
        self._start = now()

    def now(self) -> float:
        return (self._now() - self._start) * self.speed_up

    def real(self, machine_s: float) -> float:
        """Real seconds that a stretch of machine time takes."""
        return machine_s / self.speed_up


class Wire:
    """Serves one controller on the pseudo-terminal that ``path`` links to.

    ``lock`` guards the controller: hold it to read the truth (position, laser) from another thread, after `catch_up`.
    """

    def __init__(self, controller: Controller, path: Path, clock: MachineClock) -> None:
        self.controller = controller
        self.path = path
        self.lock = threading.RLock()
        self._clock = clock
        self._master: int | None = None
        self._attended = False
        self._wake_read, self._wake_write = os.pipe()
        os.set_blocking(self._wake_read, False)
        self._stopping = False
        self._thread = threading.Thread(target=self._carry, name="stage-wire", daemon=True)

    def start(self) -> None:
        self._plug_in()
        self._thread.start()

    def stop(self) -> None:
        self._stopping = True
        self._wake()
        self._thread.join()
        self._pull_out()
        os.close(self._wake_read)
        os.close(self._wake_write)

    def catch_up(self) -> float:
        """Bring the controller to the present and return machine time. The caller holds the lock."""
        now = self._clock.now()
        self.controller.advance(now)
        return now

    def unplug(self) -> None:
        """Pull the USB cable: the device node vanishes and the board loses its power."""
        with self.lock:
            self.catch_up()
            self._unplug_now()
        self._wake()

    def unplug_in_move(self) -> None:
        """Pull the cable in the middle of the next move."""
        with self.lock:
            self.controller.faults.in_move = self._unplug_now

    def replug(self) -> None:
        with self.lock:
            self.catch_up()
            self.controller.replug()
            self._plug_in()
        self._wake()

    def _unplug_now(self) -> None:
        self.controller.unplug()
        self._pull_out()

    def _plug_in(self) -> None:
        master, slave = os.openpty()
        tty.setraw(slave)  # before anybody opens it: a cooked terminal would echo the greeting back as commands
        os.set_blocking(master, False)
        name = os.ttyname(slave)
        os.close(slave)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        fresh = self.path.with_name(self.path.name + ".new")
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(name)
        fresh.replace(self.path)
        self._master, self._attended = master, False

    def _pull_out(self) -> None:
        if self._master is not None:
            self.path.unlink(missing_ok=True)
            os.close(self._master)
            self._master = None

    def _wake(self) -> None:
        os.write(self._wake_write, b".")

    def _carry(self) -> None:
        while not self._stopping:
            with self.lock:
                now = self.catch_up()
                self._deliver()
                self._notice_host()
                due = self.controller.next_event()
                master, attended = self._master, self._attended
            timeout = None if due is None else max(self._clock.real(due - now), 0.0)
            if master is not None and not attended:
                timeout = UNATTENDED_LOOK_S
            watched = [self._wake_read] + ([master] if master is not None and attended else [])
            try:
                ready, _, _ = select.select(watched, [], [], timeout)
            except (OSError, ValueError):  # the cable was pulled while we slept on it
                continue
            if self._wake_read in ready:
                os.read(self._wake_read, 4096)
            if master in ready:
                with self.lock:
                    self.catch_up()
                    self._collect()

    def _deliver(self) -> None:
        data = self.controller.transmit()
        if data and self._master is not None and self._attended:
            try:
                os.write(self._master, data)
            except OSError as fault:  # nobody reads: a real UART would lose these bytes too
                if fault.errno not in (errno.EAGAIN, errno.EIO):
                    raise

    def _collect(self) -> None:
        if self._master is None:
            return
        try:
            data = os.read(self._master, 4096)
        except BlockingIOError:
            return
        except OSError:  # EIO: the last host closed the port, whether it wanted to or was killed
            data = b""
        if data:
            self.controller.receive(data)
        else:
            self._attended = False
            self.controller.link_lost()

    def _notice_host(self) -> None:
        if self._master is None or self._attended:
            return
        poll = select.poll()
        poll.register(self._master, select.POLLIN)
        events = dict(poll.poll(0)).get(self._master, 0)
        if not events & select.POLLHUP:
            self._attended = True
            self.controller.link_found()
