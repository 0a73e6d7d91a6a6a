"""CSV exports open right in a spreadsheet, run nothing there, and hold every number unchanged."""

from __future__ import annotations

import csv
import datetime as dt
import io

import numpy as np
import pytest
from django.db import connection
from django.test.utils import CaptureQueriesContext

from inspection.models import Role
from inspection.reports.csv import Dialect, safe_text, write_table
from inspection.reports.rows import Selection, measurements_table, scans_table
from inspection.states import ScanState
from scanning.errors import BadInput
from tests.inspection.reports import plant

pytestmark = pytest.mark.django_db


@pytest.fixture
def viewer(client):
    client.force_login(plant.person("vera", Role.VIEWER))
    return client


def body(response) -> str:
    return b"".join(response.streaming_content).decode("utf-8")


def parsed(text: str, separator: str = ",") -> list[list[str]]:
    assert text.startswith("\ufeff"), "Excel needs the byte order mark"
    return list(csv.reader(io.StringIO(text[1:]), delimiter=separator))


@pytest.mark.parametrize("text", ["=1+1", "+49 40", "-2+3", "@SUM(A1)", "\t=1", "  =1", "\r=1", "＝1"])
def test_text_that_a_spreadsheet_would_run_is_disarmed(text):
    assert safe_text(text) == "'" + text


@pytest.mark.parametrize("text", ["K-114", "a=b", "", "2-3", "Ä"])
def test_other_text_is_left_alone(text):
    assert safe_text(text) == text


@pytest.mark.parametrize(
    ("value", "point", "comma"),
    [
        (-22.5, "-22.5", "-22,5"), (1e-7, "1e-07", "1e-07"), (-3, "-3", "-3"), (float("nan"), "", ""),
        (float("-inf"), "", ""), (None, "", ""), (True, "yes", "yes"), (-1.5e-5, "-1.5e-05", "-1,5e-05"),
        (dt.date(2026, 5, 4), "2026-05-04", "2026-05-04"),
    ],
)  # fmt: skip
def test_numbers_are_never_touched(value, point, comma):
    assert Dialect().cell(value) == point
    assert Dialect(";", ",").cell(value) == comma


def test_every_float32_comes_back_unchanged():
    values = np.random.default_rng(1).normal(0, 1e3, 500).astype(np.float32)
    assert [np.float32(Dialect().cell(float(value))) for value in values] == list(values)


@pytest.mark.parametrize(("separator", "decimal"), [(",", ","), ("|", "."), (";", "x"), ("", "")])
def test_an_impossible_dialect_is_refused_in_one_sentence(viewer, separator, decimal):
    with pytest.raises(BadInput):
        Dialect.asked_for(separator, decimal)
    answer = viewer.get("/reports/scans.csv", {"sep": separator, "decimal": decimal})
    assert answer.status_code == 422
    assert answer.content.decode().count(".") >= 1


def test_the_measurements_come_one_row_per_scan_and_metric(viewer):
    tool = plant.knife(code="=K-1", note="=cmd|' /C calc'!A0")
    plant.visit(tool, 0, recession=-12.25)
    answer = viewer.get("/reports/measurements.csv", {"tool": "=K-1", "sep": ";", "decimal": ","})
    assert "attachment" in answer["Content-Disposition"]
    table = parsed(body(answer), ";")
    heading = table[0]
    assert len(table) == 1 + 3 * 4
    row = next(line for line in table if line[heading.index("region")] == "R1")
    assert row[heading.index("tool")] == "'=K-1"
    assert row[heading.index("value")] == "-12,25"
    assert row[heading.index("standard uncertainty")] == "3,1"
    assert row[heading.index("unit")] == "um"
    assert row[heading.index("origin")]
    tools = parsed(body(viewer.get("/reports/tools.csv")))
    assert tools[1][-1].startswith("'=cmd")
    assert tools[1][tools[0].index("verdict")] == "replace"


def test_the_scans_say_what_failed_and_why(viewer):
    plant.visit(plant.knife(), 0, states={"R2": ScanState.FAILED})
    table = parsed(body(viewer.get("/reports/scans.csv")))
    by_region = {row[3]: row for row in table[1:]}
    assert by_region["R2"][4:6] == ["failed", ""]
    assert by_region["R2"][-1].startswith("The camera sent no frame")
    assert by_region["R3"][4:6] == ["done", "replace"]
    assert float(by_region["R1"][table[0].index("undefined %")]) == pytest.approx(6.35)


def test_only_the_newest_result_of_a_scan_is_exported():
    tool = plant.knife()
    scan = plant.visit(tool, 0, recession=10).scans.get(region__name="R1")
    plant.result(scan, 0, 99.0, {}, False, (5, 5), scan.limit_set, later=dt.timedelta(hours=2))
    values = [row[7] for row in measurements_table(Selection(region="R1")).rows]
    assert 99.0 in values
    assert 10.0 not in values


def test_the_selection_narrows_by_tool_state_and_day(viewer):
    tool = plant.knife()
    plant.visit(tool, 0)
    plant.visit(tool, 1, states={"R1": ScanState.FAILED})
    plant.visit(plant.knife("K-2"), 1)
    assert len(parsed(body(viewer.get("/reports/scans.csv", {"tool": "K-114"})))) == 7
    assert len(parsed(body(viewer.get("/reports/scans.csv", {"state": "failed"})))) == 2
    assert len(parsed(body(viewer.get("/reports/scans.csv", {"since": "2026-06-08", "until": "2026-06-08"})))) == 7
    assert viewer.get("/reports/scans.csv", {"since": "yesterday"}).status_code == 422
    assert viewer.get("/reports/scans.csv", {"state": "lost"}).status_code == 422


def test_the_damages_have_position_and_uncertainty(viewer):
    plant.visit(plant.knife(), 0)
    answer = viewer.get("/reports/damages.csv")
    table = parsed(body(answer))
    assert [row[5] for row in table[1:]].count("medium") == 2
    assert all(float(row[7]) > 0 for row in table[1:])


def test_the_range_image_is_a_matrix_with_its_axes(viewer):
    visit = plant.visit(plant.knife(), 0, images=True, shape=(40, 12))
    scan = visit.scans.get(region__name="R1")
    answer = viewer.get(f"/reports/scans/{scan.pk}/range.csv", {"sep": ";", "decimal": ","})
    assert f"K-114_R1_2026-06-01_scan-{scan.pk}_range.csv" in answer["Content-Disposition"]
    table = parsed(body(answer), ";")
    start = next(i for i, row in enumerate(table) if row and row[0] == "y mm \\ x mm")
    assert ["row pitch µm", "7,150838"] in table
    assert ["profile pitch µm", "41,65"] in table
    assert table[start][1:4] == ["0,0000", "0,0416", "0,0833"]
    matrix = table[start + 1 :]
    assert len(matrix) == 40
    stored = plant.surface((40, 12), [], seed=0)
    got = np.array([[float(cell.replace(",", ".")) if cell else np.nan for cell in row[1:]] for row in matrix])
    np.testing.assert_allclose(got, stored, atol=0.0051)
    assert np.isnan(got).any()


def test_a_range_image_that_was_changed_on_disk_is_not_exported(viewer, settings):
    visit = plant.visit(plant.knife(), 0, images=True, shape=(40, 12))
    scan = visit.scans.get(region__name="R1")
    path = settings.RANGES / scan.range_images.get().file
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    answer = viewer.get(f"/reports/scans/{scan.pk}/range.csv")
    assert answer.status_code == 422
    assert "was changed after it was judged" in answer.content.decode()
    path.unlink()
    assert "is missing" in viewer.get(f"/reports/scans/{scan.pk}/range.csv").content.decode()


def test_an_export_costs_the_same_number_of_queries_for_one_scan_and_for_many():
    tool = plant.knife()
    plant.visit(tool, 0)
    with CaptureQueriesContext(connection) as one:
        list(write_table(scans_table(Selection()), Dialect()))
        list(write_table(measurements_table(Selection()), Dialect()))
    for number in range(1, 6):
        plant.visit(tool, number)
    with CaptureQueriesContext(connection) as many:
        list(write_table(scans_table(Selection()), Dialect()))
        list(write_table(measurements_table(Selection()), Dialect()))
    assert len(many) == len(one)


def test_exports_are_for_people_who_signed_in(client):
    assert client.get("/reports/scans.csv").status_code in (302, 401, 403)
