"""Whether this installation works, for machines: one JSON answer at ``/health/``.

A process id proves nothing (a worker can be alive and deaf), so the signs looked at are work done: the database
answers, the doorbell answers, each rig's worker has shown itself lately, the disk has room.
"""

from __future__ import annotations

import datetime as dt
import shutil
from dataclasses import dataclass

import redis
from django.conf import settings
from django.db import DatabaseError, connection
from django.http import HttpRequest, JsonResponse
from django.utils import timezone
from django.views.decorators.cache import never_cache
from django.views.decorators.http import require_safe

from inspection.models import Rig

#: A rig worker shows itself every 10 s; three missed times is a fault.
WORKER_SILENT = dt.timedelta(seconds=45)
#: Below this a scan of 1205 steps and five exposures no longer fits.
DISK_LOW_BYTES = 5 * 10**9


@dataclass(frozen=True)
class Sign:
    """One thing looked at: ``good`` or not, and a sentence for people."""

    name: str
    good: bool
    text: str


def signs() -> list[Sign]:
    """Look at everything. The database comes first: without it nothing else can be told."""
    found: list[Sign] = []
    try:
        with connection.cursor() as cursor:
            cursor.execute("SELECT 1")
        rigs = list(Rig.objects.filter(active=True))
    except DatabaseError as error:
        return [Sign("database", False, f"The database does not answer: {error}")]
    found.append(Sign("database", True, "The database answers."))
    found.append(doorbell())
    settings.HOME.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(settings.HOME).free
    found.append(Sign("disk", free > DISK_LOW_BYTES, f"{free / 1e9:.1f} GB free for stacks and results."))
    now = timezone.now()
    for rig in rigs:
        seen = rig.worker_seen_at
        if seen is None:
            found.append(Sign(f"rig {rig.slug}", False, f"No worker has ever served {rig.name}; start one."))
        else:
            age = now - seen
            found.append(
                Sign(
                    f"rig {rig.slug}", age < WORKER_SILENT, f"{rig.name}: worker seen {age.total_seconds():.0f} s ago."
                )
            )
    return found


def doorbell() -> Sign:
    url = settings.REDIS_URL.replace("redis+socket://", "unix://")
    try:
        client = redis.Redis.from_url(url, socket_connect_timeout=1, socket_timeout=1)
        client.ping()
        client.close()
    except (redis.RedisError, OSError) as error:
        return Sign("doorbell", False, f"Redis does not answer at {url}: {error}. Scans start only with the tick.")
    return Sign("doorbell", True, "Redis answers.")


@require_safe
@never_cache
def health(request: HttpRequest) -> JsonResponse:
    """200 while the database answers; 503 otherwise. The body names every sign, so a monitor can be stricter."""
    found = signs()
    alive = found[0].good
    return JsonResponse(
        {
            "status": "ok" if all(sign.good for sign in found) else "degraded" if alive else "down",
            "signs": {sign.name: {"good": sign.good, "text": sign.text} for sign in found},
        },
        status=200 if alive else 503,
    )
