"""A result says how sure its points are and how far its gauge reaches; an older one, without those, still shows."""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable

import numpy as np
import pytest
from django.test import Client
from django.urls import reverse
from django.utils import timezone

from inspection.models import Inspection, PrecisionReport, RangeImage, ToolType, User
from inspection.selectors.range_view import channels_of, file_of
from inspection.services import plant as services
from inspection.states import ScanState
from tests.inspection.pages.plant import PROFILE_UM, ROW_UM, measured, scan_row
from tests.inspection.pages.test_range_image_bytes import decoded, fetch

Browse = Callable[[str], Client]
SHAPE = (160, 90)


@pytest.fixture
def image(people: dict[str, User]) -> RangeImage:
    tool = services.create_tool(by=people["erik"], code="K-7", tool_type=ToolType.objects.get())
    visit = Inspection.objects.create(tool=tool, requested_by=people["olga"], requested_at=timezone.now())
    scan = scan_row(visit, tool.regions.get(name="R2"), ScanState.DONE, timezone.now())
    return measured(scan, chips=[(0.5, 0.5, 200, 60)], shape=SHAPE, seed=4)


def bare(image: RangeImage) -> RangeImage:
    """A result of the same scan as it was stored before there was a confidence, without a precision report."""
    place = file_of(image).with_name("older.npz")
    with np.load(file_of(image)) as stored:
        np.savez(place, **{name: stored[name] for name in stored.files if name != "confidence"})
    return RangeImage.objects.create(
        scan=image.scan, recipe=image.recipe, created_at=image.created_at + dt.timedelta(minutes=1),
        file=f"pages/{place.name}", sha256="older", rows=SHAPE[0], profiles=SHAPE[1],
        row_pitch_um=ROW_UM, profile_pitch_um=PROFILE_UM, provenance={},
    )  # fmt: skip


@pytest.fixture
def older(image: RangeImage) -> RangeImage:
    row = bare(image)
    PrecisionReport.objects.create(
        range_image=row, undefined_count=0, undefined_share=0.0, saturated_count=0, saturated_share=0.0, sigma_um=4.2,
        cell_scan_um=41.65, cell_row_um=7.15, detail={"outside_calibrated": {"count": 3}},
    )  # fmt: skip
    return row


def page_of(client: Client, image: RangeImage) -> str:
    return " ".join(client.get(reverse("scan", args=[image.scan_id])).content.decode().split())


def test_the_page_offers_the_map_and_says_both_figures(browse: Browse, image: RangeImage) -> None:
    with np.load(file_of(image)) as stored:
        known = np.isfinite(stored["height_um"])
        share = np.mean(stored["confidence"][known] > 0.95)
    assert 0.5 < share < 0.999
    page = page_of(browse("vera"), image)
    assert '<option value="confidence">Confidence</option>' in page
    assert f'Confidence above 0.95</dt><dd>{100 * share:.1f} % <span class="unit">of measured points' in page
    assert 'Outside the calibrated range</dt><dd>0.0 % <span class="unit">of heights' in page


def test_read_out_on_the_way_is_told_beside_the_budget_and_not_in_it(browse: Browse, image: RangeImage) -> None:
    page = page_of(browse("vera"), image)
    assert "While the stage moved the camera was read out for 18.4 s" in page
    assert "overlapped" not in page


def test_the_map_is_the_stored_confidence_on_a_scale_from_nothing_to_one(browse: Browse, image: RangeImage) -> None:
    answer = fetch(browse("vera"), image.scan, channel="confidence")
    assert (answer["X-Span"], answer["X-Unit"]) == ("0,1", "1")
    with np.load(file_of(image)) as stored:
        np.testing.assert_allclose(decoded(answer), stored["confidence"], atol=0.00051)
    cut = browse("vera").get(reverse("scan-cut", args=[image.scan_id]), {"row": 20, "col": 20, "channel": "confidence"})
    assert max(value for value in cut.json()["along"]["values"] if value is not None) <= 1.0


def test_an_older_result_shows_without_them(browse: Browse, older: RangeImage) -> None:
    page = page_of(browse("vera"), older)
    assert '<option value="height">' in page
    assert 'value="confidence"' not in page
    assert "Confidence above" not in page
    assert "Outside the calibrated range" not in page
    assert fetch(browse("vera"), older.scan).status_code == 200
    answer = fetch(browse("vera"), older.scan, channel="confidence")
    assert answer.status_code == 400
    assert "does not say how sure its points are" in answer.json()["detail"]  # type: ignore[attr-defined]


def test_a_result_without_any_precision_report_offers_the_heights(image: RangeImage) -> None:
    assert list(channels_of(bare(image))) == ["level", "height", "intensity", "width"]
