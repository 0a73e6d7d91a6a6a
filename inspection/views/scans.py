"""A scan: its progress while it runs, its result afterwards, and what a person may ask of it. And the whole visit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from django.http import HttpResponse, HttpResponseNotModified
from django.shortcuts import redirect, render
from django.views.decorators.http import require_POST, require_safe

from inspection.models import Inspection, Measurement, RangeImage, Recipe, Scan, User
from inspection.selectors.overview import worst
from inspection.selectors.range_view import check_same_pitch
from inspection.selectors.scan import ScanPage, comparable, progress, progress_version, scan_state
from inspection.selectors.tool import key_numbers, numbers
from inspection.services import queue
from inspection.services.continuing import can_continue, continue_scan
from inspection.views.signed_in import SignedIn, back_with_fault, found, said
from scanning.errors import Fault

#: htmx takes the fragment and stops asking.
STOP_POLLING: Final = 286
#: End of the fixed colour scale without a depth limit: our "large" damage begins here.
DEPTH_SCALE_UM: Final = 150.0


def _scan(pk: int) -> Scan:
    return found(
        Scan.objects.select_related(
            "region__tool__tool_type", "inspection", "rig", "recipe", "calibration", "limit_set", "requested_by"
        ),
        pk=pk,
    )


def _number(text: str | None) -> int | None:
    return int(text) if text and text.isascii() and text.isdigit() else None


@require_safe
def scan_page(request: SignedIn, pk: int) -> HttpResponse:
    scan = _scan(pk)
    page = scan_state(scan, _number(request.GET.get("result")))
    context = {
        "scan": scan,
        "tool": scan.region.tool,
        "page": page,
        "result": page.result,
        "progress": progress(scan),
        "start_mm": scan.plan.get("start_mm", scan.region.start_mm),
        "fixed_um": _fixed_scale_um(page),
        "recipes": Recipe.objects.all() if scan.has_ended and scan.stack_file else [],
        "can_continue": can_continue(scan),
        "siblings": scan.inspection.scans.select_related("region").order_by("region__name", "pk"),
    }
    return render(request, "scan/scan.html", context)


def _fixed_scale_um(page: ScanPage) -> float:
    """Depth at which the colour scale ends when it is not stretched: the replace limit, the same for every scan."""
    for number in page.result.numbers if page.result else []:
        if number.measurement.metric == "d_max" and number.limit and number.limit.replace_above:
            return number.limit.replace_above
    return DEPTH_SCALE_UM


@require_safe
def scan_progress(request: SignedIn, pk: int) -> HttpResponse:
    """The live part of the page, asked for every second; cheap while nothing moves, 286 once it has ended."""
    scan = found(Scan.objects.select_related("region__tool", "rig", "requested_by"), pk=pk)
    tag = f'"{progress_version(scan)}-{request.user.role}"'
    if scan.is_live and request.headers.get("If-None-Match") == tag:
        return HttpResponseNotModified(headers={"ETag": tag})
    response = render(
        request, "scan/_progress.html", {"scan": scan, "progress": progress(scan), "tool": scan.region.tool}
    )
    if scan.has_ended:
        response.status_code = STOP_POLLING
        response["HX-Refresh"] = "true"  # the page becomes the result
    response["ETag"] = tag
    response["Cache-Control"] = "private, no-cache"
    return response


def _asked(request: SignedIn, pk: int, ask: Callable[[Scan, User | None], object], sentence: str) -> HttpResponse:
    scan = _scan(pk)
    to: Scan | str = scan
    if request.POST.get("from") == "queue":
        to = scan.rig.get_absolute_url()
    try:
        ask(scan, request.user)
    except Fault as fault:
        return back_with_fault(request, fault, to)
    said(request, sentence)
    return redirect(to)


@require_POST
def scan_cancel(request: SignedIn, pk: int) -> HttpResponse:
    return _asked(request, pk, queue.cancel_scan, "Cancelled. A scan on the rig stops at its next step and parks.")


@require_POST
def scan_pause(request: SignedIn, pk: int) -> HttpResponse:
    return _asked(request, pk, queue.pause_scan, "Pausing at the next step: laser off, stage parked.")


@require_POST
def scan_resume(request: SignedIn, pk: int) -> HttpResponse:
    return _asked(request, pk, queue.resume_scan, "Going on: the stage homes again and continues where it stopped.")


@require_POST
def scan_finish(request: SignedIn, pk: int) -> HttpResponse:
    return _asked(
        request, pk, queue.finish_early, "Finishing early: what was scanned so far is kept and marked partial."
    )


@require_POST
def scan_continue(request: SignedIn, pk: int) -> HttpResponse:
    """Go on with a scan that broke off; the box says that somebody has looked at the rig."""
    looked = request.POST.get("looked") == "1"
    return _asked(
        request,
        pk,
        lambda scan, by: continue_scan(scan, by, looked=looked),
        "It goes on where it broke off, first in the queue: the frames are verified and the stage homes again.",
    )


@require_POST
def scan_again(request: SignedIn, pk: int) -> HttpResponse:
    scan = _scan(pk)
    try:
        again = queue.scan_again(scan, request.user)
    except Fault as fault:
        return back_with_fault(request, fault, scan)
    said(request, f"Queued again as scan {again.pk}, next on {again.rig}.")
    return redirect(again)


@require_POST
def scan_reprocess(request: SignedIn, pk: int) -> HttpResponse:
    scan = _scan(pk)
    recipe = found(Recipe, pk=_number(request.POST.get("recipe")) or 0)
    try:
        queue.reprocess(scan, request.user, recipe)
    except Fault as fault:
        return back_with_fault(request, fault, scan)
    said(request, f"Computing again with {recipe.name}. The earlier results stay; reload to see the new one.")
    return redirect(scan)


@require_safe
def scan_compare(request: SignedIn, pk: int) -> HttpResponse:
    """This scan minus an earlier one of the same region."""
    scan = found(Scan.objects.select_related("region__tool", "inspection"), pk=pk)
    others = comparable(scan)
    mine = scan.range_images.prefetch_related("measurements").first()
    chosen = next((image for image in others if image.pk == _number(request.GET.get("with"))), None)
    if chosen is None:
        earlier = [
            image
            for image in others
            if scan.finished_at and (image.scan.finished_at or image.created_at) < scan.finished_at
        ]
        chosen = next(iter(earlier or others), None)
    rows, fault = [], ""
    if mine and chosen:
        try:
            check_same_pitch(mine, chosen)
        except Fault as caught:
            fault = str(caught)
        before = {m.metric: m for m in chosen.measurements.all()}
        rows = [_changed(m, before[m.metric]) for m in mine.measurements.all() if m.metric in before]
    context = {
        "scan": scan,
        "tool": scan.region.tool,
        "mine": mine,
        "other": chosen,
        "others": others,
        "rows": rows,
        "fault": fault,
    }
    return render(request, "scan/compare.html", context)


def _changed(now: Measurement, before: Measurement) -> dict[str, Any]:
    """One metric then and now. A change is real when it is larger than its own expanded uncertainty (k = 2)."""
    delta = None if now.value is None or before.value is None else now.value - before.value
    u = _joint_u(now.u, before.u)
    real = delta is not None and u is not None and abs(delta) > 2 * u
    return {"now": now, "before": before, "delta": delta, "u": u, "real": real}


def _joint_u(a: float | None, b: float | None) -> float | None:
    """Standard uncertainty of a difference of two independent values."""
    return None if a is None or b is None else float((a * a + b * b) ** 0.5)


@require_safe
def inspection_page(request: SignedIn, pk: int) -> HttpResponse:
    """All regions of one visit together are the verdict of the visit."""
    visit = found(Inspection.objects.select_related("tool__tool_type", "requested_by"), pk=pk)
    scans = list(visit.scans.select_related("region", "rig", "recipe").order_by("region__name", "-queued_at"))
    images = (
        RangeImage.objects.filter(scan__in=scans)
        .select_related("limit_set")
        .prefetch_related("measurements", "damages", "limit_set__limits")
        .order_by("created_at", "pk")
    )
    newest = {image.scan_id: image for image in images}
    rows = _one_per_region(scans, newest)
    context = {
        "visit": visit,
        "tool": visit.tool,
        "rows": rows,
        "verdict": worst(row["image"].verdict if row["image"] else None for row in rows),
        "live": any(scan.is_live for scan in scans),
        "repeated": len(scans) - len(rows),
    }
    template = "scan/_inspection_rows.html" if request.htmx else "scan/inspection.html"
    response = render(request, template, context)
    if request.htmx and not context["live"]:
        response.status_code = STOP_POLLING
        response["HX-Refresh"] = "true"
    return response


def _one_per_region(scans: list[Scan], newest: dict[int, RangeImage]) -> list[dict[str, Any]]:
    """The scan that speaks for each region: the newest one with a result, otherwise the newest."""
    chosen: dict[int, Scan] = {}
    for scan in scans:  # newest first within a region
        present = chosen.get(scan.region_id)
        if present is None or (present.pk not in newest and not present.is_live and scan.pk in newest):
            chosen[scan.region_id] = scan
    rows = []
    for scan in chosen.values():
        image = newest.get(scan.pk)
        rows.append(
            {
                "scan": scan,
                "image": image,
                "numbers": key_numbers(numbers(image)) if image else [],
                "progress": progress(scan),
            }
        )
    return rows
