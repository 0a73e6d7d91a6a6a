"""From stored frames to a verdict: once, whole, and again with another recipe without touching the first."""

from __future__ import annotations

import datetime as dt
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from django.conf import settings
from django.utils import timezone

from inspection.models import Calibration, Measurement, RangeImage, Recomputation, Rig, Scan, Schedule, Tool, User
from inspection.selectors.queue import queue_view
from inspection.services import queue, results, schedules
from inspection.services.calibrations import add_calibration
from inspection.services.limits import set_limits
from inspection.services.recipes import recipe_named
from inspection.states import ScanState, Verdict
from scanning.errors import BadInput
from scanning.range_image import RangeImage as Image
from tests.worker.fakes import FakeRig
from worker import compute, tick
from worker.rig import serve

#: Committed rows: the lease is renewed by a thread with a connection of its own.
pytestmark = pytest.mark.django_db(transaction=True)


@pytest.fixture(autouse=True)
def own_folders(settings: Any, tmp_path: Path) -> None:
    settings.STACKS, settings.RANGES = tmp_path / "stacks", tmp_path / "ranges"


@pytest.fixture
def rung(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    calls: list[tuple[Any, ...]] = []
    monkeypatch.setattr("inspection.services.ring._send", lambda *call: calls.append(call))
    return calls


@pytest.fixture
def calibration(rig: Rig, erik: User) -> Calibration:
    pairs = "height_mm,column_px\n" + "".join(
        f"{0.0142 * c:.6f},{c + e}\n" for c, e in ((20, 0), (40, 0.1), (60, -0.1), (90, 0))
    )
    today = timezone.localdate()
    return add_calibration(
        rig=rig, csv_file=pairs, by=erik, artefact="Gauge 17", done_on=today, valid_until=today + dt.timedelta(days=90)
    )


@pytest.fixture
def acquired(make_tool: Callable[..., Tool], rig: Rig, olga: User, calibration: Calibration) -> Scan:
    """A scan whose frames are stored and whose numbers are still to come."""
    tool = make_tool(regions=1, length_mm=0.5, rows=80, flat_row=5, flat_rows=60)
    set_limits(tool.tool_type, {"d_max": (50.0, 150.0, "um"), "V-": (0.002, 0.02, "mm3")}, by=olga, reason="Trial")
    inspection = queue.enqueue_inspection(tool=tool, rig=rig, by=olga, recipe=recipe_named("NF"))
    assert serve("rig1", opening=FakeRig().opening) == [ScanState.PROCESSING]
    return inspection.scans.get()


def now(scan: Scan) -> Scan:
    return Scan.objects.get(pk=scan.pk)


def test_a_scan_ends_done_with_numbers_file_and_verdict(acquired: Scan) -> None:
    compute.measure(acquired.pk)

    scan = now(acquired)
    image = scan.range_images.get()
    assert (scan.state, scan.lease_token, scan.fault) == (ScanState.DONE, None, "")
    assert (image.rows, image.profiles) == (80, 60)
    stored = (settings.RANGES / image.file).read_bytes()
    assert hashlib.sha256(stored).hexdigest() == image.sha256
    assert image.calibration == acquired.calibration
    assert image.recipe == acquired.recipe
    assert image.limit_set is not None
    assert image.provenance["stack_sha256"] == scan.stack_sha256
    assert image.precision.sigma_um is not None
    assert image.precision.undefined_count == 0
    assert image.precision.cell_row_um == pytest.approx(7.150838, rel=1e-6)
    with np.load(settings.RANGES / image.file) as arrays:
        assert image.precision.confident_share == np.mean(arrays["confidence"] > 0.95)  # every pixel has a height
        assert image.precision.outside_calibrated_share == arrays["outside_calibrated"].mean()
    measured = dict(image.measurements.values_list("metric", "value"))
    assert measured["n"] == 0
    assert measured["V-"] == 0
    assert measured["L_max"] == 0
    assert image.verdict == Verdict.OK, image.verdict_reasons
    assert not list((settings.RANGES / "pending").glob("*"))


def test_computing_twice_gives_one_result(acquired: Scan) -> None:
    compute.measure(acquired.pk)
    compute.measure(acquired.pk)

    assert RangeImage.objects.count() == 1
    assert len(list(settings.RANGES.rglob("*.npz"))) == 1


def test_a_result_beaten_by_another_process_leaves_no_file(acquired: Scan, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both have computed; the other stores first."""
    store = results._add_rows

    def other_was_first(*args: Any) -> Any:
        Scan.objects.filter(pk=acquired.pk).update(state=ScanState.DONE)
        return store(*args)

    monkeypatch.setattr(results, "_add_rows", other_was_first)
    compute.measure(acquired.pk)

    assert RangeImage.objects.count() == Measurement.objects.count() == 0
    assert not [path for path in settings.RANGES.rglob("scan-*.npz") if "pending" not in path.parts]


def test_without_the_live_image_the_frames_give_the_same_numbers(acquired: Scan) -> None:
    pending = results.pending_range_file(acquired.pk)
    live = Image.load(pending)
    pending.unlink()
    compute.measure(acquired.pk)

    stored = Image.load(settings.RANGES / now(acquired).range_images.get().file)
    np.testing.assert_array_equal(stored.height_um, live.height_um)


def test_computing_again_adds_a_result_and_keeps_the_first(acquired: Scan, olga: User) -> None:
    compute.measure(acquired.pk)
    order = queue.reprocess(now(acquired), olga, recipe_named("SCI"))
    compute.recompute(order.pk)
    compute.recompute(order.pk)

    order.refresh_from_db()
    first, second = RangeImage.objects.order_by("pk")
    assert (order.state, order.range_image, order.attempts) == (Recomputation.State.DONE, second, 1)
    assert (first.recipe.name, second.recipe.name) == ("NF", "SCI")
    assert second.profiles == 12
    assert now(acquired).state == ScanState.DONE


def test_the_same_recipe_gives_the_same_file_bit_for_bit(acquired: Scan, olga: User) -> None:
    compute.measure(acquired.pk)
    for _ in range(2):
        compute.recompute(queue.reprocess(now(acquired), olga, recipe_named("NF")).pk)

    images = [Image.load(settings.RANGES / one.file) for one in RangeImage.objects.order_by("pk")]
    for other in images[1:]:
        for name in ("column_px", "height_um", "intensity", "width_px"):
            np.testing.assert_array_equal(getattr(images[0], name), getattr(other, name), err_msg=name)
    values = [
        list(one.measurements.order_by("metric").values_list("metric", "value", "u"))
        for one in RangeImage.objects.order_by("pk")
    ]
    assert values[0] == values[1] == values[2]


def test_frames_that_cannot_be_read_fail_with_a_sentence(acquired: Scan) -> None:
    results.pending_range_file(acquired.pk).unlink()
    stack = settings.STACKS / acquired.stack_file
    raw = bytearray(stack.read_bytes())
    for at in range(len(raw) // 2, len(raw) // 2 + 4000):
        raw[at] ^= 0xFF
    stack.write_bytes(raw)
    compute.measure(acquired.pk)

    scan = now(acquired)
    assert scan.state == ScanState.FAILED
    assert "damaged" in scan.fault
    assert not RangeImage.objects.exists()


def test_a_surface_that_cannot_be_measured_gives_an_unknown_verdict_and_says_why(
    acquired: Scan, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise BadInput("Only 30 % of the surface agree on one plane; check that the region lies on the bevel.")

    monkeypatch.setattr(compute, "inspect_surface", refuse)
    compute.measure(acquired.pk)

    image = now(acquired).range_images.get()
    assert image.verdict == Verdict.UNKNOWN
    assert image.verdict_reasons[0].startswith("Only 30 %")
    assert image.surface["warnings"] == image.verdict_reasons[:1]


def test_a_passing_trouble_is_tried_again_and_a_lasting_one_given_up(
    acquired: Scan, monkeypatch: pytest.MonkeyPatch
) -> None:
    def trouble(*_: Any, **__: Any) -> None:
        raise OSError("Input/output error")

    monkeypatch.setattr(compute, "precision_of", trouble)
    states = []
    for _ in range(4):
        compute.measure(acquired.pk)
        states.append(now(acquired).state)

    assert states == [ScanState.PROCESSING, ScanState.PROCESSING, ScanState.FAILED, ScanState.FAILED]
    assert "Computing failed 3 times, last with: OSError: Input/output error" in now(acquired).fault


def test_a_scan_that_kills_its_workers_is_given_up(acquired: Scan) -> None:
    """Each attempt was claimed and never came back; the lease ran out each time."""
    Scan.objects.filter(pk=acquired.pk).update(
        attempts=compute.MOST_ATTEMPTS, lease_until=timezone.now() - dt.timedelta(seconds=1)
    )
    compute.measure(acquired.pk)

    assert now(acquired).state == ScanState.FAILED
    assert "never came to an end" in now(acquired).fault


def test_the_tick_rings_for_numbers_that_wait(acquired: Scan, rung: list[Any]) -> None:
    rung.clear()
    tick.ring_what_waits(timezone.now())
    assert rung == []  # the first ring may still be on its way
    tick.ring_what_waits(timezone.now() + tick.COMPUTE_PATIENCE + dt.timedelta(seconds=1))

    assert ("worker.measure", [acquired.pk], "compute") in rung


def test_the_tick_rings_rigs_with_waiting_scans_only(tool: Tool, rig: Rig, olga: User, rung: list[Any]) -> None:
    Rig.objects.create(slug="idle", name="Idle rig", exposures_us=[100])
    queue.enqueue_inspection(tool=tool, rig=rig, by=olga)
    rung.clear()
    tick.tick()
    assert rung == [("worker.ring", ["rig1"], "rig.rig1")]

    queue.pause_queue(rig, olga, "lunch")
    rung.clear()
    tick.tick()
    assert rung == []


def test_the_last_region_moves_the_schedules_date(acquired: Scan, rig: Rig, erik: User) -> None:
    today = timezone.localdate()
    schedule = schedules.save_schedule(
        by=erik, tool=acquired.region.tool, rig=rig, every=1, unit="weeks", next_due=today, automatic=False
    )
    compute.measure(acquired.pk)

    assert Schedule.objects.get(pk=schedule.pk).next_due == today + dt.timedelta(weeks=1)


def test_a_partial_scan_gets_no_ok_and_moves_no_date(acquired: Scan, rig: Rig, erik: User) -> None:
    today = timezone.localdate()
    schedules.save_schedule(
        by=erik, tool=acquired.region.tool, rig=rig, every=1, unit="weeks", next_due=today, automatic=False
    )
    Scan.objects.filter(pk=acquired.pk).update(partial=True)
    compute.measure(acquired.pk)

    image = now(acquired).range_images.get()
    assert image.verdict == Verdict.UNKNOWN
    assert "ended early" in image.verdict_reasons[0]
    assert Schedule.objects.get().next_due == today


def test_the_first_ok_scan_becomes_the_baseline_of_the_next(acquired: Scan, rig: Rig, olga: User) -> None:
    compute.measure(acquired.pk)
    again = queue.scan_again(now(acquired), olga)
    serve("rig1", opening=FakeRig().opening)
    compute.measure(again.pk)

    first, second = acquired.range_images.get(), again.range_images.get()
    assert (first.baseline, second.baseline) == (None, first)


def test_after_a_regrind_the_old_baseline_is_none(acquired: Scan, rig: Rig, olga: User) -> None:
    from inspection.services.plant import record_event

    compute.measure(acquired.pk)
    record_event(acquired.region.tool, "reground", at=timezone.now(), by=olga)
    again = queue.scan_again(now(acquired), olga)
    serve("rig1", opening=FakeRig().opening)
    compute.measure(again.pk)

    assert again.range_images.get().baseline is None


def test_the_queue_says_what_is_computed_and_how_long_it_waits(acquired: Scan, rig: Rig) -> None:
    view = queue_view(rig)
    late = queue_view(rig, now=timezone.now() + dt.timedelta(minutes=5))

    assert [row.why for row in view.processing] == ["surface numbers are being computed"]
    assert late.processing[0].why.startswith("waiting for a compute worker since ")
