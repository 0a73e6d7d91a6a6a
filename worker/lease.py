"""Who drives a rig or computes a scan, and until when: a token and a time in the scan's row.

A process that was killed cannot say so. It stops renewing its lease, and once that has run out anybody may say for it
that the scan was interrupted. The other way round, a process that was only asleep finds its token gone and must not
write another word: every write here names the token.
"""

from __future__ import annotations

import datetime as dt
import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from uuid import UUID, uuid4

from django.db import DatabaseError, IntegrityError, connection, transaction
from django.db.models import F
from django.utils import timezone

from inspection.models import Rig, Scan
from inspection.services.audit import audit
from inspection.services.moves import move
from inspection.services.queue import pause_queue_for_fault
from inspection.states import ON_RIG, QueueState, ScanState

log = logging.getLogger(__name__)

#: Three missed beats. Longer only delays the sentence that the worker died; shorter turns a slow disk into a death.
LEASE_S = 9.0
BEAT_S = LEASE_S / 3.0
#: States in which a process holds a scan.
HELD = frozenset({*ON_RIG, ScanState.PROCESSING})


class LeaseLostError(Exception):
    """Somebody else has taken the scan over, or nobody knows any more that we hold it. Park, and write nothing."""


def drop_connection() -> None:
    """Let the next query connect anew. A server that was restarted has cut the old connection, which stays cut.

    Django does this between requests only, and a scan is one long task.
    """
    if not connection.in_atomic_block:
        connection.close()


class Lease:
    """A held scan. ``clock`` (monotonic seconds) judges by itself when a database that does not answer has cost it."""

    def __init__(
        self, scan_id: int, token: UUID, rig_id: int | None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.scan_id = scan_id
        self.token = token
        self._rig_id = rig_id
        self._clock = clock
        self._renewed_at = clock()
        self._taken_away = False

    @property
    def lost(self) -> bool:
        return self._taken_away or self._clock() - self._renewed_at > LEASE_S

    def check(self) -> None:
        """Raise `LeaseLostError` once the scan is no longer ours."""
        if self.lost:
            raise LeaseLostError(f"the lease on scan {self.scan_id} is lost")

    def renew(self) -> None:
        """Push the lease's end forward. A database error is left to the clock: the next beat may succeed."""
        now = self._clock()
        until = timezone.now() + dt.timedelta(seconds=LEASE_S)
        try:
            held = self._mine().update(lease_until=until)
            if self._rig_id is not None:
                Rig.objects.filter(pk=self._rig_id).update(worker_seen_at=timezone.now())
        except DatabaseError as error:
            log.warning("Could not renew the lease on scan %s: %s", self.scan_id, error)
            drop_connection()
            return
        if held:
            self._renewed_at = now
        else:
            self._taken_away = True

    def write(self, **fields: Any) -> None:
        """Write columns of the held scan; raise `LeaseLostError` if it is not ours any more."""
        if not self._mine().update(**fields):
            self._taken_away = True
            self.check()

    def move(self, frm: str, to: str, **fields: Any) -> None:
        """Change the held scan's state; raise `LeaseLostError` if it is not ours, or not in ``frm``, any more."""
        if not move(self.scan_id, frm=frm, to=to, token=self.token, **fields):
            self._taken_away = True
            self.check()

    def _mine(self) -> Any:
        return Scan.objects.filter(pk=self.scan_id, lease_token=self.token, state__in=HELD)

    @contextmanager
    def beating(self, every_s: float = BEAT_S) -> Iterator[None]:
        """Renew from a thread of its own while the block runs."""
        enough = threading.Event()

        def beat() -> None:
            try:
                while not enough.wait(every_s) and not self._taken_away:
                    self.renew()
            finally:
                connection.close()

        thread = threading.Thread(target=beat, name=f"lease of scan {self.scan_id}", daemon=True)
        thread.start()
        try:
            yield
        finally:
            enough.set()
            thread.join()


def claim(rig_slug: str, worker: str) -> Lease | None:
    """Take the rig's next scan, or return None: nothing queued, queue paused or locked, or the rig has a scan already.

    The rig's row is locked meanwhile, so that nobody can lock the rig for hands-in work between look and claim; the
    unique constraint on running scans is the second net.
    """
    try:
        with transaction.atomic():
            rig = Rig.objects.select_for_update().filter(slug=rig_slug).first()
            if rig is None or not rig.active or rig.queue_state != QueueState.READY:
                return None
            while True:
                scan = rig.scans.filter(state=ScanState.QUEUED).order_by("position", "pk").first()
                if scan is None:
                    return None
                token, now = uuid4(), timezone.now()
                if move(
                    scan.pk,
                    frm=ScanState.QUEUED,
                    to=ScanState.RUNNING,
                    lease_token=token,
                    lease_until=now + dt.timedelta(seconds=LEASE_S),
                    attempts=F("attempts") + 1,
                    worker=worker[:120],
                    started_at=now,
                    progress_at=now,
                    phase="starting",
                    done=0,
                ):
                    return Lease(scan.pk, token, rig.pk)
    except IntegrityError:  # the rig already has a scan
        return None


def claim_computing(scan_id: int, worker: str) -> tuple[Lease, int] | None:
    """Take a scan whose numbers are to be computed; None if it needs none or another process is at it.

    Returns the lease and how many times its computing has now been started.
    """
    token, now = uuid4(), timezone.now()
    with transaction.atomic():
        scan = Scan.objects.select_for_update().filter(pk=scan_id, state=ScanState.PROCESSING).first()
        if scan is None or (scan.lease_until is not None and scan.lease_until > now):
            return None
        won = Scan.objects.filter(pk=scan_id, state=ScanState.PROCESSING, lease_until=scan.lease_until).update(
            lease_token=token,
            lease_until=now + dt.timedelta(seconds=LEASE_S),
            attempts=F("attempts") + 1,
            worker=worker[:120],
        )
    return (Lease(scan_id, token, None), scan.attempts + 1) if won else None


def sweep(now: dt.datetime | None = None, *, rig_slug: str | None = None) -> list[int]:
    """Call every scan interrupted whose worker has let its lease run out; return their ids.

    Its rig's queue is paused with the reason, because nobody knows how stage and tool were left. The frames on the disk
    stay, and are named in the row so that they can be looked at and computed.
    """
    now = now or timezone.now()
    dead = Scan.objects.filter(state__in=ON_RIG, source=Scan.Source.RIG, lease_until__lt=now)
    if rig_slug is not None:
        dead = dead.filter(rig__slug=rig_slug)
    swept = []
    for scan in dead.select_related("region__tool", "rig"):
        fault = (
            f"The worker of {scan.rig.name} died or lost its database at step {scan.done} of {scan.total}; look at the "
            f"rig, then resume the queue and scan again."
        )
        with transaction.atomic():
            # The lease is named, so that a worker that has just renewed it is left alone.
            won = (
                Scan.objects.filter(
                    pk=scan.pk, state=scan.state, lease_token=scan.lease_token, lease_until=scan.lease_until
                ).update(
                    state=ScanState.INTERRUPTED,
                    finished_at=now,
                    lease_token=None,
                    lease_until=None,
                    fault=fault,
                    partial=True,
                    phase="",
                )
                == 1
            )
            if won:
                pause_queue_for_fault(scan.rig_id, f"{scan.region} was interrupted: {fault}")
                audit(None, "scan.interrupted", scan, reason=fault)
                swept.append(scan.pk)
    return swept
