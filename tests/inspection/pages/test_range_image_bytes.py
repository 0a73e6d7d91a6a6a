"""A range image reaches the browser as int16 counts that decode to the very heights that were stored."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from django.http import HttpResponse
from django.test import Client
from django.urls import reverse
from django.utils import timezone
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from inspection.models import Inspection, RangeImage, Scan, Tool, ToolType, User
from inspection.selectors.range_view import area_mean, damage_box, file_of
from inspection.services import plant as services
from inspection.states import ScanState
from tests.inspection.pages.plant import PROFILE_UM, ROW_UM, measured, scan_row

Browse = Callable[[str], Client]
SHAPE = (160, 90)


@pytest.fixture
def image(people: dict[str, User]) -> RangeImage:
    tool: Tool = services.create_tool(by=people["erik"], code="K-7", tool_type=ToolType.objects.get())
    visit = Inspection.objects.create(tool=tool, requested_by=people["olga"], requested_at=timezone.now())
    scan = scan_row(visit, tool.regions.get(name="R2"), ScanState.DONE, timezone.now())
    return measured(scan, chips=[(0.5, 0.5, 200, 60)], shape=SHAPE, seed=3)


def decoded(answer: HttpResponse) -> np.ndarray[Any, np.dtype[np.float64]]:
    rows, columns = (int(part) for part in answer["X-Shape"].split(","))
    counts = np.frombuffer(answer.content, "<i2").reshape(rows, columns)
    return np.where(counts == int(answer["X-No-Data"]), np.nan, counts * float(answer["X-Scale"]))


def stored(image: RangeImage) -> np.ndarray[Any, np.dtype[np.float32]]:
    with np.load(file_of(image)) as arrays_:
        return arrays_["height_um"]


def fetch(client: Client, scan: Scan | int, **query: Any) -> HttpResponse:
    pk = scan if isinstance(scan, int) else scan.pk
    return client.get(reverse("scan-range", args=[pk]), query)  # type: ignore[return-value]


def test_heights_come_back_to_a_twentieth_of_a_micrometre(browse: Browse, image: RangeImage) -> None:
    answer = fetch(browse("vera"), image.scan, channel="height")
    heights = stored(image)
    np.testing.assert_array_equal(np.isnan(decoded(answer)), np.isnan(heights))
    np.testing.assert_allclose(decoded(answer), heights, atol=0.0501)
    assert answer["X-Cell-mm"] == f"{ROW_UM / 1e3:.6f},{PROFILE_UM / 1e3:.6f}"


def test_the_levelled_surface_lies_about_zero_beside_the_damage(browse: Browse, image: RangeImage) -> None:
    level = decoded(fetch(browse("vera"), image.scan))
    assert abs(np.nanmedian(level)) < 1.0
    assert np.nanmin(level[70:90, 40:50]) < -45.0


def test_a_window_is_cut_where_it_was_asked(browse: Browse, image: RangeImage) -> None:
    answer = fetch(browse("vera"), image.scan, channel="height", rows="20:40", cols="5:25")
    np.testing.assert_allclose(decoded(answer), stored(image)[20:40, 5:25], atol=0.0501)
    y, x = (float(part) for part in answer["X-Origin-mm"].split(","))
    assert (y, x) == pytest.approx((20 * ROW_UM / 1e3, 5 * PROFILE_UM / 1e3), abs=1e-6)


def test_a_small_screen_gets_the_mean_of_what_was_measured(browse: Browse, image: RangeImage) -> None:
    answer = fetch(browse("vera"), image.scan, channel="height", max="45")
    heights = stored(image)[:, :]
    small = decoded(answer)
    assert small.shape == (45, 45)
    assert np.nanmean(small) == pytest.approx(np.nanmean(heights), abs=1.0)


@hypothesis_settings(max_examples=40, deadline=None)
@given(
    arrays(np.float32, (12, 8), elements=st.floats(-500, 500, width=32)),
    arrays(np.bool_, (12, 8)),
)
def test_the_area_mean_is_the_mean_of_measured_pixels(
    heights: np.ndarray[Any, np.dtype[np.float32]], holes: np.ndarray[Any, np.dtype[np.bool_]]
) -> None:
    data = np.where(holes, np.float32(np.nan), heights)
    blocks = data.reshape(4, 3, 4, 2).transpose(0, 2, 1, 3).reshape(4, 4, 6)
    share = np.isfinite(blocks).mean(axis=2)
    total = np.nansum(blocks, axis=2)
    with np.errstate(invalid="ignore", divide="ignore"):
        expected = np.where(share >= 0.5, total / np.isfinite(blocks).sum(axis=2), np.nan)
    np.testing.assert_allclose(area_mean(data, 4, 4), expected, atol=2e-3)


def test_heights_beyond_16_bits_are_sent_coarser_not_wrapped(browse: Browse, image: RangeImage) -> None:
    path = file_of(image)
    with np.load(path) as arrays_:
        everything = dict(arrays_)
    everything["height_um"] = everything["height_um"] * 100
    np.savez(path, **everything)
    tall = RangeImage.objects.create(
        scan=image.scan, recipe=image.recipe, created_at=timezone.now(), file=image.file, sha256="tall", rows=SHAPE[0],
        profiles=SHAPE[1], row_pitch_um=ROW_UM, profile_pitch_um=PROFILE_UM, provenance={},
    )  # fmt: skip
    answer = fetch(browse("vera"), image.scan, channel="height", result=tall.pk)
    assert float(answer["X-Scale"]) > 0.1
    np.testing.assert_allclose(decoded(answer), everything["height_um"], atol=float(answer["X-Scale"]) / 2 + 0.01)


def test_the_same_picture_is_not_sent_twice(browse: Browse, image: RangeImage) -> None:
    client = browse("vera")
    first = fetch(client, image.scan)
    url = reverse("scan-range", args=[image.scan_id])
    assert client.get(url, headers={"If-None-Match": first["ETag"]}).status_code == 304
    other = client.get(url, {"channel": "width"}, headers={"If-None-Match": first["ETag"]})
    assert other.status_code == 200


@pytest.mark.parametrize(
    ("query", "sentence"),
    [
        ({"channel": "colour"}, "There is no channel “colour”"),
        ({"rows": "5"}, "rows=5 is not a span"),
        ({"rows": "900:901"}, "outside the range image of 160 x 90"),
        ({"max": "-3"}, "max=-3 is not a whole number"),
        ({"result": "one"}, "result=one is not a whole number"),
        ({"cols": "²:9"}, "is not a whole number"),
    ],
)
def test_a_senseless_question_gets_a_sentence(
    browse: Browse, image: RangeImage, query: dict[str, str], sentence: str
) -> None:
    answer = fetch(browse("vera"), image.scan, **query)
    assert answer.status_code == 400
    assert sentence in answer.json()["detail"]  # type: ignore[attr-defined]


def test_a_lost_file_is_said_in_words(browse: Browse, image: RangeImage) -> None:
    file_of(image).unlink()
    answer = fetch(browse("vera"), image.scan)
    assert answer.status_code == 400
    assert "cannot be read (FileNotFoundError); restore it" in answer.json()["detail"]  # type: ignore[attr-defined]


def test_a_cut_gives_both_profiles_with_null_where_nothing_was_seen(browse: Browse, image: RangeImage) -> None:
    heights = stored(image)
    row, profile = 80, 45
    answer = browse("vera").get(
        reverse("scan-cut", args=[image.scan_id]), {"row": row, "col": profile, "channel": "height"}
    )
    data = answer.json()
    for name, line in (("along", heights[row]), ("across", heights[:, profile])):
        got = np.array([np.nan if value is None else value for value in data[name]["values"]])
        np.testing.assert_allclose(got, line, atol=1e-3)
    assert data["across"]["values"][-1] is None  # beyond the edge
    assert browse("vera").get(reverse("scan-cut", args=[image.scan_id]), {"row": "999", "col": 1}).status_code == 400


def test_the_outline_of_a_damage_lies_around_the_pixels_of_its_mask(image: RangeImage) -> None:
    damage = image.damages.get()
    box = damage_box(damage, image)
    assert box is not None
    points = np.array(box["outline"][0])
    centre_x, centre_y = 0.5 * SHAPE[1] * PROFILE_UM / 1e3, 0.5 * SHAPE[0] * ROW_UM / 1e3
    assert points[:, 0].min() < centre_x < points[:, 0].max()
    assert points[:, 1].min() < centre_y < points[:, 1].max()
    assert box["x0"] <= points[:, 0].min()
    assert points[:, 1].max() <= box["y1"]


def test_a_scan_less_itself_is_zero_and_other_pitches_are_refused(browse: Browse, image: RangeImage) -> None:
    url = reverse("scan-difference", args=[image.scan_id])
    zero = decoded(browse("vera").get(url, {"with": image.pk}))  # type: ignore[arg-type]
    assert np.nanmax(np.abs(zero)) == 0.0
    other = scan_row(image.scan.inspection, image.scan.region, ScanState.DONE, timezone.now())
    coarse = RangeImage.objects.create(
        scan=other, recipe=image.recipe, created_at=timezone.now(), file=image.file, sha256="coarse", rows=SHAPE[0],
        profiles=SHAPE[1], row_pitch_um=ROW_UM, profile_pitch_um=41.65, provenance={},
    )  # fmt: skip
    answer = browse("vera").get(url, {"with": coarse.pk})
    assert answer.status_code == 400
    assert "different pitches" in answer.json()["detail"]
    page = browse("vera").get(reverse("scan-compare", args=[image.scan_id]), {"with": coarse.pk}).content.decode()
    assert "so they cannot be subtracted" in page
    assert "data-difference" not in page
