"""Full disks, stepped clocks, storms and doubles: each leaves a true state and a sentence."""

from __future__ import annotations

import datetime as dt
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import h5py
import pytest
import time_machine
from django.conf import settings
from django.db import connection
from django.utils import timezone

from inspection.models import DueSlot, Inspection, Rig, Scan, Tool, User
from inspection.services import queue
from inspection.services import ring as doorbell
from inspection.services.continuing import continue_scan
from inspection.services.emergency import emergency_stop
from inspection.services.schedules import save_schedule
from inspection.services.schedules import tick as schedule_tick
from inspection.states import QueueState, ScanState
from scanning import open_stack
from tests.faults.plant import Plant, plant, wait_until
from tests.worker.fakes import FakeRig, at_grab
from worker import stopping
from worker.lease import claim, sweep
from worker.rig import serve
from worker.scan import run_scan

pytestmark = pytest.mark.django_db(transaction=True)


@pytest.fixture(autouse=True)
def clean(settings: Any, tmp_path: Path) -> None:
    settings.STACKS, settings.RANGES = tmp_path / "stacks", tmp_path / "ranges"
    stopping.forget()


@pytest.fixture
def one(make_tool: Callable[..., Tool], rig: Rig, olga: User) -> Scan:
    return queue.enqueue_inspection(tool=make_tool(regions=1), rig=rig, by=olga).scans.get()


def now(scan: Scan) -> Scan:
    return Scan.objects.select_related("rig").get(pk=scan.pk)


def run(fake: FakeRig) -> str:
    lease = claim("rig1", "tester")
    assert lease is not None
    return run_scan(lease, opening=fake.opening)


def test_a_full_disk_ends_the_scan_with_a_sentence_and_it_goes_on_once_there_is_room(
    one: Scan, olga: User, monkeypatch: pytest.MonkeyPatch
) -> None:
    resize = h5py.Dataset.resize
    full = [True]

    def refuse(self: Any, size: int, axis: int | None = None) -> None:
        if full[0] and self.name == "/frames" and size > 12:
            raise OSError(28, "No space left on device")
        resize(self, size, axis)

    monkeypatch.setattr(h5py.Dataset, "resize", refuse)
    fake = FakeRig()
    assert run(fake) == ScanState.FAILED

    scan = now(one)
    assert "cannot be written" in scan.fault
    assert "make room on the disk" in scan.fault
    assert (fake.lit, fake.parked, scan.rig.queue_state) == (False, 1, QueueState.PAUSED)
    with open_stack(Path(settings.STACKS) / scan.stack_file) as stack:
        assert stack.header.steps == 12
    full[0] = False
    continue_scan(scan, olga, looked=True)
    assert run(FakeRig()) == ScanState.PROCESSING
    assert now(one).acquisition["continued_at_step"] == 12


@pytest.mark.parametrize("hours", [1, -1])
def test_a_clock_stepped_by_an_hour_costs_no_running_scan(one: Scan, hours: int) -> None:
    """NTP finds the machine an hour off in mid-scan. The lease's end is in the future or the past, its owner lives."""
    with time_machine.travel(timezone.now(), tick=True) as clock:

        def step() -> None:
            clock.shift(dt.timedelta(hours=hours))
            # The next beat comes before the sweep: the worker beats every 3 s, the sweep runs every second or later.
            lease.renew()
            assert sweep() == []

        lease = claim("rig1", "tester")
        assert lease is not None
        assert run_scan(lease, opening=FakeRig(at_grab(40, step)).opening) == ScanState.PROCESSING
    assert now(one).done == 30


def test_after_a_step_back_a_dead_worker_is_still_found(one: Scan) -> None:
    """Its lease seems to run for an hour; the hour is the longest a false state may stand."""
    lease = claim("rig1", "tester")
    assert lease is not None
    until = now(one).lease_until
    assert until is not None
    back = timezone.now() - dt.timedelta(hours=1)
    assert sweep(back) == []
    assert sweep(back + dt.timedelta(hours=1, seconds=10)) == [one.pk]


@pytest.mark.parametrize(
    ("day", "at"),
    [(dt.date(2026, 3, 29), "02:30"), (dt.date(2026, 10, 25), "02:30"), (dt.date(2026, 10, 25), "00:10")],
)
def test_a_due_date_on_the_day_the_clocks_change_is_queued_once(
    tool: Tool, rig: Rig, erik: User, settings: Any, day: dt.date, at: str
) -> None:
    """02:30 does not exist on one of these days and comes twice on the other."""
    settings.TIME_ZONE = "Europe/Berlin"
    zone = ZoneInfo("Europe/Berlin")
    with timezone.override(zone):
        save_schedule(
            by=erik, tool=tool, rig=rig, every=1, unit="weeks", next_due=day, queue_after=dt.time.fromisoformat(at)
        )
        moment = dt.datetime.combine(day, dt.time(0), zone).astimezone(dt.UTC)
        queued_at = []
        for minute in range(0, 26 * 60, 10):
            tick = moment + dt.timedelta(minutes=minute)
            if schedule_tick(tick).queued:
                queued_at.append(tick.astimezone(zone))
    assert len(queued_at) == 1
    assert queued_at[0].date() == day
    assert (queued_at[0].time().replace(microsecond=0) >= dt.time.fromisoformat(at)) or day.month == 3
    assert Inspection.objects.count() == DueSlot.objects.count() == 1


def test_two_ticks_at_once_queue_what_is_due_once(make_tool: Callable[..., Tool], rig: Rig, erik: User) -> None:
    today = timezone.localdate()
    for n in range(5):
        save_schedule(
            by=erik, tool=make_tool(f"K-{n}"), rig=rig, every=1, unit="weeks", next_due=today, queue_after=dt.time(0)
        )
    moment = timezone.now().replace(hour=23, minute=59)
    start = threading.Barrier(4)

    def tick() -> None:
        start.wait()
        try:
            schedule_tick(moment)
        finally:
            connection.close()

    threads = [threading.Thread(target=tick) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    schedule_tick(moment)
    assert Inspection.objects.count() == DueSlot.objects.filter(inspection__isnull=False).count() == 5
    assert Scan.objects.count() == 15


def test_two_workers_of_one_rig_share_its_scans_and_never_drive_it_together(
    make_tool: Callable[..., Tool], rig: Rig, olga: User
) -> None:
    queue.enqueue_inspection(tool=make_tool(regions=3), rig=rig, by=olga)
    driving = threading.Lock()
    together: list[bool] = []
    start = threading.Barrier(2)
    ended: list[str] = []

    class Watched(FakeRig):
        @contextmanager
        def opening(self, config: Mapping[str, Any]) -> Iterator[Any]:
            alone = driving.acquire(blocking=False)
            together.append(not alone)
            try:
                with super().opening(config) as opened:
                    yield opened
            finally:
                if alone:
                    driving.release()

    def work() -> None:
        start.wait()
        try:
            deadline = time.monotonic() + 60
            while Scan.objects.filter(state=ScanState.QUEUED).exists() and time.monotonic() < deadline:
                ended.extend(serve("rig1", opening=Watched().opening))
        finally:
            connection.close()

    threads = [threading.Thread(target=work) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert ended.count(ScanState.PROCESSING) == 3
    assert together == [False, False, False]


# -- with real processes ----------------------------------------------------------------------------------------------


def light_and_time(rig: Rig) -> float:
    from scanning.rig.simulated.camera import SimulatedCamera

    camera = SimulatedCamera(rig.config["camera"]["address"])
    camera.open()
    try:
        return float(camera.bench_state()["laser"])
    finally:
        camera.close()


@pytest.mark.timeout(200)
def test_a_storm_a_flush_and_the_emergency_stop_on_a_working_rig(
    make_tool: Callable[..., Tool], rig: Rig, olga: User, settings: Any
) -> None:
    with plant() as site:
        _storm(site, make_tool, rig, olga, settings)
    doorbell._sender.cache_clear()


def _storm(site: Plant, make_tool: Callable[..., Tool], rig: Rig, olga: User, settings: Any) -> None:
    site.environment["EDGEWATCH_HOME"] = str(settings.HOME)
    site.valkey()
    Rig.objects.update(config=site.simulated_rig(speed_up=1.0), exposures_us=[300])
    rig.refresh_from_db()
    settings.REDIS_URL = site.redis_url
    doorbell._sender.cache_clear()
    site.worker("rig.rig1")
    wait_until(lambda: Rig.objects.get().worker_seen_at, "the rig's worker")

    # Redis loses everything between the order and its ring; the next ring finds the row.
    tool = make_tool(regions=1, length_mm=8.0, rows=64)
    scan = queue.enqueue_inspection(tool=tool, rig=rig, by=olga).scans.get()
    with site.broker() as broker:
        broker.flushall()
    doorbell.ring("rig1")
    wait_until(lambda: now(scan).done >= 3, "the scan after Redis was flushed")

    # 10,000 rings while it scans: nothing starts twice, and the scan goes on.
    with site.broker() as broker:
        message = wait_until(lambda: doorbell.ring("rig1") or broker.lindex("rig.rig1", 0), "a ring in the queue")
        broker.rpush("rig.rig1", *[message] * 10_000)
    at = now(scan).done
    wait_until(lambda: now(scan).done > at, "steps during the storm")

    # The emergency stop, pressed at the rig's own speed: from the call to the controller's laser being off.
    took = []
    for number in range(3):
        wait_until(lambda: light_and_time(rig) > 0 and now(scan).state == ScanState.RUNNING, "light")
        began = time.perf_counter()
        assert emergency_stop(rig, olga)
        while light_and_time(rig) > 0:
            assert time.perf_counter() - began < 5
        took.append(1000 * (time.perf_counter() - began))
        wait_until(lambda: now(scan).state == ScanState.INTERRUPTED, "the interrupted state")
        if number < 2:
            continue_scan(now(scan), olga, looked=True)
    print("emergency stop to dark: " + ", ".join(f"{ms:.0f} ms" for ms in took))
    assert min(took) < 100
    assert "Emergency stop by olga" in now(scan).fault
    # The storm's messages are answered by looking: one scan, driven once at a time, none doubled.
    assert (Scan.objects.count(), now(scan).attempts) == (1, 3)
