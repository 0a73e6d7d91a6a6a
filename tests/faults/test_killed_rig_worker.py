"""kill -9 of a real prefork worker over a real Valkey in the middle of a scan on a real serial line."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from django.conf import settings

from inspection.models import Rig, Scan, Tool, User
from inspection.services import queue
from inspection.states import QueueState, ScanState
from scanning import open_stack
from tests.faults.plant import Plant, plant, wait_until
from worker.lease import LEASE_S

pytestmark = pytest.mark.django_db(transaction=True)


@pytest.fixture
def site() -> Iterator[Plant]:
    with plant() as made:
        made.valkey()
        yield made


@pytest.fixture
def order(site: Plant, make_tool: Callable[..., Tool], rig: Rig, olga: User) -> Callable[[], list[Scan]]:
    """Queue two regions, long enough to be killed in."""
    Rig.objects.update(config=site.simulated_rig(speed_up=20.0), exposures_us=[300])
    rig.refresh_from_db()

    def place() -> list[Scan]:
        tool = make_tool(regions=2, length_mm=4.0, rows=64)
        return list(queue.enqueue_inspection(tool=tool, rig=rig, by=olga).scans.order_by("position"))

    return place


def scan_now(scan: Scan) -> Scan:
    return Scan.objects.select_related("rig").get(pk=scan.pk)


def test_a_killed_worker_leaves_a_true_state_readable_frames_and_a_queue_that_says_why(
    site: Plant, order: Callable[[], list[Scan]]
) -> None:
    first, second = order()
    site.worker("rig.rig1")
    wait_until(lambda: scan_now(first).done >= 10, "ten steps")
    site.kill("rig-rig1")
    assert scan_now(first).state == ScanState.RUNNING  # nobody could say otherwise yet
    # The controller's own dead-man: its host is gone.
    wait_until(lambda: light_of(scan_now(first).rig) == 0.0, "darkness", 10)

    site.worker("rig.rig1")  # what a supervisor does
    wait_until(lambda: scan_now(first).state == ScanState.INTERRUPTED, "the interrupted state", LEASE_S + 30)

    scan = scan_now(first)
    assert scan.rig.queue_state == QueueState.PAUSED
    assert "died" in scan.rig.queue_reason
    assert scan.attempts == 1
    assert not scan.range_images.exists()
    with open_stack(Path(settings.STACKS) / scan.stack_file) as stack:
        assert stack.header.steps >= scan.done - 1 >= 9
        for images in stack:
            assert images[0].shape == (64, 256)
    # The restarted worker has rung for itself and found the queue paused: nothing was started a second time.
    assert scan_now(second).state == ScanState.QUEUED

    queue.cancel_scan(second, None)
    again = queue.scan_again(scan_now(first), None)
    rig = scan.rig
    queue.resume_queue(rig, None)
    site_rings(site)
    wait_until(lambda: scan_now(again).done >= 3, "the scan taken again")


def test_a_worker_asked_to_stop_parks_and_ends_within_seconds(site: Plant, order: Callable[[], list[Scan]]) -> None:
    first, _second = order()
    site.worker("rig.rig1")
    wait_until(lambda: scan_now(first).done >= 5, "five steps")

    assert site.terminate("rig-rig1") == 0

    scan = scan_now(first)
    assert scan.state == ScanState.INTERRUPTED
    assert scan.fault.startswith("The worker was stopped at step")
    assert scan.rig.queue_state == QueueState.PAUSED
    assert light_of(scan.rig) == 0.0


def light_of(rig: Rig) -> Any:
    """Ask the machine itself whether its laser is on."""
    from scanning.rig.simulated.camera import SimulatedCamera

    camera = SimulatedCamera(rig.config["camera"]["address"])
    camera.open()
    try:
        return camera.bench_state()["laser"]
    finally:
        camera.close()


def site_rings(site: Plant) -> None:
    """Ring as the web server would; the test process itself has no broker in its settings."""
    from celery import Celery

    app = Celery(broker=site.redis_url, set_as_current=False)
    app.send_task("worker.ring", args=["rig1"], queue="rig.rig1", ignore_result=True)
    app.close()
