"""The states of a scan and the moves between them, as data.

Every button, API answer and worker step derives from this table. Without it each of them would hold its own idea of
what may follow what, and the first disagreement would lose a scan.
"""

from __future__ import annotations

from django.db.models import TextChoices


class ScanState(TextChoices):
    QUEUED = "queued"
    RUNNING = "running"
    PAUSED = "paused"
    PROCESSING = "processing"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"
    INTERRUPTED = "interrupted"


#: Which state may follow which. INTERRUPTED means the worker died: what is on disk is true, nobody is driving the rig.
MOVES: dict[str, frozenset[str]] = {
    ScanState.QUEUED: frozenset({ScanState.RUNNING, ScanState.CANCELLED}),
    ScanState.RUNNING: frozenset(
        {ScanState.PAUSED, ScanState.PROCESSING, ScanState.FAILED, ScanState.CANCELLED, ScanState.INTERRUPTED}
    ),
    ScanState.PAUSED: frozenset({ScanState.RUNNING, ScanState.FAILED, ScanState.CANCELLED, ScanState.INTERRUPTED}),
    ScanState.PROCESSING: frozenset({ScanState.DONE, ScanState.FAILED}),
    ScanState.DONE: frozenset(),
    # Back into the queue only by a person who has looked at the rig (`services.continuing`).
    ScanState.FAILED: frozenset({ScanState.QUEUED}),
    ScanState.CANCELLED: frozenset(),
    ScanState.INTERRUPTED: frozenset({ScanState.QUEUED}),
}

#: A worker holds the rig.
ON_RIG = frozenset({ScanState.RUNNING, ScanState.PAUSED})
#: Something will still change by itself.
LIVE = frozenset({ScanState.QUEUED, ScanState.RUNNING, ScanState.PAUSED, ScanState.PROCESSING})
ENDED = frozenset(ScanState) - LIVE


class QueueState(TextChoices):
    READY = "ready"
    PAUSED = "paused"
    """Nothing starts until a person resumes it; the reason says why."""
    LOCKED = "locked"
    """Somebody has their hands in the rig."""


class Verdict(TextChoices):
    OK = "ok"
    WATCH = "watch"
    REPLACE = "replace"
    UNKNOWN = "unknown"


#: From best to worst: a tool is as bad as its worst region; unknown outranks ok, because nobody knows.
VERDICT_ORDER = [Verdict.OK, Verdict.UNKNOWN, Verdict.WATCH, Verdict.REPLACE]
