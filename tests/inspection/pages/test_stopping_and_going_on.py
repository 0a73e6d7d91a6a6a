"""The buttons for trouble: emergency stop, continue, a cart of tools, many scans computed again."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from django.test import Client
from django.utils import timezone

from inspection.models import Recomputation, RecomputationBatch, Rig, Scan, Tool, User
from inspection.services import queue
from inspection.services.recipes import recipe_named
from inspection.states import QueueState, ScanState


@pytest.fixture
def sign_in(olga: User, erik: User) -> Callable[[User], Client]:
    def signed_in(who: User) -> Client:
        client = Client()
        client.force_login(who)
        return client

    return signed_in


@pytest.fixture
def running(tool: Tool, rig: Rig, olga: User) -> Scan:
    scan = queue.enqueue_inspection(tool=tool, rig=rig, by=olga).scans.order_by("position")[0]
    Scan.objects.filter(pk=scan.pk).update(state=ScanState.RUNNING, started_at=timezone.now(), done=5)
    return Scan.objects.get(pk=scan.pk)


def test_the_emergency_stop_is_one_click_on_the_queue_and_on_the_scan(
    sign_in: Callable[[User], Client], running: Scan, olga: User
) -> None:
    client = sign_in(olga)
    for page in ("/rigs/rig1/", f"/scans/{running.pk}/"):
        assert 'action="/rigs/rig1/stop/"' in client.get(page).content.decode()
    answer = client.post("/rigs/rig1/stop/", follow=True).content.decode()

    assert "the stage is halted and the laser goes off" in answer
    running.refresh_from_db()
    assert running.stop_requested_by == olga
    assert Rig.objects.get().queue_state == QueueState.PAUSED
    assert client.post("/rigs/rig1/stop/", follow=True).status_code == 200  # pressed twice, it has been pressed


def test_a_scan_goes_on_only_when_somebody_has_looked(
    sign_in: Callable[[User], Client], running: Scan, olga: User
) -> None:
    Scan.objects.filter(pk=running.pk).update(state=ScanState.INTERRUPTED, partial=True, stack_file="a.h5.part")
    client = sign_in(olga)
    page = f"/scans/{running.pk}/"
    assert "Continue at step 5 of 30" in client.get(page).content.decode()
    assert "Look at the rig first" in client.post(f"{page}continue/", follow=True).content.decode()
    client.post(f"{page}continue/", {"looked": "1"})
    running.refresh_from_db()
    assert running.state == ScanState.QUEUED
    assert "Continue at step" not in client.get(page).content.decode()


def test_a_cart_is_queued_whole_in_its_order_or_not_at_all(
    sign_in: Callable[[User], Client], make_tool: Callable[..., Tool], rig: Rig, olga: User
) -> None:
    for code in ("K-1", "K-2", "K-3"):
        make_tool(code, regions=2)
    client = sign_in(olga)
    for codes, sentence in (
        ("K-2\nK-9\n", "No tool has the code K-9"),
        ("K-2\nK-2", "on the list twice"),
        (" \n", "This field is required"),
    ):
        answer = client.post("/rigs/rig1/cart/", {"codes": codes})
        assert answer.status_code == 422
        assert sentence in answer.content.decode()
    assert not Scan.objects.exists()
    assert client.post("/rigs/rig1/cart/", {"codes": "K-2\r\nK-3\r\nK-1\r\n"}).status_code == 302
    order = [scan.inspection.tool.code for scan in Scan.objects.order_by("position")]
    assert order == ["K-2", "K-2", "K-3", "K-3", "K-1", "K-1"]


def test_many_are_counted_before_they_are_computed_again(
    sign_in: Callable[[User], Client], running: Scan, erik: User
) -> None:
    Scan.objects.update(state=ScanState.DONE, stack_file="a.h5", finished_at=timezone.now())
    client = sign_in(erik)
    form = {"recipe": recipe_named("SCI").pk, "reason": "Trial", "count": ""}
    assert "3 scans</b> with stored frames fit" in client.post("/again/", form).content.decode()
    assert not RecomputationBatch.objects.exists()
    del form["count"]
    assert client.post("/again/", {**form, "start": "", "tool": "K-8"}).status_code == 422
    page = client.post("/again/", {**form, "start": ""})["Location"]

    assert "Computing 3 scans again" in client.get(page).content.decode()
    assert client.get(page, headers={"HX-Request": "true"}).status_code == 200
    client.post(f"{page}cancel/")
    assert client.get(page, headers={"HX-Request": "true"}).status_code == 286  # nothing waits: stop asking
    assert set(Recomputation.objects.values_list("state", flat=True)) == {"cancelled"}
    client.post(f"{page}resume/")
    assert set(Recomputation.objects.values_list("state", flat=True)) == {"queued"}
