"""The worker that owns a rig: takes scan after scan until the queue is empty, paused or locked.

The bell only says "look". What to do is in the rows, so ten thousand rings cost ten thousand short looks, a lost one is
made up for by the tick, and two workers on one rig get one scan between them.
"""

from __future__ import annotations

import logging
import socket
from typing import Any, cast

from celery import signals
from celery.worker.consumer import Consumer
from django.db import DatabaseError, connection
from django.utils import timezone

from inspection.models import Rig
from inspection.services.ring import RING_EXPIRES_S, rig_queue, ring
from inspection.states import ScanState
from scanning.rig.rig import open_rig
from worker import stopping
from worker.celery import app
from worker.lease import claim, sweep
from worker.scan import OpenRig, run_scan

log = logging.getLogger(__name__)

#: How often the worker shows that it is there, and looks after scans of its rig that a dead predecessor left.
SEEN_EVERY_S = 10.0
LOOK_EVERY_S = 1.0
QUEUE_PREFIX = rig_queue("")


@app.task(name="worker.ring", ignore_result=True, acks_late=False, expires=RING_EXPIRES_S)
def ring_task(rig_slug: str) -> None:
    """Serve the rig's queue. Acknowledged before it starts and never repeated: a motor must not be moved twice."""
    serve(rig_slug)


def serve(rig_slug: str, *, opening: OpenRig = open_rig) -> list[str]:
    """Run the rig's queued scans one after the other; return the states they ended in.

    Ends when nothing can be claimed: queue empty, paused (a failed scan pauses it), locked, or another worker has the
    rig. Ends too when the worker is going down.
    """
    watch = stopping.Watch()
    worker = f"{socket.gethostname()}"
    states = []
    sweep(rig_slug=rig_slug)
    while not watch.reason():
        lease = claim(rig_slug, worker)
        if lease is None:
            break
        states.append(run_scan(lease, opening=opening, watch=watch))
        if states[-1] not in (ScanState.PROCESSING, ScanState.CANCELLED):
            break  # the queue is paused, or the rig is somebody else's
    return states


@signals.worker_ready.connect
def show_up(sender: Consumer, **_: Any) -> None:
    """Show at once and from then on that somebody serves the rig, and ring for what waited while nobody did.

    On the event loop's own timer, because a second thread in the parent could hold a lock at the moment a child is
    forked. The loop starts again, and this with it, after every loss of the broker: a worker that cannot hear is not
    seen.
    """
    for slug in slugs_served(sender):
        stopping.forget()
        seen(slug)
        look_after(slug)
        sender.timer.call_repeatedly(SEEN_EVERY_S, seen, (slug,))
        sender.timer.call_repeatedly(LOOK_EVERY_S, look_after, (slug,))
        ring(slug)


@signals.worker_shutting_down.connect
def go_down(**_: Any) -> None:
    """Let a running scan end at its next step instead of waiting for its last."""
    stopping.ask_to_stop()


def slugs_served(consumer: Consumer) -> list[str]:
    """The rigs whose queues this worker consumes."""
    names = [str(queue.name) for queue in cast(Any, consumer).task_consumer.queues]
    return [name.removeprefix(QUEUE_PREFIX) for name in names if name.startswith(QUEUE_PREFIX)]


def seen(slug: str) -> None:
    """Note that the rig's worker is alive and hears."""
    try:
        Rig.objects.filter(slug=slug).update(worker_seen_at=timezone.now())
    except DatabaseError as error:
        log.warning("Could not note that the worker of %s is here: %s", slug, error)
    finally:
        connection.close()  # nothing open may be inherited by a child


def look_after(slug: str) -> None:
    """Call interrupted what a dead predecessor on this rig left running."""
    try:
        for scan_id in sweep(rig_slug=slug):
            log.warning("Scan %s was interrupted: its worker let the lease run out.", scan_id)
    except DatabaseError as error:
        log.warning("Could not look after the scans of %s: %s", slug, error)
    finally:
        connection.close()
