"""Every page shows a plant in full swing to every role that may see it, and loads nothing from anywhere else."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import pytest
from django.test import Client
from django.urls import reverse
from django.utils import timezone

from inspection.models import Calibration, Event, Inspection, LimitSet, Recipe, Scan, Schedule, Tool, User
from inspection.roles import NEEDED
from inspection.services import plant as services
from inspection.states import ScanState
from tests.inspection.pages.plant import small_plant, whole_plant

pytestmark = pytest.mark.django_db


@pytest.fixture
def plant() -> dict[str, User]:
    return whole_plant(shape=(160, 90), visits=2)


def client_of(person: User) -> Client:
    client = Client()
    client.force_login(person)
    return client


class Page(HTMLParser):
    """Collects what a browser would load or run."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.inline: list[str] = []
        self.script_kind: str | None = None
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        values = dict(attributes)
        self.loaded += [value for name in ("src", "href", "action") if (value := values.get(name))]
        self.inline += [f"{tag} {name}" for name in values if name.startswith("on")]
        if tag == "script" and "src" not in values and values.get("type") != "application/json":
            self.inline.append("script")


SHOWN = (ScanState.QUEUED, ScanState.RUNNING, ScanState.DONE, ScanState.FAILED, ScanState.INTERRUPTED)


def pages() -> list[tuple[str, list[object]]]:
    """(address, arguments) of every page that can be looked at, on records in many states."""
    found: list[tuple[str, list[object]]] = [
        (name, [])
        for name in (
            "overview",
            "rigs",
            "calibrations",
            "calibration-new",
            "recipes",
            "limits",
            "schedules",
            "import",
            "schedule-new",
            "tool-new",
            "tool-type-new",
            "audit",
            "health-page",
            "help",
            "people",
            "person-new",
            "own-password",
        )
    ]
    found += [("tool", [tool.pk]) for tool in Tool.objects.all()]
    found += [("scan", [Scan.objects.filter(state=state).latest("pk").pk]) for state in SHOWN]
    found += [("inspection", [Inspection.objects.filter(scans__state=state).latest("pk").pk]) for state in SHOWN]
    found += [("queue", ["rig1"]), ("queue", ["rig2"])]
    tool = Tool.objects.get(code="K-114")
    region = tool.regions.get(name="R2")
    done = Scan.objects.filter(region=region, state=ScanState.DONE).latest("finished_at")
    found += [
        ("tool-edit", [tool.pk]), ("region-new", [tool.pk]), ("region-edit", [tool.pk, region.pk]),
        ("scan-order", [tool.pk]), ("scan-compare", [done.pk]), ("calibration", [Calibration.objects.latest("pk").pk]),
        ("recipe", [Recipe.objects.latest("pk").pk]), ("limits-history", [tool.tool_type_id]),
        ("limits-edit", [tool.tool_type_id]), ("tool-type-edit", [tool.tool_type_id]),
        ("schedule-edit", [Schedule.objects.latest("pk").pk]), ("person-edit", [User.objects.get(username="vera").pk]),
    ]  # fmt: skip
    return found


def test_every_page_shows_for_every_role_that_may_see_it(plant: dict[str, User]) -> None:
    for name, person in plant.items():
        client = client_of(person)
        for address, arguments in pages():
            if not person.at_least(NEEDED[address]):
                continue
            answer = client.get(reverse(address, args=arguments), follow=True)
            where = (name, address, arguments)
            assert answer.status_code == 200, where
            text = answer.content.decode()
            assert "{{" not in text, where
            assert "{%" not in text, where
            assert not re.search(r"\bnan\b(?!o)", re.sub(r"<[^>]*>", " ", text)), where
            page = Page(text)
            assert page.inline == [], where
            assert [link for link in page.loaded if re.match(r"(https?:)?//", link)] == [], where


def test_every_answer_carries_the_content_policy(plant: dict[str, User]) -> None:
    for path in ("/", "/sign-in/", "/nowhere/", "/people/"):
        policy = client_of(plant["vera"]).get(path)["Content-Security-Policy"]
        assert "script-src 'self';" in policy
        assert "unsafe-eval" not in policy


def test_the_overview_shows_the_worst_first_and_why(plant: dict[str, User]) -> None:
    text = client_of(plant["vera"]).get("/").content.decode()
    assert text.index("K-114") < text.index("K-115")
    assert "5 days overdue" in text
    assert "Not scanned since it was reground." in text


def test_a_scanned_label_opens_its_tool(plant: dict[str, User]) -> None:
    tool = Tool.objects.get(code="K-204")
    answer = client_of(plant["vera"]).get(reverse("tool-lookup"), {"search": "k-204"})
    assert answer["Location"] == tool.get_absolute_url()


def test_an_unknown_label_says_so_and_keeps_what_was_typed(plant: dict[str, User]) -> None:
    answer = client_of(plant["vera"]).get(reverse("tool-lookup"), {"search": "Q-9"}, follow=True)
    text = answer.content.decode()
    assert "No tool has the code “Q-9”" in text
    assert 'value="Q-9"' in text


def test_an_empty_plant_says_what_to_do_next() -> None:
    people = small_plant()
    assert "Add the first tool" in client_of(people["erik"]).get("/").content.decode()
    assert "An engineer must add the first tool" in client_of(people["vera"]).get("/").content.decode()
    assert "Nothing waits" in client_of(people["vera"]).get(reverse("queue", args=["rig1"])).content.decode()


def test_the_waiting_scans_say_why_they_wait(plant: dict[str, User]) -> None:
    text = client_of(plant["vera"]).get(reverse("queue", args=["rig2"])).content.decode()
    assert "Queue paused by Olga" in text
    assert "Waiting for the step gauge" in text


def test_a_regrind_takes_the_old_verdict_away(plant: dict[str, User]) -> None:
    tool = Tool.objects.get(code="K-114")
    client = client_of(plant["vera"])
    assert 'class="panel hero replace"' in client.get(tool.get_absolute_url()).content.decode()
    services.record_event(tool, Event.Kind.REGROUND, at=timezone.now(), by=plant["olga"], removed_mm=0.5)
    text = client.get(tool.get_absolute_url()).content.decode()
    assert 'class="panel hero unknown"' in text
    assert "the present edge was not scanned yet" in text


def test_a_scan_page_shows_number_uncertainty_damage_and_what_it_rests_on(plant: dict[str, User]) -> None:
    scan = Scan.objects.filter(region__tool__code="K-114", region__name="R3", state=ScanState.DONE).latest(
        "finished_at"
    )
    image = scan.range_images.get()
    text = client_of(plant["vera"]).get(scan.get_absolute_url()).content.decode()
    assert re.search(r"[\d.]+ <span class=\"pm\">± [\d.]+ µm</span>", text)
    assert text.count('data-damage="') == image.damages.count() > 0
    assert image.sha256[:16] in text
    assert scan.stack_sha256[:16] in text
    assert f"v{LimitSet.objects.get().version}" in text


def test_the_overview_asks_the_database_a_fixed_number_of_times(
    plant: dict[str, User], django_assert_max_num_queries: pytest.FixtureRequest
) -> None:
    client = client_of(plant["vera"])
    with django_assert_max_num_queries(12):  # type: ignore[operator]
        client.get("/")
