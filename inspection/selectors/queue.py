"""What a rig's queue looks like to a person: who is next, when it starts, and if it waits, why.

A queue that waits without a reason is what users of comparable products complain about most; here every waiting scan
carries one, in words.
"""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass
from statistics import median

from django.utils import timezone

from inspection.models import Rig, Scan
from inspection.states import ON_RIG, QueueState, ScanState

#: A worker shows itself every 10 s; three missed times and a person should look.
WORKER_SILENT = dt.timedelta(seconds=45)
#: Before either is reached an estimate jumps about, and a jumping estimate is soon ignored.
ETA_FROM_SHARE = 0.05
ETA_FROM = dt.timedelta(seconds=20)
#: Runs of the rig that an estimate rests on.
LAST_RUNS = 8
#: Numbers waiting for a compute worker this long deserve a remark.
COMPUTE_LATE = dt.timedelta(seconds=90)


@dataclass(frozen=True)
class QueueRow:
    """One scan in the queue. ``position`` is 0 on the rig, 1 for the next; ``why`` says in words what it waits for."""

    scan: Scan
    position: int
    why: str
    starts_at: dt.datetime | None
    ends_at: dt.datetime | None
    stopping: bool = False


@dataclass(frozen=True)
class QueueView:
    """A rig's queue: on the rig and waiting (``rows``), being computed (``processing``), the last ended (``ended``)."""

    rig: Rig
    rows: list[QueueRow]
    processing: list[QueueRow]
    ended: list[Scan]
    worker_silent: bool
    banner: str


def queue_view(rig: Rig, *, now: dt.datetime | None = None, ended: int = 10) -> QueueView:
    """Return the queue of ``rig`` as it stands in the database now."""
    now = now or timezone.now()
    rig = Rig.objects.select_related("queue_owner").get(pk=rig.pk)
    scans = Scan.objects.filter(rig=rig).select_related(
        "region", "inspection__tool", "recipe", "requested_by", "cancel_requested_by"
    )
    on_rig = list(scans.filter(state__in=ON_RIG, source=Scan.Source.RIG))
    queued = list(scans.filter(state=ScanState.QUEUED).order_by("position", "pk"))
    processing = list(scans.filter(state=ScanState.PROCESSING).order_by("progress_at", "pk"))
    last = list(
        scans.filter(finished_at__isnull=False).exclude(state=ScanState.PROCESSING).order_by("-finished_at")[:ended]
    )
    pace = seconds_per_step(rig)
    halted = halt_reason(rig, now)
    silent = worker_silent(rig, now)
    rows = []
    free_at: dt.datetime | None = now
    for scan in on_rig:
        ends_at = expected_end(scan, pace, now)
        rows.append(QueueRow(scan, 0, _on_rig(scan), scan.started_at, ends_at, _stopping(scan)))
        free_at = ends_at
    for position, scan in enumerate(queued, start=1):
        starts_at = free_at if not halted and not silent else None
        rows.append(QueueRow(scan, position, _waiting(position, starts_at, halted, silent, rig, now), starts_at, None))
        free_at = None if free_at is None or pace is None else free_at + dt.timedelta(seconds=pace * _steps(scan))
    banner = halted or (_silence(rig) if silent else "")
    return QueueView(rig, rows, [_processing(scan, now) for scan in processing], last, silent, banner)


def reason_for_waiting(scan: Scan, *, now: dt.datetime | None = None) -> str:
    """Say for one scan, in words, what it waits for; empty when it does not."""
    if scan.state not in (ScanState.QUEUED, ScanState.PROCESSING, *ON_RIG):
        return ""
    view = queue_view(scan.rig, now=now, ended=0)
    return next((row.why for row in [*view.rows, *view.processing] if row.scan.pk == scan.pk), "")


def halt_reason(rig: Rig, now: dt.datetime) -> str:
    """Why the queue starts nothing, with who and since when; empty when it may."""
    who = f" by {rig.queue_owner.get_short_name() or rig.queue_owner.username}" if rig.queue_owner else ""
    when = f" {_clock(rig.queue_since, now)}" if rig.queue_since else ""
    if rig.queue_state == QueueState.LOCKED:
        return f"Rig locked{who}{when}: {rig.queue_reason}"
    if rig.queue_state == QueueState.PAUSED:
        return f"Queue paused{who}{when}: {rig.queue_reason}"
    if not rig.active:
        return f"{rig.name} is out of service."
    return ""


def worker_silent(rig: Rig, now: dt.datetime) -> bool:
    return rig.worker_seen_at is None or now - rig.worker_seen_at > WORKER_SILENT


def seconds_per_step(rig: Rig) -> float | None:
    """Median pace of this rig's last runs, set-up and parking included; None when it has not run yet."""
    runs = Scan.objects.filter(
        rig=rig, source=Scan.Source.RIG, state__in=[ScanState.DONE, ScanState.PROCESSING], done__gt=0
    ).order_by("-started_at")[:LAST_RUNS]
    paces = [
        run.acquisition["duration_s"] / run.done
        for run in runs
        if run.acquisition
        and run.acquisition.get("duration_s")
        and not run.acquisition.get("pauses")
        and not run.acquisition.get("continued_at_step")
    ]
    return median(paces) if paces else None


def expected_end(scan: Scan, pace: float | None, now: dt.datetime) -> dt.datetime | None:
    """When a scan on the rig will be through; None while nobody can know.

    From the rig's last runs at first, from the scan's own pace as it gains weight; hidden until 5 % or 20 s are done.
    """
    if scan.state != ScanState.RUNNING or scan.started_at is None or not scan.total or _stopping(scan):
        return None
    elapsed = (now - scan.started_at).total_seconds()
    share = scan.done / scan.total
    if share < ETA_FROM_SHARE and elapsed < ETA_FROM.total_seconds():
        return None
    own = elapsed / scan.done if scan.done else None
    if own is None and pace is None:
        return None
    if own is None or pace is None:
        mixed = own if own is not None else pace
    else:
        mixed = share * own + (1.0 - share) * pace
    assert mixed is not None
    return now + dt.timedelta(seconds=max(0.0, mixed * (scan.total - scan.done)))


def _steps(scan: Scan) -> int:
    return int(scan.total or scan.plan.get("steps", 0))


def _stopping(scan: Scan) -> bool:
    return scan.cancel_requested_at is not None or scan.finish_requested_at is not None


def _on_rig(scan: Scan) -> str:
    if scan.cancel_requested_at is not None:
        who = f" for {scan.cancel_requested_by}" if scan.cancel_requested_by else ""
        return f"stopping{who}: the stage parks after this step"
    if scan.finish_requested_at is not None:
        return "finishing early: the stage parks after this step"
    if scan.state == ScanState.PAUSED:
        return "paused, laser off and stage parked"
    if scan.pause_requested_at is not None:
        return "pausing: the stage parks after this step"
    return "on the rig"


def _waiting(
    position: int, starts_at: dt.datetime | None, halted: str, silent: bool, rig: Rig, now: dt.datetime
) -> str:
    if halted:
        return halted
    if silent:
        return _silence(rig)
    if starts_at is None:
        return f"position {position}"
    minutes = (starts_at - now).total_seconds() / 60.0
    if minutes < 1.0:
        return "next, starts at once" if position == 1 else f"position {position}, starts in less than a minute"
    return f"position {position}, starts in about {minutes:.0f} min"


def _silence(rig: Rig) -> str:
    if rig.worker_seen_at is None:
        return f"No worker has ever served {rig.name}; start one."
    return f"Worker not seen since {_clock(rig.worker_seen_at, timezone.now())}."


def _processing(scan: Scan, now: dt.datetime) -> QueueRow:
    since = scan.progress_at or scan.queued_at
    why = "surface numbers are being computed"
    if now - since > COMPUTE_LATE:
        why = f"waiting for a compute worker since {_clock(since, now)}"
    return QueueRow(scan, 0, why, scan.started_at, None)


def _clock(moment: dt.datetime, now: dt.datetime) -> str:
    local = timezone.localtime(moment)
    return f"{local:%H:%M}" if local.date() == timezone.localdate(now) else f"{local:%Y-%m-%d %H:%M}"
