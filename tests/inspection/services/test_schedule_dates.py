"""Which date an inspection moves a schedule to: the rules of QATrack+, month ends, and the hour that DST repeats."""

from __future__ import annotations

import datetime as dt
from zoneinfo import ZoneInfo

import pytest
from django.utils import timezone

from inspection.models import Inspection, Rig, Scan, Schedule, Tool, User
from inspection.selectors.due import due_list
from inspection.services import schedules
from inspection.services.recipes import recipe_named
from inspection.states import ScanState
from scanning.errors import BadInput

D = dt.date.fromisoformat


def rule(every: int, unit: str, first: str, due: str | None = None, before: int = 1, after: int = 2) -> Schedule:
    return Schedule(
        every=every,
        unit=unit,
        first_due=D(first),
        next_due=D(due or first),
        window_before_days=before,
        window_after_days=after,
        queue_after=dt.time(6),
    )


@pytest.mark.parametrize(
    ("done_on", "moves_to", "why"),
    [
        ("2026-05-30", "2026-06-01", "two days early, before the window: the date stays"),
        ("2026-05-31", "2026-06-08", "inside the window, before the date: one step"),
        ("2026-06-01", "2026-06-08", "on the day: one step"),
        ("2026-06-03", "2026-06-08", "inside the window, after the date: one step"),
        ("2026-06-06", "2026-06-08", "overdue but nearer to this date than to the next: one step"),
        ("2026-06-07", "2026-06-15", "overdue and already in the next window: it counts for that date too"),
        ("2026-06-23", "2026-06-29", "three weeks overdue: the next future date, not one in the past"),
        ("2026-06-28", "2026-07-06", "long overdue and in a window: past that date"),
    ],
)
def test_a_weekly_date_moves_by_the_window_rules(done_on: str, moves_to: str, why: str) -> None:
    schedule = rule(1, "weeks", "2026-06-01")

    assert schedules.next_due_after_inspection(schedule, D(done_on)) == D(moves_to), why


def test_the_31st_comes_back_after_february() -> None:
    schedule = rule(1, "months", "2027-01-31")
    seen = []
    for _ in range(4):
        schedule.next_due = schedules.next_due_after_inspection(schedule, schedule.next_due)
        seen.append(schedule.next_due.isoformat())

    assert seen == ["2027-02-28", "2027-03-31", "2027-04-30", "2027-05-31"]


def test_a_leap_day_is_the_end_of_february_in_other_years() -> None:
    schedule = rule(12, "months", "2028-02-29")

    assert [schedules.due_date(schedule, n).isoformat() for n in (1, 4)] == ["2029-02-28", "2032-02-29"]


@pytest.mark.parametrize(("every", "unit"), [(1, "days"), (3, "days"), (2, "weeks"), (1, "months"), (7, "months")])
def test_the_date_after_is_the_first_later_one(every: int, unit: str) -> None:
    """Held against counting up one by one."""
    schedule = rule(every, unit, "2026-01-31")
    dates = [schedules.due_date(schedule, n) for n in range(900)]
    for day in range(0, 800, 13):
        date = D("2026-01-01") + dt.timedelta(days=day)
        assert schedules.date_after(schedule, date) == next(one for one in dates if one > date)


def test_a_window_as_long_as_the_interval_is_refused(tool: Tool, rig: Rig, erik: User) -> None:
    with pytest.raises(BadInput, match="as long as the interval"):
        schedules.save_schedule(
            by=erik, tool=tool, rig=rig, every=1, unit="days", next_due=D("2026-06-01"), window_before_days=1
        )


@pytest.fixture
def weekly(tool: Tool, rig: Rig, erik: User) -> Schedule:
    return schedules.save_schedule(
        by=erik, tool=tool, rig=rig, every=1, unit="weeks", next_due=D("2026-06-01"), queue_after=dt.time(6, 0)
    )


def at(text: str, zone: str = "UTC") -> dt.datetime:
    return dt.datetime.fromisoformat(text).replace(tzinfo=ZoneInfo(zone))


def test_a_due_scan_is_queued_by_itself_from_its_hour_on(weekly: Schedule) -> None:
    assert schedules.tick(at("2026-05-31T23:00")).queued == []
    assert schedules.tick(at("2026-06-01T05:59")).queued == []

    (inspection,) = schedules.tick(at("2026-06-01T06:00")).queued

    assert inspection.tool == weekly.tool
    assert inspection.scans.filter(state=ScanState.QUEUED).count() == 3
    assert inspection.requested_by is None


def test_two_ticks_queue_once(weekly: Schedule) -> None:
    schedules.tick(at("2026-06-01T06:00"))
    schedules.tick(at("2026-06-01T06:00"))
    schedules.tick(at("2026-06-03T06:01"))

    assert Inspection.objects.count() == 1
    assert weekly.slots.count() == 1


def test_a_tick_beaten_to_the_slot_leaves_nothing_behind(weekly: Schedule, monkeypatch: pytest.MonkeyPatch) -> None:
    """The other tick commits its slot after we looked: our inspection must go with our slot."""
    from inspection.models import DueSlot
    from inspection.services.queue import enqueue_inspection as looked

    def other_was_first(**order: object) -> Inspection:
        DueSlot.objects.create(schedule=weekly, due_on=weekly.next_due)
        return looked(**order)  # type: ignore[arg-type]

    monkeypatch.setattr(schedules, "enqueue_inspection", other_was_first)
    summary = schedules.tick(at("2026-06-01T06:00"))

    assert summary.queued == []
    assert Inspection.objects.count() == 0
    assert Scan.objects.count() == 0


def test_a_tool_that_is_queued_already_is_not_queued_twice(weekly: Schedule, olga: User) -> None:
    from inspection.services.queue import enqueue_inspection

    waiting = enqueue_inspection(tool=weekly.tool, rig=weekly.rig, by=olga)
    schedules.tick(at("2026-06-01T06:00"))

    assert Inspection.objects.count() == 1
    assert weekly.slots.get().inspection == waiting


def test_what_cannot_be_queued_says_why_and_stays_due(weekly: Schedule) -> None:
    Rig.objects.filter(pk=weekly.rig_id).update(active=False)

    ((schedule, why),) = schedules.tick(at("2026-06-01T06:00")).refused

    assert schedule == weekly
    assert "out of service" in why
    (row,) = due_list(D("2026-06-05"))
    assert (row.colour, row.overdue_days) == ("red", 4)
    assert row.slot is not None
    assert "out of service" in row.slot.note


@pytest.mark.parametrize(
    ("now", "queued"),
    [
        ("2026-03-29T00:45+00:00", False),  # 01:45 local, summer time begins at 02:00
        ("2026-03-29T01:00+00:00", True),  # 03:00 local: 02:30 never was, but it is past
    ],
)
def test_an_hour_that_spring_skips_still_queues(weekly: Schedule, now: str, queued: bool) -> None:
    Schedule.objects.update(next_due=D("2026-03-29"), queue_after=dt.time(2, 30))
    with timezone.override(ZoneInfo("Europe/Stockholm")):
        assert bool(schedules.tick(dt.datetime.fromisoformat(now)).queued) is queued


def test_an_hour_that_autumn_repeats_queues_once(weekly: Schedule) -> None:
    Schedule.objects.update(next_due=D("2026-10-25"), queue_after=dt.time(2, 30))
    with timezone.override(ZoneInfo("Europe/Stockholm")):
        ticks = [schedules.tick(dt.datetime.fromisoformat(f"2026-10-25T{h}+00:00")) for h in ("00:31", "01:31")]

    assert [len(one.queued) for one in ticks] == [1, 0]


def test_the_due_day_is_the_plants_not_utc(weekly: Schedule) -> None:
    """At 23:00 UTC on 31 May it is already the 1st in Stockholm, and past six in Auckland."""
    with timezone.override(ZoneInfo("Europe/Stockholm")):
        assert schedules.tick(at("2026-05-31T23:00")).queued == []
    with timezone.override(ZoneInfo("Pacific/Auckland")):
        assert len(schedules.tick(at("2026-05-31T23:00")).queued) == 1


@pytest.mark.parametrize(
    ("today", "colour", "words"),
    [
        ("2026-05-31", "green", "due in 1 day"),
        ("2026-06-01", "yellow", "due today"),
        ("2026-06-03", "yellow", "overdue by 2 days"),
        ("2026-06-04", "red", "overdue by 3 days"),
    ],
)
def test_colours_follow_date_and_window(weekly: Schedule, today: str, colour: str, words: str) -> None:
    (row,) = due_list(D(today))

    assert (row.colour, row.words) == (colour, words)


def finish(inspection: Inspection, *, regions: int) -> None:
    ids = list(inspection.scans.order_by("pk").values_list("pk", flat=True))[:regions]
    Scan.objects.filter(pk__in=ids).update(state=ScanState.DONE)


def test_the_date_moves_when_every_region_is_done(weekly: Schedule) -> None:
    (inspection,) = schedules.tick(at("2026-06-01T06:00")).queued
    finish(inspection, regions=2)
    assert schedules.note_inspection_done(inspection, D("2026-06-01")) == []

    finish(inspection, regions=3)
    assert schedules.note_inspection_done(inspection, D("2026-06-01")) == [weekly]

    weekly.refresh_from_db()
    assert weekly.next_due == D("2026-06-08")


def test_a_failed_region_scanned_again_completes_the_visit(weekly: Schedule, olga: User) -> None:
    from inspection.services.queue import scan_again

    (inspection,) = schedules.tick(at("2026-06-01T06:00")).queued
    finish(inspection, regions=2)
    failed = inspection.scans.get(state=ScanState.QUEUED)
    Scan.objects.filter(pk=failed.pk).update(state=ScanState.FAILED)
    failed.refresh_from_db()
    again = scan_again(failed, olga)
    assert schedules.note_inspection_done(inspection, D("2026-06-02")) == []

    Scan.objects.filter(pk=again.pk).update(state=ScanState.DONE)
    assert schedules.note_inspection_done(inspection, D("2026-06-02")) == [weekly]


def test_editing_the_rule_counts_from_the_new_date(weekly: Schedule, erik: User) -> None:
    schedules.save_schedule(
        by=erik, schedule=weekly, tool=weekly.tool, rig=weekly.rig, every=1, unit="months", next_due=D("2026-08-31"),
        recipe=recipe_named("SCI"),
    )  # fmt: skip
    weekly.refresh_from_db()

    assert schedules.date_after(weekly, D("2026-08-31")) == D("2026-09-30")
