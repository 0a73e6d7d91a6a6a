"""Forms that put work before a rig: a scan order, a rule for rescans, a recorded stack."""

from __future__ import annotations

import datetime as dt
from typing import Any

from django import forms
from django.core.files.uploadedfile import UploadedFile
from django.utils import timezone

from inspection.models import Recipe, Region, Rig, Schedule, Tool


class RecipeChoice(forms.ModelChoiceField):  # type: ignore[type-arg]  # not subscriptable at run time
    def label_from_instance(self, obj: Any) -> str:
        return f"{obj.name} ({obj.sha256[:8]})"


class ScanOrderForm(forms.Form):
    """Which regions of a tool, on which rig, by which recipe, and why."""

    rig = forms.ModelChoiceField(Rig.objects.none(), empty_label=None)
    regions = forms.ModelMultipleChoiceField(Region.objects.none(), widget=forms.CheckboxSelectMultiple)
    recipe = RecipeChoice(Recipe.objects.none(), required=False, empty_label="The rig's usual recipe")
    exposures_us = forms.CharField(
        label="Exposures (µs)",
        required=False,
        help_text="Comma-separated, for example 100, 300, 900. Empty takes the rig's own bracket.",
    )
    reason = forms.CharField(
        max_length=200, required=False, help_text="For example “after collision” or “weekly check”."
    )

    def __init__(self, *args: Any, tool: Tool, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.fields["rig"].queryset = Rig.objects.filter(active=True)  # type: ignore[attr-defined]
        regions = tool.regions.filter(active=True)
        self.fields["regions"].queryset = regions  # type: ignore[attr-defined]
        self.fields["regions"].label_from_instance = lambda region: (  # type: ignore[attr-defined]
            f"{region.name}: {region.start_mm:.2f} to {region.start_mm + region.length_mm:.2f} mm"
        )
        self.fields["recipe"].queryset = Recipe.objects.all()  # type: ignore[attr-defined]
        self.initial.setdefault("regions", [region.pk for region in regions])
        self.initial.setdefault("rig", Rig.objects.filter(active=True).first())

    def clean_exposures_us(self) -> list[float] | None:
        text = self.cleaned_data["exposures_us"].strip()
        if not text:
            return None
        try:
            return [float(part) for part in text.replace(";", ",").split(",") if part.strip()]
        except ValueError:
            raise forms.ValidationError(
                f"“{text}” is not a list of times. Write microseconds with commas between, such as 100, 300, 900."
            ) from None


class ScheduleForm(forms.ModelForm):  # type: ignore[type-arg]  # not subscriptable at run time
    class Meta:
        model = Schedule
        fields = (
            "tool",
            "rig",
            "recipe",
            "every",
            "unit",
            "next_due",
            "window_before_days",
            "window_after_days",
            "queue_after",
            "automatic",
            "enabled",
        )
        widgets = {
            "next_due": forms.DateInput(attrs={"type": "date"}, format="%Y-%m-%d"),
            "queue_after": forms.TimeInput(attrs={"type": "time"}, format="%H:%M"),
        }
        labels = {
            "every": "Every",
            "unit": "Unit",
            "next_due": "Next due on",
            "window_before_days": "May be early by (days)",
            "window_after_days": "May be late by (days)",
            "queue_after": "Not before (local time)",
            "automatic": "Queue it by itself on the due date",
            "enabled": "In force",
        }
        help_texts = {
            "window_after_days": "Yellow during this time, red after it.",
            "queue_after": "",
        }

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.fields["rig"].queryset = Rig.objects.filter(active=True)  # type: ignore[attr-defined]
        self.fields["recipe"].required = False
        self.fields["recipe"].empty_label = "The rig's usual recipe"  # type: ignore[attr-defined]
        self.initial.setdefault("queue_after", dt.time(6, 0))
        self.initial.setdefault("next_due", timezone.localdate() + dt.timedelta(days=7))
        if self.instance.pk:
            del self.fields["tool"]

    def _post_clean(self) -> None:
        """The service checks and saves."""


class ManyFiles(forms.FileInput):
    allow_multiple_selected = True


class FilesField(forms.FileField):
    """Several files in one field; cleaned to a list."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, widget=ManyFiles(attrs={"multiple": True}), **kwargs)

    def clean(self, data: Any, initial: Any = None) -> list[UploadedFile[Any]]:
        files = data if isinstance(data, list | tuple) else [data]
        return [super(FilesField, self).clean(file, initial) for file in files]


class ImportForm(forms.Form):
    """A stack that other software recorded, and the region it shows."""

    region = forms.ModelChoiceField(
        Region.objects.none(), label="Tool and region", empty_label="Choose what the stack shows"
    )
    rig = forms.ModelChoiceField(Rig.objects.none(), empty_label=None)
    use_calibration = forms.BooleanField(
        label="Recorded on this rig, so its calibration holds",
        required=False,
        help_text="Otherwise heights rest on the stack's own mm_per_pixel and the verdict stays unknown.",
    )
    recipe = RecipeChoice(Recipe.objects.none(), required=False, empty_label="What fits the recorded exposures")
    stack = FilesField(
        label="Files",
        help_text="One zip of the stack folder, or all its files at once: stack.json and the TIFF or PNG frames.",
    )

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        regions = Region.objects.filter(active=True).select_related("tool").order_by("tool__code", "name")
        self.fields["region"].queryset = regions  # type: ignore[attr-defined]
        self.fields["rig"].queryset = Rig.objects.filter(active=True)  # type: ignore[attr-defined]
        self.fields["recipe"].queryset = Recipe.objects.all()  # type: ignore[attr-defined]
        self.initial.setdefault("rig", Rig.objects.filter(active=True).first())
