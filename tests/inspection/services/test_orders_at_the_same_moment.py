"""Two people at two screens in the same second: neither order is lost, doubled or woven into the other."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable
from typing import Any

import pytest
from django.db import connection

from inspection.models import LimitSet, Recipe, Rig, Scan, Tool, ToolType, User
from inspection.services import queue
from inspection.services.limits import set_limits
from inspection.services.recipes import recipe_named
from inspection.states import QueueState, ScanState
from scanning.errors import BadInput

pytestmark = pytest.mark.django_db(transaction=True)


def at_once(*acts: Callable[[], Any]) -> list[Any]:
    """Run ``acts`` in a thread each, started together; what each returned, or the `BadInput` it raised."""
    start = threading.Barrier(len(acts))
    came: list[Any] = [None] * len(acts)

    def run(at: int, act: Callable[[], Any]) -> None:
        start.wait()
        try:
            came[at] = act()
        except BadInput as refused:
            came[at] = refused
        finally:
            connection.close()

    threads = [threading.Thread(target=run, args=one) for one in enumerate(acts)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return came


def test_the_scans_of_a_tool_stay_together(make_tool: Callable[..., Tool], rig: Rig, olga: User) -> None:
    """Woven orders would have a person change knives after every region."""
    tools = [make_tool(f"K-{n}") for n in range(4)]
    at_once(*(lambda tool=tool: queue.enqueue_inspection(tool=tool, rig=rig, by=olga) for tool in tools))

    order = [scan.region.tool.code for scan in Scan.objects.order_by("position", "pk").select_related("region__tool")]
    changes = sum(one != other for one, other in itertools.pairwise(order))
    assert len(order) == 12
    assert changes == 3, order
    assert len(set(Scan.objects.values_list("position", flat=True))) == 12


def test_a_cancelled_scan_is_cancelled_once_and_never_started(tool: Tool, rig: Rig, olga: User) -> None:
    from worker.lease import claim

    for _ in range(8):
        scan = queue.enqueue_inspection(tool=tool, rig=rig, by=olga, regions=[tool.regions.first()]).scans.get()  # type: ignore[list-item]
        cancelled, got = at_once(lambda scan=scan: queue.cancel_scan(scan, olga), lambda: claim("rig1", "w"))
        scan.refresh_from_db()
        if got is None:
            assert scan.state == ScanState.CANCELLED
        else:  # claimed first: the worker is asked to stop
            assert (scan.state, scan.cancel_requested_at is not None) == (ScanState.RUNNING, True)
        assert cancelled is None
        Scan.objects.filter(pk=scan.pk).update(state=ScanState.CANCELLED)


def test_hands_and_a_starting_scan_never_meet(tool: Tool, rig: Rig, olga: User) -> None:
    from worker.lease import claim

    queue.enqueue_inspection(tool=tool, rig=rig, by=olga)
    for _ in range(8):
        locked, got = at_once(lambda: queue.lock_rig(rig, olga, "lens"), lambda: claim("rig1", "w"))
        state = Rig.objects.get().queue_state
        assert (state == QueueState.LOCKED) == (got is None) == (locked is None)
        Scan.objects.filter(state=ScanState.RUNNING).update(state=ScanState.QUEUED, lease_token=None)
        Rig.objects.update(queue_state=QueueState.READY)


def test_two_sets_of_limits_get_two_versions_or_one_sentence(tool_type: ToolType, erik: User, adam: User) -> None:
    came = at_once(
        *(
            lambda by=by: set_limits(tool_type, {"d_max": (50.0, 150.0, "um")}, by=by, reason="Trial")
            for by in (erik, adam)
        )
    )
    versions = list(LimitSet.objects.order_by("version").values_list("version", flat=True))
    refused = [one for one in came if isinstance(one, BadInput)]
    assert versions == list(range(1, 3 - len(refused)))
    assert all("Somebody else set the limits" in str(one) for one in refused)


def test_a_recipe_used_by_many_at_once_is_kept_once(db: None) -> None:
    came = at_once(*(lambda: recipe_named("HDRE-I").pk for _ in range(4)))
    assert len(set(came)) == 1
    assert Recipe.objects.count() == 1
