"""The emergency stop on the page: feed hold and laser off, now.

It is no substitute for the button on the machine, which works without computers. It exists because the person at the
screen may be the one who sees the chip fall into the rig. The worker looks for it forty times a second, outside the
step loop, because a step can take a second; a message could be lost, so it is a column like every other request.
"""

from __future__ import annotations

from django.db import transaction
from django.db.models.functions import Now
from django.utils import timezone

from inspection.models import Rig, Scan, User
from inspection.services.audit import audit
from inspection.states import ON_RIG, QueueState


def emergency_stop(rig: Rig, by: User | None) -> bool:
    """Stop whatever moves on ``rig`` and pause its queue; return whether a scan was on it.

    May be pressed any number of times, by anybody, in any state.
    """
    now = timezone.now()
    reason = f"Emergency stop by {by}." if by else "Emergency stop."
    with transaction.atomic():
        # First and alone what the worker waits for.
        hit = Scan.objects.filter(
            rig=rig, state__in=ON_RIG, source=Scan.Source.RIG, stop_requested_at__isnull=True
        ).update(stop_requested_at=Now(), stop_requested_by=by)
    with transaction.atomic():
        row = Rig.objects.select_for_update().get(pk=rig.pk)
        if row.queue_state == QueueState.LOCKED:
            Rig.objects.filter(pk=rig.pk).update(pause_under_lock=reason)
        else:
            Rig.objects.filter(pk=rig.pk).update(
                queue_state=QueueState.PAUSED, queue_reason=reason, queue_owner=by, queue_since=now
            )
        audit(by, "rig.emergency_stop", rig, after={"scan_on_rig": bool(hit)})
    rig.refresh_from_db()
    return bool(hit)
