"""The first page: every tool, worst first; and the field a code scanner types into."""

from __future__ import annotations

from django.contrib import messages
from django.http import HttpResponse
from django.shortcuts import redirect, render
from django.utils import timezone
from django.views.decorators.http import require_safe

from inspection.models import Rig, Tool
from inspection.selectors.overview import find_tools, overview
from inspection.views.signed_in import SignedIn


@require_safe
def overview_page(request: SignedIn) -> HttpResponse:
    today = timezone.localdate()
    asked = {key: request.GET.get(key, "").strip() for key in ("search", "verdict", "status")}
    context = {
        "overview": overview(**asked, today=today),
        "asked": asked,
        "statuses": Tool.Status.choices,
        "today": today,
        "rigs": Rig.objects.filter(active=True),
    }
    template = "plant/_overview_rows.html" if request.htmx else "plant/overview.html"
    return render(request, template, context)


@require_safe
def tool_lookup(request: SignedIn) -> HttpResponse:
    """A scanner types the code and Enter: an exact or only match opens the tool, several show the list."""
    code = request.GET.get("search", "").strip()
    if not code:
        return redirect("overview")
    tools = find_tools(code)
    if len(tools) == 1:
        return redirect(tools[0])
    if not tools:
        messages.error(request, f"No tool has the code “{code}”. Check the label, or add the tool.")
    response = redirect("overview")
    response["Location"] += f"?{request.GET.urlencode()}"
    return response
