"""Rescans by the calendar: dates with a window, one idempotent tick a minute, one slot per schedule and date.

Without this a tool is scanned when somebody thinks of it. The rules are QATrack+'s, because its users found the traps:
an inspection before the window does not move the date; one inside it moves the date by one step; one long overdue moves
it to the next date whose window is still ahead. Due days are local dates, so neither DST nor UTC midnight shifts them,
and dates are counted from the first one, so that the 31st comes back after February.
"""

from __future__ import annotations

import calendar
import datetime as dt
import logging
from dataclasses import dataclass, field

from django.db import IntegrityError, transaction
from django.utils import timezone

from inspection.models import DueSlot, Inspection, Recipe, Rig, Schedule, Tool, User
from inspection.services.audit import audit
from inspection.services.queue import enqueue_inspection
from inspection.states import LIVE, ScanState
from scanning.errors import BadInput

log = logging.getLogger(__name__)

#: Ten years of days; beyond that a number is a typing error.
MOST_STEPS_APART = 3650


@dataclass
class TickSummary:
    """What one tick did: inspections queued, slots that could not be queued (with why), slots another tick had done."""

    queued: list[Inspection] = field(default_factory=list)
    refused: list[tuple[Schedule, str]] = field(default_factory=list)


def save_schedule(
    *,
    by: User | None,
    tool: Tool,
    rig: Rig,
    every: int,
    unit: str,
    next_due: dt.date,
    window_before_days: int = 1,
    window_after_days: int = 2,
    queue_after: dt.time = dt.time(6, 0),
    automatic: bool = True,
    enabled: bool = True,
    recipe: Recipe | None = None,
    schedule: Schedule | None = None,
) -> Schedule:
    """Add a schedule, or change ``schedule``. Dates are counted from ``next_due`` whenever the rule changes.

    Raises `BadInput` for an interval below one, or a window that reaches back to the date before: every inspection
    would then count for two dates.
    """
    if unit not in Schedule.Unit.values:
        raise BadInput(f"There is no unit {unit!r}; choose days, weeks or months.")
    if not 1 <= every <= MOST_STEPS_APART:
        raise BadInput(f"Every {every} {unit} is no interval; give a whole number from 1 to {MOST_STEPS_APART}.")
    if window_before_days < 0 or window_after_days < 0:
        raise BadInput("The window is counted in days before and after the date, from 0 up.")
    shortest = every * {"days": 1, "weeks": 7, "months": 28}[unit]
    if window_before_days >= shortest or window_after_days >= shortest:
        raise BadInput(
            f"A window of {window_before_days} days before and {window_after_days} after is as long as the interval of "
            f"{every} {unit}; make it shorter, or one inspection would count for two dates."
        )
    if tool.status == Tool.Status.RETIRED:
        raise BadInput(f"Tool {tool.code} is retired; it needs no schedule.")
    values = {
        "tool": tool,
        "rig": rig,
        "recipe": recipe,
        "every": every,
        "unit": unit,
        "window_before_days": window_before_days,
        "window_after_days": window_after_days,
        "queue_after": queue_after,
        "automatic": automatic,
        "enabled": enabled,
        "next_due": next_due,
    }
    with transaction.atomic():
        if schedule is None:
            schedule = Schedule.objects.create(created_by=by, first_due=next_due, **values)
            audit(by, "schedule.created", schedule, after=values)
            return schedule
        before = {name: getattr(schedule, name) for name in values}
        changed = {name: value for name, value in values.items() if before[name] != value}
        for name, value in changed.items():
            setattr(schedule, name, value)
        if {"every", "unit", "next_due"} & set(changed):
            schedule.first_due = next_due
        schedule.save()
        if changed:
            audit(by, "schedule.changed", schedule, before={name: before[name] for name in changed}, after=changed)
    return schedule


def due_date(schedule: Schedule, number: int) -> dt.date:
    """The date ``number`` steps after the first one. A month without that day gets its last day."""
    first = schedule.first_due or schedule.next_due
    step = schedule.every * number
    if schedule.unit == Schedule.Unit.DAYS:
        return first + dt.timedelta(days=step)
    if schedule.unit == Schedule.Unit.WEEKS:
        return first + dt.timedelta(weeks=step)
    year, month = divmod(first.year * 12 + first.month - 1 + step, 12)
    return dt.date(year, month + 1, min(first.day, calendar.monthrange(year, month + 1)[1]))


def date_after(schedule: Schedule, date: dt.date) -> dt.date:
    """The schedule's first date later than ``date``."""
    first = schedule.first_due or schedule.next_due
    days = {"days": 1.0, "weeks": 7.0, "months": 31.0}[schedule.unit] * schedule.every
    number = max(0, int((date - first).days / days) - 1)  # at or before the answer, whatever the months' lengths
    while due_date(schedule, number) <= date:
        number += 1
    return due_date(schedule, number)


def next_due_after_inspection(schedule: Schedule, done_on: dt.date) -> dt.date:
    """Where an inspection on ``done_on`` moves the schedule's date.

    Before the window: nowhere. Otherwise on to the first date whose window had not opened yet, which is one step for an
    inspection inside the window, and the next future date for one long overdue.
    """
    due = schedule.next_due
    while done_on >= due - dt.timedelta(days=schedule.window_before_days):
        due = date_after(schedule, due)
    return due


def note_inspection_done(inspection: Inspection, done_on: dt.date | None = None) -> list[Schedule]:
    """Move the dates of the tool's schedules if this inspection is complete; return those that moved.

    Complete means: each of its regions has a finished scan and none is still going on. The verdict does not matter,
    not even "unknown": the visit took place, and queueing it again by itself would not cure an expired calibration.
    """
    scans = list(inspection.scans.all())
    done = {scan.region_id for scan in scans if scan.state == ScanState.DONE and not scan.partial}
    if not scans or done != {scan.region_id for scan in scans} or any(scan.state in LIVE for scan in scans):
        return []
    on = done_on or timezone.localdate()
    moved = []
    with transaction.atomic():
        for schedule in Schedule.objects.select_for_update().filter(tool_id=inspection.tool_id, enabled=True):
            due = next_due_after_inspection(schedule, on)
            if due != schedule.next_due:
                audit(None, "schedule.moved", schedule, before={"next_due": schedule.next_due}, after={"next_due": due})
                schedule.next_due = due
                schedule.save(update_fields=["next_due"])
                moved.append(schedule)
    return moved


def tick(now: dt.datetime) -> TickSummary:
    """Queue what is due at ``now`` (aware). Run it as often as you like, twice at once too: a date is queued once.

    A date that could not be queued (rig out of service, region outside its travel) keeps its slot with the reason, so
    that the due list can say why; it stays due until somebody inspects the tool.
    """
    local = timezone.localtime(now)
    summary = TickSummary()
    due = Schedule.objects.filter(enabled=True, automatic=True, next_due__lte=local.date()).select_related(
        "tool", "rig", "recipe"
    )
    for schedule in due:
        if schedule.next_due == local.date() and local.time() < schedule.queue_after:
            continue
        if schedule.slots.filter(due_on=schedule.next_due).exists():
            continue
        try:
            _queue_slot(schedule, summary)
        except IntegrityError:  # another tick took the slot in between; all of ours is rolled back
            log.info("Slot %s %s was taken by another tick.", schedule, schedule.next_due)
    return summary


def _queue_slot(schedule: Schedule, summary: TickSummary) -> None:
    with transaction.atomic():
        slot = DueSlot.objects.create(schedule=schedule, due_on=schedule.next_due)
        tool = schedule.tool
        waiting = Inspection.objects.filter(tool=tool, scans__state__in=LIVE).order_by("-pk").first()
        if waiting is not None:
            slot.inspection, slot.note = waiting, "The tool was already queued."
        elif tool.status != Tool.Status.IN_SERVICE and tool.status != Tool.Status.SPARE:
            slot.note = f"Tool {tool.code} is {tool.status}."
            summary.refused.append((schedule, slot.note))
        else:
            try:
                slot.inspection = enqueue_inspection(
                    tool=tool,
                    rig=schedule.rig,
                    by=None,
                    recipe=schedule.recipe,
                    reason=f"Scheduled for {schedule.next_due:%Y-%m-%d}",
                )
                summary.queued.append(slot.inspection)
            except BadInput as fault:
                slot.note = str(fault)[:300]
                summary.refused.append((schedule, slot.note))
        slot.save(update_fields=["inspection", "note"])
