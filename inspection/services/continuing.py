"""Going on with a scan that broke off, at the step where it broke off.

Half an hour of frames is on the disk, each with its checksum; throwing it away because a worker was restarted is what
people resent. But nobody knows what happened to the tool meanwhile, so a person must have looked and says so, the stage
homes again, and every frame is verified before the first new one is taken.
"""

from __future__ import annotations

from django.db import transaction
from django.db.models import Min
from django.utils import timezone

from inspection.models import Rig, Scan, User
from inspection.services.audit import audit
from inspection.services.moves import WrongState
from inspection.services.ring import ring
from inspection.states import QueueState, ScanState
from scanning.errors import BadInput

#: Ends after which the frames so far are worth going on from. A cancelled scan was not wanted any more.
BROKEN_OFF = (ScanState.INTERRUPTED, ScanState.FAILED)


def can_continue(scan: Scan) -> bool:
    """Whether the scan broke off on a rig and nothing was computed from its frames yet.

    It may have died before its first frame, or its frames may be gone: it then starts clean.
    """
    return (
        scan.state in BROKEN_OFF and scan.source == Scan.Source.RIG and scan.partial and not scan.range_images.exists()
    )


def continue_scan(scan: Scan, by: User | None, *, looked: bool) -> None:
    """Put ``scan`` first in its rig's queue, to go on at its first step without a whole frame.

    ``looked`` is the person's word that the tool lies as it did and the way is free. A queue that was paused by the
    fault goes on; one that a person paused or locked stays so. Raises `WrongState` if the scan cannot go on.
    """
    if not looked:
        raise BadInput("Look at the rig first and confirm that the tool lies as it did and nothing is in the way.")
    if not can_continue(scan):
        state = Scan.objects.values_list("state", flat=True).get(pk=scan.pk)
        raise WrongState(
            f"Scan {scan.pk} is {state} and cannot be continued: only a scan that broke off on a rig and has no "
            f"result, can; scan the region again.",
            state,
        )
    with transaction.atomic():
        rig = Rig.objects.select_for_update().get(pk=scan.rig_id)
        first = rig.scans.filter(state=ScanState.QUEUED).aggregate(first=Min("position"))["first"]
        won = Scan.objects.filter(pk=scan.pk, state=scan.state).update(
            state=ScanState.QUEUED,
            position=(first or 1.0) - 1.0,
            queued_at=timezone.now(),
            continued=scan.continued + 1,
            finished_at=None,
            fault="",
            message=f"Goes on at step {scan.done}.",
            partial=False,
            phase="",
            cancel_requested_at=None,
            cancel_requested_by=None,
            pause_requested_at=None,
            finish_requested_at=None,
            stop_requested_at=None,
            stop_requested_by=None,
        )
        if not won:
            raise WrongState(f"Scan {scan.pk} was continued by somebody else at this moment.", ScanState.QUEUED)
        stopped = scan.stop_requested_at is not None
        by_fault = rig.queue_state == QueueState.PAUSED and (rig.queue_owner_id is None or stopped)
        if by_fault:
            Rig.objects.filter(pk=rig.pk).update(
                queue_state=QueueState.READY, queue_reason="", queue_owner=None, queue_since=timezone.now()
            )
        audit(by, "scan.continued", scan, before={"state": scan.state, "done": scan.done, "fault": scan.fault})
        ring(rig.slug)
    scan.refresh_from_db()
