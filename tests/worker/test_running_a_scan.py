"""One claimed scan on a rig without hardware: every end it can have, and what is left on disk and in the row."""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from django.conf import settings
from django.db import OperationalError, connection
from django.utils import timezone

from inspection.models import Rig, Scan, Tool, User
from inspection.services import queue
from inspection.services.recipes import recipe_of
from inspection.services.results import pending_range_file
from inspection.states import QueueState, ScanState
from scanning import open_stack, process_stack
from scanning.range_image import RangeImage
from tests.worker.fakes import FakeRig, at_grab, camera_falls_silent
from worker import stopping
from worker.lease import Lease, claim, sweep
from worker.rig import serve
from worker.scan import run_scan

#: Committed rows: the lease is renewed by a thread with a connection of its own.
pytestmark = pytest.mark.django_db(transaction=True)

#: 30 steps of three exposures after the one dark frame.
GRABS = 1 + 30 * 3


@pytest.fixture(autouse=True)
def clean(settings: Any, tmp_path: Path) -> None:
    settings.STACKS, settings.RANGES = tmp_path / "stacks", tmp_path / "ranges"
    stopping.forget()


@pytest.fixture
def one(make_tool: Callable[..., Tool], rig: Rig, olga: User) -> Scan:
    return queue.enqueue_inspection(tool=make_tool(regions=1), rig=rig, by=olga).scans.get()


def claimed() -> Lease:
    lease = claim("rig1", "tester")
    assert lease is not None
    return lease


def after(scan: Scan) -> Scan:
    return Scan.objects.select_related("rig", "recipe").get(pk=scan.pk)


def steps_on_disk(scan: Scan) -> int:
    with open_stack(Path(settings.STACKS) / scan.stack_file) as stack:
        for index in range(stack.header.steps):
            stack.step(index)  # every frame against its checksum
        return stack.header.steps


def test_a_scan_leaves_a_whole_stack_and_its_range_image(one: Scan) -> None:
    rig = FakeRig()
    assert run_scan(claimed(), opening=rig.opening) == ScanState.PROCESSING

    scan = after(one)
    assert (scan.state, scan.done, scan.partial, scan.lease_token) == (ScanState.PROCESSING, 30, False, None)
    assert steps_on_disk(scan) == 30
    assert len(scan.stack_sha256) == 64
    assert scan.acquisition["link"]["lines_sent"] == GRABS
    assert (rig.lit, rig.parked) == (False, 1)


def test_the_live_range_image_equals_the_one_computed_from_the_stack(one: Scan) -> None:
    run_scan(claimed(), opening=FakeRig().opening)

    scan = after(one)
    live = RangeImage.load(pending_range_file(scan.pk))
    with open_stack(Path(settings.STACKS) / scan.stack_file) as stack:
        again = process_stack(stack, recipe_of(scan.recipe))
    for name in ("column_px", "height_um", "intensity", "width_px"):
        np.testing.assert_array_equal(getattr(live, name), getattr(again, name), err_msg=name)
    assert (live.saturated, live.frame_pixels, live.profile_pitch_um) == (
        again.saturated, again.frame_pixels, again.profile_pitch_um,
    )  # fmt: skip
    assert live.undefined == 0


def test_cancelling_keeps_the_frames_and_lets_the_queue_go_on(one: Scan, olga: User) -> None:
    rig = FakeRig(at_grab(40, lambda: queue.cancel_scan(Scan.objects.get(pk=one.pk), olga)))
    assert run_scan(claimed(), opening=rig.opening) == ScanState.CANCELLED

    scan = after(one)
    assert (scan.state, scan.partial, scan.lease_token) == (ScanState.CANCELLED, True, None)
    assert 0 < steps_on_disk(scan) == scan.done < 30
    assert scan.rig.queue_state == QueueState.READY
    assert (rig.lit, rig.parked) == (False, 1)


def test_finishing_early_measures_what_there_is(one: Scan, olga: User) -> None:
    rig = FakeRig(at_grab(40, lambda: queue.finish_early(Scan.objects.get(pk=one.pk), olga)))
    assert run_scan(claimed(), opening=rig.opening) == ScanState.PROCESSING

    scan = after(one)
    assert scan.partial
    assert steps_on_disk(scan) == scan.done < 30
    assert RangeImage.load(pending_range_file(scan.pk)).height_um.shape[1] == scan.done - 4  # a sliding window of five


def test_finishing_before_the_first_profile_fails_with_a_sentence(one: Scan, olga: User) -> None:
    rig = FakeRig(at_grab(2, lambda: queue.finish_early(Scan.objects.get(pk=one.pk), olga)))
    assert run_scan(claimed(), opening=rig.opening) == ScanState.FAILED

    assert "too few for a single profile" in after(one).fault


def test_a_pause_parks_in_the_dark_and_goes_on_at_the_same_step(
    one: Scan, olga: User, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[str, bool, int]] = []
    rig = FakeRig(at_grab(40, lambda: queue.pause_scan(Scan.objects.get(pk=one.pk), olga)))

    def wait(_seconds: float) -> None:
        scan = Scan.objects.get(pk=one.pk)
        seen.append((scan.state, rig.lit, rig.parked))
        if len(seen) == 3:
            queue.resume_scan(scan, olga)

    monkeypatch.setattr("scanning.rig.session.RealClock.sleep", staticmethod(wait))
    assert run_scan(claimed(), opening=rig.opening) == ScanState.PROCESSING

    assert seen[-1] == (ScanState.PAUSED, False, 1)
    scan = after(one)
    assert (scan.done, scan.partial, rig.homed) == (30, False, 2)
    assert steps_on_disk(scan) == 30
    assert scan.acquisition["pauses"] == 1


@pytest.mark.parametrize(
    ("asking", "ends"), [(queue.cancel_scan, ScanState.CANCELLED), (queue.finish_early, ScanState.PROCESSING)]
)
def test_a_paused_scan_can_be_ended(
    one: Scan, olga: User, monkeypatch: pytest.MonkeyPatch, asking: Callable[..., None], ends: str
) -> None:
    looks = []

    def wait(_seconds: float) -> None:
        looks.append(1)
        if len(looks) == 2:
            asking(Scan.objects.get(pk=one.pk), olga)

    monkeypatch.setattr("scanning.rig.session.RealClock.sleep", staticmethod(wait))
    rig = FakeRig(at_grab(40, lambda: queue.pause_scan(Scan.objects.get(pk=one.pk), olga)))

    assert run_scan(claimed(), opening=rig.opening) == ends
    assert after(one).state == ends


def test_a_silent_camera_fails_the_scan_and_stops_the_queue(one: Scan) -> None:
    def during(rig: FakeRig) -> None:
        if rig.grabs >= 40:
            camera_falls_silent()

    rig = FakeRig(during)
    assert run_scan(claimed(), opening=rig.opening) == ScanState.FAILED

    scan = after(one)
    assert scan.fault == "The camera sent nothing within 5 s; check its cable and power."
    assert scan.rig.queue_state == QueueState.PAUSED
    assert "camera sent nothing" in scan.rig.queue_reason
    assert steps_on_disk(scan) == scan.done == 12
    assert (rig.lit, rig.parked) == (False, 1)


def test_a_rig_that_cannot_be_opened_fails_with_the_drivers_sentence(one: Scan, rig: Rig) -> None:
    """The plant's rig row has no hardware configured at all."""
    assert run_scan(claimed()) == ScanState.FAILED

    scan = after(one)
    assert scan.fault == "The configuration of Rig 1 has no stage; add one."
    assert scan.stack_file == ""


def test_a_bug_of_ours_still_ends_in_a_true_state(one: Scan) -> None:
    def bug() -> None:
        raise ZeroDivisionError("a bug")

    assert run_scan(claimed(), opening=FakeRig(at_grab(40, bug)).opening) == ScanState.FAILED

    assert "unforeseen ZeroDivisionError" in after(one).fault


def test_a_worker_told_to_go_parks_and_says_so(one: Scan) -> None:
    rig = FakeRig(at_grab(40, stopping.ask_to_stop))
    assert run_scan(claimed(), opening=rig.opening) == ScanState.INTERRUPTED

    scan = after(one)
    assert scan.fault.startswith("The worker was stopped at step")
    assert scan.rig.queue_state == QueueState.PAUSED
    assert steps_on_disk(scan) == scan.done
    assert (rig.lit, rig.parked) == (False, 1)


def test_a_worker_cut_off_by_a_signal_parks_and_says_so(one: Scan) -> None:
    """Cold shutdown raises SystemExit wherever the task is."""

    def cut() -> None:
        raise SystemExit(0)

    rig = FakeRig(at_grab(40, cut))
    with pytest.raises(SystemExit):
        run_scan(claimed(), opening=rig.opening)

    scan = after(one)
    assert scan.state == ScanState.INTERRUPTED
    assert scan.rig.queue_state == QueueState.PAUSED
    assert (rig.lit, rig.parked) == (False, 1)


def test_a_zombie_parks_and_leaves_the_row_alone(one: Scan) -> None:
    """Its lease is swept away in mid-scan, as if it had been frozen; then it wakes up."""

    def freeze() -> None:
        sweep(timezone.now() + dt.timedelta(minutes=1))

    rig = FakeRig(at_grab(40, freeze))
    lease = claimed()
    assert run_scan(lease, opening=rig.opening) == "lost"

    scan = after(one)
    assert scan.state == ScanState.INTERRUPTED
    assert "died or lost its database" in scan.fault
    assert (rig.lit, rig.parked) == (False, 1)
    assert steps_on_disk(scan) > 0  # the part is named in the row and readable


def test_a_database_that_stumbles_does_not_stop_the_scan(one: Scan, monkeypatch: pytest.MonkeyPatch) -> None:
    stumbles = iter([True] * 5)
    asked = Scan.objects.filter

    def filter_(*args: Any, **kwargs: Any) -> Any:
        if "lease_token" in kwargs and "state__in" not in kwargs and next(stumbles, False):
            raise OperationalError("database is locked")
        return asked(*args, **kwargs)

    monkeypatch.setattr(Scan.objects, "filter", filter_)
    assert run_scan(claimed(), opening=FakeRig().opening) == ScanState.PROCESSING

    assert after(one).done == 30


def test_a_database_that_cut_its_connections_is_connected_to_anew(one: Scan) -> None:
    """What a restart of PostgreSQL does to a scan under way."""

    def cut() -> None:
        assert connection.connection is not None
        connection.connection.close()

    assert run_scan(claimed(), opening=FakeRig(at_grab(40, cut)).opening) == ScanState.PROCESSING

    assert (after(one).done, after(one).partial) == (30, False)


def test_the_worker_serves_until_the_queue_is_empty(tool: Tool, rig: Rig, olga: User) -> None:
    queue.enqueue_inspection(tool=tool, rig=rig, by=olga)
    states = serve("rig1", opening=FakeRig().opening)

    assert states == [ScanState.PROCESSING] * 3
    # Rings that come late or twice find nothing to do.
    assert serve("rig1", opening=FakeRig().opening) == []


def test_after_a_failure_nothing_more_is_started(tool: Tool, rig: Rig, olga: User) -> None:
    queue.enqueue_inspection(tool=tool, rig=rig, by=olga)
    fake = FakeRig(lambda _rig: camera_falls_silent())

    assert serve("rig1", opening=fake.opening) == [ScanState.FAILED]
    assert fake.opened == 1
    assert Scan.objects.filter(state=ScanState.QUEUED).count() == 2
    assert serve("rig1", opening=fake.opening) == []


def test_a_cancelled_scan_makes_room_for_the_next(tool: Tool, rig: Rig, olga: User) -> None:
    first = queue.enqueue_inspection(tool=tool, rig=rig, by=olga).scans.order_by("position")[0]
    fake = FakeRig(at_grab(10, lambda: queue.cancel_scan(Scan.objects.get(pk=first.pk), olga)))

    assert serve("rig1", opening=fake.opening) == [ScanState.CANCELLED, ScanState.PROCESSING, ScanState.PROCESSING]
