"""Whether this installation works: one list of signs for the page people read and for the answer machines ask for.

A process id proves nothing (a worker can be alive and deaf), so the signs looked at are work done: the database
answers, the doorbell answers, each rig's worker has shown itself lately, the disk has room.
"""

from __future__ import annotations

import datetime as dt
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import redis
from django.conf import settings
from django.db import DatabaseError, connection
from django.http import HttpRequest, JsonResponse
from django.utils import timezone
from django.views.decorators.cache import never_cache
from django.views.decorators.http import require_safe

from inspection.models import Rig, Scan
from inspection.states import QueueState, ScanState

#: A rig's worker shows itself every 10 s; three missed times and it is gone.
WORKER_SILENT = dt.timedelta(seconds=35)
#: A full 1205-step, five-exposure stack takes about 1.5 GB.
LOW_DISK_BYTES = 10 * 2**30
#: An order older than half a shift is worth a look.
LONG_WAIT = dt.timedelta(hours=4)


@dataclass(frozen=True)
class Sign:
    """One thing looked at, in a sentence. ``tone`` is ok, watch (look when you can) or replace (act now)."""

    what: str
    tone: Literal["ok", "watch", "replace"]
    sentence: str


def signs() -> list[Sign]:
    """Look at everything. Without the database nothing else can be told."""
    try:
        with connection.cursor() as cursor:
            cursor.execute("SELECT 1")
    except DatabaseError as error:
        return [Sign("Database", "replace", f"It does not answer: {error}")]
    return [Sign("Database", "ok", "It answers."), doorbell(), *rigs(), queue(), disk()]


def doorbell() -> Sign:
    """Redis or Valkey. Without it scans start with the tick only, if that runs without it at all."""
    url = settings.REDIS_URL.replace("redis+socket://", "unix://")
    try:
        client = redis.Redis.from_url(url, socket_connect_timeout=1, socket_timeout=1)
        client.ping()
        client.close()
    except (redis.RedisError, OSError) as error:
        return Sign("Doorbell", "replace", f"Redis does not answer ({error}). Start it; nothing queued is lost.")
    return Sign("Doorbell", "ok", "Redis answers.")


def rigs() -> Iterator[Sign]:
    now = timezone.now()
    none = True
    for rig in Rig.objects.filter(active=True):
        none = False
        if rig.worker_seen_at is None:
            yield Sign(rig.name, "replace", "Its worker has never been seen. Start it, or look at its log.")
        elif now - rig.worker_seen_at > WORKER_SILENT:
            since = timezone.localtime(rig.worker_seen_at)
            yield Sign(rig.name, "replace", f"Its worker is silent since {since:%d %b %H:%M:%S}. Restart it.")
        elif rig.queue_state != QueueState.READY:
            yield Sign(rig.name, "watch", f"Queue {rig.queue_state}: {rig.queue_reason}")
        else:
            yield Sign(rig.name, "ok", "Worker alive, queue ready.")
        calibration = rig.calibration_now()
        if calibration is None:
            yield Sign(f"{rig.name} calibration", "replace", "Never calibrated: no verdict can be trusted.")
        elif calibration.expired():
            yield Sign(f"{rig.name} calibration", "watch", f"Expired on {calibration.valid_until:%d %b %Y}.")
    if none:
        yield Sign("Rigs", "watch", "No rig is set up.")


def queue() -> Sign:
    oldest = Scan.objects.filter(state=ScanState.QUEUED).order_by("queued_at").first()
    if oldest is None:
        return Sign("Queue", "ok", "Nothing waits.")
    since = timezone.localtime(oldest.queued_at)
    return Sign(
        "Queue",
        "watch" if timezone.now() - oldest.queued_at > LONG_WAIT else "ok",
        f"The oldest order ({oldest.region}) waits since {since:%d %b %H:%M}.",
    )


def disk() -> Sign:
    settings.HOME.mkdir(parents=True, exist_ok=True)
    usage = shutil.disk_usage(settings.HOME)
    room = f"{usage.free / 2**30:.0f} GB free of {usage.total / 2**30:.0f} GB for stacks and range images."
    return Sign("Disk", "ok" if usage.free > LOW_DISK_BYTES else "replace", room)


@require_safe
@never_cache
def health(request: HttpRequest) -> JsonResponse:
    """200 while the database answers, else 503. The body names every sign, so a monitor can be stricter."""
    found = signs()
    alive = found[0].tone == "ok"
    tones = {sign.tone for sign in found}
    return JsonResponse(
        {
            "status": "ok" if tones == {"ok"} else "degraded" if alive else "down",
            "signs": {sign.what: {"tone": sign.tone, "text": sign.sentence} for sign in found},
        },
        status=200 if alive else 503,
    )
