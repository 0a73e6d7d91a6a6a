"""The rules results come from: recipes, and the limits of each tool type with their history."""

from __future__ import annotations

import json

from django.db.models import Count
from django.http import HttpResponse
from django.shortcuts import redirect, render
from django.views.decorators.http import require_safe

from inspection.forms.measuring import LimitsForm
from inspection.models import LimitSet, Measurement, Recipe, ToolType
from inspection.services.limits import DEFAULT_LIMITS, set_limits
from inspection.views.signed_in import SignedIn, form_page, found, refused, said
from scanning.errors import Fault


@require_safe
def recipes_page(request: SignedIn) -> HttpResponse:
    recipes = Recipe.objects.annotate(results=Count("range_images")).order_by("name", "-pk")
    return render(request, "rig/recipes.html", {"recipes": recipes})


@require_safe
def recipe_page(request: SignedIn, pk: int) -> HttpResponse:
    recipe = found(Recipe, pk=pk)
    definition = json.dumps(recipe.definition, indent=2, ensure_ascii=False)
    return render(request, "rig/recipe.html", {"recipe": recipe, "definition": definition})


@require_safe
def limits_page(request: SignedIn) -> HttpResponse:
    types = ToolType.objects.annotate(tool_count=Count("tools")).prefetch_related("limit_sets__limits")
    return render(request, "plant/limits.html", {"types": types})


def _labels() -> dict[str, str]:
    """What each metric is called, from the newest measurement of it."""
    return dict(Measurement.objects.order_by("pk").values_list("metric", "label").distinct())


@require_safe
def limits_history(request: SignedIn, pk: int) -> HttpResponse:
    tool_type = found(ToolType, pk=pk)
    sets = tool_type.limit_sets.select_related("by").prefetch_related("limits").annotate(results=Count("scans"))
    labels = _labels()
    rows = [
        {"set": row, "limits": [(labels.get(limit.metric, limit.metric), limit) for limit in row.limits.all()]}
        for row in sets
    ]
    return render(request, "plant/limits_history.html", {"tool_type": tool_type, "rows": rows})


def limits_edit(request: SignedIn, pk: int) -> HttpResponse:
    tool_type = found(ToolType, pk=pk)
    current = LimitSet.objects.filter(tool_type=tool_type).prefetch_related("limits").first()
    form = LimitsForm(request.POST or None, metrics=_limitable(tool_type, current), current=current)
    if request.method == "POST" and form.is_valid():
        try:
            row = set_limits(tool_type, form.limits(), by=request.user, reason=form.cleaned_data["reason"])
        except Fault as fault:
            refused(form, fault)
        else:
            said(
                request, f"Limits v{row.version} are in force for scans ordered from now on. Old verdicts keep theirs."
            )
            return redirect("limits-history", tool_type.pk)
    return form_page(request, "plant/limits_form.html", form, tool_type=tool_type, current=current)


def _limitable(tool_type: ToolType, current: LimitSet | None) -> list[tuple[str, str, str]]:
    """(metric, label, unit) of all that may have a limit: those that have one, the defaults, whatever was measured."""
    labels = _labels()
    units = {limit.metric: limit.unit for limit in current.limits.all()} if current else {}
    for metric, (_watch, _replace, unit) in DEFAULT_LIMITS.items():
        units.setdefault(metric, unit)
    measured = (
        Measurement.objects.filter(range_image__scan__region__tool__tool_type=tool_type, value__isnull=False)
        .order_by()
        .values_list("metric", "unit")
        .distinct()
    )
    for metric, unit in measured:
        units.setdefault(metric, unit)
    return [(metric, labels.get(metric, metric), unit) for metric, unit in units.items()]
