"""A tool: its verdict, its regions, what happened to it, and ordering a scan of it."""

from __future__ import annotations

from django.http import HttpResponse, JsonResponse
from django.shortcuts import redirect, render
from django.views.decorators.http import require_POST, require_safe

from inspection.forms.orders import ScanOrderForm
from inspection.forms.plant import EventForm, RegionForm, ToolForm, ToolTypeForm
from inspection.models import Region, Rig, Tool, ToolType
from inspection.selectors.tool import tool_state, trend_metrics
from inspection.selectors.trend import tool_trends
from inspection.services import plant
from inspection.services.queue import enqueue_inspection
from inspection.views.signed_in import SignedIn, form_page, found, refused, said
from scanning.errors import Fault


def _tool(pk: int) -> Tool:
    return found(Tool.objects.select_related("tool_type"), pk=pk)


@require_safe
def tool_page(request: SignedIn, pk: int) -> HttpResponse:
    return _tool_page(request, _tool(pk), EventForm(prefix="event"))


def _tool_page(request: SignedIn, tool: Tool, event_form: EventForm) -> HttpResponse:
    context = {
        "tool": tool,
        "state": tool_state(tool),
        "metrics": trend_metrics(tool),
        "event_form": event_form,
        "rigs": Rig.objects.filter(active=True),
    }
    return render(request, "plant/tool.html", context, status=422 if event_form.errors else 200)


@require_safe
def tool_trend(request: SignedIn, pk: int) -> HttpResponse:
    """The history of one metric of all regions, for the chart."""
    tool = _tool(pk)
    metric = request.GET.get("metric", "")
    return JsonResponse({"series": tool_trends(tool, [metric]) if metric else []})


@require_POST
def tool_event(request: SignedIn, pk: int) -> HttpResponse:
    tool = _tool(pk)
    form = EventForm(request.POST, prefix="event")
    if form.is_valid():
        data = form.cleaned_data
        try:
            event = plant.record_event(
                tool,
                data["kind"],
                at=data["at"],
                by=request.user,
                life_used=data["life_used"],
                removed_mm=data["removed_mm"],
                note=data["note"],
            )
        except Fault as fault:
            refused(form, fault)
        else:
            said(request, f"Recorded: {tool.code} {event.get_kind_display().lower()}.")
            return redirect(tool)
    return _tool_page(request, tool, form)


def tool_new(request: SignedIn) -> HttpResponse:
    form = ToolForm(request.POST or None, initial={"tool_type": request.GET.get("type")})
    if request.method == "POST" and form.is_valid():
        try:
            tool = plant.create_tool(by=request.user, **form.cleaned_data)
        except Fault as fault:
            refused(form, fault)
        else:
            said(request, f"Tool {tool.code} is known now, with regions R1 to R3. Adjust them, then scan it.")
            return redirect(tool)
    return form_page(request, "plant/tool_form.html", form, types=ToolType.objects.exists())


def tool_edit(request: SignedIn, pk: int) -> HttpResponse:
    tool = _tool(pk)
    form = ToolForm(request.POST or None, instance=tool)
    if request.method == "POST" and form.is_valid():
        try:
            plant.update_tool(tool, by=request.user, **form.cleaned_data)
        except Fault as fault:
            refused(form, fault)
        else:
            said(request, "Saved.")
            return redirect(tool)
    return form_page(request, "plant/tool_form.html", form, tool=tool, types=True)


def region_new(request: SignedIn, pk: int) -> HttpResponse:
    tool = _tool(pk)
    form = RegionForm(request.POST or None, initial={"name": f"R{tool.regions.count() + 1}"})
    if request.method == "POST" and form.is_valid():
        values = {name: value for name, value in form.cleaned_data.items() if name != "active"}
        try:
            region = plant.create_region(tool, by=request.user, **values)
        except Fault as fault:
            refused(form, fault)
        else:
            said(request, f"Region {region.name} added.")
            return redirect(tool)
    return form_page(request, "plant/region_form.html", form, tool=tool, reach_mm=_reach_mm())


def region_edit(request: SignedIn, pk: int, region_pk: int) -> HttpResponse:
    region = found(Region.objects.select_related("tool__tool_type"), pk=region_pk, tool=pk)
    form = RegionForm(request.POST or None, instance=region)
    if request.method == "POST" and form.is_valid():
        try:
            plant.update_region(region, by=request.user, **form.cleaned_data)
        except Fault as fault:
            refused(form, fault)
        else:
            said(request, f"Region {region.name} saved. Scans already ordered keep their old positions.")
            return redirect(region.tool)
    return form_page(request, "plant/region_form.html", form, tool=region.tool, region=region, reach_mm=_reach_mm())


def _reach_mm() -> float | None:
    return max(Rig.objects.filter(active=True).values_list("travel_mm", flat=True), default=None)


def scan_order(request: SignedIn, pk: int) -> HttpResponse:
    """Order a scan of a tool's regions."""
    tool = _tool(pk)
    form = ScanOrderForm(
        request.POST or None, tool=tool, initial={"rig": request.GET.get("rig")} if "rig" in request.GET else {}
    )
    if request.method == "POST" and form.is_valid():
        data = form.cleaned_data
        try:
            inspection = enqueue_inspection(
                tool=tool,
                rig=data["rig"],
                by=request.user,
                regions=list(data["regions"]),
                recipe=data["recipe"],
                reason=data["reason"],
                exposures_us=data["exposures_us"],
            )
        except Fault as fault:
            refused(form, fault)
        else:
            said(request, f"Queued on {data['rig']}: {tool.code} {', '.join(r.name for r in data['regions'])}.")
            return redirect(inspection)
    rigs = Rig.objects.filter(active=True)
    return form_page(request, "scan/order.html", form, tool=tool, rigs=rigs)


def tool_type_new(request: SignedIn) -> HttpResponse:
    form = ToolTypeForm(request.POST or None)
    if request.method == "POST" and form.is_valid():
        try:
            tool_type = plant.create_tool_type(by=request.user, **form.cleaned_data)
        except Fault as fault:
            refused(form, fault)
        else:
            said(request, f"Tool type {tool_type.name} added with the default limits. Check them here.")
            return redirect("limits-history", tool_type.pk)
    return form_page(request, "plant/tool_type_form.html", form)


def tool_type_edit(request: SignedIn, pk: int) -> HttpResponse:
    tool_type = found(ToolType, pk=pk)
    form = ToolTypeForm(request.POST or None, instance=tool_type)
    if request.method == "POST" and form.is_valid():
        try:
            plant.update_tool_type(tool_type, by=request.user, **form.cleaned_data)
        except Fault as fault:
            refused(form, fault)
        else:
            said(request, "Saved.")
            return redirect("limits-history", tool_type.pk)
    return form_page(request, "plant/tool_type_form.html", form, tool_type=tool_type)
