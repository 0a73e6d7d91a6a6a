"""Forms about what measures: a calibration from gauge pairs, and the limits of a tool type."""

from __future__ import annotations

import datetime as dt
from typing import Any

from django import forms
from django.utils import timezone

from inspection.models import LimitSet, Rig

#: A calibration holds this long unless somebody says otherwise.
VALID_DAYS = 180


class CalibrationForm(forms.Form):
    """Gauge pairs as a file or as text; the text is what the preview keeps, so nothing is uploaded twice."""

    rig = forms.ModelChoiceField(Rig.objects.none(), empty_label=None)
    csv_file = forms.FileField(
        label="Gauge pairs (CSV)", required=False, help_text="Columns height_mm and column_px, at least three rows."
    )
    pairs = forms.CharField(
        label="… or paste them",
        required=False,
        strip=False,
        max_length=200_000,
        widget=forms.Textarea(
            attrs={"rows": 9, "class": "mono", "placeholder": "height_mm,column_px\n0.00,112.4\n0.10,119.5\n…"}
        ),
    )
    artefact = forms.CharField(label="Gauge and its certificate", max_length=200)
    done_on = forms.DateField(label="Done on", widget=forms.DateInput(attrs={"type": "date"}, format="%Y-%m-%d"))
    valid_until = forms.DateField(
        label="Valid until", widget=forms.DateInput(attrs={"type": "date"}, format="%Y-%m-%d")
    )

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.fields["rig"].queryset = Rig.objects.filter(active=True)  # type: ignore[attr-defined]
        today = timezone.localdate()
        self.initial.setdefault("done_on", today)
        self.initial.setdefault("valid_until", today + dt.timedelta(days=VALID_DAYS))

    def clean(self) -> dict[str, Any]:
        cleaned = super().clean() or {}
        if not cleaned.get("csv_file") and not (cleaned.get("pairs") or "").strip():
            self.add_error("csv_file", "Choose a CSV file with the gauge pairs, or paste them below.")
        return cleaned


def _plain(value: float | None) -> str | None:
    return None if value is None else f"{value:g}"


class LimitsForm(forms.Form):
    """The whole new limit set of a tool type: one pair of fields per metric, and the reason."""

    reason = forms.CharField(max_length=300, help_text="Why the limits change. It stays in the history for good.")

    def __init__(
        self, *args: Any, metrics: list[tuple[str, str, str]], current: LimitSet | None, **kwargs: Any
    ) -> None:
        super().__init__(*args, **kwargs)
        self.metrics = metrics
        limits = {limit.metric: limit for limit in current.limits.all()} if current else {}
        for metric, label, _unit in metrics:
            limit = limits.get(metric)
            for kind, word in (("watch", "watch above"), ("replace", "replace above")):
                self.fields[f"{kind}:{metric}"] = forms.FloatField(
                    required=False, label=f"{label}: {word}", widget=forms.NumberInput(attrs={"step": "any"})
                )
                self.initial[f"{kind}:{metric}"] = _plain(getattr(limit, f"{kind}_above")) if limit else None

    def limited(self) -> list[dict[str, Any]]:
        """The metrics that have a limit now, or came back with one."""
        return [
            row for row in self.rows() if any(bound.value() not in (None, "") or bound.errors for bound in row["pair"])
        ]

    def others(self) -> list[dict[str, Any]]:
        limited = {row["metric"] for row in self.limited()}
        return [row for row in self.rows() if row["metric"] not in limited]

    def rows(self) -> list[dict[str, Any]]:
        return [
            {
                "metric": metric,
                "label": label,
                "unit": unit,
                "pair": [self[f"watch:{metric}"], self[f"replace:{metric}"]],
            }
            for metric, label, unit in self.metrics
        ]

    def clean(self) -> dict[str, Any]:
        cleaned = super().clean() or {}
        for metric, label, _unit in self.metrics:
            watch, replace = cleaned.get(f"watch:{metric}"), cleaned.get(f"replace:{metric}")
            if watch is not None and replace is not None and watch > replace:
                self.add_error(f"watch:{metric}", f"{label}: “watch” must not lie above “replace”.")
        return cleaned

    def limits(self) -> dict[str, tuple[float | None, float | None, str]]:
        """Metric -> (watch above, replace above, unit) of every metric that has a limit."""
        cleaned = self.cleaned_data
        return {
            metric: (cleaned[f"watch:{metric}"], cleaned[f"replace:{metric}"], unit)
            for metric, _label, unit in self.metrics
            if cleaned[f"watch:{metric}"] is not None or cleaned[f"replace:{metric}"] is not None
        }
