"""When which tool is due."""

from __future__ import annotations

from django.http import HttpResponse
from django.shortcuts import redirect, render
from django.utils import timezone
from django.views.decorators.http import require_safe

from inspection.forms.orders import ScheduleForm
from inspection.models import DueSlot, Rig, Schedule, Tool
from inspection.selectors.due import due_list
from inspection.services.schedules import save_schedule
from inspection.views.signed_in import SignedIn, form_page, found, refused, said
from scanning.errors import Fault


@require_safe
def schedules_page(request: SignedIn) -> HttpResponse:
    rows = due_list(timezone.localdate())
    context = {
        "rows": rows,
        "disabled": Schedule.objects.filter(enabled=False).select_related("tool", "rig"),
        "overdue": sum(1 for row in rows if row.colour == "red"),
        "slots": DueSlot.objects.select_related("schedule__tool", "inspection")[:20],
    }
    return render(request, "plant/schedules.html", context)


def schedule_new(request: SignedIn) -> HttpResponse:
    form = ScheduleForm(
        request.POST or None, initial={"tool": request.GET.get("tool"), "rig": Rig.objects.filter(active=True).first()}
    )
    if request.method == "POST" and form.is_valid():
        try:
            row = save_schedule(by=request.user, **form.cleaned_data)
        except Fault as fault:
            refused(form, fault)
        else:
            said(request, f"{row.tool.code} is due on {row.next_due:%Y-%m-%d}, then every {row.every} {row.unit}.")
            return redirect("schedules")
    return form_page(request, "plant/schedule_form.html", form, tools=Tool.objects.exists())


def schedule_edit(request: SignedIn, pk: int) -> HttpResponse:
    schedule = found(Schedule.objects.select_related("tool"), pk=pk)
    form = ScheduleForm(request.POST or None, instance=schedule)
    if request.method == "POST" and form.is_valid():
        try:
            save_schedule(by=request.user, schedule=schedule, tool=schedule.tool, **form.cleaned_data)
        except Fault as fault:
            refused(form, fault)
        else:
            said(request, "Saved.")
            return redirect("schedules")
    return form_page(request, "plant/schedule_form.html", form, schedule=schedule, tools=True)
