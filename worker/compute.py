"""The work that needs no rig: surface numbers of a fresh scan, and computing an old one again.

Everything here starts from stored frames and may be done twice without harm, so these tasks are acknowledged late and
come back when a worker dies. What keeps two of them from storing two results is the lease and the final move, not the
broker.
"""

from __future__ import annotations

import datetime as dt
import logging
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from celery.exceptions import SoftTimeLimitExceeded
from django.conf import settings
from django.db import DatabaseError, connection
from django.db.models import F
from django.utils import timezone

from inspection.models import RangeImage as RangeImageRow
from inspection.models import Recipe, Recomputation, Scan
from inspection.services.again import ring_next
from inspection.services.calibrations import calibration_of
from inspection.services.recipes import recipe_of
from inspection.services.results import baseline_for, pending_range_file, record_result
from inspection.states import ScanState
from scanning import process_stack
from scanning.errors import BadInput, Fault
from scanning.precision import FlatRegion, precision_of
from scanning.range_image import RangeImage
from scanning.stacks import open_stack
from scanning.surface import InspectionSettings, inspect_surface
from worker.celery import app
from worker.lease import BEAT_S, LEASE_S, Lease, LeaseLostError, claim_computing, drop_connection

log = logging.getLogger(__name__)

#: A scan whose computing has killed or failed this many workers is given up; its frames stay.
MOST_ATTEMPTS = 3
#: 1205 steps of five exposures take under a minute; an hour is a machine that is swapping.
SOFT_LIMIT_S, HARD_LIMIT_S = 3600, 3660

LIMITS: dict[str, Any] = {
    "acks_late": True,
    "reject_on_worker_lost": True,
    "ignore_result": True,
    "soft_time_limit": SOFT_LIMIT_S,
    "time_limit": HARD_LIMIT_S,
}


@app.task(name="worker.measure", **LIMITS)
def measure(scan_id: int) -> None:
    """Compute the surface numbers of a scan that is processing, and store the result."""
    held = claim_computing(scan_id, f"compute@{socket.gethostname()}")
    if held is None:
        return
    lease, attempt = held
    with lease.beating():
        try:
            if attempt > MOST_ATTEMPTS:
                raise BadInput(
                    f"Computing was started {MOST_ATTEMPTS} times and never came to an end; see the compute worker's "
                    f"log."
                )
            scan = Scan.objects.select_related("recipe", "calibration", "limit_set", "region__tool", "inspection").get(
                pk=scan_id
            )
            compute(scan, scan.recipe, lease=lease)
        except LeaseLostError:
            log.warning("Scan %s was taken over while it was computed; nothing of it was stored here.", scan_id)
        except Fault as fault:
            lease.move(
                ScanState.PROCESSING,
                ScanState.FAILED,
                fault=str(fault)[:500],
                finished_at=timezone.now(),
                lease_token=None,
                lease_until=None,
                phase="",
            )
        except (Exception, SoftTimeLimitExceeded) as error:
            log.exception("Computing scan %s failed (attempt %d).", scan_id, attempt)
            _give_back(lease, attempt, error)


def _give_back(lease: Lease, attempt: int, error: BaseException) -> None:
    """Let the tick start it again, unless it has failed too often."""
    if attempt < MOST_ATTEMPTS:
        lease.write(lease_until=None, lease_token=None, message=f"Computing failed ({error}); trying again."[:300])
        return
    lease.move(
        ScanState.PROCESSING,
        ScanState.FAILED,
        fault=f"Computing failed {attempt} times, last with: {type(error).__name__}: {error}"[:500],
        finished_at=timezone.now(),
        lease_token=None,
        lease_until=None,
        phase="",
    )


@app.task(name="worker.recompute", **LIMITS)
def recompute(recomputation_id: int) -> None:
    """Do a `Recomputation`: compute a scan's result again with another recipe, beside the earlier ones."""
    now = timezone.now()
    orders = Recomputation.objects.filter(pk=recomputation_id)
    fresh = orders.filter(state=Recomputation.State.QUEUED)
    lost = orders.filter(state=Recomputation.State.RUNNING, lease_until__lt=now)
    started = {
        "state": Recomputation.State.RUNNING,
        "started_at": now,
        "lease_until": now + dt.timedelta(seconds=LEASE_S),
        "attempts": F("attempts") + 1,
    }
    if not fresh.update(**started) and not lost.update(**started):
        return
    order = orders.select_related(
        "recipe", "scan__calibration", "scan__limit_set", "scan__region__tool", "scan__inspection"
    ).get()
    try:
        if order.attempts > MOST_ATTEMPTS:
            raise BadInput(f"Computing was started {MOST_ATTEMPTS} times and never came to an end; see the log.")
        with _beating(order):
            compute(order.scan, order.recipe, recomputation=order)
    except Fault as fault:
        _fail(order, str(fault))
    except (Exception, SoftTimeLimitExceeded) as error:
        log.exception("Recomputation %s failed.", order.pk)
        _fail(order, f"{type(error).__name__}: {error}")

    finally:
        if order.batch_id is not None:
            ring_next(order.batch_id, 1)


@contextmanager
def _beating(order: Recomputation) -> Iterator[None]:
    """Show from a thread of its own that the order is being worked on, so that one whose worker was killed is found."""
    enough = threading.Event()

    def beat() -> None:
        try:
            while not enough.wait(BEAT_S):
                try:
                    Recomputation.objects.filter(pk=order.pk, state=Recomputation.State.RUNNING).update(
                        lease_until=timezone.now() + dt.timedelta(seconds=LEASE_S)
                    )
                except DatabaseError as error:
                    log.warning("Could not renew the lease on recomputation %s: %s", order.pk, error)
                    drop_connection()
        finally:
            connection.close()

    thread = threading.Thread(target=beat, name=f"lease of recomputation {order.pk}", daemon=True)
    thread.start()
    try:
        yield
    finally:
        enough.set()
        thread.join()


def _fail(order: Recomputation, fault: str) -> None:
    Recomputation.objects.filter(pk=order.pk, state=Recomputation.State.RUNNING).update(
        state=Recomputation.State.FAILED, fault=fault[:500], finished_at=timezone.now()
    )


def compute(
    scan: Scan, recipe: Recipe, *, lease: Lease | None = None, recomputation: Recomputation | None = None
) -> RangeImageRow | None:
    """Range image, surface numbers, precision and verdict of ``scan`` with ``recipe``, stored in one transaction.

    Returns the stored row, or None if another process had stored one. A surface that cannot be measured still gives a
    range image, with the reason and the verdict "unknown".
    """
    pending = pending_range_file(scan.pk)
    if recomputation is None and pending.exists():
        image = RangeImage.load(pending)
    else:
        image = _from_frames(scan, recipe, lease)
    baseline, doubts = None, []
    report = None
    calibration = calibration_of(scan.calibration)
    try:
        row = baseline_for(scan, image)
        before = RangeImage.load(Path(settings.RANGES) / row.file) if row is not None else None
        baseline = row
        report = inspect_surface(
            image,
            baseline=before,
            settings=InspectionSettings(start_mm=float(scan.plan.get("start_mm", 0.0))),
            calibration=calibration,
        )
    except Fault as fault:
        doubts.append(str(fault))
    precision = precision_of(image, flat_of(scan, image))
    if lease is not None:
        lease.renew()
        lease.check()
    result = record_result(
        scan,
        image,
        report,
        precision,
        recipe=recipe,
        baseline=baseline,
        doubts=doubts,
        recomputation=recomputation,
    )
    if recomputation is None:
        pending.unlink(missing_ok=True)
    return result


def flat_of(scan: Scan, image: RangeImage) -> FlatRegion | None:
    """The region's flat part as it was ordered, over all profiles; None (it is then looked for) if it is not there."""
    first = int(scan.plan["flat_row"])
    last = min(first + int(scan.plan["flat_rows"]), image.height_um.shape[0])
    return FlatRegion(first, last, 0, image.height_um.shape[1], "the region's") if last - first >= 3 else None


def _from_frames(scan: Scan, recipe: Recipe, lease: Lease | None) -> RangeImage:
    if not scan.stack_file:
        raise BadInput(f"Scan {scan.pk} has no stored frames, so it cannot be computed; scan the region again.")

    def progress(_done: int, _steps: int) -> None:
        if lease is not None:
            lease.check()

    with open_stack(Path(settings.STACKS) / scan.stack_file) as stack:
        return process_stack(stack, recipe_of(recipe), calibration_of(scan.calibration), progress)
