"""What was changed by whom, how this installation is, and what the words mean."""

from __future__ import annotations

import datetime as dt
import platform
import shutil
from dataclasses import dataclass

import django
import numpy as np
from django.conf import settings
from django.core.paginator import Paginator
from django.db import connection
from django.http import HttpResponse
from django.shortcuts import render
from django.utils import timezone
from django.views.decorators.http import require_safe

from inspection.models import AuditEvent, Rig, Scan
from inspection.states import ScanState
from inspection.views.signed_in import SignedIn

PER_PAGE = 50
#: A rig's worker beats every 10 s; three missed beats and it is gone.
WORKER_SILENT = dt.timedelta(seconds=35)
#: A full 1205-step, five-exposure stack takes about 1.5 GB.
LOW_DISK_BYTES = 10 * 2**30


@require_safe
def audit_page(request: SignedIn) -> HttpResponse:
    events = AuditEvent.objects.select_related("actor")
    search = request.GET.get("search", "").strip()
    if search:
        events = events.filter(target__icontains=search) | events.filter(verb__icontains=search)
    page = Paginator(events, PER_PAGE).get_page(request.GET.get("page"))
    return render(request, "people/audit.html", {"page": page, "search": search})


@dataclass(frozen=True)
class Finding:
    """One line of the health page. ``tone`` is ok, watch or replace."""

    what: str
    tone: str
    sentence: str


@require_safe
def health_page(request: SignedIn) -> HttpResponse:
    now = timezone.now()
    versions = {
        "Python": platform.python_version(),
        "Django": django.get_version(),
        "NumPy": np.__version__,
        "Database": connection.vendor,
    }
    findings = [*_rigs(now), _queue(now), _disk()]
    return render(request, "people/health.html", {"findings": findings, "versions": versions})


def _rigs(now: dt.datetime) -> list[Finding]:
    rows = []
    for rig in Rig.objects.filter(active=True):
        if rig.worker_seen_at is None:
            rows.append(Finding(rig.name, "replace", "Its worker has never been seen. Start it, or look at its log."))
        elif now - rig.worker_seen_at > WORKER_SILENT:
            since = timezone.localtime(rig.worker_seen_at)
            rows.append(Finding(rig.name, "replace", f"Its worker is silent since {since:%d %b %H:%M:%S}. Restart it."))
        elif rig.queue_state != "ready":
            rows.append(Finding(rig.name, "watch", f"Queue {rig.queue_state}: {rig.queue_reason}"))
        else:
            rows.append(Finding(rig.name, "ok", "Worker alive, queue ready."))
        calibration = rig.calibration_now()
        if calibration is None:
            rows.append(Finding(f"{rig.name} calibration", "replace", "Never calibrated: no verdict can be trusted."))
        elif calibration.expired():
            rows.append(Finding(f"{rig.name} calibration", "watch", f"Expired on {calibration.valid_until:%d %b %Y}."))
    return rows or [Finding("Rigs", "watch", "No rig is set up.")]


def _queue(now: dt.datetime) -> Finding:
    oldest = Scan.objects.filter(state=ScanState.QUEUED).order_by("queued_at").first()
    if oldest is None:
        return Finding("Queue", "ok", "Nothing waits.")
    hours = (now - oldest.queued_at).total_seconds() / 3600
    tone = "watch" if hours > 4 else "ok"
    return Finding(
        "Queue",
        tone,
        f"The oldest order ({oldest.region}) waits since {timezone.localtime(oldest.queued_at):%d %b %H:%M}.",
    )


def _disk() -> Finding:
    usage = shutil.disk_usage(settings.HOME)
    free = usage.free / 2**30
    tone = "ok" if usage.free > LOW_DISK_BYTES else "replace"
    return Finding("Disk", tone, f"{free:.0f} GB free of {usage.total / 2**30:.0f} GB for stacks and range images.")


@require_safe
def help_page(request: SignedIn) -> HttpResponse:
    return render(request, "people/help.html")
