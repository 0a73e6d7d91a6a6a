"""Which tool is due, and how badly, in the three colours everybody reads from afar.

Green until the due date, yellow from it to the end of the window, red after. Coloured by the local date, so that
nothing turns red in the evening because it is already tomorrow in UTC.
"""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass

from django.db.models import Prefetch
from django.utils import timezone

from inspection.models import DueSlot, Schedule, Tool


@dataclass(frozen=True)
class DueRow:
    """One schedule and where it stands on ``today``.

    ``overdue_days`` counts from the due date (0 until it has passed); ``opens_on`` and ``closes_on`` bound the window
    in which an inspection counts for this date. ``slot`` is what the tick did about it, None if nothing yet.
    """

    schedule: Schedule
    due_on: dt.date
    opens_on: dt.date
    closes_on: dt.date
    colour: str
    today: dt.date
    overdue_days: int
    slot: DueSlot | None

    @property
    def words(self) -> str:
        days = (self.due_on - self.today).days
        if days == 0:
            return "due today"
        if days > 0:
            return f"due in {days} day{'s' if days != 1 else ''}"
        return f"overdue by {-days} day{'s' if days != -1 else ''}"


def due_list(today: dt.date | None = None, *, tool: Tool | None = None) -> list[DueRow]:
    """Every enabled schedule of a tool in use, most urgent first. Two queries, however many there are."""
    today = today or timezone.localdate()
    schedules = (
        Schedule.objects.filter(enabled=True)
        .exclude(tool__status=Tool.Status.RETIRED)
        .select_related("tool", "rig", "recipe")
        .prefetch_related(Prefetch("slots", queryset=DueSlot.objects.order_by("-due_on")))
        .order_by("next_due", "pk")
    )
    if tool is not None:
        schedules = schedules.filter(tool=tool)
    return [due_row(schedule, today) for schedule in schedules]


def due_row(schedule: Schedule, today: dt.date) -> DueRow:
    """Where one schedule stands on ``today``."""
    due = schedule.next_due
    slot = next((one for one in schedule.slots.all() if one.due_on == due), None)
    return DueRow(
        schedule=schedule,
        due_on=due,
        opens_on=due - dt.timedelta(days=schedule.window_before_days),
        closes_on=due + dt.timedelta(days=schedule.window_after_days),
        colour=colour(schedule, today),
        today=today,
        overdue_days=max(0, (today - due).days),
        slot=slot,
    )


def colour(schedule: Schedule, today: dt.date) -> str:
    """green, yellow or red."""
    if today < schedule.next_due:
        return "green"
    return "yellow" if today <= schedule.next_due + dt.timedelta(days=schedule.window_after_days) else "red"
