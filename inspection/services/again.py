"""Many scans computed again with one recipe, by all compute workers together; earlier results stay.

The orders are rows, as everything that is to be done. The compute workers are rung by a Celery group for the first few,
and each order that ends rings for the next, so that a thousand old scans never stand in the way of a fresh one.
"""

from __future__ import annotations

from collections.abc import Sequence

from django.db import transaction
from django.db.models import Count
from django.utils import timezone

from inspection.models import Recipe, Recomputation, RecomputationBatch, Scan, User
from inspection.services.audit import audit
from inspection.services.queue import check_recipe
from inspection.services.ring import ring_recompute_many
from inspection.states import ENDED
from scanning.errors import BadInput

#: Orders of a batch that are rung for at a time.
AT_ONCE = 8
State = Recomputation.State


def compute_many_again(scans: Sequence[Scan], recipe: Recipe, by: User | None, reason: str) -> RecomputationBatch:
    """Order every scan of ``scans`` to be computed again with ``recipe``. All, or none.

    Raises `BadInput` without a reason, without scans, or naming the first scan without frames or whose frames do not
    fit the recipe.
    """
    reason = reason.strip()
    if not reason:
        raise BadInput("Say why so many scans are computed again; it stands beside every new result.")
    if not scans:
        raise BadInput("No scan with stored frames fits that choice; choose other tools or an earlier date.")
    for scan in scans:
        if scan.state not in ENDED or not scan.stack_file:
            raise BadInput(f"Scan {scan.pk} has no finished frames, so it cannot be computed again; leave it out.")
        check_recipe(recipe, scan.plan, f"{scan.region} (scan {scan.pk})")
    now = timezone.now()
    with transaction.atomic():
        batch = RecomputationBatch.objects.create(recipe=recipe, reason=reason[:200], requested_by=by, requested_at=now)
        Recomputation.objects.bulk_create(
            Recomputation(scan=scan, recipe=recipe, requested_by=by, requested_at=now, batch=batch) for scan in scans
        )
        audit(by, "batch.started", batch, after={"scans": len(scans), "recipe": recipe.name}, reason=reason)
        ring_next(batch.pk)
    return batch


def ring_next(batch_id: int, many: int = AT_ONCE) -> None:
    """Ring for a batch's next orders. Called for a batch without anything waiting, it does nothing."""
    waiting = Recomputation.objects.filter(batch_id=batch_id, state=State.QUEUED).order_by("pk")
    ring_recompute_many(list(waiting.values_list("pk", flat=True)[:many]))


def cancel_batch(batch: RecomputationBatch, by: User | None) -> int:
    """Take what has not begun out of the batch and return how many that were. What is being computed is finished."""
    with transaction.atomic():
        taken = Recomputation.objects.filter(batch=batch, state=State.QUEUED).update(
            state=State.CANCELLED, finished_at=timezone.now()
        )
        if not taken:
            raise BadInput("Nothing of this batch waits any more, so there is nothing to cancel.")
        audit(by, "batch.cancelled", batch, after={"taken_out": taken})
    return taken


def resume_batch(batch: RecomputationBatch, by: User | None) -> int:
    """Put what was cancelled or failed back into the queue; what is done stays done. Returns how many."""
    with transaction.atomic():
        back = Recomputation.objects.filter(batch=batch, state__in=(State.CANCELLED, State.FAILED)).update(
            state=State.QUEUED, finished_at=None, started_at=None, fault="", attempts=0
        )
        if not back:
            raise BadInput("Nothing of this batch was cancelled or failed, so there is nothing to resume.")
        audit(by, "batch.resumed", batch, after={"put_back": back})
        ring_next(batch.pk)
    return back


def counts(batch: RecomputationBatch) -> dict[str, int]:
    """How many orders of the batch are in each state; every state is there."""
    found = dict(batch.orders.order_by().values_list("state").annotate(n=Count("pk")))
    return {state.value: found.get(state.value, 0) for state in State}
