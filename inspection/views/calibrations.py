"""Calibrations: what holds for each rig, how good it is, and a new one, looked at before it counts."""

from __future__ import annotations

from django.http import HttpResponse
from django.shortcuts import redirect, render
from django.utils import timezone
from django.views.decorators.http import require_safe

from inspection.forms.measuring import CalibrationForm
from inspection.models import Calibration, Rig
from inspection.selectors.calibration import calibrations_by_rig, colour, fit_chart, stored_chart
from inspection.services.calibrations import add_calibration, fit_pairs
from inspection.views.signed_in import SignedIn, form_page, found, refused, said
from scanning.calibration import standing
from scanning.errors import Fault


@require_safe
def calibrations_page(request: SignedIn) -> HttpResponse:
    today = timezone.localdate()
    return render(request, "rig/calibrations.html", {"rows": calibrations_by_rig(today), "today": today})


@require_safe
def calibration_page(request: SignedIn, pk: int) -> HttpResponse:
    calibration = found(Calibration.objects.select_related("rig", "by"), pk=pk)
    today = timezone.localdate()
    context = {
        "calibration": calibration,
        "current": calibration.rig.calibration_now() == calibration,
        "colour": colour(calibration, today),
        "standing": standing(calibration.valid_until, today)[1],
        "chart": stored_chart(calibration),
        "u_slope_percent": 100 * calibration.u_slope_mm_per_px / abs(calibration.slope_mm_per_px),
        "scans": calibration.scans.count(),
    }
    return render(request, "rig/calibration.html", context)


def calibration_new(request: SignedIn) -> HttpResponse:
    """First look at the fit, then put it in force. The pairs travel as text, so the file is chosen once."""
    form = CalibrationForm(request.POST or None, request.FILES or None, initial={"rig": request.GET.get("rig")})
    fit = chart = None
    if request.method == "POST" and form.is_valid():
        data = form.cleaned_data
        try:
            # An uploaded file wins over pasted text: it was chosen last.
            source = data["csv_file"] or data["pairs"]
            fit = fit_pairs(source, artefact=data["artefact"], done_on=data["done_on"], valid_until=data["valid_until"])
            if "confirm" in request.POST:
                text = _as_csv(fit.heights_mm, fit.columns_px)
                row = add_calibration(
                    rig=data["rig"],
                    csv_file=text,
                    by=request.user,
                    artefact=data["artefact"],
                    done_on=data["done_on"],
                    valid_until=data["valid_until"],
                )
                said(request, f"In force for {row.rig} until {row.valid_until:%Y-%m-%d}.")
                return redirect(row)
        except Fault as fault:
            refused(form, fault)
            fit = None
    if fit is not None:
        chart = fit_chart(fit)
        # The file cannot be put back into the page, its content can.
        kept = request.POST.copy()
        kept["pairs"] = _as_csv(fit.heights_mm, fit.columns_px)
        form.data = kept
    return form_page(request, "rig/calibration_new.html", form, fit=fit, chart=chart, rigs=Rig.objects.exists())


def _as_csv(heights_mm: tuple[float, ...], columns_px: tuple[float, ...]) -> str:
    rows = [f"{height!r},{column!r}" for height, column in zip(heights_mm, columns_px, strict=True)]
    return "\n".join(["height_mm,column_px", *rows])
