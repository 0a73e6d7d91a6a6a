"""What was changed by whom, how this installation is, and what the words mean."""

from __future__ import annotations

import platform

import django
import numpy as np
from django.core.paginator import Paginator
from django.db import connection
from django.http import HttpResponse
from django.shortcuts import render
from django.views.decorators.http import require_safe

from inspection.health import signs
from inspection.models import AuditEvent
from inspection.views.signed_in import SignedIn

PER_PAGE = 50


@require_safe
def audit_page(request: SignedIn) -> HttpResponse:
    events = AuditEvent.objects.select_related("actor")
    search = request.GET.get("search", "").strip()
    if search:
        events = events.filter(target__icontains=search) | events.filter(verb__icontains=search)
    page = Paginator(events, PER_PAGE).get_page(request.GET.get("page"))
    return render(request, "people/audit.html", {"page": page, "search": search})


@require_safe
def health_page(request: SignedIn) -> HttpResponse:
    versions = {
        "Python": platform.python_version(),
        "Django": django.get_version(),
        "NumPy": np.__version__,
        "Database": connection.vendor,
    }
    return render(request, "people/health.html", {"findings": signs(), "versions": versions})


@require_safe
def help_page(request: SignedIn) -> HttpResponse:
    return render(request, "people/help.html")
