"""A scan that broke off goes on at its step, once a person has looked; an emergency stop is such a break."""

from __future__ import annotations

import datetime as dt
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from django.conf import settings

from inspection.keeping.verify import verify
from inspection.models import AuditEvent, Rig, Scan, Tool, User
from inspection.services import queue
from inspection.services.continuing import can_continue, continue_scan
from inspection.services.emergency import emergency_stop
from inspection.services.moves import WrongState
from inspection.services.results import pending_range_file
from inspection.states import QueueState, ScanState
from scanning import open_stack
from scanning.errors import BadInput
from scanning.range_image import RangeImage
from scanning.stacks import PART_SUFFIX
from tests.worker.fakes import FakeRig, at_grab, camera_falls_silent
from worker import compute, stopping
from worker.lease import claim, sweep
from worker.rig import serve
from worker.scan import run_scan

#: Committed rows: lease and emergency stop are looked after by threads with connections of their own.
pytestmark = pytest.mark.django_db(transaction=True)


@pytest.fixture(autouse=True)
def clean(settings: Any, tmp_path: Path) -> None:
    settings.STACKS, settings.RANGES = tmp_path / "stacks", tmp_path / "ranges"
    stopping.forget()


@pytest.fixture
def order(make_tool: Callable[..., Tool], rig: Rig, olga: User) -> Callable[[], Scan]:
    tool = make_tool(regions=1)
    return lambda: queue.enqueue_inspection(tool=tool, rig=rig, by=olga).scans.get()


def now(scan: Scan) -> Scan:
    return Scan.objects.select_related("rig").get(pk=scan.pk)


def run(fake: FakeRig) -> str:
    lease = claim("rig1", "tester")
    assert lease is not None
    return run_scan(lease, opening=fake.opening)


def file_of(scan: Scan) -> Path:
    return Path(settings.STACKS) / now(scan).stack_file


def killed(scan: Scan, at: int) -> None:
    """Leave behind what kill -9 leaves: a part on the disk, a running row whose lease runs out."""

    class Killed(BaseException):
        pass

    def kill() -> None:
        raise Killed

    import worker.scan as module

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module._Run, "_end", lambda self, *_: self._close())
        with pytest.raises(Killed):
            run(FakeRig(at_grab(at, kill)))
    row = now(scan)
    assert row.stack_file.endswith(PART_SUFFIX)
    assert row.lease_until is not None
    assert sweep(row.lease_until + dt.timedelta(seconds=1)) == [scan.pk]


def test_a_killed_scan_goes_on_at_its_step_and_the_stack_is_the_one_it_would_have_been(
    order: Callable[[], Scan], olga: User
) -> None:
    whole, broken = order(), order()
    assert run(FakeRig()) == ScanState.PROCESSING
    killed(broken, at=40)
    before = file_of(broken)
    row = now(broken)
    assert can_continue(row)
    assert row.rig.queue_state == QueueState.PAUSED
    continue_scan(row, olga, looked=True)

    assert (now(broken).state, now(broken).rig.queue_state) == (ScanState.QUEUED, QueueState.READY)
    again = FakeRig()
    assert run(again) == ScanState.PROCESSING
    assert again.homed == 1
    assert again.grabs < 1 + 30 * 3  # the dark frame and what was missing, no more
    row = now(broken)
    assert (row.done, row.partial, row.fault) == (30, False, "")
    assert 0 < row.acquisition["continued_at_step"] < 30
    assert row.stack_sha256 == now(whole).stack_sha256
    assert not before.exists()
    images = [RangeImage.load(pending_range_file(scan.pk)) for scan in (whole, broken)]
    for name in ("column_px", "height_um", "intensity", "width_px"):
        np.testing.assert_array_equal(getattr(images[0], name), getattr(images[1], name), err_msg=name)
    compute.measure(broken.pk)
    assert now(broken).state == ScanState.DONE
    assert verify().faults == []
    assert AuditEvent.objects.filter(verb="scan.continued", actor=olga).count() == 1


def test_a_frame_damaged_meanwhile_is_taken_again(order: Callable[[], Scan], olga: User) -> None:
    whole, broken = order(), order()
    run(FakeRig())
    killed(broken, at=60)
    with open_stack(file_of(broken)) as stack:
        steps = stack.header.steps
    raw = bytearray(file_of(broken).read_bytes())
    for at in range(len(raw) // 2, len(raw) // 2 + 300):
        raw[at] ^= 0xFF
    file_of(broken).write_bytes(raw)
    continue_scan(now(broken), olga, looked=True)

    assert run(FakeRig()) == ScanState.PROCESSING
    assert now(broken).acquisition["continued_at_step"] < steps
    assert now(broken).stack_sha256 == now(whole).stack_sha256


def test_frames_that_cannot_be_read_at_all_start_the_scan_clean(order: Callable[[], Scan], olga: User) -> None:
    whole, broken = order(), order()
    run(FakeRig())
    killed(broken, at=40)
    file_of(broken).write_bytes(b"\0" * 5000)
    continue_scan(now(broken), olga, looked=True)

    assert run(FakeRig()) == ScanState.PROCESSING
    assert now(broken).acquisition["continued_at_step"] == 0
    assert now(broken).stack_sha256 == now(whole).stack_sha256


def test_a_scan_killed_before_its_first_frame_starts_clean(order: Callable[[], Scan], olga: User) -> None:
    """The row names a part that was never made."""
    whole, broken = order(), order()
    run(FakeRig())
    killed(broken, at=1)
    assert not file_of(broken).exists()
    continue_scan(now(broken), olga, looked=True)

    assert run(FakeRig()) == ScanState.PROCESSING
    assert now(broken).stack_sha256 == now(whole).stack_sha256


def test_it_can_break_off_and_go_on_more_than_once(order: Callable[[], Scan], olga: User) -> None:
    whole, broken = order(), order()
    run(FakeRig())
    killed(broken, at=20)
    continue_scan(now(broken), olga, looked=True)
    killed(broken, at=20)
    steps = now(broken).done
    continue_scan(now(broken), olga, looked=True)
    assert run(FakeRig(lambda rig: stopping.ask_to_stop() if rig.grabs == 20 else None)) == ScanState.INTERRUPTED
    stopping.forget()
    assert now(broken).done > steps
    continue_scan(now(broken), olga, looked=True)

    assert run(FakeRig()) == ScanState.PROCESSING
    assert (now(broken).continued, now(broken).stack_sha256) == (3, now(whole).stack_sha256)
    assert len(list(Path(settings.STACKS).rglob("*.h5*"))) == 2


def test_a_break_while_the_frames_are_verified_loses_none(
    order: Callable[[], Scan], olga: User, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, broken = order(), order()
    run(FakeRig())
    killed(broken, at=60)
    earlier = file_of(broken)
    continue_scan(now(broken), olga, looked=True)
    stopping.ask_to_stop()
    assert run(FakeRig()) == ScanState.INTERRUPTED
    stopping.forget()
    assert file_of(broken) == earlier
    assert earlier.exists()
    continue_scan(now(broken), olga, looked=True)

    assert run(FakeRig()) == ScanState.PROCESSING
    assert now(broken).acquisition["continued_at_step"] > 10
    assert now(broken).stack_sha256 == now(whole).stack_sha256


def test_a_scan_whose_camera_failed_can_go_on(order: Callable[[], Scan], olga: User) -> None:
    scan = order()

    def during(rig: FakeRig) -> None:
        if rig.grabs >= 40:
            camera_falls_silent()

    assert run(FakeRig(during)) == ScanState.FAILED
    continue_scan(now(scan), olga, looked=True)
    assert run(FakeRig()) == ScanState.PROCESSING
    assert now(scan).done == 30


def test_a_rig_that_was_changed_meanwhile_refuses_the_old_frames(order: Callable[[], Scan], olga: User) -> None:
    scan = order()
    killed(scan, at=40)
    continue_scan(now(scan), olga, looked=True)
    fake = FakeRig()
    fake.saturation = 4095

    assert run(fake) == ScanState.FAILED
    assert "The rig has changed since the scan broke off (saturation)" in now(scan).fault
    assert file_of(scan).exists()
    assert fake.grabs == 0


def test_nothing_goes_on_unseen_or_twice_or_over_a_result(order: Callable[[], Scan], olga: User, erik: User) -> None:
    scan, other = order(), order()
    killed(scan, at=40)
    with pytest.raises(BadInput, match="Look at the rig first"):
        continue_scan(now(scan), olga, looked=False)
    with pytest.raises(WrongState, match="is queued and cannot be continued"):
        continue_scan(now(other), olga, looked=True)
    stale = now(scan)
    continue_scan(now(scan), olga, looked=True)
    with pytest.raises(WrongState):
        continue_scan(stale, erik, looked=True)
    assert now(scan).continued == 1
    assert [s.pk for s in Scan.objects.filter(state="queued").order_by("position")] == [scan.pk, other.pk]


def test_a_queue_that_a_person_paused_stays_paused(order: Callable[[], Scan], olga: User) -> None:
    scan = order()
    killed(scan, at=40)
    queue.resume_queue(now(scan).rig, olga)
    queue.pause_queue(now(scan).rig, olga, "lunch")
    continue_scan(now(scan), olga, looked=True)

    assert now(scan).rig.queue_reason == "lunch"
    assert now(scan).state == ScanState.QUEUED


def test_the_emergency_stop_halts_the_stage_darkens_and_says_who(order: Callable[[], Scan], olga: User) -> None:
    scan, other = order(), order()
    halted: list[bool] = []

    def during(rig: FakeRig) -> None:
        if rig.grabs == 40:
            assert emergency_stop(Rig.objects.get(), olga)

            end = time.monotonic() + 5
            while not rig.halted and time.monotonic() < end:  # the stop comes from a thread of its own
                time.sleep(0.005)
            halted.append(rig.halted and not rig.lit)

    fake = FakeRig(during)
    assert serve("rig1", opening=fake.opening) == [ScanState.INTERRUPTED]

    assert halted == [True]
    row = now(scan)
    assert row.fault.startswith("Emergency stop by olga at step ")
    assert "of 30: the stage was halted, the laser is off" in row.fault
    assert (row.rig.queue_state, fake.parked) == (QueueState.PAUSED, 0)
    assert "Emergency stop by olga" in row.rig.queue_reason
    assert now(other).state == ScanState.QUEUED
    continue_scan(row, olga, looked=True)
    assert serve("rig1", opening=FakeRig().opening) == [ScanState.PROCESSING] * 2


def test_the_emergency_stop_ends_a_pause_too(
    order: Callable[[], Scan], olga: User, monkeypatch: pytest.MonkeyPatch
) -> None:
    scan = order()
    looks: list[int] = []

    def wait(_seconds: float) -> None:
        looks.append(1)
        if len(looks) == 2:
            emergency_stop(Rig.objects.get(), olga)

    monkeypatch.setattr("scanning.rig.session.RealClock.sleep", staticmethod(wait))
    fake = FakeRig(at_grab(40, lambda: queue.pause_scan(Scan.objects.get(pk=scan.pk), olga)))
    assert run(fake) == ScanState.INTERRUPTED
    assert now(scan).fault.startswith("Emergency stop by olga")


def test_without_a_scan_the_emergency_stop_pauses_the_queue_and_respects_a_lock(rig: Rig, olga: User) -> None:
    assert not emergency_stop(rig, olga)
    assert (rig.queue_state, rig.queue_reason, rig.queue_owner) == (QueueState.PAUSED, "Emergency stop by olga.", olga)
    queue.resume_queue(rig, olga)
    queue.lock_rig(rig, olga, "lens")
    emergency_stop(rig, olga)
    assert (rig.queue_state, rig.pause_under_lock) == (QueueState.LOCKED, "Emergency stop by olga.")
