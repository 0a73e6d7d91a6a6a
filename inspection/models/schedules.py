"""When a tool is due. Dates, not times: clocks change and shifts move, a due date does not."""

from __future__ import annotations

from typing import Any

from django.conf import settings
from django.db import models

from inspection.models.plant import Tool
from inspection.models.rigs import Recipe, Rig
from inspection.models.scans import Inspection


class Schedule(models.Model):
    """A tool's rescan rule: every ``every`` ``unit``, within a window around the due date.

    On the due date, after ``queue_after`` local time, the tick queues the scan by itself when ``automatic`` is set.
    """

    class Unit(models.TextChoices):
        DAYS = "days"
        WEEKS = "weeks"
        MONTHS = "months"

    tool = models.ForeignKey(Tool, on_delete=models.CASCADE, related_name="schedules")
    rig = models.ForeignKey(Rig, on_delete=models.PROTECT, related_name="schedules")
    recipe = models.ForeignKey(Recipe, null=True, blank=True, on_delete=models.PROTECT, related_name="+")
    every = models.PositiveIntegerField(default=1)
    unit = models.CharField(max_length=6, choices=Unit, default=Unit.WEEKS)
    window_before_days = models.PositiveIntegerField(default=1)
    window_after_days = models.PositiveIntegerField(default=2)
    queue_after = models.TimeField(help_text="Local time of day from which the scan may be queued.")
    automatic = models.BooleanField(default=True)
    enabled = models.BooleanField(default=True)
    next_due = models.DateField()
    first_due = models.DateField(
        null=True, blank=True, help_text="Dates are counted from here, so that the 31st comes back after February."
    )
    created_by = models.ForeignKey(settings.AUTH_USER_MODEL, null=True, on_delete=models.PROTECT, related_name="+")

    class Meta:
        ordering = ["next_due", "pk"]

    def __str__(self) -> str:
        return f"{self.tool.code} every {self.every} {self.unit}"

    def save(self, *args: Any, **kwargs: Any) -> None:
        if self.first_due is None:
            self.first_due = self.next_due
        super().save(*args, **kwargs)


class DueSlot(models.Model):
    """One due date of one schedule. The unique constraint is what makes two ticks harmless."""

    schedule = models.ForeignKey(Schedule, on_delete=models.CASCADE, related_name="slots")
    due_on = models.DateField()
    created_at = models.DateTimeField(auto_now_add=True)
    inspection = models.ForeignKey(
        Inspection, null=True, blank=True, on_delete=models.SET_NULL, related_name="due_slots"
    )
    note = models.CharField(max_length=300, blank=True, help_text="Why nothing was queued, if so.")

    class Meta:
        ordering = ["-due_on"]
        constraints = [models.UniqueConstraint(fields=["schedule", "due_on"], name="one_slot_per_schedule_and_date")]

    def __str__(self) -> str:
        return f"{self.schedule} due {self.due_on}"
