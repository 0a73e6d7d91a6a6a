"""Makes room: raw stacks older than a rule says go, results never.

A five-exposure stack takes over a gigabyte and a full disk stops the rig, so most plants keep raw frames for some weeks
only. What a result depends on stays: its range image, numbers and the hash of the frames it came from. What cannot be
had again stays too: frames without a result, those somebody has asked to compute again, and the newest of each region.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from django.conf import settings
from django.db import transaction
from django.utils import timezone

from inspection.models import RangeImage, Recomputation, Scan
from inspection.services.audit import audit
from inspection.states import ScanState
from scanning.errors import BadInput

#: Recomputations in these states still need the frames.
WAITING = (Recomputation.State.QUEUED, Recomputation.State.RUNNING)
Progress = Callable[[int, int, str], None]


@dataclass
class Removed:
    """Which scans lost their raw frames, and how many bytes that freed (or would free)."""

    scans: list[Scan] = field(default_factory=list)
    bytes: int = 0


def removable(older_than_days: int, now: dt.datetime | None = None) -> Iterator[Scan]:
    """Scans whose raw frames the rule lets go, oldest first."""
    if older_than_days < 1:
        raise BadInput(f"Stacks cannot be kept for {older_than_days} days; give a number of days from 1 up.")
    before = (now or timezone.now()) - dt.timedelta(days=older_than_days)
    newest: dict[int, int] = {}
    done = Scan.objects.filter(state=ScanState.DONE).order_by("region_id", "-finished_at", "-pk")
    for region, pk in done.values_list("region_id", "pk"):
        newest.setdefault(region, pk)
    scans = (
        Scan.objects.filter(state=ScanState.DONE, finished_at__lt=before)
        .exclude(stack_file="")
        .exclude(pk__in=newest.values())
        .select_related("region__tool")
        .order_by("finished_at", "pk")
    )
    for scan in scans:
        has_result = RangeImage.objects.filter(scan=scan).exists()
        if has_result and not Recomputation.objects.filter(scan=scan, state__in=WAITING).exists():
            yield scan


def remove_old_stacks(
    older_than_days: int, *, dry_run: bool = False, now: dt.datetime | None = None, progress: Progress = lambda *_: None
) -> Removed:
    """Remove the raw frames the rule lets go. The row changes first: it never names a file that is gone."""
    removed = Removed()
    chosen = list(removable(older_than_days, now))
    for done, scan in enumerate(chosen, start=1):
        progress(done, len(chosen), scan.stack_file)
        file = Path(settings.STACKS) / scan.stack_file
        size = file.stat().st_size if file.is_file() else 0
        if not dry_run:
            with transaction.atomic():
                if not Scan.objects.filter(pk=scan.pk, stack_file=scan.stack_file).update(
                    stack_file="", stack_removed_at=now or timezone.now()
                ):
                    continue
                audit(
                    None, "stack.removed", scan, before={"file": scan.stack_file, "sha256": scan.stack_sha256},
                    reason=f"Raw frames are kept for {older_than_days} days.",
                )  # fmt: skip
            try:
                file.unlink(missing_ok=True)
            except OSError as error:
                raise BadInput(
                    f"{file} could not be removed ({error.strerror}); look at the folder's rights."
                ) from error
        removed.scans.append(scan)
        removed.bytes += size
    return removed
