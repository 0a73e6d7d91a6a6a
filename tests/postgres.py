"""A PostgreSQL cluster and a Redis of our own, thrown away afterwards: `python -m tests.postgres tests/worker ...`.

The product is written against SQLite and Valkey in development and meets PostgreSQL and Redis in a mill. What differs
(row locks, READ COMMITTED, the case of letters, the place of NULL) is found only by running the same tests on both.
Nothing that is already running on the machine is used or touched.
"""

from __future__ import annotations

import contextlib
import os
import pwd
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PATIENCE_S = 30.0


def postgres_binaries() -> Path | None:
    """The folder with initdb and postgres, newest version first; None where there is none."""
    debian = sorted(
        Path("/usr/lib/postgresql").glob("*/bin"),
        key=lambda folder: int(folder.parent.name) if folder.parent.name.isdigit() else 0,
        reverse=True,
    )
    on_path = shutil.which("initdb")
    for folder in [*debian, *([Path(on_path).resolve().parent] if on_path else [])]:
        if (folder / "initdb").exists() and (folder / "postgres").exists():
            return folder
    return None


def missing() -> str:
    """Why no cluster can be started here; empty where one can."""
    if postgres_binaries() is None:
        return "no PostgreSQL server is installed (Debian: apt-get install postgresql)"
    if os.geteuid() == 0 and _unprivileged() is None:
        return "PostgreSQL refuses to run as root, and there is no user postgres or nobody to run it as"
    return ""


def _unprivileged() -> pwd.struct_passwd | None:
    for name in ("postgres", "nobody"):
        with contextlib.suppress(KeyError):
            return pwd.getpwnam(name)
    return None


@contextmanager
def postgres() -> Iterator[str]:
    """Yield the DATABASE_URL of a fresh cluster on a unix socket; the cluster is gone afterwards."""
    if reason := missing():
        raise RuntimeError(reason)
    binaries = postgres_binaries()
    assert binaries is not None
    # Short, because a unix socket's path must stay under 108 bytes.
    folder = Path(tempfile.mkdtemp(prefix="ew-pg-"))
    who: dict[str, Any] = {}
    if os.geteuid() == 0:
        user = _unprivileged()
        assert user is not None
        os.chown(folder, user.pw_uid, user.pw_gid)
        who = {"user": user.pw_uid, "group": user.pw_gid, "extra_groups": []}
    server: subprocess.Popen[bytes] | None = None
    try:
        data = folder / "data"
        subprocess.run(
            [str(binaries / "initdb"), "-D", str(data), "-U", "edgewatch", "-A", "trust", "-E", "UTF8", "--no-sync",
             "--locale", "C.UTF-8"],
            check=True, cwd=folder, stdout=subprocess.DEVNULL, **who,
        )  # fmt: skip
        server = subprocess.Popen(
            [str(binaries / "postgres"), "-D", str(data), "-k", str(folder), "-c", "listen_addresses=",
             "-c", "fsync=off", "-c", "full_page_writes=off", "-c", "log_min_messages=warning"],
            cwd=folder, stdout=(folder / "log").open("wb"), stderr=subprocess.STDOUT, **who,
        )  # fmt: skip
        _wait_for(lambda: _answers(folder), server, folder / "log")
        yield f"postgres://edgewatch@{str(folder).replace('/', '%2F')}/postgres"
    finally:
        if server is not None:
            server.send_signal(signal.SIGINT)  # fast shutdown: sessions are cut
            try:
                server.wait(15)
            except subprocess.TimeoutExpired:
                server.kill()
                server.wait()
        shutil.rmtree(folder, ignore_errors=True)


def _answers(folder: Path) -> bool:
    import psycopg

    try:
        psycopg.connect(host=str(folder), user="edgewatch", dbname="postgres", connect_timeout=2).close()
    except psycopg.OperationalError:
        return False
    return True


def _wait_for(ready: Any, server: subprocess.Popen[bytes], log: Path) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not ready():
        if server.poll() is not None or time.monotonic() > deadline:
            raise RuntimeError(f"PostgreSQL did not start: {log.read_text(errors='replace')[-2000:]}")
        time.sleep(0.05)


def free_port() -> int:
    with contextlib.closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def main(arguments: list[str]) -> int:
    """Run pytest with ``arguments`` on a scratch PostgreSQL, and on Redis where its server is installed."""
    if reason := missing():
        print(f"Skipped: {reason}.")
        return 0
    environment = dict(os.environ)
    if redis := shutil.which("redis-server"):
        environment["TEST_REDIS_SERVER"] = redis
    else:
        print("No redis-server is installed: the broker is Valkey.")
    with postgres() as url:
        environment["TEST_DATABASE_URL"] = url
        return subprocess.call([sys.executable, "-m", "pytest", *arguments], cwd=ROOT, env=environment)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
