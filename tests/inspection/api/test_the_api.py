"""The API: who may do what, pages of records, orders, conflicts, and faults in one sentence."""

from __future__ import annotations

import datetime as dt
import io
import json

import numpy as np
import pytest
from django.test import Client
from django.utils import timezone

from inspection.api import api
from inspection.api.tokens import find_token, issue_token, revoke_token
from inspection.models import ApiToken, Measurement, RangeImage, Role, Scan
from inspection.states import ScanState
from scanning.errors import BadInput
from tests.inspection.reports import plant

pytestmark = pytest.mark.django_db


class Program:
    """Another program with a token."""

    def __init__(self, secret: str = "") -> None:
        self.client = Client()
        self.headers = {"Authorization": f"Bearer {secret}"} if secret else {}

    def get(self, path: str, **query):
        return self.client.get(f"/api/v1{path}", query, headers=self.headers)

    def post(self, path: str, body=None, raw: bytes | None = None):
        data = raw if raw is not None else json.dumps(body or {})
        return self.client.post(f"/api/v1{path}", data, content_type="application/json", headers=self.headers)


def program(role: str = Role.VIEWER, scope: str = ApiToken.Scope.READ) -> Program:
    owner = plant.person(f"robot-{role}", role)
    return Program(issue_token(owner=owner, name="CMMS", scope=scope, by=owner)[1])


@pytest.fixture
def reader() -> Program:
    return program()


@pytest.fixture
def planner() -> Program:
    return program(Role.OPERATOR, ApiToken.Scope.QUEUE)


def strict(answer):
    def never(name: str):
        raise AssertionError(f"{name} is not JSON")

    return json.loads(answer.content, parse_constant=never)


# --- who may -------------------------------------------------------------------------------------------------------


def reads() -> list[str]:
    return [
        path.replace("{tool_id}", "1")
        .replace("{scan_id}", "1")
        .replace("{inspection_id}", "1")
        .replace("{slug}", "rig-1")
        for path, ways in api.get_openapi_schema(path_prefix="")["paths"].items()
        if "get" in ways
    ]


def test_every_address_wants_a_key():
    stranger = Program()
    addresses = reads()
    assert len(addresses) >= 14
    for address in addresses:
        answer = stranger.get("/" + address.lstrip("/"))
        assert answer.status_code == 401, address
        assert strict(answer)["detail"].startswith("Sign in")
    assert stranger.post("/inspections", {}).status_code == 401
    assert stranger.post("/scans/1/cancel").status_code == 401


def test_a_wrong_withdrawn_or_ownerless_token_opens_nothing(reader):
    assert Program("ewt_wrong").get("/tools").status_code == 401
    assert Program("ewt_é").get("/tools").status_code == 401
    owner = plant.person("robot-viewer")
    token, secret = issue_token(owner=owner, name="x", scope="read", by=owner)
    assert Program(secret).get("/tools").status_code == 200
    revoke_token(token, by=owner)
    assert Program(secret).get("/tools").status_code == 401
    _, other = issue_token(owner=owner, name="y", scope="read", by=owner)
    owner.is_active = False
    owner.save()
    assert Program(other).get("/tools").status_code == 401


def test_only_the_hash_of_a_token_is_kept():
    owner = plant.person("vera")
    token, secret = issue_token(owner=owner, name="x", scope="read", by=owner)
    assert secret not in str(ApiToken.objects.filter(pk=token.pk).values())
    assert find_token(secret) == token


def test_a_wrong_token_does_not_fall_back_on_the_session():
    program = Program("ewt_wrong")
    program.client.force_login(plant.person("adam", Role.ADMIN))
    assert program.get("/me").status_code == 401


@pytest.mark.parametrize(
    ("role", "scope", "status"),
    [("operator", "queue", 201), ("admin", "queue", 201), ("operator", "read", 403), ("viewer", "read", 403)],
)
def test_only_operators_with_the_scope_may_order(role, scope, status):
    plant.knife()
    plant.rig()
    answer = program(role, scope).post("/inspections", {"tool": "K-114", "rig": "rig-1"})
    assert answer.status_code == status, answer.content
    assert Scan.objects.count() == (3 if status == 201 else 0)


def test_a_viewer_gets_no_queue_token_and_a_demoted_operator_loses_it():
    with pytest.raises(BadInput, match="may not order scans"):
        issue_token(owner=plant.person("vera"), name="x", scope="queue", by=plant.person("vera"))
    plant.knife()
    plant.rig()
    planner = program(Role.OPERATOR, "queue")
    owner = plant.person("robot-operator")
    owner.role = Role.VIEWER
    owner.save()
    assert planner.post("/inspections", {"tool": "K-114", "rig": "rig-1"}).status_code == 403
    assert strict(planner.get("/me")) == {
        "user": "robot-operator", "role": "viewer", "may_read": True, "may_queue": False, "token": "CMMS",
    }  # fmt: skip


def test_a_session_reads_but_orders_only_with_the_csrf_token():
    plant.knife()
    plant.rig()
    browser = Client(enforce_csrf_checks=True)
    browser.force_login(plant.person("olga", Role.OPERATOR))
    assert browser.get("/api/v1/tools").status_code == 200
    order = json.dumps({"tool": "K-114", "rig": "rig-1"})
    refused = browser.post("/api/v1/inspections", order, content_type="application/json")
    assert refused.status_code == 403
    assert "CSRF" in strict(refused)["detail"]
    browser.get("/api/v1/docs")  # its page carries the token
    crumb = browser.cookies["csrftoken"].value
    taken = browser.post("/api/v1/inspections", order, content_type="application/json", headers={"X-CSRFToken": crumb})
    assert taken.status_code == 201


# --- reading -------------------------------------------------------------------------------------------------------


def test_tools_come_with_their_worst_verdict(reader):
    tool = plant.knife()
    plant.knife("K-2")
    plant.visit(tool, 0)
    listed = strict(reader.get("/tools"))
    assert listed["count"] == 2
    assert {row["code"]: row["verdict"] for row in listed["items"]} == {"K-114": "replace", "K-2": None}
    assert strict(reader.get("/tools", code="K-2"))["count"] == 1
    detail = strict(reader.get(f"/tools/{tool.pk}"))
    assert [region["name"] for region in detail["regions"]] == ["R1", "R2", "R3"]
    assert "ER_max" in [metric["code"] for metric in detail["metrics"]]


def test_scans_come_in_pages_without_gaps_or_doubles(reader):
    tool = plant.knife()
    for number in range(4):
        plant.visit(tool, number)
    seen = []
    for offset in range(0, 15, 5):
        page = strict(reader.get("/scans", limit=5, offset=offset))
        assert (page["count"], page["limit"], page["offset"]) == (12, 5, offset)
        seen += [row["id"] for row in page["items"]]
    assert len(seen) == 12
    assert set(seen) == set(Scan.objects.values_list("pk", flat=True))
    assert reader.get("/scans", limit=501).status_code == 422
    assert reader.get("/scans", offset=-1).status_code == 422


def test_scans_are_found_by_tool_state_and_day(reader):
    plant.visit(plant.knife(), 0, states={"R2": ScanState.FAILED})
    plant.visit(plant.knife("K-2"), 1)
    assert strict(reader.get("/scans", tool="K-2"))["count"] == 3
    failed = strict(reader.get("/scans", state="failed"))
    assert [row["region"] for row in failed["items"]] == ["R2"]
    assert failed["items"][0]["fault"].startswith("The camera sent no frame")
    assert strict(reader.get("/scans", since="2026-06-08"))["count"] == 3
    assert "There is no state" in strict(reader.get("/scans", state="lost"))["detail"]


def test_a_scan_comes_with_numbers_damages_precision_and_provenance(reader):
    visit = plant.visit(plant.knife(), 0)
    scan = visit.scans.get(region__name="R2")
    plant.result(scan, 1, 5.0, {}, False, (4, 4), scan.limit_set, later=dt.timedelta(hours=1))
    told = strict(reader.get(f"/scans/{scan.pk}"))
    result = told["result"]
    numbers = {row["metric"]: row for row in result["measurements"]}
    assert numbers["ER_max"]["value"] == pytest.approx(9.0)
    assert numbers["V-"] | {"origin": ""} == {
        "metric": "V-", "label": "Missing volume", "value": 0.031, "unit": "mm3", "u": 0.0016, "origin": "",
    }  # fmt: skip
    assert numbers["Sq_c"]["value"] is None
    assert [damage["severity"] for damage in result["damages"]] == ["medium", "medium", "minor"]
    assert result["precision"]["sigma_um"] == 4.21
    assert result["precision"]["confident_share"] is None  # stored before there was such a figure
    known = {"confident": {"above": 0.95, "share": 0.972}, "outside_calibrated": {"count": 0, "share": 0.0}}
    plant.result(scan, 1, 5.0, {}, False, (4, 4), scan.limit_set, later=dt.timedelta(hours=2), precision=known)
    newest = strict(reader.get(f"/scans/{scan.pk}"))["result"]["precision"]
    assert (newest["confident_share"], newest["confident_above"]) == (0.972, 0.95)
    assert newest["outside_calibrated_share"] == 0.0
    assert result["calibration"]["slope_mm_per_px"] == 0.014237376
    assert result["limits_version"] == 1
    assert len(told["results"]) == 2
    assert len(told["stack_sha256"]) == 64


def test_nan_is_null_everywhere(reader):
    visit = plant.visit(plant.knife(), 0)
    scan = visit.scans.get(region__name="R1")
    image = scan.range_images.get()
    fresh = RangeImage.objects.create(
        scan=scan, recipe=scan.recipe, created_at=image.created_at + dt.timedelta(hours=1), file="x", sha256="0" * 64,
        rows=1, profiles=1, row_pitch_um=1, profile_pitch_um=1, provenance={"deep": [1.0, {"er": None}]},
    )  # fmt: skip
    Measurement.objects.create(range_image=fresh, metric="ER_max", label="x", value=float("nan"), u=float("inf"))
    numbers = strict(reader.get(f"/scans/{scan.pk}"))["result"]["measurements"]
    assert (numbers[0]["value"], numbers[0]["u"]) == (None, None)
    strict(reader.get(f"/tools/{visit.tool_id}/trend", metric="ER_max"))


def test_a_visit_is_as_bad_as_its_worst_region_and_never_ok_with_one_missing(reader):
    tool = plant.knife()
    all_there = plant.visit(tool, 0)
    hole = plant.visit(tool, 1, states={"R2": ScanState.FAILED, "R3": ScanState.CANCELLED})
    assert strict(reader.get(f"/inspections/{all_there.pk}"))["verdict"] == "replace"
    assert strict(reader.get(f"/inspections/{hole.pk}"))["verdict"] == "unknown"
    assert strict(reader.get("/inspections", tool="K-114"))["count"] == 2


def test_the_range_image_is_the_stored_file(reader):
    visit = plant.visit(plant.knife(), 0, images=True, shape=(40, 12))
    scan = visit.scans.get(region__name="R1")
    answer = reader.get(f"/scans/{scan.pk}/range.npz")
    with np.load(io.BytesIO(b"".join(answer.streaming_content))) as data:
        np.testing.assert_array_equal(data["height_um"], plant.surface((40, 12), [], seed=0))
    text = b"".join(reader.get(f"/scans/{scan.pk}/range.csv", sep=";", decimal=",").streaming_content).decode()
    assert "row pitch" in text
    unfinished = plant.visit(plant.knife("K-2"), 0, states={"R1": ScanState.RUNNING})
    refused = reader.get(f"/scans/{unfinished.scans.get(region__name='R1').pk}/range.npz")
    assert refused.status_code == 422
    assert "has no range image: it is running" in strict(refused)["detail"]


def test_the_trend_holds_the_forecast(reader):
    tool = plant.knife()
    for number, recession in enumerate([20, 74, 127, 183]):
        plant.visit(tool, number, recession=recession)
    told = strict(reader.get(f"/tools/{tool.pk}/trend", metric="ER_max", region="R1"))
    assert len(told) == 1
    assert "reaches the replace limit of 450 µm" in told[0]["sentence"]
    assert reader.get(f"/tools/{tool.pk}/trend", metric="ER_max", region="R9").status_code == 422
    assert reader.get(f"/tools/{tool.pk}/trend").status_code == 422


# --- ordering ------------------------------------------------------------------------------------------------------


def test_an_order_is_queued_and_visible(planner):
    plant.knife()
    plant.rig()
    told = strict(
        planner.post("/inspections", {"tool": "K-114", "rig": "rig-1", "regions": ["R3", "R1"], "reason": "noise"})
    )
    assert [scan["region"] for scan in told["scans"]] == ["R1", "R3"]
    assert {scan["state"] for scan in told["scans"]} == {"queued"}
    assert (told["requested_by"], told["reason"], told["verdict"]) == ("robot-operator", "noise", "unknown")
    queue = strict(planner.get("/rigs/rig-1/queue"))
    assert [row["position"] for row in queue["rows"]] == [1, 2]
    assert all(row["waits_for"] for row in queue["rows"])


def test_cancelling_twice_is_a_conflict_that_names_the_state(planner):
    plant.knife()
    plant.rig()
    told = strict(planner.post("/inspections", {"tool": "K-114", "rig": "rig-1"}))
    scan = told["scans"][0]["id"]
    assert strict(planner.post(f"/scans/{scan}/cancel"))["state"] == "cancelled"
    again = planner.post(f"/scans/{scan}/cancel")
    assert again.status_code == 409
    assert strict(again)["state"] == "cancelled"
    assert strict(again)["detail"].endswith(".")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"tool": "K-0"}, "There is no tool 'K-0'"),
        ({"rig": "rig-9"}, "There is no rig 'rig-9'"),
        ({"regions": ["R9"]}, "has no region 'R9'"),
        ({"recipe": "magic"}, "magic"),
        ({"exposures_us": [-1]}, "-1"),
        ({"exposures_us": ["long"]}, "exposures_us"),
        ({"exposures_us": [float("nan")]}, "xposure"),
        ({"regions": []}, "region"),
        ({"tol": 1}, "tol"),
        ({"tool": "a\x00b"}, "tool"),
        ({"tool": None}, "tool"),
    ],
)
def test_a_bad_order_is_one_sentence_and_queues_nothing(planner, change, says):
    plant.knife()
    plant.rig()
    answer = planner.post("/inspections", {"tool": "K-114", "rig": "rig-1"} | change)
    assert answer.status_code == 422
    detail = strict(answer)["detail"]
    assert isinstance(detail, str)
    assert says in detail
    assert detail.endswith(".")
    assert Scan.objects.count() == 0


@pytest.mark.parametrize(
    "raw",
    [b"", b"{", b"\xff\xfe", b"[]", b"null", b'"x"', b"[" * 5000, b'{"tool": "\\ud800", "rig": "r"}',
     b'{"tool": "K-114", "rig": "rig-1", "exposures_us": [1e999]}', b'{"tool": ' + b"1" * 5000 + b"}"],
)  # fmt: skip
def test_a_malformed_body_is_never_a_crash(planner, raw):
    plant.knife()
    plant.rig()
    answer = planner.post("/inspections", raw=raw)
    assert answer.status_code in (400, 422), answer.content
    assert isinstance(strict(answer)["detail"], str)
    assert Scan.objects.count() == 0


@pytest.mark.parametrize(
    "address",
    ["/scans/0", "/scans/99999999999999999999", "/scans/x", "/tools/77", "/rigs/none/queue", "/inspections/-1"],
)
def test_what_is_not_there_is_said_in_one_sentence(reader, address):
    answer = reader.get(address)
    assert answer.status_code in (404, 422)
    assert isinstance(strict(answer)["detail"], str)


def test_the_document_describes_itself_and_needs_no_internet(client):
    document = json.loads(client.get("/api/v1/openapi.json").content)
    assert document["openapi"].startswith("3.")
    assert "/api/v1/inspections" in document["paths"]
    page = client.get("/api/v1/docs").content.decode()
    assert "https://" not in page
    assert "http://" not in page
    assert "ninja/swagger-ui-bundle.js" in page
    assert "<script>" not in page


def test_the_due_list_and_the_rigs_are_readable(reader):
    tool, rig = plant.knife(), plant.rig()
    tool.schedules.create(rig=rig, next_due=timezone.localdate() - dt.timedelta(days=3), queue_after=dt.time(6))
    row = strict(reader.get("/due"))[0]
    assert (row["tool"], row["overdue_days"], row["words"]) == ("K-114", 3, "overdue by 3 days")
    assert strict(reader.get("/rigs"))[0]["slug"] == "rig-1"
