"""A batch: many scans computed again, with progress, cancel and resume; the results there were stay."""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from django.utils import timezone

from inspection.models import RangeImage, Recomputation, Rig, Scan, Tool, User
from inspection.services import again, queue
from inspection.services.recipes import recipe_named
from scanning.errors import BadInput
from tests.worker.fakes import FakeRig
from worker import compute, tick
from worker.rig import serve

pytestmark = pytest.mark.django_db(transaction=True)


@pytest.fixture(autouse=True)
def own_folders(settings: Any, tmp_path: Path) -> None:
    settings.STACKS, settings.RANGES = tmp_path / "stacks", tmp_path / "ranges"


@pytest.fixture
def rung(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Recomputations rung for, instead of a broker."""
    calls: list[int] = []
    monkeypatch.setattr("inspection.services.ring._send_group", lambda _task, ids, _queue: calls.extend(ids))
    monkeypatch.setattr("inspection.services.ring._send", lambda *_: None)
    return calls


@pytest.fixture
def scans(make_tool: Callable[..., Tool], rig: Rig, olga: User) -> list[Scan]:
    """Four measured scans."""
    tool = make_tool(regions=2, length_mm=0.4, rows=80, flat_row=5, flat_rows=60)
    for _ in range(2):
        queue.enqueue_inspection(tool=tool, rig=rig, by=olga, recipe=recipe_named("NF"))
    serve("rig1", opening=FakeRig().opening)
    for scan in Scan.objects.all():
        compute.measure(scan.pk)
    return list(Scan.objects.order_by("pk"))


def test_each_that_ends_rings_for_the_next_until_all_are_done(
    scans: list[Scan], erik: User, rung: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(again, "AT_ONCE", 2)
    monkeypatch.setattr(again.ring_next, "__defaults__", (2,))
    before = {image.pk: image.sha256 for image in RangeImage.objects.all()}
    batch = again.compute_many_again(scans, recipe_named("SCI"), erik, "SCI for all")
    assert len(rung) == 2
    while rung:
        compute.recompute(rung.pop(0))

    assert again.counts(batch) == {"queued": 0, "running": 0, "done": 4, "failed": 0, "cancelled": 0}
    assert RangeImage.objects.count() == 8
    assert {image.pk: image.sha256 for image in RangeImage.objects.filter(pk__in=before)} == before
    assert {scan.state for scan in Scan.objects.all()} == {"done"}


def test_cancelling_takes_out_what_waits_and_resuming_puts_it_back(
    scans: list[Scan], erik: User, rung: list[int]
) -> None:
    batch = again.compute_many_again(scans, recipe_named("SCI"), erik, "Trial")
    compute.recompute(rung[0])
    assert again.cancel_batch(batch, erik) == 3
    for order in list(rung):  # messages that were on their way find nothing to do
        compute.recompute(order)
    assert again.counts(batch)["done"] == 1
    with pytest.raises(BadInput, match="nothing to cancel"):
        again.cancel_batch(batch, erik)

    rung.clear()
    assert again.resume_batch(batch, erik) == 3
    for order in list(rung):
        compute.recompute(order)
    assert again.counts(batch)["done"] == 4
    with pytest.raises(BadInput, match="nothing to resume"):
        again.resume_batch(batch, erik)


def test_one_that_fails_does_not_stop_the_others(scans: list[Scan], erik: User, rung: list[int], settings: Any) -> None:
    (Path(settings.STACKS) / scans[1].stack_file).unlink()
    batch = again.compute_many_again(scans, recipe_named("SCI"), erik, "Trial")
    for order in list(rung):
        compute.recompute(order)

    assert (again.counts(batch)["done"], again.counts(batch)["failed"]) == (3, 1)
    assert Recomputation.objects.get(state="failed").fault


def test_a_killed_workers_order_is_found_by_its_lease_and_done_once(
    scans: list[Scan], erik: User, rung: list[int]
) -> None:
    batch = again.compute_many_again(scans[:1], recipe_named("SCI"), erik, "Trial")
    order = batch.orders.get()
    held = {"state": "running", "attempts": 1, "started_at": timezone.now()}
    Recomputation.objects.update(**held, lease_until=timezone.now() + dt.timedelta(seconds=5))
    rung.clear()
    tick.sweep()
    compute.recompute(order.pk)
    assert (rung, again.counts(batch)["running"]) == ([], 1)  # its worker is alive

    Recomputation.objects.update(lease_until=timezone.now() - dt.timedelta(seconds=1))
    tick.sweep()
    assert rung == [order.pk]
    compute.recompute(order.pk)
    compute.recompute(order.pk)
    assert again.counts(batch)["done"] == 1
    assert RangeImage.objects.filter(scan=scans[0]).count() == 2


def test_the_tick_rings_for_a_few_of_each_batch_however_many_wait(
    scans: list[Scan], erik: User, rung: list[int]
) -> None:
    again.compute_many_again(scans * 5, recipe_named("SCI"), erik, "Trial")
    rung.clear()
    tick.ring_what_waits(timezone.now())
    assert len(rung) == again.AT_ONCE


def test_a_batch_that_cannot_be_is_refused_whole(scans: list[Scan], erik: User, rung: list[int]) -> None:
    Scan.objects.filter(pk=scans[3].pk).update(stack_file="")
    scans[3].refresh_from_db()
    with pytest.raises(BadInput, match="has no finished frames"):
        again.compute_many_again(scans, recipe_named("SCI"), erik, "Trial")
    with pytest.raises(BadInput, match="Say why"):
        again.compute_many_again(scans[:1], recipe_named("SCI"), erik, " ")
    with pytest.raises(BadInput, match="No scan with stored frames"):
        again.compute_many_again([], recipe_named("SCI"), erik, "Trial")
    assert not Recomputation.objects.exists()
