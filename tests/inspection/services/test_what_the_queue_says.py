"""A queue that waits says why, in words, and an estimate is shown only when it means something."""

from __future__ import annotations

import datetime as dt

import pytest
from django.utils import timezone

from inspection.models import Rig, Scan, Tool, User
from inspection.selectors.queue import queue_view, reason_for_waiting, seconds_per_step
from inspection.services import queue
from inspection.states import ScanState

NOW = dt.datetime(2026, 6, 1, 14, 30, tzinfo=dt.UTC)


@pytest.fixture
def three(tool: Tool, rig: Rig, olga: User) -> list[Scan]:
    Rig.objects.update(worker_seen_at=NOW)
    return list(queue.enqueue_inspection(tool=tool, rig=rig, by=olga).scans.order_by("position"))


def whys(rig: Rig, now: dt.datetime = NOW) -> list[str]:
    return [row.why for row in queue_view(rig, now=now).rows]


def earlier_run(scan: Scan, seconds: float) -> None:
    """A run of 30 steps on this rig that took so long."""
    Scan.objects.create(
        inspection=scan.inspection, region=scan.region, rig=scan.rig, state=ScanState.DONE, queued_at=NOW,
        started_at=NOW - dt.timedelta(hours=1), finished_at=NOW, recipe=scan.recipe, done=30, total=30,
        acquisition={"duration_s": seconds},
    )  # fmt: skip


def test_without_earlier_runs_only_the_place_is_known(three: list[Scan], rig: Rig) -> None:
    assert whys(rig) == ["next, starts at once", "position 2", "position 3"]


def test_earlier_runs_of_the_rig_tell_when_it_starts(three: list[Scan], rig: Rig) -> None:
    for seconds in (170.0, 180.0, 1000.0):
        earlier_run(three[0], seconds)

    assert seconds_per_step(rig) == 6.0  # the median: one slow run does not count
    assert whys(rig) == [
        "next, starts at once", "position 2, starts in about 3 min", "position 3, starts in about 6 min",
    ]  # fmt: skip


def test_a_paused_queue_says_who_when_and_why(three: list[Scan], rig: Rig, olga: User) -> None:
    queue.pause_queue(rig, olga, "waiting for the next cart")
    Rig.objects.update(queue_since=NOW - dt.timedelta(minutes=28))

    assert whys(rig) == ["Queue paused by Olga 14:02: waiting for the next cart"] * 3
    assert reason_for_waiting(three[2], now=NOW) == "Queue paused by Olga 14:02: waiting for the next cart"


def test_a_locked_rig_says_what_is_done_to_it(three: list[Scan], rig: Rig, olga: User) -> None:
    queue.lock_rig(rig, olga, "cleaning the lens")
    Rig.objects.update(queue_since=NOW - dt.timedelta(days=1))

    assert queue_view(rig, now=NOW).banner == "Rig locked by Olga 2026-05-31 14:30: cleaning the lens"


def test_a_silent_worker_is_named(three: list[Scan], rig: Rig) -> None:
    Rig.objects.update(worker_seen_at=NOW - dt.timedelta(minutes=10))
    assert whys(rig)[0].startswith("Worker not seen since ")
    Rig.objects.update(worker_seen_at=None)
    assert whys(rig)[0] == "No worker has ever served Rig 1; start one."


def test_the_scan_on_the_rig_leads_and_its_end_is_hidden_at_first(three: list[Scan], rig: Rig, olga: User) -> None:
    started = NOW - dt.timedelta(seconds=10)
    Scan.objects.filter(pk=three[0].pk).update(state=ScanState.RUNNING, started_at=started, done=1, total=30)
    first = queue_view(rig, now=NOW).rows[0]
    assert (first.position, first.why, first.ends_at) == (0, "on the rig", None)

    Scan.objects.filter(pk=three[0].pk).update(done=15)
    first, second, _third = queue_view(rig, now=NOW).rows
    assert first.ends_at == NOW + dt.timedelta(seconds=10)  # half done in 10 s
    assert second.starts_at == first.ends_at

    Scan.objects.filter(pk=three[0].pk).update(cancel_requested_at=NOW, cancel_requested_by=olga)
    first = queue_view(rig, now=NOW).rows[0]
    assert (first.stopping, first.ends_at) == (True, None)
    assert first.why == "stopping for olga: the stage parks after this step"


def test_a_paused_scan_says_that_it_is_dark(three: list[Scan], rig: Rig) -> None:
    Scan.objects.filter(pk=three[0].pk).update(state=ScanState.PAUSED, started_at=NOW)
    assert whys(rig)[0] == "paused, laser off and stage parked"


def test_ended_scans_wait_for_nothing(three: list[Scan], olga: User) -> None:
    queue.cancel_scan(three[0], olga)
    assert reason_for_waiting(three[0], now=timezone.now()) == ""
