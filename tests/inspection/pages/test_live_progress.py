"""A running scan's fragment is cheap while nothing moves, tells the truth when it does, and stops asking at the end."""

from __future__ import annotations

import datetime as dt
import re
from collections.abc import Callable

import pytest
import time_machine
from django.test import Client
from django.urls import reverse
from django.utils import timezone

from inspection.models import Inspection, Rig, Scan, Tool, ToolType, User
from inspection.services import plant as services
from inspection.states import ScanState
from tests.inspection.pages.plant import ACQUISITION, scan_row

Browse = Callable[[str], Client]
NOON = dt.datetime(2026, 3, 4, 12, 0, 1, tzinfo=dt.UTC)


@pytest.fixture
def tool(people: dict[str, User]) -> Tool:
    return services.create_tool(by=people["erik"], code="K-7", tool_type=ToolType.objects.get())


@pytest.fixture
def scan(tool: Tool, people: dict[str, User]) -> Scan:
    visit = Inspection.objects.create(tool=tool, requested_by=people["olga"], requested_at=timezone.now())
    region = tool.regions.get(name="R1")
    return scan_row(visit, region, ScanState.RUNNING, timezone.now(), done=10, total=245, phase="scan")


def ask(client: Client, scan: Scan, tag: str = "") -> object:
    headers = {"HX-Request": "true"} | ({"If-None-Match": tag} if tag else {})
    return client.get(reverse("scan-progress", args=[scan.pk]), headers=headers)


def test_nothing_new_is_answered_without_a_body(browse: Browse, scan: Scan) -> None:
    client = browse("vera")
    with time_machine.travel(NOON, tick=False):
        first = client.get(reverse("scan-progress", args=[scan.pk]))
        again = client.get(reverse("scan-progress", args=[scan.pk]), headers={"If-None-Match": first["ETag"]})
    assert first.status_code == 200
    assert again.status_code == 304
    assert again.content == b""


@pytest.mark.parametrize(
    "change", [{"done": 11}, {"message": "dark"}, {"cancel_requested_at": NOON}, {"state": "paused"}]
)
def test_every_change_is_sent(browse: Browse, scan: Scan, change: dict[str, object]) -> None:
    client = browse("vera")
    with time_machine.travel(NOON, tick=False):
        tag = client.get(reverse("scan-progress", args=[scan.pk]))["ETag"]
        Scan.objects.filter(pk=scan.pk).update(**change)
        assert client.get(reverse("scan-progress", args=[scan.pk]), headers={"If-None-Match": tag}).status_code == 200


def test_the_end_stops_the_polling_and_turns_the_page_into_the_result(browse: Browse, scan: Scan) -> None:
    client = browse("vera")
    tag = client.get(reverse("scan-progress", args=[scan.pk]))["ETag"]
    Scan.objects.filter(pk=scan.pk).update(state=ScanState.FAILED, fault="The laser is gone.")
    answer = client.get(reverse("scan-progress", args=[scan.pk]), headers={"If-None-Match": tag})
    assert answer.status_code == 286
    assert answer["HX-Refresh"] == "true"
    assert "hx-trigger" not in answer.content.decode()
    assert "The laser is gone." in client.get(scan.get_absolute_url()).content.decode()


def test_no_time_is_promised_at_the_start_and_a_sound_one_later(browse: Browse, scan: Scan) -> None:
    client = browse("vera")
    Scan.objects.filter(pk=scan.pk).update(started_at=NOON - dt.timedelta(seconds=5), done=2)
    with time_machine.travel(NOON, tick=False):
        assert "not yet known" in client.get(reverse("scan-progress", args=[scan.pk])).content.decode()
    Scan.objects.filter(pk=scan.pk).update(started_at=NOON - dt.timedelta(seconds=49), done=49)
    with time_machine.travel(NOON, tick=False):
        text = client.get(reverse("scan-progress", args=[scan.pk])).content.decode()
    assert "about 3 min 16 s" in text  # 196 steps at 1 s each
    assert re.search(r"20 %", text)


def test_a_viewer_gets_no_buttons_and_an_operator_does(browse: Browse, scan: Scan) -> None:
    assert "<button" not in browse("vera").get(reverse("scan-progress", args=[scan.pk])).content.decode()
    text = browse("olga").get(reverse("scan-progress", args=[scan.pk])).content.decode()
    assert "Pause" in text
    assert "Cancel…" in text


def test_cancelling_asks_with_the_facts_first(browse: Browse, scan: Scan) -> None:
    text = browse("olga").get(scan.get_absolute_url()).content.decode()
    dialog = text[text.index('<dialog id="cancel-dialog">') :]
    assert "10 of 245 steps" in dialog
    assert "Let it run" in dialog


@pytest.mark.parametrize(
    ("address", "column"),
    [
        ("scan-cancel", "cancel_requested_at"),
        ("scan-pause", "pause_requested_at"),
        ("scan-finish", "finish_requested_at"),
    ],
)
def test_a_button_writes_the_request_the_worker_reads(browse: Browse, scan: Scan, address: str, column: str) -> None:
    assert browse("olga").post(reverse(address, args=[scan.pk])).status_code == 302
    scan.refresh_from_db()
    assert getattr(scan, column) is not None
    assert scan.state == ScanState.RUNNING


def test_a_button_that_comes_too_late_says_so(browse: Browse, scan: Scan) -> None:
    Scan.objects.filter(pk=scan.pk).update(state=ScanState.DONE)
    answer = browse("olga").post(reverse("scan-pause", args=[scan.pk]), follow=True)
    assert "is done; only a running scan can be paused" in answer.content.decode()


def test_the_queue_moves_by_buttons_and_answers_with_its_rows(browse: Browse, scan: Scan, tool: Tool) -> None:
    later = [
        scan_row(scan.inspection, tool.regions.get(name=name), ScanState.QUEUED, timezone.now(), position=place)
        for place, name in enumerate(("R2", "R3"), 1)
    ]
    answer = browse("olga").post(
        reverse("queue-move", args=["rig1", later[1].pk]), {"where": "next"}, headers={"HX-Request": "true"}
    )
    text = answer.content.decode()
    assert answer.status_code == 200
    assert text.lstrip().startswith('<div id="queue"')
    assert text.index(f"/scans/{later[1].pk}/") < text.index(f"/scans/{later[0].pk}/")


def test_the_rig_is_locked_with_a_note_everybody_sees(browse: Browse, people: dict[str, User]) -> None:
    client = browse("olga")
    htmx = {"HX-Request": "true"}
    refused = client.post(reverse("queue-lock", args=["rig1"]), {"note": " "}, headers=htmx)
    assert "Say what is done at the rig" in refused.content.decode()
    client.post(reverse("queue-lock", args=["rig1"]), {"note": "Cleaning the lens"})
    text = browse("vera").get("/").content.decode()
    assert "queue locked. Cleaning the lens" in text
    client.post(reverse("queue-unlock", args=["rig1"]))
    assert Rig.objects.get().queue_state == "ready"


def test_the_time_budget_is_shown_largest_first(browse: Browse, scan: Scan) -> None:
    from inspection.selectors.scan import time_budget

    parts = time_budget(ACQUISITION)
    assert [part.name for part in parts] == ["motion", "exposure", "readout", "settle", "homing", "other"]
    assert sum(part.share for part in parts) == pytest.approx(1.0)
