"""Ordering scans, their order in the queue, and what a person may ask of them in which state."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from inspection.models import AuditEvent, Calibration, Inspection, Rig, Scan, Tool, User
from inspection.services import queue
from inspection.services.moves import WrongState
from inspection.services.plant import create_tool_type, record_event, update_region
from inspection.services.recipes import recipe_named
from inspection.states import QueueState, ScanState
from scanning.errors import BadInput


@pytest.fixture
def rung(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """What went to the broker, instead of a broker."""
    calls: list[tuple[Any, ...]] = []
    monkeypatch.setattr("inspection.services.ring._send", lambda *call: calls.append(call))
    return calls


@pytest.fixture
def three(tool: Tool, rig: Rig, olga: User) -> list[Scan]:
    inspection = queue.enqueue_inspection(tool=tool, rig=rig, by=olga, reason="After the night shift")
    return list(inspection.scans.order_by("position"))


def names(rig: Rig) -> list[str]:
    return [scan.region.name for scan in rig.scans.filter(state=ScanState.QUEUED).order_by("position", "pk")]


def test_one_scan_per_active_region_with_everything_frozen(three: list[Scan], rig: Rig, tool: Tool, erik: User) -> None:
    region = three[0].region
    update_region(region, by=erik, start_mm=55.0)
    three[0].refresh_from_db()

    assert [scan.region.name for scan in three] == ["R1", "R2", "R3"]
    assert three[0].plan == {
        "region": "R1", "start_mm": 10.0, "length_mm": 0.25, "steps": 30, "motor_steps_per_profile": 17,
        "step_um": pytest.approx(8.33), "exposures_us": [100.0, 300.0, 900.0], "rows": 64, "row_offset": 0,
        "columns": 256, "column_offset": 0, "flat_row": 4, "flat_rows": 40,
    }  # fmt: skip
    assert three[0].recipe.name == "PRECISE"
    assert three[0].total == 30


def test_the_bell_rings_once_after_commit(
    tool: Tool, rig: Rig, olga: User, rung: list[Any], django_capture_on_commit_callbacks: Any
) -> None:
    with django_capture_on_commit_callbacks(execute=True):
        queue.enqueue_inspection(tool=tool, rig=rig, by=olga)
        assert rung == []

    assert rung == [("worker.ring", ["rig1"], "rig.rig1")]


def test_a_broker_that_is_down_does_not_fail_the_order(
    tool: Tool, rig: Rig, olga: User, django_capture_on_commit_callbacks: Any, caplog: pytest.LogCaptureFixture
) -> None:
    """The test settings name a socket nobody listens on."""
    with django_capture_on_commit_callbacks(execute=True):
        queue.enqueue_inspection(tool=tool, rig=rig, by=olga)

    assert Scan.objects.filter(state=ScanState.QUEUED).count() == 3
    assert "the tick will" in caplog.text


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"start_mm": 99.9}, "outside the 0 to 100 mm that Rig 1 can travel"),
        ({"start_mm": -1.0}, "outside the 0 to 100 mm"),
        ({"length_mm": 0.02}, "too short for a single profile"),
        ({"length_mm": 0.0}, "length above 0 mm"),
    ],
)
def test_a_region_the_rig_cannot_scan_is_refused_and_nothing_is_queued(
    make_tool: Callable[..., Tool], rig: Rig, olga: User, change: dict[str, float], says: str
) -> None:
    tool = make_tool("K-8")
    tool.regions.filter(name="R2").update(**change)

    with pytest.raises(BadInput, match=says):
        queue.enqueue_inspection(tool=tool, rig=rig, by=olga)

    assert Scan.objects.count() == Inspection.objects.count() == 0


@pytest.mark.parametrize(
    ("exposures", "says"),
    [
        ([100, float("nan")], "outside 0 to"),
        ([-5.0], "outside 0 to"),
        ([100, 100], "twice"),
        ([0, 100], "logarithmic"),
        (["fast"], "not all numbers"),
    ],
)
def test_impossible_exposures_are_refused(tool: Tool, rig: Rig, olga: User, exposures: list[Any], says: str) -> None:
    with pytest.raises(BadInput, match=says):
        queue.enqueue_inspection(tool=tool, rig=rig, by=olga, exposures_us=exposures)


def test_orders_that_cannot_be_met_are_refused(make_tool: Callable[..., Tool], rig: Rig, olga: User) -> None:
    bare, other, retired = make_tool("K-1", regions=0), make_tool("K-2"), make_tool("K-3")
    Tool.objects.filter(pk=retired.pk).update(status=Tool.Status.RETIRED)
    retired.refresh_from_db()
    with pytest.raises(BadInput, match="has no region"):
        queue.enqueue_inspection(tool=bare, rig=rig, by=olga)
    with pytest.raises(BadInput, match="belongs to another tool"):
        queue.enqueue_inspection(tool=bare, rig=rig, by=olga, regions=[other.regions.get(name="R1")])
    with pytest.raises(BadInput, match="is retired"):
        queue.enqueue_inspection(tool=retired, rig=rig, by=olga)
    with pytest.raises(BadInput, match="logarithmic"):
        queue.enqueue_inspection(tool=other, rig=rig, by=olga, recipe=recipe_named("HDR-CAM"))
    Rig.objects.update(active=False)
    rig.refresh_from_db()
    with pytest.raises(BadInput, match="out of service"):
        queue.enqueue_inspection(tool=other, rig=rig, by=olga)

    assert Inspection.objects.count() == 0


@pytest.mark.parametrize(
    ("which", "where", "order"),
    [
        (2, "up", ["R1", "R3", "R2"]),
        (0, "down", ["R2", "R1", "R3"]),
        (2, "next", ["R3", "R1", "R2"]),
        (0, "last", ["R2", "R3", "R1"]),
        (0, "up", ["R1", "R2", "R3"]),
        (2, "down", ["R1", "R2", "R3"]),
    ],
)
def test_a_queued_scan_changes_its_place(
    three: list[Scan], rig: Rig, olga: User, which: int, where: str, order: list[str]
) -> None:
    queue.move_scan(three[which], olga, where)

    assert names(rig) == order


def test_only_queued_scans_change_places(three: list[Scan], olga: User) -> None:
    Scan.objects.filter(pk=three[0].pk).update(state=ScanState.RUNNING)
    with pytest.raises(WrongState, match="is running; only a queued scan can be moved") as refused:
        queue.move_scan(three[0], olga, "up")

    assert refused.value.state == ScanState.RUNNING


def test_cancelling_a_queued_scan_ends_it_at_once(three: list[Scan], rig: Rig, olga: User) -> None:
    queue.cancel_scan(three[1], olga)

    assert three[1].state == ScanState.CANCELLED
    assert three[1].message == "Cancelled by olga."
    assert names(rig) == ["R1", "R3"]


def test_requests_to_a_running_scan_are_columns(three: list[Scan], olga: User) -> None:
    scan = three[0]
    Scan.objects.filter(pk=scan.pk).update(state=ScanState.RUNNING)
    queue.pause_scan(scan, olga)
    assert scan.pause_requested_at is not None
    queue.resume_scan(scan, olga)
    assert scan.pause_requested_at is None
    queue.finish_early(scan, olga)
    assert scan.finish_requested_at is not None
    queue.cancel_scan(scan, olga)
    assert (scan.state, scan.cancel_requested_by) == (ScanState.RUNNING, olga)


@pytest.mark.parametrize("state", [ScanState.DONE, ScanState.FAILED, ScanState.CANCELLED, ScanState.INTERRUPTED])
def test_an_ended_scan_takes_no_requests(three: list[Scan], olga: User, state: ScanState) -> None:
    scan = three[0]
    Scan.objects.filter(pk=scan.pk).update(state=state)
    before = AuditEvent.objects.count()
    for ask in (queue.cancel_scan, queue.pause_scan, queue.resume_scan, queue.finish_early):
        with pytest.raises(WrongState, match=f"Scan {scan.pk} is {state}"):
            ask(scan, olga)

    assert AuditEvent.objects.count() == before


def test_scanning_again_is_next_and_uses_the_calibration_in_force(
    three: list[Scan], rig: Rig, olga: User, erik: User
) -> None:
    import datetime as dt

    from inspection.services.calibrations import add_calibration

    Scan.objects.filter(pk=three[0].pk).update(state=ScanState.INTERRUPTED)
    three[0].refresh_from_db()
    newer = add_calibration(
        rig=rig, csv_file="height_mm,column_px\n0.1,10\n0.2,17\n0.3,24.1\n", by=erik, artefact="Gauge 17",
        done_on=dt.date(2026, 1, 1), valid_until=dt.date(2027, 1, 1),
    )  # fmt: skip
    again = queue.scan_again(three[0], olga)

    assert names(rig) == ["R1", "R2", "R3"]
    assert again.inspection == three[0].inspection
    assert (three[0].calibration, again.calibration) == (None, newer)
    assert again.plan == three[0].plan


def test_a_scan_still_going_on_is_not_scanned_again(three: list[Scan], olga: User) -> None:
    with pytest.raises(WrongState, match="is queued"):
        queue.scan_again(three[0], olga)


def test_pausing_the_queue_demands_a_reason_and_shows_it(rig: Rig, olga: User) -> None:
    with pytest.raises(BadInput, match="Say why"):
        queue.pause_queue(rig, olga, "  ")
    queue.pause_queue(rig, olga, "lunch")

    assert (rig.queue_state, rig.queue_reason, rig.queue_owner) == (QueueState.PAUSED, "lunch", olga)
    with pytest.raises(WrongState, match="is paused, so it cannot be paused"):
        queue.pause_queue(rig, olga, "again")
    queue.resume_queue(rig, olga)
    assert (rig.queue_state, rig.queue_reason) == (QueueState.READY, "")


def test_a_lock_keeps_the_pause_it_covers(rig: Rig, olga: User, erik: User) -> None:
    queue.pause_queue_for_fault(rig.pk, "The camera sent nothing.")
    rig.refresh_from_db()
    queue.lock_rig(rig, erik, "changing the camera cable")
    with pytest.raises(WrongState, match="is locked"):
        queue.resume_queue(rig, olga)
    queue.unlock_rig(rig, erik)

    assert (rig.queue_state, rig.queue_reason) == (QueueState.PAUSED, "The camera sent nothing.")


def test_a_fault_under_a_lock_waits_for_the_unlock(rig: Rig, erik: User) -> None:
    queue.lock_rig(rig, erik, "cleaning the lens")
    queue.pause_queue_for_fault(rig.pk, "The worker died.")
    rig.refresh_from_db()
    assert (rig.queue_state, rig.queue_reason) == (QueueState.LOCKED, "cleaning the lens")
    queue.unlock_rig(rig, erik)

    assert (rig.queue_state, rig.queue_reason) == (QueueState.PAUSED, "The worker died.")


def test_nobody_reaches_in_while_a_scan_is_on_the_rig(three: list[Scan], rig: Rig, olga: User) -> None:
    Scan.objects.filter(pk=three[0].pk).update(state=ScanState.RUNNING)
    with pytest.raises(WrongState, match="A scan is on Rig 1"):
        queue.lock_rig(rig, olga, "cleaning the lens")

    rig.refresh_from_db()
    assert rig.queue_state == QueueState.READY


def test_reprocessing_needs_frames_and_a_fitting_recipe(three: list[Scan], olga: User) -> None:
    scan = three[0]
    with pytest.raises(WrongState, match="is queued"):
        queue.reprocess(scan, olga, recipe_named("SCI"))
    Scan.objects.filter(pk=scan.pk).update(state=ScanState.DONE)
    scan.refresh_from_db()
    with pytest.raises(BadInput, match="no stored frames"):
        queue.reprocess(scan, olga, recipe_named("SCI"))
    scan.stack_file = "x.h5"
    with pytest.raises(BadInput, match="logarithmic"):
        queue.reprocess(scan, olga, recipe_named("HDR-CAM"))

    assert queue.reprocess(scan, olga, recipe_named("SCI")).state == "queued"


def test_every_change_leaves_its_line(three: list[Scan], rig: Rig, olga: User) -> None:
    queue.cancel_scan(three[0], olga)
    queue.pause_queue(rig, olga, "lunch")

    assert list(AuditEvent.objects.order_by("pk").values_list("verb", "actor__username")) == [
        ("inspection.queued", "olga"),
        ("scan.cancelled", "olga"),
        ("queue.paused", "olga"),
    ]


def test_a_regrind_counts_the_use_from_zero(tool: Tool, olga: User) -> None:
    from django.utils import timezone

    Tool.objects.update(life_used=61.5)
    tool.refresh_from_db()
    event = record_event(tool, "reground", at=timezone.now(), by=olga, removed_mm=0.4)

    assert (event.life_used, tool.life_used) == (61.5, 0.0)


def test_a_regrind_entered_late_keeps_the_use_since_a_newer_one(tool: Tool, olga: User) -> None:
    import datetime as dt

    from django.utils import timezone

    now = timezone.now()
    record_event(tool, "reground", at=now - dt.timedelta(days=2), by=olga)
    Tool.objects.update(life_used=8.0)
    tool.refresh_from_db()
    record_event(tool, "reground", at=now - dt.timedelta(days=30), by=olga)

    assert tool.life_used == 8.0


def test_a_new_tool_type_has_limits_from_the_start(erik: User) -> None:
    kind = create_tool_type(by=erik, name="Planer knife", edge_length_mm=60.0)

    assert set(kind.limit_sets.get().limits.values_list("metric", flat=True)) == {"d_max", "L_max", "V-", "ER_max"}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"start_mm": 89.9, "length_mm": 1.0}, "within the tool's edge"),
        ({"start_mm": float("nan")}, "not a number"),
        ({"rows": 0}, "sensor rows"),
        ({"flat_row": 60}, "flat part"),
        ({"name": "R2"}, "already has a region R2"),
    ],
)
def test_a_region_that_makes_no_sense_is_refused(tool: Tool, rig: Rig, erik: User, change: Any, says: str) -> None:
    region = tool.regions.get(name="R1")
    with pytest.raises(BadInput, match=says):
        update_region(region, by=erik, **change)

    assert tool.regions.get(pk=region.pk).start_mm == 10.0


def test_an_old_calibration_is_never_edited(rig: Rig, erik: User) -> None:
    import datetime as dt

    from inspection.models.insert_only import InsertOnlyError
    from inspection.services.calibrations import add_calibration

    row = add_calibration(
        rig=rig, csv_file="height_mm,column_px\n0.1,10\n0.2,17\n0.3,24.1\n", by=erik, artefact="Gauge 17",
        done_on=dt.date(2026, 1, 1), valid_until=dt.date(2027, 1, 1),
    )  # fmt: skip
    row.slope_mm_per_px = 1.0
    with pytest.raises(InsertOnlyError):
        row.save()
    assert Calibration.objects.get().slope_mm_per_px == pytest.approx(0.0141835, rel=1e-3)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("height_mm,column_px\n0.1,10\n0.2,17\n", "three"),
        ("height_mm,column_px\n0.1,10\n0.2,nan\n0.3,24\n", "."),
        ("a,b\n1,2\n3,4\n5,6\n", "."),
        ("", "."),
    ],
)
def test_bad_gauge_pairs_store_nothing(rig: Rig, erik: User, text: str, says: str) -> None:
    import datetime as dt

    from inspection.services.calibrations import add_calibration

    with pytest.raises(BadInput, match=says):
        add_calibration(
            rig=rig, csv_file=text, by=erik, artefact="Gauge 17", done_on=dt.date(2026, 1, 1),
            valid_until=dt.date(2027, 1, 1),
        )  # fmt: skip

    assert not Calibration.objects.exists()
