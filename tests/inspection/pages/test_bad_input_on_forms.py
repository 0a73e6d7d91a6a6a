"""A fault is one sentence on the form, with status 422; what was typed stays and nothing is stored."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest
from django.core.files.uploadedfile import SimpleUploadedFile
from django.test import Client
from django.urls import reverse

from inspection.models import Calibration, Inspection, LimitSet, Region, Rig, Scan, Schedule, Tool, ToolType, User
from inspection.services import plant as services
from tests.inspection.pages.plant import GAUGE_PAIRS

Browse = Callable[[str], Client]


@pytest.fixture
def knife(people: dict[str, User]) -> Tool:
    return services.create_tool(by=people["erik"], code="K-114", tool_type=ToolType.objects.get())


@pytest.mark.parametrize(
    ("start", "length", "sentence"),
    [
        ("95", "10", "must lie within the tool&#x27;s edge"),
        ("-1", "2", "must lie within the tool&#x27;s edge"),
        ("1", "0", "must lie within the tool&#x27;s edge"),
        ("nonsense", "2", "Enter a number."),
    ],
)
def test_a_region_outside_the_tool_is_refused(
    browse: Browse, knife: Tool, start: str, length: str, sentence: str
) -> None:
    region = knife.regions.get(name="R1")
    form = {"name": "R1", "start_mm": start, "length_mm": length, "row_offset": 0, "rows": 1000, "flat_row": 0,
            "flat_rows": 600, "active": "on"}  # fmt: skip
    answer = browse("erik").post(reverse("region-edit", args=[knife.pk, region.pk]), form)
    assert answer.status_code == 422
    text = answer.content.decode()
    assert sentence in text
    assert f'value="{start}"' in text
    assert Region.objects.get(pk=region.pk).start_mm == region.start_mm


def test_a_region_beyond_the_stage_is_refused(browse: Browse, knife: Tool) -> None:
    Rig.objects.update(travel_mm=40.0)
    form = {
        "name": "R4",
        "start_mm": "39",
        "length_mm": "5",
        "row_offset": 0,
        "rows": 1000,
        "flat_row": 0,
        "flat_rows": 600,
    }
    answer = browse("erik").post(reverse("region-new", args=[knife.pk]), form)
    assert answer.status_code == 422
    assert "beyond the 40 mm that the longest stage can travel" in answer.content.decode()
    assert knife.regions.count() == 3


def test_an_order_names_what_is_wrong_and_queues_nothing(browse: Browse, knife: Tool) -> None:
    rig = Rig.objects.get()
    form: dict[str, Any] = {"rig": rig.pk, "regions": [r.pk for r in knife.regions.all()], "exposures_us": "100, fast"}
    answer = browse("olga").post(reverse("scan-order", args=[knife.pk]), form)
    assert answer.status_code == 422
    assert "“100, fast” is not a list of times" in answer.content.decode()
    answer = browse("olga").post(reverse("scan-order", args=[knife.pk]), {**form, "exposures_us": "-5"})
    assert answer.status_code == 422
    assert Inspection.objects.count() == 0


def test_an_order_queues_one_scan_per_chosen_region(browse: Browse, knife: Tool) -> None:
    two = list(knife.regions.order_by("name"))[:2]
    answer = browse("olga").post(
        reverse("scan-order", args=[knife.pk]),
        {
            "rig": Rig.objects.get().pk,
            "regions": [r.pk for r in two],
            "exposures_us": "100;300",
            "reason": "After collision",
        },
    )
    visit = Inspection.objects.get()
    assert answer["Location"] == visit.get_absolute_url()
    assert [scan.region for scan in visit.scans.order_by("region__name")] == two
    assert visit.reason == "After collision"


@pytest.mark.parametrize(
    ("pairs", "sentence"),
    [
        (b"height_mm,column_px\n0.1,10\n0.2,20\n", "three"),
        (b"height_mm,column_px\n0.1,10\n0.2,nan\n0.3,30\n", "line 3"),
        (b"a,b\n1,2\n", "has no column height_mm"),
        (b"\xff\xfe\x00\x01binary", "not a text file"),
        (b"", "empty"),
    ],
)
def test_unusable_gauge_pairs_are_refused(browse: Browse, pairs: bytes, sentence: str) -> None:
    before = Calibration.objects.count()
    form = {"rig": Rig.objects.get().pk, "artefact": "Stair 1", "done_on": "2026-01-02", "valid_until": "2026-07-01",
            "csv_file": SimpleUploadedFile("pairs.csv", pairs), "confirm": "1"}  # fmt: skip
    answer = browse("erik").post(reverse("calibration-new"), form)
    assert answer.status_code == 422
    text = answer.content.decode()
    assert sentence in text
    assert 'value="Stair 1"' in text
    assert Calibration.objects.count() == before


def test_a_calibration_is_looked_at_before_it_counts(browse: Browse) -> None:
    before = Calibration.objects.count()
    form = {"rig": Rig.objects.get().pk, "artefact": "Stair 1", "done_on": "2026-01-02", "valid_until": "2026-07-01"}
    client = browse("erik")
    upload = SimpleUploadedFile("pairs.csv", GAUGE_PAIRS.encode())
    look = client.post(reverse("calibration-new"), {**form, "csv_file": upload})
    assert look.status_code == 200
    assert "It is not in force yet" in look.content.decode()
    assert Calibration.objects.count() == before
    kept = look.context["form"]["pairs"].value()
    answer = client.post(reverse("calibration-new"), {**form, "pairs": kept, "confirm": "1"})
    added = Calibration.objects.latest("pk")
    assert answer["Location"] == added.get_absolute_url()
    assert len(added.pairs) == 8


def test_limits_demand_a_reason_and_their_order(browse: Browse) -> None:
    kind = ToolType.objects.get()
    client = browse("erik")
    url = reverse("limits-edit", args=[kind.pk])
    form = {"watch:d_max": "60", "replace:d_max": "150"}
    assert client.post(url, form).status_code == 422
    swapped = client.post(url, {"watch:d_max": "200", "replace:d_max": "150", "reason": "Try"})
    assert swapped.status_code == 422
    assert "must not lie above" in swapped.content.decode()
    assert LimitSet.objects.count() == 1
    assert client.post(url, {**form, "reason": "Softer wood this season"}).status_code == 302
    newest = LimitSet.objects.latest("version")
    assert newest.version == 2
    assert newest.reason == "Softer wood this season"
    assert [(limit.metric, limit.watch_above) for limit in newest.limits.all()] == [("d_max", 60.0)]


def test_a_schedule_whose_window_swallows_its_interval_is_refused(browse: Browse, knife: Tool) -> None:
    form = {"tool": knife.pk, "rig": Rig.objects.get().pk, "every": "1", "unit": "weeks", "next_due": "2026-12-01",
            "window_before_days": "9", "window_after_days": "2", "queue_after": "06:00"}  # fmt: skip
    answer = browse("erik").post(reverse("schedule-new"), form)
    assert answer.status_code == 422
    assert "one inspection would count for two dates" in answer.content.decode()
    assert Schedule.objects.count() == 0
    assert browse("erik").post(reverse("schedule-new"), {**form, "window_before_days": "1"}).status_code == 302
    assert Schedule.objects.get().every == 1


def test_an_event_in_the_future_is_refused_and_the_dialog_stays_open(browse: Browse, knife: Tool) -> None:
    form = {"event-kind": "reground", "event-at": "2199-01-01T06:00", "event-note": "typed in vain?"}
    answer = browse("olga").post(reverse("tool-event", args=[knife.pk]), form)
    assert answer.status_code == 422
    text = answer.content.decode()
    assert "lies in the future" in text
    assert "typed in vain?" in text
    assert knife.events.count() == 0


def test_a_tool_code_is_given_once(browse: Browse, knife: Tool) -> None:
    form = {"code": "K-114", "tool_type": knife.tool_type_id, "status": "in service"}
    answer = browse("erik").post(reverse("tool-new"), form)
    assert answer.status_code == 422
    assert "There is already a tool K-114" in answer.content.decode()


@pytest.mark.parametrize(
    ("files", "sentence"),
    [
        ([("stack.json", b"{")], "stack.json"),
        ([("frames.zip", b"no zip")], "cannot be unpacked"),
        ([("a.tiff", b"II*\0")], "stack.json"),
        ([("stack.json", json.dumps({"format": "edgewatch-stack/1", "exposures_us": [100], "step_um": 8.33,
           "row_pitch_um": 7.15, "mm_per_pixel": 0.0142, "line_width_px": 3.0, "dark_level": 2, "saturation": 255,
           "response": "linear"}).encode()), ("exposure-100us.tiff", b"not a picture")], "exposure-100us.tiff"),
    ],
)  # fmt: skip
def test_a_broken_stack_is_one_sentence_and_leaves_nothing(
    browse: Browse, knife: Tool, settings: Any, files: list[tuple[str, bytes]], sentence: str
) -> None:
    region = knife.regions.get(name="R2")
    uploads = [SimpleUploadedFile(name, content) for name, content in files]
    answer = browse("olga").post(
        reverse("import"), {"region": region.pk, "rig": Rig.objects.get().pk, "stack": uploads}
    )
    assert answer.status_code == 422
    text = answer.content.decode()
    assert sentence in text
    assert f'<option value="{region.pk}" selected>' in text
    assert Scan.objects.count() == 0
    left = [path for path in settings.UPLOADS.rglob("*") if path.is_file()] if settings.UPLOADS.exists() else []
    assert left == []
