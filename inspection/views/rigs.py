"""Rigs and their queues: what waits and why, in which order, and stopping the queue or the rig."""

from __future__ import annotations

from collections.abc import Callable

from django.contrib import messages
from django.http import HttpResponse
from django.shortcuts import redirect, render
from django.views.decorators.http import require_POST, require_safe

from inspection.forms.again import CartForm
from inspection.models import Rig, Scan
from inspection.selectors.queue import queue_view
from inspection.services import queue
from inspection.services.carts import order_cart
from inspection.services.emergency import emergency_stop
from inspection.views.signed_in import SignedIn, form_page, found, refused, said
from scanning.errors import Fault

#: Where a waiting scan can go, the icon, and what its button says.
MOVES = [("next", "next", "Run next"), ("up", "up", "Up"), ("down", "down", "Down")]


@require_safe
def rigs_page(request: SignedIn) -> HttpResponse:
    rigs = list(Rig.objects.all())
    if len(rigs) == 1:
        return redirect(rigs[0])
    return render(request, "rig/rigs.html", {"rows": [queue_view(rig) for rig in rigs]})


@require_safe
def queue_page(request: SignedIn, slug: str) -> HttpResponse:
    rig = found(Rig.objects.select_related("queue_owner"), slug=slug)
    ended = (
        rig.scans.filter(finished_at__isnull=False)
        .select_related("region__tool", "inspection")
        .order_by("-finished_at")[:12]
    )
    context = {"rig": rig, "queue": queue_view(rig, ended=0), "ended": ended, "rigs": Rig.objects.all(), "moves": MOVES}
    return render(request, "rig/queue.html", context)


@require_safe
def queue_rows(request: SignedIn, slug: str) -> HttpResponse:
    return _rows(request, found(Rig.objects.select_related("queue_owner"), slug=slug))


def _rows(request: SignedIn, rig: Rig, fault: str = "") -> HttpResponse:
    return render(
        request, "rig/_queue.html", {"rig": rig, "queue": queue_view(rig, ended=0), "fault": fault, "moves": MOVES}
    )


def _answer(request: SignedIn, rig: Rig, act: Callable[[], object]) -> HttpResponse:
    """Do it and show the queue: the fragment for htmx, the page otherwise."""
    fault = ""
    try:
        act()
    except Fault as caught:
        fault = str(caught)
    if request.htmx:
        rig.refresh_from_db()
        return _rows(request, rig, fault)
    if fault:
        messages.error(request, fault)
    return redirect(rig)


@require_POST
def queue_move(request: SignedIn, slug: str, pk: int) -> HttpResponse:
    rig = found(Rig, slug=slug)
    scan = found(Scan.objects.filter(rig=rig), pk=pk)
    return _answer(request, rig, lambda: queue.move_scan(scan, request.user, where=request.POST.get("where", "")))


@require_POST
def queue_pause(request: SignedIn, slug: str) -> HttpResponse:
    rig = found(Rig, slug=slug)
    return _answer(request, rig, lambda: queue.pause_queue(rig, request.user, request.POST.get("reason", "")))


@require_POST
def queue_resume(request: SignedIn, slug: str) -> HttpResponse:
    rig = found(Rig, slug=slug)
    return _answer(request, rig, lambda: queue.resume_queue(rig, request.user))


@require_POST
def queue_lock(request: SignedIn, slug: str) -> HttpResponse:
    rig = found(Rig, slug=slug)
    return _answer(request, rig, lambda: queue.lock_rig(rig, request.user, request.POST.get("note", "")))


@require_POST
def queue_stop(request: SignedIn, slug: str) -> HttpResponse:
    """The emergency stop. It never answers with a refusal: pressed twice, it has been pressed."""
    rig = found(Rig, slug=slug)
    if emergency_stop(rig, request.user):
        messages.error(request, "Emergency stop: the stage is halted and the laser goes off. Look at the rig.")
    else:
        messages.error(request, "Emergency stop: no scan was on the rig; its queue is paused.")
    if request.htmx:
        response = HttpResponse(status=204)
        response["HX-Refresh"] = "true"
        return response
    return redirect(rig)


def queue_cart(request: SignedIn, slug: str) -> HttpResponse:
    """Order a cart of tools."""
    rig = found(Rig, slug=slug)
    form = CartForm(request.POST or None)
    if request.method == "POST" and form.is_valid():
        try:
            visits = order_cart(
                codes=form.cleaned_data["codes"].split(), rig=rig, by=request.user, reason=form.cleaned_data["reason"]
            )
        except Fault as fault:
            refused(form, fault)
        else:
            said(request, f"Queued on {rig}: {', '.join(visit.tool.code for visit in visits)}.")
            return redirect(rig)
    return form_page(request, "rig/cart.html", form, rig=rig)


@require_POST
def queue_unlock(request: SignedIn, slug: str) -> HttpResponse:
    rig = found(Rig, slug=slug)
    return _answer(request, rig, lambda: queue.unlock_rig(rig, request.user))
