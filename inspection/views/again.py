"""Computing many scans again: choosing them, following the batch, cancelling and resuming it."""

from __future__ import annotations

from collections.abc import Callable

from django.http import HttpResponse
from django.shortcuts import redirect, render
from django.views.decorators.http import require_POST, require_safe

from inspection.forms.again import AgainForm
from inspection.models import Recomputation, RecomputationBatch, User
from inspection.services import again
from inspection.views.scans import STOP_POLLING
from inspection.views.signed_in import SignedIn, back_with_fault, form_page, found, refused, said
from scanning.errors import Fault

#: Failed orders shown with their sentence; more say nothing new.
MOST_FAILED = 50


def again_page(request: SignedIn) -> HttpResponse:
    """Choose; the first press of the button says how many scans that are, the second starts them."""
    form = AgainForm(request.POST or None)
    count = None
    if request.method == "POST" and form.is_valid():
        scans = form.chosen()
        count = scans.count()
        if "start" in request.POST:
            try:
                batch = again.compute_many_again(
                    list(scans), form.cleaned_data["recipe"], request.user, form.cleaned_data["reason"]
                )
            except Fault as fault:
                refused(form, fault)
            else:
                said(request, f"{count} scans are computed again. Their earlier results stay.")
                return redirect(batch)
    rows = [(batch, again.counts(batch)) for batch in RecomputationBatch.objects.select_related("recipe")[:20]]
    return form_page(request, "scan/again.html", form, count=count, rows=rows)


@require_safe
def batch_page(request: SignedIn, pk: int) -> HttpResponse:
    batch = found(RecomputationBatch.objects.select_related("recipe", "requested_by"), pk=pk)
    counted = again.counts(batch)
    total = sum(counted.values())
    waiting = counted["queued"] + counted["running"]
    failed = batch.orders.filter(state=Recomputation.State.FAILED).select_related("scan__region__tool")[:MOST_FAILED]
    context = {
        "batch": batch, "counts": counted, "total": total, "waiting": waiting, "failed": failed,
        "percent": 100 * (total - waiting) // max(total, 1),
    }  # fmt: skip
    response = render(request, "scan/_again_batch.html" if request.htmx else "scan/again_batch.html", context)
    if request.htmx and not waiting:
        response.status_code = STOP_POLLING
        response["HX-Refresh"] = "true"
    return response


def _asked(
    request: SignedIn, pk: int, act: Callable[[RecomputationBatch, User | None], int], sentence: str
) -> HttpResponse:
    batch = found(RecomputationBatch, pk=pk)
    try:
        count = act(batch, request.user)
    except Fault as fault:
        return back_with_fault(request, fault, batch.get_absolute_url())
    said(request, sentence.format(count))
    return redirect(batch)


@require_POST
def batch_cancel(request: SignedIn, pk: int) -> HttpResponse:
    return _asked(request, pk, again.cancel_batch, "{} scans were taken out. What is being computed is finished.")


@require_POST
def batch_resume(request: SignedIn, pk: int) -> HttpResponse:
    return _asked(request, pk, again.resume_batch, "{} scans wait to be computed again.")
