"""Forms about tools, their regions, and what happens to them."""

from __future__ import annotations

from typing import Any

from django import forms
from django.utils import timezone

from inspection.models import Event, Region, Tool, ToolType


class ToolTypeForm(forms.ModelForm):  # type: ignore[type-arg]  # not subscriptable at run time
    class Meta:
        model = ToolType
        fields = ("name", "edge_length_mm", "bevel_angle_deg", "life_unit", "note")
        widgets = {"note": forms.Textarea(attrs={"rows": 3})}
        labels = {
            "edge_length_mm": "Edge length (mm)",
            "bevel_angle_deg": "Bevel angle (degrees)",
            "life_unit": "Use is counted in",
        }

    def _post_clean(self) -> None:
        """The service checks and saves; a model form would write half of it into the row first."""


class ToolForm(forms.ModelForm):  # type: ignore[type-arg]  # not subscriptable at run time
    class Meta:
        model = Tool
        fields = ("code", "tool_type", "location", "status", "life_used", "note")
        widgets = {"note": forms.Textarea(attrs={"rows": 3})}
        labels = {"life_used": "Use so far", "tool_type": "Tool type"}

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.fields["life_used"].required = False
        if self.instance.pk:
            # What a tool is decides its limits; another type is another tool.
            del self.fields["tool_type"]
        elif ToolType.objects.count() == 1:
            self.initial["tool_type"] = self.initial.get("tool_type") or ToolType.objects.get()

    def clean_life_used(self) -> float:
        return self.cleaned_data["life_used"] or 0.0

    def _post_clean(self) -> None:
        """See ToolTypeForm."""


class RegionForm(forms.ModelForm):  # type: ignore[type-arg]  # not subscriptable at run time
    class Meta:
        model = Region
        fields = ("name", "start_mm", "length_mm", "row_offset", "rows", "flat_row", "flat_rows", "active")
        labels = {
            "start_mm": "Starts at, along the stage",
            "length_mm": "Length",
            "row_offset": "First sensor row",
            "rows": "Sensor rows",
            "flat_row": "Flat part: first row",
            "flat_rows": "Flat part: rows",
            "active": "Scan this region",
        }
        widgets = {
            "start_mm": forms.NumberInput(attrs={"step": "any"}),
            "length_mm": forms.NumberInput(attrs={"step": "any"}),
        }
        help_texts = {
            "rows": "Rows lie along the laser line, across the bevel.",
            "flat_rows": "Undamaged ground bevel: the precision report's sigma is taken there.",
        }

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        for name in ("start_mm", "length_mm"):
            if isinstance(self.initial.get(name), float):
                self.initial[name] = round(self.initial[name], 6)  # sums of step lengths end in 0000000003

    def _post_clean(self) -> None:
        """See ToolTypeForm."""


class EventForm(forms.ModelForm):  # type: ignore[type-arg]  # not subscriptable at run time
    class Meta:
        model = Event
        fields = ("kind", "at", "life_used", "removed_mm", "note")
        widgets = {"at": forms.DateTimeInput(attrs={"type": "datetime-local"}, format="%Y-%m-%dT%H:%M")}
        labels = {
            "kind": "What happened",
            "at": "When",
            "life_used": "Use at that moment",
            "removed_mm": "Stock removed",
        }
        help_texts = {"removed_mm": ""}

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.fields["at"].input_formats = ["%Y-%m-%dT%H:%M", "%Y-%m-%dT%H:%M:%S"]  # type: ignore[attr-defined]
        if not self.is_bound:
            self.initial["at"] = timezone.localtime().strftime("%Y-%m-%dT%H:%M")

    def _post_clean(self) -> None:
        """See ToolTypeForm."""
