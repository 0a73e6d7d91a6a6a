"""kill -9 at random moments of a scan, and what was true afterwards. The moments come from a fixed seed.

Each moment: order a scan, kill one process (with its children) at a random time between the order and the usual end,
start it again at once as a supervisor does, and watch the rows until the scan has its true end. A scan the rig worker's
death broke off is continued as a person would; whoever died, the scan must end done, once, with every frame whole.
"""

from __future__ import annotations

import json
import random
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from django.conf import settings

from inspection.models import Inspection, RangeImage, Rig, Scan, Tool, User
from inspection.services import queue
from inspection.services import ring as doorbell
from inspection.services.continuing import continue_scan
from inspection.states import ENDED, ON_RIG, ScanState
from scanning import open_stack
from tests.faults.plant import Plant, wait_until

WHO = ("rig worker", "compute worker", "web", "tick", "broker")
SEED = 20261124
#: A scan that has not come to its end so long after a kill is stuck.
STUCK_S = 120.0


@dataclass
class Tally:
    """What a number of kills of one kind led to; times in seconds after the kill."""

    who: str
    moments: int = 0
    states: dict[str, int] = field(default_factory=dict)
    """How often the scan was in which state when the process died."""
    lost: int = 0
    doubled: int = 0
    stuck: int = 0
    broken_frames: int = 0
    true_after_s: list[float] = field(default_factory=list)
    dark_after_s: list[float] = field(default_factory=list)
    done_after_s: list[float] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def row(self) -> str:
        """One line of the table in docs/reliability.md."""

        def span(values: list[float]) -> str:
            return f"{sorted(values)[len(values) // 2]:.1f} / {max(values):.1f}" if values else "-"

        when = ", ".join(f"{state} {count}" for state, count in sorted(self.states.items()))
        counted = f"{self.lost} | {self.doubled} | {self.stuck} | {self.broken_frames}"
        times = " | ".join(span(values) for values in (self.true_after_s, self.dark_after_s, self.done_after_s))
        return f"| {self.who} | {self.moments} | {when} | {counted} | {times} |"


class Site:
    """A whole installation with its five kinds of processes, on this test's database."""

    def __init__(self, plant: Plant, tool: Tool, rig: Rig, by: User, port: int, token: str) -> None:
        self.plant, self.tool, self.rig, self.by, self.port, self.token = plant, tool, rig, by, port, token
        self.start: dict[str, tuple[str, Callable[[], Any]]] = {
            "rig worker": ("rig-rig1", lambda: plant.worker("rig.rig1")),
            "compute worker": ("compute", plant.compute),
            "web": ("web", lambda: plant.web(port)),
            "tick": ("tick", plant.tick),
            "broker": ("valkey", plant.valkey),
        }

    def up(self) -> None:
        settings.REDIS_URL = self.plant.redis_url
        doorbell._sender.cache_clear()
        for who in ("broker", "rig worker", "compute worker", "web", "tick"):
            self.start[who][1]()
        wait_until(self._answers, "the web server")
        wait_until(lambda: Rig.objects.get().worker_seen_at, "the rig's worker")

    def _answers(self) -> bool:
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self.port}/health/", timeout=2) as answer:
                return bool(answer.status == 200)
        except (urllib.error.URLError, OSError):
            return False

    def ask(self, path: str, body: Any = None) -> int:
        """Call the API as another program would; 0 if the connection broke."""
        request = urllib.request.Request(
            f"http://127.0.0.1:{self.port}/api/v1/{path}",
            data=None if body is None else json.dumps(body).encode(),
            headers={"Authorization": f"Bearer {self.token}", "Content-Type": "application/json"},
        )
        try:
            with urllib.request.urlopen(request, timeout=10) as answer:
                return int(answer.status)
        except urllib.error.HTTPError as error:
            return error.code
        except (urllib.error.URLError, OSError):
            return 0

    def order(self) -> Scan:
        return queue.enqueue_inspection(tool=self.tool, rig=self.rig, by=self.by).scans.get()

    def laser(self) -> float:
        from scanning.rig.simulated.camera import SimulatedCamera

        camera = SimulatedCamera(Rig.objects.get().config["camera"]["address"])
        camera.open()
        try:
            return float(camera.bench_state()["laser"])
        finally:
            camera.close()

    def usual_s(self) -> float:
        """How long a scan takes from the order to its end while nobody is killed."""
        began = time.monotonic()
        scan = self.order()
        self.ended(scan, STUCK_S)
        assert now(scan).state == ScanState.DONE, now(scan).fault
        return time.monotonic() - began

    def ended(self, scan: Scan, patience_s: float) -> bool:
        deadline = time.monotonic() + patience_s
        while time.monotonic() < deadline:
            if now(scan).state in ENDED:
                return True
            time.sleep(0.05)
        return False

    def moment(self, who: str, at_s: float, tally: Tally) -> None:
        """One kill, ``at_s`` seconds after an order."""
        tally.moments += 1
        order: dict[str, Any] = {"tool": self.tool.code, "rig": self.rig.slug}
        codes: list[int] = []
        visits = Inspection.objects.count()
        if who == "web":  # ordered through the process that will be killed, at every other moment in mid-request
            asking = threading.Thread(target=lambda: codes.append(self.ask("inspections", order)))
            asking.start()
            if tally.moments % 2:
                at_s = at_s / 50
            else:
                asking.join()
        else:
            scan = self.order()
        if who == "compute worker" and tally.moments % 2:  # every other moment while it computes, however short that is
            deadline = time.monotonic() + STUCK_S
            while now(scan).state not in (ScanState.PROCESSING, *ENDED) and time.monotonic() < deadline:
                time.sleep(0.01)
            at_s /= 10
        time.sleep(at_s)
        name, start = self.start[who]
        if who != "web":
            state = now(scan).state
            tally.states[state] = tally.states.get(state, 0) + 1
        held = who == "rig worker" and now(scan).state in ON_RIG
        began = time.monotonic()
        self.plant.kill(name)
        if who == "rig worker":
            while self.laser() > 0 and time.monotonic() - began < 30:
                time.sleep(0.02)
            tally.dark_after_s.append(time.monotonic() - began)
        start()
        if who == "web":
            asking.join()
            wait_until(self._answers, "the web server after its death")
            tally.true_after_s.append(time.monotonic() - began)
            made = Inspection.objects.count() - visits
            state = f"answered {codes[0]}" if codes[0] else f"cut off, {made} made"
            tally.states[state] = tally.states.get(state, 0) + 1
            if codes[0] == 201 and made != 1:
                tally.lost += 1
            if made == 0:
                return
            scan = Scan.objects.latest("pk")
            if scan.inspection.scans.count() != 1 or made > 1:
                tally.doubled += 1
        if held:  # its row says "running" though nobody runs it
            wait_until(lambda: now(scan).state not in ON_RIG, "a true state", STUCK_S)
            tally.true_after_s.append(time.monotonic() - began)
        self._follow(scan, began, tally)

    def _follow(self, scan: Scan, began: float, tally: Tally) -> None:
        if not self.ended(scan, STUCK_S):
            tally.stuck += 1
            tally.notes.append(f"scan {scan.pk} is {now(scan).state} {now(scan).phase}")
            queue.cancel_scan(scan, None)
            return
        if now(scan).state == ScanState.INTERRUPTED:
            continue_scan(now(scan), self.by, looked=True)
            if not self.ended(scan, STUCK_S):
                tally.stuck += 1
                tally.notes.append(f"continued scan {scan.pk} is {now(scan).state}")
                return
        tally.done_after_s.append(time.monotonic() - began)
        row = now(scan)
        images = RangeImage.objects.filter(scan=scan).count()
        if row.state != ScanState.DONE or images == 0:
            tally.lost += 1
            tally.notes.append(f"scan {scan.pk} is {row.state}: {row.fault}")
            return
        if images > 1:
            tally.doubled += 1
        try:
            with open_stack(Path(settings.STACKS) / row.stack_file) as stack:
                verify = getattr(stack, "verify", None)
                assert verify is not None
                verify()
                if stack.header.steps != row.total or stack.sha256() != row.stack_sha256:
                    raise ValueError(f"{stack.header.steps} of {row.total} steps")
        except Exception as fault:  # whatever is wrong with it is what is counted
            tally.broken_frames += 1
            tally.notes.append(f"scan {scan.pk}: {fault}")


def now(scan: Scan) -> Scan:
    return Scan.objects.select_related("rig").get(pk=scan.pk)


def run(site: Site, who: str, count: int, usual_s: float, say: Callable[[str], None] = lambda _: None) -> Tally:
    """Kill ``who`` at ``count`` moments of the seed."""
    chance = random.Random(f"{SEED} {who}")
    tally = Tally(who)
    for number in range(count):
        site.moment(who, chance.uniform(0.0, usual_s), tally)
        say(f"{number + 1} of {count}: {tally.row()}")
    return tally
