"""Malformed stacks, X3P files, CSVs, forms, addresses and API bodies: no 500, no hang, nothing half stored.

A few hundred from a fixed seed in every test run; TEST_FUZZ=10000 (in `make test-faults`) takes that many in all.
"""

from __future__ import annotations

import io
import json
import os
import random
import time
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from django.core.files.uploadedfile import SimpleUploadedFile
from django.db import connection
from django.test import Client
from django.urls import URLPattern, URLResolver, get_resolver, reverse

from inspection.models import Calibration, Inspection, Recipe, Rig, Scan, Tool, User
from inspection.roles import OWN_AUTHENTICATION
from inspection.services.queue import enqueue_inspection
from inspection.services.recipes import recipe_named
from scanning.errors import BadInput
from scanning.exchange.x3p import read_x3p, write_x3p
from scanning.range_image import RangeImage
from tests.worker.fakes import line_image

SEED = 4711
TOTAL = int(os.environ.get("TEST_FUZZ", "300"))
#: Share of the total for each kind.
SHARE = {"stacks": 0.2, "x3p": 0.2, "csv": 0.2, "api": 0.2, "pages": 0.2}
#: No single answer may take longer, on two busy cores.
SLOWEST_S = 10.0

pytestmark = [pytest.mark.django_db, pytest.mark.timeout(0 if TOTAL > 1000 else 120)]

NASTY = [
    "", " ", "\0", "a\0b", "\ud800", "\u202e", "'; DROP TABLE inspection_scan; --", "<script>alert(1)</script>",
    "{{ 7*7 }}", "../../etc/passwd", "%00", "A" * 5000, "-1", "0", "1e400", "NaN", "Infinity", "-0",
    "99999999999999999999", "9223372036854775808", "1,2,3", "٣", "½", "\r\nX: y", "null", "true",
    "[]", "{}", "2026-02-30", "0001-01-01",
    "9999-12-31", "25:99",
]  # fmt: skip


def count(kind: str) -> int:
    return max(10, round(TOTAL * SHARE[kind]))


@pytest.fixture(autouse=True)
def own_folders(settings: Any, tmp_path: Path) -> None:
    settings.STACKS, settings.RANGES, settings.UPLOADS = (tmp_path / name for name in ("stacks", "ranges", "uploads"))
    settings.STACK_UPLOAD_MAX_BYTES = 20 * 2**20


@pytest.fixture
def client(adam: User) -> Client:
    made = Client(raise_request_exception=True)  # a 500 would be an exception here, with its traceback
    made.force_login(adam)
    return made


def timed(act: Callable[[], Any]) -> Any:
    began = time.perf_counter()
    came = act()
    took = time.perf_counter() - began
    assert took < SLOWEST_S, f"one answer took {took:.1f} s"
    return came


def damaged(raw: bytes, chance: random.Random) -> bytes:
    """The bytes with something wrong: bits, a cut, a doubled or zeroed stretch, or all of it noise."""
    data = bytearray(raw)
    what = chance.randrange(6)
    if what == 0:
        for _ in range(chance.randint(1, 20)):
            data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    elif what == 1:
        del data[chance.randrange(len(data)) :]
    elif what == 2:
        at = chance.randrange(len(data))
        data[at:at] = data[at : at + chance.randint(1, 500)]
    elif what == 3:
        at, length = chance.randrange(len(data)), chance.randint(1, 300)
        data[at : at + length] = bytes(len(data[at : at + length]))
    elif what == 4:
        at = chance.randrange(len(data))
        data[at : at + 8] = chance.randbytes(8)
    else:
        data = bytearray(chance.randbytes(chance.randint(0, 2000)))
    return bytes(data)


def value(chance: random.Random, depth: int = 0) -> Any:
    """Any JSON value, mostly a bad one."""
    kind = chance.randrange(8 if depth < 3 else 6)
    if kind <= 2:
        return chance.choice(NASTY)
    if kind == 3:
        return chance.choice([0, -1, 1, 2**31, 2**63, -(2**70), 10**400, 1e308, -1e308, 0.1, 1e-320])
    if kind == 4:
        return chance.choice([None, True, False])
    if kind == 5:
        return chance.choice([float("nan"), float("inf"), 7, "K-7", "rig1", "R1"])
    if kind == 6:
        return [value(chance, depth + 1) for _ in range(chance.randint(0, 5))]
    return {str(chance.choice(NASTY)): value(chance, depth + 1) for _ in range(chance.randint(0, 4))}


# -- stacks ---------------------------------------------------------------------------------------------------------

STACK_JSON = {
    "format": "edgewatch-stack/1", "exposures_us": [100, 300], "step_um": 8.33, "row_pitch_um": 7.15,
    "mm_per_pixel": 0.0142, "line_width_px": 3.03, "dark_level": 2, "saturation": 255, "response": "linear",
}  # fmt: skip


def tiff(exposure_us: float, steps: int = 8) -> bytes:
    out = io.BytesIO()
    tifffile.imwrite(
        out, np.stack([line_image(24, 96, step, exposure_us) for step in range(steps)]), photometric="minisblack"
    )
    return out.getvalue()


def archive(files: dict[str, bytes]) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as opened:
        for name, content in files.items():
            opened.writestr(name, content)
    return out.getvalue()


def bad_stack(good: dict[str, bytes], chance: random.Random) -> tuple[str, bytes]:
    files = dict(good)
    what = chance.randrange(9)
    if what == 0:
        return "stack.zip", damaged(archive(files), chance)
    if what == 1:
        name = chance.choice(list(files))
        files[name] = damaged(files[name], chance)
    elif what == 2:
        said = dict(STACK_JSON)
        said[chance.choice([*said, "more"])] = value(chance)
        files["stack.json"] = json.dumps(said).encode("utf-8", "surrogatepass")
    elif what == 3:
        files["stack.json"] = json.dumps(value(chance)).encode("utf-8", "surrogatepass")
    elif what == 4:
        del files[chance.choice(list(files))]
    elif what == 5:
        files[chance.choice(["../evil.tiff", "/etc/evil", "a/../../b", "C:\\evil", "x" * 300])] = b"x"
    elif what == 6:
        files["exposure-300us.tiff"] = tiff(300, steps=chance.randint(1, 7))
    elif what == 7:
        files["zeros.bin"] = bytes(30 * 2**20)  # a bomb: unpacks far beyond what it is
    else:
        # A picture that says it is enormous.
        big = io.BytesIO()
        tifffile.imwrite(big, np.zeros((4, 4), np.uint8))
        raw = big.getvalue()
        files["exposure-100us.tiff"] = raw.replace(b"\x00\x01\x03\x00\x01\x00\x00\x00\x04", b"\x00\x01\x03\x00\x01\x00\x00\x00\xff", 1)  # fmt: skip # noqa: E501
    return chance.choice(["stack.zip", "stack.zip", "s.ZIP", "stack.h5", "\u202ezip"]), archive(files)


def test_malformed_stacks(client: Client, tool: Tool, rig: Rig, settings: Any) -> None:
    recipe_named("NF")
    good = {"stack.json": json.dumps(STACK_JSON).encode(), "exposure-100us.tiff": tiff(100),
            "exposure-300us.tiff": tiff(300)}  # fmt: skip
    region = tool.regions.get(name="R1")
    chance = random.Random(SEED)

    def send(name: str, content: bytes) -> Any:
        form = {"region": region.pk, "rig": rig.pk, "stack": SimpleUploadedFile(name, content)}
        return timed(lambda: client.post("/import/", form))

    whole_one = {"region": region.pk, "rig": rig.pk, "stack": SimpleUploadedFile("stack.zip", archive(good))}
    assert client.post("/import/", whole_one).status_code == 302  # untimed: the first loads and compiles the pipeline
    came: Counter[int] = Counter()
    for number in range(count("stacks")):
        before = Scan.objects.count(), Inspection.objects.count()
        kept = {path for path in Path(settings.STACKS).rglob("*") if path.is_file()}
        answer = send(*bad_stack(good, chance))
        came[answer.status_code] += 1
        assert answer.status_code in (302, 422), number
        if answer.status_code == 422:
            assert (Scan.objects.count(), Inspection.objects.count()) == before, number
            assert {path for path in Path(settings.STACKS).rglob("*") if path.is_file()} == kept, number
        assert not [path for path in Path(settings.UPLOADS).rglob("*") if path.is_file()], number
    print(f"stacks: {dict(came)}")
    assert came[422] > came[302]


# -- X3P ------------------------------------------------------------------------------------------------------------


def test_malformed_x3p(tmp_path: Path) -> None:
    rng = np.random.default_rng(SEED)
    heights = rng.normal(0, 5, (20, 30)).astype(np.float32)
    image = RangeImage(
        column_px=heights / 14, height_um=heights, row_pitch_um=7.15, profile_pitch_um=8.33,
        intensity=np.ones_like(heights), width_px=np.ones_like(heights), saturated=0, frame_pixels=1, wall_s=0.0,
        cpu_s=0.0, provenance={},
    )  # fmt: skip
    good = tmp_path / "good.x3p"
    write_x3p(image, good)
    read_x3p(good)
    with zipfile.ZipFile(good) as opened:
        parts = {name: opened.read(name) for name in opened.namelist()}
    chance = random.Random(SEED)
    bad = tmp_path / "bad.x3p"
    came: Counter[str] = Counter()
    for _ in range(count("x3p")):
        if chance.random() < 0.4:
            content = damaged(good.read_bytes(), chance)
        else:
            files = dict(parts)
            name = chance.choice(list(files))
            if chance.random() < 0.2:
                del files[name]
            elif name.endswith(".xml") and chance.random() < 0.5:
                words = files[name].split(b">")
                at = chance.randrange(len(words))
                words[at] = chance.choice(NASTY).encode("utf-8", "surrogatepass") + b"<" + words[at].rpartition(b"<")[2]
                files[name] = b">".join(words)
            else:
                files[name] = damaged(files[name], chance)
            content = archive(files)
        bad.write_bytes(content)
        try:
            timed(lambda: read_x3p(bad))
            came["read"] += 1
        except BadInput:
            came["refused"] += 1
    print(f"x3p: {dict(came)}")
    assert came["refused"] > came["read"]


# -- CSV ------------------------------------------------------------------------------------------------------------


def test_malformed_gauge_pairs(client: Client, rig: Rig) -> None:
    good = "height_mm,column_px\n" + "".join(f"{0.0142 * c:.6f},{c}\n" for c in (20, 40, 60, 90))
    chance = random.Random(SEED)
    came: Counter[int] = Counter()
    client.post("/calibrations/new/", {"rig": rig.pk, "pairs": good})  # untimed: the first loads what it needs
    for number in range(count("csv")):
        if chance.random() < 0.5:
            text = damaged(good.encode(), chance)
        else:
            lines = good.splitlines()
            at = chance.randrange(len(lines))
            lines[at] = ",".join(str(value(chance, 3)) for _ in range(chance.randint(0, 4)))
            text = chance.choice(["\n", "\r\n", "\r"]).join(lines).encode("utf-8", "surrogatepass")
        form: dict[str, Any] = {
            "rig": rig.pk, "artefact": "Gauge 17", "done_on": "2026-11-01", "valid_until": "2027-11-01", "confirm": "1",
        }  # fmt: skip
        if chance.random() < 0.3:
            form[chance.choice(list(form))] = chance.choice(NASTY).encode("utf-8", "replace").decode()
        if chance.random() < 0.5:
            form["csv_file"] = SimpleUploadedFile("pairs.csv", text)
        else:
            form["pairs"] = text.decode("utf-8", "replace")
        before = Calibration.objects.count()
        answer = timed(lambda form=form: client.post("/calibrations/new/", form))
        came[answer.status_code] += 1
        assert answer.status_code in (200, 302, 400, 422), number
        assert (Calibration.objects.count() == before + 1) == (answer.status_code == 302), number
    print(f"csv: {dict(came)}")


# -- API and pages --------------------------------------------------------------------------------------------------


def whole(before: tuple[int, int]) -> bool:
    """Every visit that is there now has its scans."""
    visits = Inspection.objects.count()
    return visits == before[0] or not Inspection.objects.filter(scans__isnull=True).exists()


def test_malformed_api_calls(client: Client, tool: Tool, rig: Rig, erik: User) -> None:
    recipe_named("NF")
    chance = random.Random(SEED)
    came: Counter[int] = Counter()
    fields = ["tool", "rig", "regions", "recipe", "exposures_us", "reason", "other"]
    good = {"tool": "K-7", "rig": "rig1", "regions": ["R1"], "reason": "x"}
    paths = [
        "me", "tools", "tools/{}", "tools/{}/regions", "tools/{}/trend", "inspections", "inspections/{}",
        "inspections/{}/report.pdf", "scans", "scans/{}", "scans/{}/range.npz", "scans/{}/range.csv", "rigs",
        "rigs/{}/queue", "due", "openapi.json", "docs", "{}",
    ]  # fmt: skip
    questions = ["code", "status", "limit", "offset", "metric", "region", "tool", "state", "sep", "decimal", "since"]
    for number in range(count("api")):
        before = Inspection.objects.count(), Scan.objects.count()
        way = chance.randrange(4)
        if way == 0:
            body: Any = dict(good)
            for _ in range(chance.randint(1, 3)):
                body[chance.choice(fields)] = value(chance)
            raw = json.dumps(body).encode("utf-8", "surrogatepass")
        elif way == 1:
            raw = json.dumps(value(chance)).encode("utf-8", "surrogatepass")
        elif way == 2:
            raw = damaged(json.dumps(good).encode(), chance)
        if way < 3:
            kind = chance.choice(["application/json"] * 5 + ["text/plain", "application/x-www-form-urlencoded", ""])
            answer = timed(lambda raw=raw, kind=kind: client.post("/api/v1/inspections", raw, content_type=kind))
        else:
            path = chance.choice(paths).format(chance.choice(["1", "999", "-1", "9" * 25, "x", "%00", "%F0%9F%99%88"]))
            asked = {
                chance.choice(questions): str(chance.choice(NASTY)).encode("utf-8", "replace").decode()
                for _ in range(chance.randint(0, 3))
            }
            answer = timed(lambda path=path, asked=asked: client.get(f"/api/v1/{path}", asked))
        came[answer.status_code] += 1
        assert answer.status_code < 500, (number, answer.content[:300])
        assert whole(before), number
        if answer.status_code == 201:
            Scan.objects.all().delete()
            Inspection.objects.all().delete()
    print(f"api: {dict(came)}")


def pages(resolver: URLResolver, spaces: tuple[str, ...] = ()) -> list[tuple[str, list[str]]]:
    found = []
    for entry in resolver.url_patterns:
        if isinstance(entry, URLResolver):
            inner = (*spaces, entry.namespace) if entry.namespace else spaces
            if not any(space.startswith(OWN_AUTHENTICATION) for space in inner):
                found += pages(entry, inner)
        elif (
            isinstance(entry, URLPattern)
            and entry.name
            and entry.name not in ("sign-out", "person-edit", "own-password")
        ):
            found.append((entry.name, list(entry.pattern.converters)))
    return found


#: What the forms of the pages ask for.
NAMES = [
    "search", "verdict", "status", "page", "metric", "type", "rig", "tool", "region", "regions", "recipe",
    "exposures_us", "reason", "note", "where", "from", "looked", "name", "code", "location", "tool_type",
    "life_used", "bevel_angle_deg", "edge_length_mm", "life_unit", "start_mm", "length_mm", "rows", "row_offset",
    "flat_row", "flat_rows", "active", "every", "unit", "next_due", "window_before_days", "window_after_days",
    "queue_after", "automatic", "enabled", "event-kind", "event-at", "event-life_used", "event-note", "username",
    "first_name", "last_name", "role", "is_active", "password", "codes", "since", "newest_only", "start", "result",
    "with", "channel", "cols", "max", "row", "col", "sep", "decimal", "state", "inline", "csv_file", "pairs",
    "artefact", "done_on", "valid_until", "confirm", "d_max-watch", "d_max-replace", "limit_reason",
]  # fmt: skip


def test_malformed_forms_and_addresses(client: Client, tool: Tool, rig: Rig, settings: Any) -> None:
    settings.PASSWORD_HASHERS = ["django.contrib.auth.hashers.MD5PasswordHasher"]
    recipe: Recipe = recipe_named("NF")
    chance = random.Random(SEED)
    came: Counter[int] = Counter()
    scan = enqueue_inspection(tool=tool, rig=rig, by=None).scans.order_by("pk")[0]
    takes: dict[str, set[str]] = {}  # what an address takes is learnt from its first answers
    known = [str(tool.pk), str(rig.pk), str(recipe.pk), str(tool.regions.all()[0].pk), "on", "1", "days", "viewer", "h"]
    all_pages = pages(get_resolver())
    for number in range(count("pages")):
        name, arguments = chance.choice(all_pages)
        given = {
            a: "rig1" if a == "slug" else chance.choice([scan.pk, scan.pk, tool.pk, scan.region_id, 999, 2**63, 10**30])
            for a in arguments
        }
        path = reverse(name, kwargs=given)
        said = {}
        for field in chance.sample(NAMES, chance.randint(0, 25)):
            text = chance.choice(known) if chance.random() < 0.5 else chance.choice(NASTY)
            said[field] = text.encode("utf-8", "replace").decode()
        before = Inspection.objects.count(), Scan.objects.count()
        headers = {"HX-Request": "true"} if chance.random() < 0.3 else {}
        method = chance.choice(sorted(takes.get(name, {"GET", "POST"})))
        call = client.post if method == "POST" else client.get
        answer = timed(lambda call=call, path=path, said=said, headers=headers: call(path, said, headers=headers))
        came[answer.status_code] += 1
        if answer.status_code == 405:
            takes[name] = {"GET", "POST"} - {method}
        assert answer.status_code < 500 or (name == "health" and answer.status_code == 503), (number, path, said)
        assert whole(before), number
        assert not connection.needs_rollback, (number, path)
    print(f"pages: {dict(came)}")
