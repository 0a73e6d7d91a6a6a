"""Keeps the processes of one machine running together, and takes them down together.

`manage.py up` and `manage.py run_rig` start web server, workers and the rig simulator as children. Without one place
that watches them, a worker that dies at night stays dead, and a terminal that is closed leaves a worker driving the rig
with nobody to stop it.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO

PR_SET_PDEATHSIG = 1

#: A child that lived this long before dying starts again at once; one that dies sooner waits, doubling up to a minute.
SETTLED_S = 30.0
LONGEST_WAIT_S = 60.0


def die_with_parent() -> None:
    """Run in the child before exec: have the kernel send SIGTERM when the supervisor is gone, however it went."""
    os.setpgid(0, 0)  # Ctrl-C reaches the supervisor alone, which then stops the children in order
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)


@dataclass
class Child:
    """One supervised process. ``grace_s`` is how long it may take to stop before it is killed."""

    name: str
    command: Sequence[str]
    log: Path
    grace_s: float = 10.0
    restart: bool = True
    environment: Mapping[str, str] = field(default_factory=dict)
    process: subprocess.Popen[bytes] | None = None
    started_at: float = 0.0
    not_before: float = 0.0
    wait_s: float = 1.0

    def start(self) -> None:
        self.log.parent.mkdir(parents=True, exist_ok=True)
        with self.log.open("ab") as out:
            self.process = subprocess.Popen(
                self.command,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=subprocess.STDOUT,
                env={**os.environ, **self.environment},
                preexec_fn=die_with_parent,
            )
        self.started_at = time.monotonic()

    @property
    def running(self) -> bool:
        return self.process is not None and self.process.poll() is None

    def stop(self) -> None:
        """Ask the process to end, wait ``grace_s``, then kill its whole group."""
        if self.process is None:
            return
        if self.process.poll() is None:
            self.process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(self.grace_s)
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.process.pid, signal.SIGKILL)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(5)

    def last_lines(self, count: int = 12) -> str:
        try:
            return "\n".join(self.log.read_text(errors="replace").splitlines()[-count:])
        except FileNotFoundError:
            return ""


class Supervisor:
    """Starts children in order, restarts those that die, stops them in reverse order."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self.children: list[Child] = []
        self.stopping = threading.Event()
        self._say = say

    def start(self, child: Child) -> Child:
        child.start()
        self.children.append(child)
        return child

    def watch(self) -> None:
        """Look once at every child and start again what has died. Call it about twice a second from the main thread.

        The main thread matters: the kernel ties the death signal to the thread that started the child.
        """
        now = time.monotonic()
        for child in self.children:
            if child.running or not child.restart or self.stopping.is_set():
                continue
            if child.process is not None:
                lived = now - child.started_at
                child.wait_s = 1.0 if lived > SETTLED_S else min(child.wait_s * 2, LONGEST_WAIT_S)
                child.not_before = now + child.wait_s
                self._say(
                    f"{child.name} stopped (exit {child.process.returncode}); starting again in {child.wait_s:.0f} s. "
                    f"Its log: {child.log}"
                )
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    os.killpg(child.process.pid, signal.SIGKILL)
                child.process = None
            if now >= child.not_before:
                child.start()

    def stop(self) -> None:
        self.stopping.set()
        for child in reversed(self.children):
            child.stop()


def hold_alone(home: Path) -> TextIO | None:
    """Take the lock of an installation, held until the returned file is closed; None if another process holds it.

    Two sets of workers on one home would drive one rig. The kernel drops the lock with its holder, however it ends.
    """
    home.mkdir(parents=True, exist_ok=True)
    lock = (home / "up.lock").open("w")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.close()
        return None
    return lock


def raise_on_signals() -> None:
    """Turn SIGINT, SIGTERM and SIGHUP into KeyboardInterrupt, so that ``finally`` stops the children whichever came.

    SIGINT too: a shell that starts a command in the background has it ignored, and Python then leaves it so.
    """

    def interrupt(signum: int, _frame: object) -> None:
        raise KeyboardInterrupt

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, interrupt)
