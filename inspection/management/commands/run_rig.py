"""`manage.py run_rig SLUG`: the one worker that owns a rig, and, for a simulated rig, the machine it drives.

A rig has one owner; this command is what a service unit or a compose service starts, once per rig.
"""

from __future__ import annotations

import sys
import time
from typing import Any

from django.conf import settings
from django.core.management.base import BaseCommand, CommandError, CommandParser

from inspection.models import Rig
from inspection.supervise import Child, Supervisor, raise_on_signals


class Command(BaseCommand):
    help = "Serve one rig's queue until stopped; starts the simulated machine as well where the rig is simulated."

    def add_arguments(self, parser: CommandParser) -> None:
        parser.add_argument("slug")

    def handle(self, *args: Any, **options: Any) -> None:
        slug = options["slug"]
        rig = Rig.objects.filter(slug=slug).first()
        if rig is None:
            known = ", ".join(Rig.objects.values_list("slug", flat=True)) or "none"
            raise CommandError(f"There is no rig {slug!r}. Known rigs: {known}.")
        raise_on_signals()
        supervisor = Supervisor(self.stderr.write)
        logs = settings.HOME / "logs"
        try:
            if machine := rig.config.get("simulated"):
                supervisor.start(
                    Child(
                        "simulated rig",
                        [
                            sys.executable, "-m", "scanning.rig.simulated",
                            "--dir", machine["dir"], "--speed-up", str(machine.get("speed_up", 1)),
                        ],
                        logs / f"simulated-{slug}.log",
                        grace_s=3,
                    )
                )  # fmt: skip
            supervisor.start(
                Child(
                    "rig worker",
                    [
                        sys.executable, "-m", "celery", "-A", "worker", "worker", "--pool", "prefork",
                        "--concurrency", "1", "--queues", f"rig.{slug}", "--hostname", f"{slug}@%h",
                        "--without-gossip", "--without-mingle", "--loglevel", "INFO",
                    ],
                    logs / f"worker-{slug}.log",
                    grace_s=25,
                )
            )  # fmt: skip
            while True:
                supervisor.watch()
                time.sleep(0.5)
        except KeyboardInterrupt:
            pass
        finally:
            supervisor.stop()
