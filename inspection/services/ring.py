"""The doorbell: tells a worker, by name only, that there may be something to do.

The rows are the queue. A message lost here costs at most a minute, because the tick rings again; a message that came
twice finds nothing to do. So a broker that is down must never fail the change that wanted to ring.
"""

from __future__ import annotations

import logging
from functools import cache, partial

from celery import Celery, group
from django.conf import settings
from django.db import transaction

log = logging.getLogger(__name__)

#: A ring older than this says nothing that the tick has not said meanwhile.
RING_EXPIRES_S = 120
COMPUTE_QUEUE = "compute"
#: Served by the same workers, in turn with the other: a fresh scan waits behind one old one, not behind a thousand.
AGAIN_QUEUE = "again"
#: An order of a batch may wait in line this long before it is rung for again.
AGAIN_EXPIRES_S = 600

#: Fail within a second or two when the broker is away: a person is waiting for the page.
TRANSPORT_OPTIONS = {
    "socket_timeout": 30,
    "socket_connect_timeout": 2,
    "socket_keepalive": True,
    "health_check_interval": 30,
    # Longer than any compute task; hardware tasks are acknowledged before they start (patterns.md D1, D2).
    "visibility_timeout": 6 * 3600,
    "unacked_restore_interval": 5,
    "unacked_restore_throttle": 1,
}


def broker_options(url: str) -> dict[str, object]:
    """Transport options for ``url``; a unix socket knows no keepalive."""
    options: dict[str, object] = dict(TRANSPORT_OPTIONS)
    if url.startswith("redis+socket"):
        del options["socket_keepalive"]
    return options


def rig_queue(slug: str) -> str:
    """Name of the queue whose only consumer drives the rig ``slug``."""
    return f"rig.{slug}"


@cache
def _sender() -> Celery:
    """Return a Celery client that only sends. `inspection` never imports the worker's code."""
    app = Celery("doorbell", broker=settings.REDIS_URL, set_as_current=False)
    app.conf.update(
        # One try: kombu's patience of several seconds would be spent by the person who pressed the button.
        broker_transport_options={**broker_options(settings.REDIS_URL), "max_retries": 1, "interval_start": 0.0},
        broker_connection_retry=False,
        task_ignore_result=True,
        task_publish_retry=False,
    )
    return app


def ring(rig_slug: str) -> None:
    """Tell the rig's worker to look at its queue, once the current transaction is committed."""
    _on_commit("worker.ring", [rig_slug], rig_queue(rig_slug))


def ring_measure(scan_id: int) -> None:
    """Ask the compute workers for a scan's surface numbers, once the current transaction is committed."""
    _on_commit("worker.measure", [scan_id], COMPUTE_QUEUE)


def ring_recompute(recomputation_id: int) -> None:
    """Ask the compute workers to do a `Recomputation`, once the current transaction is committed."""
    ring_recompute_many([recomputation_id])


def ring_recompute_many(recomputation_ids: list[int]) -> None:
    """Spread several `Recomputation`s over the compute workers as one Celery group, after the commit."""
    if recomputation_ids:
        transaction.on_commit(partial(_send_group, "worker.recompute", recomputation_ids, AGAIN_QUEUE), robust=True)


def _on_commit(task: str, arguments: list[object], queue: str) -> None:
    transaction.on_commit(partial(_send, task, arguments, queue), robust=True)


def _send_group(task: str, arguments: list[int], queue: str) -> None:
    try:
        sender = _sender()
        group(
            sender.signature(task, args=[one], queue=queue, expires=AGAIN_EXPIRES_S, ignore_result=True)
            for one in arguments
        ).apply_async(add_to_parent=False)
    except Exception as error:  # whatever the transport raises, the change itself stands
        log.warning("Could not ring %s %s (%s); the tick will.", task, arguments, error)


def _send(task: str, arguments: list[object], queue: str) -> None:
    try:
        _sender().send_task(task, args=arguments, queue=queue, expires=RING_EXPIRES_S, ignore_result=True)
    except Exception as error:  # whatever the transport raises, the change itself stands
        log.warning("Could not ring %s %s (%s); the tick will.", task, arguments, error)
