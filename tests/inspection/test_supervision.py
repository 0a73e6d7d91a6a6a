"""The processes of one machine live and die together."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from inspection.supervise import Child, Supervisor, hold_alone

FOREVER = [sys.executable, "-c", "import time; time.sleep(600)"]


def gone(pid: int, within_s: float = 5.0) -> bool:
    """True once no process with this id runs any more (a zombie counts as gone)."""
    deadline = time.monotonic() + within_s
    while time.monotonic() < deadline:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
        except (FileNotFoundError, ProcessLookupError):
            return True
        if state == "Z":
            return True
        time.sleep(0.02)
    return False


def test_a_child_that_dies_is_started_again(tmp_path: Path) -> None:
    said: list[str] = []
    supervisor = Supervisor(said.append)
    child = supervisor.start(Child("worker", FOREVER, tmp_path / "log"))
    try:
        assert child.process is not None
        first = child.process.pid
        os.kill(first, signal.SIGKILL)
        child.process.wait()
        supervisor.watch()
        child.not_before = 0.0
        supervisor.watch()
        assert child.running
        assert child.process is not None
        assert child.process.pid != first
        assert "worker stopped (exit -9)" in said[0]
    finally:
        supervisor.stop()


def test_a_child_that_keeps_dying_waits_longer_each_time(tmp_path: Path) -> None:
    supervisor = Supervisor(lambda text: None)
    child = supervisor.start(Child("worker", [sys.executable, "-c", "raise SystemExit(3)"], tmp_path / "log"))
    waits = []
    for _ in range(4):
        assert child.process is not None
        child.process.wait()
        supervisor.watch()
        waits.append(child.wait_s)
        child.not_before = 0.0
        supervisor.watch()
    supervisor.stop()
    assert waits == [2.0, 4.0, 8.0, 16.0]


def test_stopping_ends_children_in_reverse_order_and_kills_the_deaf(tmp_path: Path) -> None:
    deaf = "import signal as s, time; s.signal(s.SIGTERM, s.SIG_IGN); print('deaf', flush=True); time.sleep(600)"
    supervisor = Supervisor(lambda text: None)
    polite = supervisor.start(Child("polite", FOREVER, tmp_path / "polite"))
    stubborn = supervisor.start(Child("stubborn", [sys.executable, "-c", deaf], tmp_path / "deaf", grace_s=0.2))
    while "deaf" not in stubborn.last_lines():
        time.sleep(0.02)
    supervisor.stop()
    assert not polite.running
    assert not stubborn.running
    assert stubborn.process is not None
    assert stubborn.process.returncode == -signal.SIGKILL


def test_children_die_when_the_supervisor_is_killed(tmp_path: Path) -> None:
    script = (
        "import sys, time; from pathlib import Path; from inspection.supervise import Child, Supervisor, hold_alone\n"
        f"c = Supervisor(print).start(Child('w', {FOREVER!r}, Path({str(tmp_path / 'log')!r})))\n"
        "print(c.process.pid, flush=True); time.sleep(600)"
    )
    parent = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    assert gone(pid)


def test_an_installation_is_held_by_one_at_a_time(tmp_path: Path) -> None:
    first = hold_alone(tmp_path)
    assert first is not None
    assert hold_alone(tmp_path) is None
    first.close()
    second = hold_alone(tmp_path)
    assert second is not None
    second.close()
