"""Taking in a stack that other software recorded."""

from __future__ import annotations

from django.http import HttpResponse
from django.shortcuts import redirect

from inspection.forms.orders import ImportForm
from inspection.models import Region
from inspection.services.importing import discard_upload, import_stack, unpack_upload
from inspection.views.signed_in import SignedIn, form_page, refused, said
from scanning.errors import Fault


def import_page(request: SignedIn) -> HttpResponse:
    """All or nothing: a fault is one sentence on the form and nothing stays behind."""
    form = ImportForm(request.POST or None, request.FILES or None, initial={"region": request.GET.get("region")})
    if request.method == "POST" and form.is_valid():
        data = form.cleaned_data
        folder = None
        try:
            folder = unpack_upload(data["stack"])
            scan = import_stack(
                folder,
                region=data["region"],
                rig=data["rig"],
                by=request.user,
                recipe=data["recipe"],
                original_name=data["stack"][0].name or "",
                calibration=data["rig"].calibration_now() if data["use_calibration"] else None,
            )
        except Fault as fault:
            refused(form, fault)
        else:
            said(request, f"Imported as scan {scan.pk} of {scan.region}.")
            return redirect(scan)
        finally:
            if folder is not None:
                discard_upload(folder)
    return form_page(request, "scan/import.html", form, regions=Region.objects.filter(active=True).exists())
