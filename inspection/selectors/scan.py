"""One scan: how far it is while it runs, and everything its result rests on once it has ended."""

from __future__ import annotations

import datetime as dt
import hashlib
from dataclasses import dataclass
from typing import Any, Final

from django.utils import timezone

from inspection.models import Damage, PrecisionReport, RangeImage, Recomputation, Scan
from inspection.selectors.queue import expected_end, reason_for_waiting, seconds_per_step
from inspection.selectors.range_view import channels_of, damage_box
from inspection.selectors.tool import Number, key_numbers, numbers
from inspection.states import ScanState

#: More colours than this in one bar cannot be told apart.
MOST_PARTS: Final = 5
#: What a scan goes through, as a person at the rig sees it.
PHASES: Final = ("home", "scan", "compute")


@dataclass(frozen=True)
class Progress:
    """How far a live scan is. ``remaining_s`` is None while it would be a guess."""

    scan: Scan
    share: float | None
    elapsed_s: float | None
    remaining_s: float | None
    stopping: bool
    pausing: bool
    finishing: bool
    why: str
    """What it waits for, in words."""

    @property
    def percent(self) -> int | None:
        return None if self.share is None else min(100, int(100 * self.share))

    @property
    def phases(self) -> list[dict[str, str]]:
        """The stages of a scan in their order, each past, now or to come."""
        at = PHASES.index("compute") if self.scan.state == ScanState.PROCESSING else 1
        if self.scan.state == ScanState.RUNNING and not self.scan.done:
            at = 0
        tones = ["past" if place < at else "now" if place == at else "" for place in range(len(PHASES))]
        return [{"word": word.capitalize(), "tone": tone} for word, tone in zip(PHASES, tones, strict=True)]


def progress_version(scan: Scan, now: dt.datetime | None = None) -> str:
    """Changes whenever the progress fragment would, from the scan's own row alone, so idle polls are free."""
    now = now or timezone.now()
    asked = (scan.cancel_requested_at, scan.pause_requested_at, scan.finish_requested_at)
    text = f"{scan.state}|{scan.phase}|{scan.done}|{scan.total}|{scan.message}|{asked}"
    bucket = int(now.timestamp() // 5)  # elapsed and remaining move even when nothing else does
    return f"{scan.pk}-{hashlib.sha256(text.encode()).hexdigest()[:16]}-{bucket}"


def progress(scan: Scan, now: dt.datetime | None = None) -> Progress:
    now = now or timezone.now()
    share = scan.done / scan.total if scan.total else None
    elapsed = (now - scan.started_at).total_seconds() if scan.started_at else None
    ends_at = expected_end(scan, seconds_per_step(scan.rig), now) if scan.state == ScanState.RUNNING else None
    remaining = (ends_at - now).total_seconds() if ends_at else None
    return Progress(
        scan=scan,
        share=share,
        elapsed_s=elapsed,
        remaining_s=remaining,
        stopping=scan.cancel_requested_at is not None,
        pausing=scan.pause_requested_at is not None and scan.state == ScanState.RUNNING,
        finishing=scan.finish_requested_at is not None,
        why=reason_for_waiting(scan, now=now) if scan.state in (ScanState.QUEUED, ScanState.PROCESSING) else "",
    )


@dataclass(frozen=True)
class DamageRow:
    damage: Damage
    box: dict[str, Any] | None


@dataclass(frozen=True)
class TimePart:
    name: str
    seconds: float
    share: float

    @property
    def percent(self) -> str:
        return f"{100 * self.share:.1f}"


@dataclass(frozen=True)
class Result:
    """One range image of a scan with what stands beside it."""

    image: RangeImage
    numbers: list[Number]
    damages: list[DamageRow]
    precision: PrecisionReport | None
    channels: dict[str, tuple[str, str]]
    newest: bool

    @property
    def key_numbers(self) -> list[Number]:
        return key_numbers(self.numbers)

    def shapes(self) -> list[dict[str, Any]]:
        """Damage outlines for the picture, JSON-ready."""
        return [
            {"number": row.damage.number, "severity": row.damage.severity, **row.box} for row in self.damages if row.box
        ]


@dataclass(frozen=True)
class ScanPage:
    scan: Scan
    results: list[RangeImage]
    result: Result | None
    time_budget: list[TimePart]
    link: dict[str, Any]
    comparable: list[RangeImage]
    recomputations: list[Recomputation]


def scan_of(pk: int) -> Scan:
    """Fetch a scan with what its page names. Raises Scan.DoesNotExist."""
    return Scan.objects.select_related(
        "inspection", "region__tool__tool_type", "rig", "recipe", "calibration", "limit_set", "requested_by"
    ).get(pk=pk)


def scan_state(scan: Scan, result_pk: int | None = None) -> ScanPage:
    """Everything the scan page shows. ``result_pk`` picks an older range image; unknown ones give the newest."""
    results = list(scan.range_images.select_related("recipe").defer("provenance", "surface"))
    chosen = next((image for image in results if image.pk == result_pk), results[0] if results else None)
    return ScanPage(
        scan=scan,
        results=results,
        result=_result(chosen.pk, newest=chosen is results[0]) if chosen else None,
        time_budget=time_budget(scan.acquisition),
        link=scan.acquisition.get("link") or {},
        comparable=comparable(scan),
        recomputations=list(
            scan.recomputations.exclude(state=Recomputation.State.DONE).select_related("recipe", "requested_by")
        ),
    )


def _result(pk: int, *, newest: bool) -> Result:
    image = (
        RangeImage.objects.select_related(
            "scan", "recipe", "calibration__by", "limit_set__tool_type", "baseline__scan", "precision"
        )
        .prefetch_related("measurements", "damages", "limit_set__limits")
        .get(pk=pk)
    )
    return Result(
        image=image,
        numbers=numbers(image),
        damages=[DamageRow(damage, damage_box(damage, image)) for damage in image.damages.all()],
        precision=getattr(image, "precision", None),
        channels=channels_of(image),
        newest=newest,
    )


def comparable(scan: Scan) -> list[RangeImage]:
    """The newest range image of each other finished scan of the same region, newest first."""
    images = (
        RangeImage.objects.filter(scan__region=scan.region_id, scan__state=ScanState.DONE)
        .exclude(scan=scan.pk)
        .select_related("scan")
        .defer("provenance", "surface")
        .order_by("-scan__finished_at", "-created_at")[:60]
    )
    newest: dict[int, RangeImage] = {}
    for image in images:
        newest.setdefault(image.scan_id, image)
    return list(newest.values())


def time_budget(acquisition: dict[str, Any]) -> list[TimePart]:
    """Where the time of a scan went, largest first; small parts beyond the first five are summed as "other"."""
    spent = acquisition.get("time") or {}
    parts = {
        name.removesuffix("_s").replace("_", " "): float(seconds)
        for name, seconds in spent.items()
        if name not in ("wall_s", "overlapped_s") and seconds > 0  # the second is part of motion
    }
    total = sum(parts.values())
    ordered = sorted(parts.items(), key=lambda part: -part[1])
    rest = sum(seconds for _, seconds in ordered[MOST_PARTS:])
    shown = ordered[:MOST_PARTS] + ([("other", rest)] if rest else [])
    return [TimePart(name, seconds, seconds / total) for name, seconds in shown]
