"""The history of a tool: newest results only, segments at regrinds, limits, a forecast, and always a few queries."""

from __future__ import annotations

import datetime as dt
import json
import time

import pytest
from django.db import connection
from django.test.utils import CaptureQueriesContext

from inspection.models import Event, Inspection, Measurement, RangeImage, Scan, Tool
from inspection.selectors.trend import tool_trends, trend, trend_metrics
from inspection.states import ScanState
from tests.inspection.reports import plant

pytestmark = pytest.mark.django_db
NOW = plant.FIRST_VISIT + dt.timedelta(days=80)


def worn(tool: Tool, recessions: list[float], first: int = 0, **options) -> list[Inspection]:
    return [plant.visit(tool, first + i, recession=value, **options) for i, value in enumerate(recessions)]


def r1(tool: Tool):
    return tool.regions.get(name="R1")


def test_steady_wear_is_forecast_on_the_life_axis():
    tool = plant.knife()
    worn(tool, [20, 74, 127, 183, 236])
    Tool.objects.filter(pk=tool.pk).update(life_used=33)
    tool.refresh_from_db()
    history = trend(r1(tool), "ER_max", now=NOW)
    assert [point["value"] for point in history["points"]] == [20, 74, 127, 183, 236]
    assert history["fit"]["axis"] == "life"
    assert history["fit"]["rate"] == pytest.approx(54.1 / 8, rel=1e-3)
    assert history["fit"]["s"] == pytest.approx(3.1), "the measurement uncertainty is the floor"
    forecast = history["forecast"]
    assert (forecast["limit_name"], forecast["limit"]) == ("replace", 450)
    assert forecast["at"] == pytest.approx((450 - 19.8) / 6.7625, rel=1e-3)
    assert forecast["earliest"] < forecast["at"] < forecast["latest"]
    assert forecast["remaining"] == pytest.approx(forecast["at"] - 33)
    assert "reaches the replace limit of 450 µm at about 63.6 h" in history["sentence"]
    assert "95 %" in history["sentence"]
    assert history["limits"] == {"watch": 300.0, "replace": 450.0, "unit": "um", "version": 1}
    json.dumps(history, allow_nan=False)


def test_the_line_never_crosses_a_regrind():
    tool = plant.knife()
    worn(tool, [20, 120, 220, 320, 420])
    Event.objects.create(tool=tool, kind="reground", at=plant.FIRST_VISIT + dt.timedelta(days=33))
    worn(tool, [15, 35, 55, 75], first=5)
    history = trend(r1(tool), "ER_max", now=NOW)
    assert [point["segment"] for point in history["points"]] == [0] * 5 + [1] * 4
    assert history["fit"]["rate"] == pytest.approx(20 / 8)
    assert [segment["n"] for segment in history["segments"]] == [5, 4]
    assert [event["ends_segment"] for event in history["events"]] == [True]


def test_a_collision_is_a_mark_but_not_a_new_edge():
    tool = plant.knife()
    worn(tool, [20, 40, 60, 80])
    Event.objects.create(tool=tool, kind="collision", at=plant.FIRST_VISIT + dt.timedelta(days=10))
    history = trend(r1(tool), "ER_max", now=NOW)
    assert {point["segment"] for point in history["points"]} == {0}
    assert history["events"][0]["kind"] == "collision"


def test_without_life_used_the_axis_is_the_date():
    tool = plant.knife()
    worn(tool, [20, 90, 160, 230], life=None)
    Inspection.objects.update(life_used=None)
    history = trend(r1(tool), "ER_max", now=plant.FIRST_VISIT + dt.timedelta(days=21))
    assert history["fit"]["axis"] == "date"
    assert history["fit"]["rate"] == pytest.approx(10)
    assert history["forecast"]["at_date"] == "2026-07-14"
    assert history["forecast"]["remaining"] == pytest.approx(22, abs=0.01)


@pytest.mark.parametrize(
    ("recessions", "says"),
    [
        ([], "No forecast for ER_max: 0 scans since"),
        ([20], "1 scan since the edge was last renewed; a forecast needs at least 3"),
        ([20, 40, 60], "low confidence: only 3 scans, no interval"),
        ([20, 40, 60, 500], "is 500 µm: the replace limit of 450 µm is already passed"),
        ([60, 40, 30, 20], "shows no rising trend over 4 scans"),
        ([20, 60, 30, 45], "no upper bound"),
    ],
)
def test_the_sentence_says_what_the_forecast_is_worth(recessions, says):
    tool = plant.knife()
    worn(tool, recessions)
    assert says in trend(r1(tool), "ER_max", now=NOW)["sentence"]


def test_reprocessing_replaces_the_point_and_failed_scans_give_none():
    tool = plant.knife()
    visits = worn(tool, [20, 40])
    plant.visit(tool, 2, states={"R1": ScanState.FAILED})
    scan = visits[1].scans.get(region__name="R1")
    plant.result(scan, 0, 44.0, {}, False, (10, 10), scan.limit_set, later=dt.timedelta(hours=1))
    history = trend(r1(tool), "ER_max", now=NOW)
    assert [point["value"] for point in history["points"]] == [20, 44]
    assert history["points"][1]["url"] == f"/scans/{scan.pk}/"


def test_a_scan_finished_early_is_shown_but_not_fitted():
    tool = plant.knife()
    visits = worn(tool, [20, 40, 60, 5])
    Scan.objects.filter(inspection=visits[-1]).update(partial=True)
    history = trend(r1(tool), "ER_max", now=NOW)
    assert [point["used"] for point in history["points"]] == [True, True, True, False]
    assert history["fit"]["n"] == 3


def test_what_was_not_measured_is_null():
    tool = plant.knife()
    worn(tool, [20, 40])
    history = trend(r1(tool), "Sq_c", now=NOW)
    assert [point["value"] for point in history["points"]] == [None, None]
    assert history["points"][0]["note"] == "not measured"


def test_limits_in_another_unit_are_not_compared():
    tool = plant.knife()
    worn(tool, [20, 40, 60, 80])
    tool.tool_type.limit_sets.create(version=2, reason="wrong unit").limits.create(
        metric="ER_max", replace_above=0.45, unit="mm"
    )
    history = trend(r1(tool), "ER_max", now=NOW)
    assert history["forecast"] is None
    assert "in mm but it is measured in µm" in history["sentence"]


def test_a_report_of_last_month_does_not_know_this_month():
    tool = plant.knife()
    worn(tool, [20, 40, 60])
    until = plant.FIRST_VISIT + dt.timedelta(days=8)
    assert len(trend(r1(tool), "ER_max", until=until, now=until)["points"]) == 2


def test_the_metrics_of_a_tool_come_with_their_labels():
    tool = plant.knife()
    worn(tool, [20])
    codes = [metric["code"] for metric in trend_metrics(tool)]
    assert codes[:2] == ["ER_max", "V-"]


def test_two_thousand_scans_cost_four_queries_and_a_blink():
    tool = plant.knife()
    first = plant.visit(tool, 0, recession=0)
    template = first.scans.get(region__name="R1")
    start = plant.FIRST_VISIT
    inspections = Inspection.objects.bulk_create(
        Inspection(tool=tool, requested_at=start + dt.timedelta(hours=i), life_used=float(i)) for i in range(2000)
    )
    scans = Scan.objects.bulk_create(
        Scan(
            inspection=inspection, region=template.region, rig=template.rig, recipe=template.recipe, state="done",
            queued_at=inspection.requested_at, finished_at=inspection.requested_at,
        )
        for inspection in inspections
    )  # fmt: skip
    images = RangeImage.objects.bulk_create(
        RangeImage(
            scan=scan, recipe=template.recipe, created_at=scan.finished_at, file="none", sha256="0" * 64, rows=1,
            profiles=1, row_pitch_um=1, profile_pitch_um=1, provenance={},
        )
        for scan in scans
    )  # fmt: skip
    Measurement.objects.bulk_create(
        Measurement(range_image=image, metric=metric, label=metric, value=0.1 * i, unit="µm", u=3.0)
        for i, image in enumerate(images)
        for metric in ("ER_max", "V-", "a", "b", "c")
    )
    took = []
    for _ in range(3):
        began = time.perf_counter()
        with CaptureQueriesContext(connection) as queries:
            history = trend(r1(tool), "ER_max", now=NOW)
        took.append(time.perf_counter() - began)
    assert len(history["points"]) == 2001
    assert len(queries) <= 6
    with CaptureQueriesContext(connection) as all_queries:
        assert len(tool_trends(tool, ["ER_max", "V-", "d_max"], now=NOW)) == 9
    assert len(all_queries) <= len(queries) + 1
    print(f"2001 scans: {1e3 * min(took):.0f} ms, {len(queries)} queries")
    assert min(took) < 0.3
