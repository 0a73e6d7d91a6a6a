"""Which scans to compute again, with what, and why."""

from __future__ import annotations

from django import forms
from django.db.models import QuerySet

from inspection.forms.orders import RecipeChoice
from inspection.models import Recipe, Scan, ToolType
from inspection.states import ScanState


class AgainForm(forms.Form):
    """A choice among the finished scans that still have their frames."""

    recipe = RecipeChoice(Recipe.objects.none(), empty_label=None)
    tool_type = forms.ModelChoiceField(ToolType.objects.none(), required=False, empty_label="All tool types")
    tool = forms.CharField(max_length=40, required=False, label="Tool", help_text="Its code; empty takes all tools.")
    since = forms.DateField(
        required=False, label="Scanned since", widget=forms.DateInput(attrs={"type": "date"}, format="%Y-%m-%d"),
        help_text="Empty goes back to the first scan.",
    )  # fmt: skip
    newest_only = forms.BooleanField(
        required=False, label="Only the newest scan of each region", help_text="Enough to see today's tools anew."
    )
    reason = forms.CharField(max_length=200, label="Why", help_text="It is kept with the batch.")

    def __init__(self, *args: object, **kwargs: object) -> None:
        super().__init__(*args, **kwargs)  # type: ignore[arg-type]
        self.fields["recipe"].queryset = Recipe.objects.order_by("name", "-pk")  # type: ignore[attr-defined]
        self.fields["tool_type"].queryset = ToolType.objects.all()  # type: ignore[attr-defined]

    def chosen(self) -> QuerySet[Scan]:
        """The scans of this choice, oldest first. Call it when the form is valid."""
        data = self.cleaned_data
        scans = Scan.objects.filter(state=ScanState.DONE).exclude(stack_file="").select_related("region__tool")
        if data["tool_type"]:
            scans = scans.filter(region__tool__tool_type=data["tool_type"])
        if data["tool"].strip():
            scans = scans.filter(region__tool__code=data["tool"].strip())
        if data["since"]:
            scans = scans.filter(finished_at__date__gte=data["since"])
        if data["newest_only"]:
            newest: dict[int, int] = {}
            for region, pk in scans.order_by("region_id", "-finished_at", "-pk").values_list("region_id", "pk"):
                newest.setdefault(region, pk)
            scans = scans.filter(pk__in=newest.values())
        return scans.order_by("finished_at", "pk")


class CartForm(forms.Form):
    """A cart of tools for one rig."""

    codes = forms.CharField(
        label="Tools", max_length=10_000, widget=forms.Textarea(attrs={"rows": 10, "autofocus": True, "class": "mono"}),
        help_text="Scan one label after the other: one code a line, in the order they come onto the rig.",
    )  # fmt: skip
    reason = forms.CharField(max_length=200, required=False, help_text="For example “after the weekend”.")
