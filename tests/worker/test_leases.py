"""Who holds a scan: two claims give one winner, a lost lease silences its owner, a dead worker is found."""

from __future__ import annotations

import datetime as dt
import threading
from collections.abc import Callable
from uuid import uuid4

import pytest
from django.db import OperationalError, connection, transaction
from django.utils import timezone

from inspection.models import Rig, Scan, Tool, User
from inspection.services import queue
from inspection.services.moves import move
from inspection.states import QueueState, ScanState
from worker.lease import LEASE_S, Lease, LeaseLostError, claim, claim_computing, sweep


@pytest.fixture
def three(tool: Tool, rig: Rig, olga: User) -> list[Scan]:
    return list(queue.enqueue_inspection(tool=tool, rig=rig, by=olga).scans.order_by("position"))


class Clock:
    """Monotonic seconds that move only when told."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def held(scan: Scan, clock: Callable[[], float] | None = None) -> Lease:
    """A lease as `claim` leaves it, with a clock of ours."""
    token = uuid4()
    Scan.objects.filter(pk=scan.pk).update(
        state=ScanState.RUNNING, lease_token=token, lease_until=timezone.now() + dt.timedelta(seconds=LEASE_S)
    )
    return Lease(scan.pk, token, scan.rig_id, clock or Clock())


def test_the_first_in_the_queue_is_claimed_with_a_lease(three: list[Scan]) -> None:
    got = claim("rig1", "tester")

    assert got is not None
    scan = Scan.objects.get(pk=three[0].pk)
    assert (got.scan_id, got.token) == (scan.pk, scan.lease_token)
    assert (scan.state, scan.attempts, scan.worker) == (ScanState.RUNNING, 1, "tester")
    assert scan.lease_until is not None
    assert scan.lease_until > timezone.now()


def test_a_rig_with_a_scan_gives_no_second_one(three: list[Scan]) -> None:
    assert claim("rig1", "one") is not None
    assert claim("rig1", "two") is None

    assert Scan.objects.filter(state=ScanState.RUNNING).count() == 1


def test_nothing_is_claimed_from_a_queue_that_must_not_run(three: list[Scan], rig: Rig, olga: User) -> None:
    assert claim("no-such-rig", "w") is None
    queue.pause_queue(rig, olga, "lunch")
    assert claim("rig1", "w") is None
    queue.lock_rig(rig, olga, "lens")
    assert claim("rig1", "w") is None
    queue.unlock_rig(rig, olga)
    queue.resume_queue(rig, olga)
    Rig.objects.update(active=False)
    assert claim("rig1", "w") is None


@pytest.mark.django_db(transaction=True)
def test_many_claims_at_the_same_moment_have_one_winner(tool: Tool, rig: Rig, olga: User) -> None:
    queue.enqueue_inspection(tool=tool, rig=rig, by=olga)
    start = threading.Barrier(4)
    won: list[Lease] = []

    def race() -> None:
        start.wait()
        try:
            if (got := claim("rig1", threading.current_thread().name)) is not None:
                won.append(got)
        finally:
            connection.close()

    threads = [threading.Thread(target=race) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    assert len(won) == 1
    assert Scan.objects.filter(state=ScanState.RUNNING).count() == 1
    assert Scan.objects.get(state=ScanState.RUNNING).lease_token == won[0].token


def test_renewing_pushes_the_end_and_shows_the_worker(three: list[Scan], rig: Rig) -> None:
    lease = held(three[0])
    Scan.objects.filter(pk=lease.scan_id).update(lease_until=timezone.now())
    lease.renew()

    scan = Scan.objects.get(pk=lease.scan_id)
    assert scan.lease_until is not None
    assert (scan.lease_until - timezone.now()).total_seconds() > LEASE_S - 2
    rig.refresh_from_db()
    assert rig.worker_seen_at is not None


def test_a_zombie_cannot_write(three: list[Scan]) -> None:
    """The lease is taken away while its owner sleeps; nothing it does afterwards reaches the row."""
    lease = held(three[0])
    assert sweep(timezone.now() + dt.timedelta(seconds=LEASE_S + 1)) == [three[0].pk]

    with pytest.raises(LeaseLostError):
        lease.write(done=99)
    with pytest.raises(LeaseLostError):
        lease.move(ScanState.RUNNING, ScanState.PROCESSING, done=99)
    lease.renew()

    scan = Scan.objects.get(pk=three[0].pk)
    assert (scan.state, scan.done, scan.lease_until) == (ScanState.INTERRUPTED, 0, None)
    assert lease.lost


def test_a_lease_without_a_database_is_lost_when_its_time_is_up(
    three: list[Scan], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock()
    lease = held(three[0], clock)

    def gone(*_: object) -> None:
        raise OperationalError("database is gone")

    monkeypatch.setattr(Lease, "_mine", gone)
    clock.now += LEASE_S - 1
    lease.renew()
    assert not lease.lost
    clock.now += 2
    with pytest.raises(LeaseLostError):
        lease.check()


def test_a_dead_worker_leaves_a_true_state_and_a_paused_queue(three: list[Scan], rig: Rig) -> None:
    lease = held(three[0])
    Scan.objects.filter(pk=lease.scan_id).update(done=12)
    assert sweep() == []  # the lease still runs

    assert sweep(timezone.now() + dt.timedelta(seconds=LEASE_S + 1)) == [three[0].pk]

    scan = Scan.objects.get(pk=three[0].pk)
    rig.refresh_from_db()
    assert (scan.state, scan.lease_token) == (ScanState.INTERRUPTED, None)
    assert "died" in scan.fault
    assert "step 12 of 30" in scan.fault
    assert rig.queue_state == QueueState.PAUSED
    assert rig.queue_reason.startswith("K-7 R1 was interrupted")
    assert claim("rig1", "w") is None


def test_two_sweeps_find_a_dead_worker_once(three: list[Scan]) -> None:
    held(three[0])
    late = timezone.now() + dt.timedelta(seconds=LEASE_S + 1)

    assert [len(sweep(late)), len(sweep(late))] == [1, 0]


def test_a_worker_that_renews_while_it_is_swept_keeps_its_scan(
    three: list[Scan], rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The sweep has read the old end of the lease; before it writes, the worker's beat comes through."""
    lease = held(three[0])
    looked = transaction.atomic

    def beat_first() -> object:
        monkeypatch.setattr(transaction, "atomic", looked)
        lease.renew()
        return looked()

    monkeypatch.setattr(transaction, "atomic", beat_first)
    assert sweep(timezone.now() + dt.timedelta(seconds=LEASE_S + 1)) == []

    rig.refresh_from_db()
    assert Scan.objects.get(pk=three[0].pk).state == ScanState.RUNNING
    assert rig.queue_state == QueueState.READY


def test_a_state_change_has_one_winner(three: list[Scan]) -> None:
    pk = three[0].pk

    assert move(pk, frm=ScanState.QUEUED, to=ScanState.RUNNING)
    assert not move(pk, frm=ScanState.QUEUED, to=ScanState.CANCELLED)
    with pytest.raises(AssertionError):
        move(pk, frm=ScanState.DONE, to=ScanState.RUNNING)


def test_one_process_at_a_time_computes_a_scan(three: list[Scan]) -> None:
    scan = three[0]
    assert claim_computing(scan.pk, "c") is None
    Scan.objects.filter(pk=scan.pk).update(state=ScanState.PROCESSING)
    first = claim_computing(scan.pk, "one")

    assert first is not None
    assert first[1] == 1
    assert claim_computing(scan.pk, "two") is None
    Scan.objects.filter(pk=scan.pk).update(lease_until=timezone.now() - dt.timedelta(seconds=1))
    second = claim_computing(scan.pk, "two")
    assert second is not None
    assert second[1] == 2
    with pytest.raises(LeaseLostError):
        first[0].write(message="too late")
