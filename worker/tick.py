"""Once a minute: queue what is due, ring again where a ring may have been lost, find workers that died.

Everything is looked up in the rows and everything may run twice or late. This is what makes the doorbell optional: with
the broker away for an hour, the first tick after it starts all that waited.
"""

from __future__ import annotations

import datetime as dt
import logging
from typing import Any

from celery import signals
from django.conf import settings
from django.db.models import Q
from django.utils import timezone

from inspection.keeping.retention import remove_old_stacks
from inspection.models import Recomputation, Rig, Scan
from inspection.services import schedules
from inspection.services.again import ring_next
from inspection.services.ring import COMPUTE_QUEUE, ring, ring_measure, ring_recompute, ring_recompute_many
from inspection.states import ON_RIG, QueueState, ScanState
from worker import lease
from worker.celery import TICK_EVERY_S, app

log = logging.getLogger(__name__)

#: A scan may wait this long for its numbers before it is rung for again.
COMPUTE_PATIENCE = dt.timedelta(seconds=15)


#: With a lease that has run out, a recomputation that lost its worker.
LOST = Q(state=Recomputation.State.RUNNING)


@app.task(name="worker.tick", ignore_result=True)
def tick() -> None:
    """The minute's work, in order: dead workers, due dates, rigs with waiting scans, numbers that wait."""
    now = timezone.now()
    lease.sweep(now)
    summary = schedules.tick(now)
    for inspection in summary.queued:
        log.info("Queued %s by its schedule.", inspection)
    for schedule, why in summary.refused:
        log.warning("%s could not be queued: %s", schedule, why)
    ring_what_waits(now)


@signals.beat_init.connect
def tick_at_once(**_: Any) -> None:
    """Tick when the clock starts, not a minute later: what fell due while nothing ran is queued first."""
    tick.apply_async(queue=COMPUTE_QUEUE, expires=TICK_EVERY_S)


@app.task(name="worker.sweep", ignore_result=True)
def sweep() -> None:
    """Find workers that died, between the ticks, and ring for what the dead were computing."""
    now = timezone.now()
    for scan_id in lease.sweep(now):
        log.warning("Scan %s was interrupted: its worker let the lease run out.", scan_id)
    ring_for_scans(now)
    for order_id in Recomputation.objects.filter(LOST, lease_until__lt=now).values_list("pk", flat=True):
        ring_recompute(order_id)


@app.task(name="worker.make_room", ignore_result=True)
def make_room() -> None:
    """Remove the raw frames that the rule lets go; without a rule (STACK_KEEP_DAYS is 0), none."""
    if settings.STACK_KEEP_DAYS:
        removed = remove_old_stacks(settings.STACK_KEEP_DAYS)
        if removed.scans:
            log.info("Removed the raw frames of %d old scans, %.1f MB.", len(removed.scans), removed.bytes / 1e6)


def ring_for_scans(now: dt.datetime) -> None:
    """Ring for every idle rig with a queued scan and for every fresh scan whose numbers nobody computes."""
    waiting = Rig.objects.filter(active=True, queue_state=QueueState.READY, scans__state=ScanState.QUEUED)
    busy = Scan.objects.filter(state__in=ON_RIG, source=Scan.Source.RIG).values("rig_id")
    for slug in waiting.exclude(pk__in=busy).distinct().values_list("slug", flat=True):
        ring(slug)
    lost = Q(lease_until__lt=now)
    late = Q(lease_until__isnull=True) & (Q(progress_at__isnull=True) | Q(progress_at__lt=now - COMPUTE_PATIENCE))
    for scan_id in Scan.objects.filter(lost | late, state=ScanState.PROCESSING).values_list("pk", flat=True):
        ring_measure(scan_id)


def ring_what_waits(now: dt.datetime) -> None:
    """Ring for everything that waits and that nobody is at."""
    ring_for_scans(now)
    lost = LOST & Q(lease_until__lt=now)
    waiting = Recomputation.objects.filter(lost | Q(state=Recomputation.State.QUEUED))
    for order_id in waiting.filter(batch__isnull=True).values_list("pk", flat=True):
        ring_recompute(order_id)
    for batch_id in waiting.filter(batch__isnull=False).order_by().values_list("batch_id", flat=True).distinct():
        lost_orders = list(waiting.filter(lost, batch_id=batch_id).values_list("pk", flat=True))
        ring_recompute_many(lost_orders)
        ring_next(batch_id)
