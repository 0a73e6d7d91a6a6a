"""The PDF report of a visit: what it says, that it says it twice the same, and that nothing typed can change it."""

from __future__ import annotations

import datetime as dt
import io

import numpy as np
import pytest
from pypdf import PdfReader

from inspection.models import Inspection, Role, Tool
from inspection.reports.content import inspection_content
from inspection.reports.figures import plain, with_uncertainty
from inspection.reports.pdf import compiled, inspection_pdf
from inspection.reports.picture import Outline, colour_range, draw
from inspection.states import ScanState
from scanning.range_image import RangeImage
from tests.inspection.reports import plant

pytestmark = pytest.mark.django_db
SMALL = (120, 40)


def words(pdf: bytes) -> str:
    """The document's text with single spaces."""
    return " ".join(" ".join(page.extract_text() for page in PdfReader(io.BytesIO(pdf)).pages).split())


@pytest.fixture
def last() -> Inspection:
    return plant.history(plant.knife(), visits=8, shape=SMALL)


def test_it_says_the_verdict_and_what_it_rests_on(last):
    text = words(inspection_pdf(last))
    for expected in [
        "Tool K-114",
        "REPLACE", "Take out of service", "Chipping knife", "Chipper 2, pocket 5", "by Olga", "Weekly check",
        "Greatest depth 214 µm is above the replace limit of 150 µm.", "Region R1", "Region R2", "Region R3",
        "0.0310 ± 0.0032", "0.1420 ± 0.0082", "mm³", "not measured", "k = 2", "medium", "large", "6.35 %",
        "4.21 µm in a cell of",
        "7.15 × 41.65 µm", "Missing volume (V-)", "version 1", "First limits", "Step gauge SG-7, certificate 4711",
        "0.0142374 mm/px", "1.58 %", "4 May 2027", "HDRE-I", "sliding", "edgewatch 0.1.0",
        "Inspected by", "Released by",
        "Page 1 of", "R3 Greatest depth is 214 µm: the replace limit of 150 µm is already passed.",
    ]:  # fmt: skip
        assert expected in text, expected
    scan = last.scans.get(region__name="R2")
    assert scan.stack_sha256 in text.replace("\u200b", "").replace(" ", "")
    assert scan.range_images.get().sha256 in text.replace("\u200b", "").replace(" ", "")


def test_it_says_how_sure_the_points_are_where_that_is_known(last):
    assert "Confidence" not in words(inspection_pdf(last))
    scan = last.scans.get(region__name="R2")
    told = {"confident": {"above": 0.95, "share": 0.9721}, "outside_calibrated": {"count": 9, "share": 0.0004}}
    plant.result(scan, 1, 5.0, {}, False, SMALL, scan.limit_set, later=dt.timedelta(hours=1), precision=told)
    text = words(inspection_pdf(Inspection.objects.get(pk=last.pk)))
    assert text.count("Confidence above 0.95 97.2 % of measured points") == 1
    assert text.count("Outside the calibrated range 0.04 % of heights") == 1


def test_the_same_records_give_the_same_bytes(last):
    assert inspection_pdf(last) == inspection_pdf(Inspection.objects.get(pk=last.pk))


def test_a_later_visit_does_not_change_an_earlier_report(last):
    before = inspection_pdf(last)
    plant.visit(last.tool, 20, recession=999)
    Tool.objects.filter(pk=last.tool_id).update(life_used=500)
    last.tool.tool_type.limit_sets.create(version=2, reason="stricter").limits.create(
        metric="ER_max", replace_above=10, unit="um"
    )
    assert inspection_pdf(Inspection.objects.get(pk=last.pk)) == before


def test_it_is_an_archive_document_with_readable_pictures(last):
    reader = PdfReader(io.BytesIO(inspection_pdf(last)))
    assert reader.metadata is not None
    assert reader.metadata.title == f"Inspection {last.pk} of tool K-114"
    assert reader.metadata.creation_date is not None
    assert reader.metadata.creation_date.date() == dt.date(2026, 7, 20)
    metadata = reader.trailer["/Root"]["/Metadata"].get_object().get_data()
    assert b"<pdfaid:part>3</pdfaid:part>" in metadata
    assert b"<pdfuaid:part>1</pdfuaid:part>" in metadata
    assert reader.trailer["/Root"]["/MarkInfo"]["/Marked"]


def test_a_visit_with_a_hole_in_it_says_so_and_is_not_ok():
    tool = plant.knife()
    visit = plant.visit(tool, 0, states={"R2": ScanState.FAILED, "R3": ScanState.CANCELLED}, images=True, shape=SMALL)
    text = words(inspection_pdf(visit))
    assert "UNKNOWN" in text
    assert "No verdict" in text
    assert "the scan is failed: The camera sent no frame within 2 s at step 17" in text
    assert "Not measured: the scan is cancelled." in text
    assert "Keep in service." not in text


def test_watch_with_a_region_missing_does_not_say_keep_it_in_service():
    visit = plant.visit(plant.knife(), 0, states={"R1": ScanState.FAILED, "R3": ScanState.CANCELLED})
    text = words(inspection_pdf(visit))
    assert "WATCH" in text
    assert "Scan again now: at least one region has no verdict." in text
    assert "Keep in service" not in text


@pytest.mark.parametrize("state", [ScanState.QUEUED, ScanState.RUNNING, ScanState.INTERRUPTED])
def test_a_visit_without_any_result_still_has_a_report(state):
    others = ScanState.QUEUED  # a rig runs one scan at a time
    visit = plant.visit(plant.knife(), 0, states={"R1": state, "R2": others, "R3": others})
    text = words(inspection_pdf(visit))
    assert "UNKNOWN" in text
    assert f"Not measured: the scan is {state}." in text
    assert "No limits were in force." in text


def test_a_visit_without_scans_has_a_report():
    visit = plant.visit(plant.knife(), 0)
    empty = Inspection.objects.create(tool=visit.tool, requested_at=visit.requested_at)
    assert "No region was ordered" in words(inspection_pdf(empty))


def test_a_lost_range_image_is_named_and_the_numbers_stay():
    visit = plant.visit(plant.knife(), 0, images=False)
    text = words(inspection_pdf(visit))
    assert "No picture: The range image file" in text
    assert "0.1420 ± 0.0082" in text


def test_what_people_type_stays_text(last):
    nasty = '#evil[] $x$ *b* _i_ <script> \\ @ref [a](b) `c` = H #sys.inputs ÄÖÜß µ € "q"'
    last.tool.note = nasty
    last.tool.location = nasty[:80]
    last.tool.save()
    last.reason = nasty
    text = words(inspection_pdf(last))
    assert text.count("#evil[] $x$ *b* _i_ <script>") >= 3
    assert "#sys.inputs ÄÖÜß µ €" in text


def test_long_notes_run_over_pages(last):
    last.tool.note = "A long note about this knife. " * 400 + "x" * 3000 + " the end"
    text = words(inspection_pdf(last))
    assert text.count("A long note about this knife.") >= 399
    assert "the end" in text


def test_characters_without_a_font_cost_the_archive_format_not_the_report(last):
    last.tool.note = "刀片 🔧 plain"
    pdf = inspection_pdf(last)
    text = words(pdf)
    assert "plain" in text
    if b"pdfaid" not in pdf and "/Metadata" not in PdfReader(io.BytesIO(pdf)).trailer["/Root"]:
        assert "shown as boxes" in text


def test_a_fault_of_ours_is_not_hidden_as_a_font_problem(last):
    content, as_of = inspection_content(last)
    del content["verdict"]
    with pytest.raises(Exception, match="verdict"):
        compiled(content, as_of)


def test_the_report_is_downloaded_by_whoever_may_look(client, last):
    assert client.get(f"/reports/inspections/{last.pk}/report.pdf").status_code == 302
    client.force_login(plant.person("vera", Role.VIEWER))
    answer = client.get(f"/reports/inspections/{last.pk}/report.pdf")
    assert answer["Content-Type"] == "application/pdf"
    assert answer["Content-Disposition"] == f'attachment; filename="K-114_2026-07-20_inspection-{last.pk}.pdf"'
    assert answer.content.startswith(b"%PDF")
    assert client.get("/reports/inspections/9999/report.pdf").status_code == 404


@pytest.mark.parametrize(
    ("value", "u", "shown"),
    [
        (214.0, 4.4, "214.0 ± 8.8"), (0.0314159, 0.0016, "0.0314 ± 0.0032"), (12345.6, 123.0, "12350 ± 250"),
        (5.0, None, "5"),
        (None, 1.0, "not measured"), (float("nan"), 1.0, "not measured"), (0.0, 0.5, "0.0 ± 1.0"),
        (3.14159, 0.0, "3.142"),
        (-0.5, 0.021, "-0.500 ± 0.042"),
    ],
)  # fmt: skip
def test_a_value_has_no_more_digits_than_its_uncertainty(value, u, shown):
    assert with_uncertainty(value, u) == shown


@pytest.mark.parametrize(
    ("value", "shown"), [(0, "0"), (1234567.0, "1.235e+06"), (0.00001234, "1.234e-05"), (99.999, "100")]
)
def test_plain_numbers(value, shown):
    assert plain(value) == shown


def as_image(height: np.ndarray, row_pitch_um: float = 7.15, profile_pitch_um: float = 41.65) -> RangeImage:
    ones = np.ones_like(height)
    return RangeImage(
        column_px=ones, height_um=height, row_pitch_um=row_pitch_um, profile_pitch_um=profile_pitch_um, intensity=ones,
        width_px=ones,
    )  # fmt: skip


@pytest.mark.parametrize("shape", [(1000, 241), (40, 1205), (2000, 10), (30, 30), (1, 1), (3, 2)])
def test_every_shape_of_range_image_can_be_drawn(shape):
    height = np.random.default_rng(0).normal(0, 5, shape).astype(np.float32)
    drawn = draw(as_image(height), [Outline(1, (0, 1), (0, 1))], name="R1")
    assert drawn.svg.startswith("<svg")
    assert drawn.width_mm < 120
    assert drawn.height_mm < 80


def test_an_image_without_any_height_is_drawn_as_nothing_measured():
    drawn = draw(as_image(np.full((50, 40), np.nan, np.float32)), [])
    assert "Nothing was measured" in drawn.caption
    assert "100.0 %" in drawn.alt


def test_a_few_wild_pixels_do_not_take_the_colours_from_everything_real():
    rng = np.random.default_rng(0)
    height = rng.normal(0, 5, (200, 50)).astype(np.float32)
    height[:10] = 1500
    low, high = colour_range(height, deepest_um=90)
    assert high < 60
    assert low > -120
    assert "beyond the colour bar" in draw(as_image(height), []).caption


def test_the_colours_reach_the_deepest_damage_and_never_dramatise_noise():
    rng = np.random.default_rng(0)
    sound = rng.normal(0, 1, (200, 50)).astype(np.float32)
    assert np.ptp(colour_range(sound)) == pytest.approx(50, abs=0.01)
    sound[50:60, 20:30] = -214
    assert colour_range(sound, deepest_um=214)[0] == pytest.approx(-214, abs=1)
