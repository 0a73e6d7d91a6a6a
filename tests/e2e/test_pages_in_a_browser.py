"""The pages in a real browser, at desk and at tablet width: they draw, they fit, and nothing is blocked or broken."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip("playwright")

from django.urls import reverse

from inspection.models import Inspection, Scan, Tool, User
from inspection.states import ScanState
from tests.e2e.browser import CHROMIUM, DESKTOP, TABLET, Visitor, visitor
from tests.inspection.pages.plant import whole_plant

pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine"),
    pytest.mark.django_db(transaction=True),
]


TOO_SMALL = """
[...document.querySelectorAll("main .button, main select, main input:not([type=checkbox], [type=hidden])")]
  .filter((one) => one.offsetParent && one.getBoundingClientRect().height < 43.5)
  .map((one) => one.outerHTML.slice(0, 80))
"""


@pytest.fixture
def plant() -> dict[str, User]:
    return whole_plant(shape=(160, 90), visits=2)


def signed_in(who: Visitor) -> Visitor:
    who.sign_in("erik", "erik-knows-the-word")
    return who


@pytest.mark.parametrize("screen", [DESKTOP, TABLET], ids=["desktop", "tablet"])
def test_every_kind_of_page_draws_and_fits(plant: dict[str, User], live_server: Any, screen: dict[str, int]) -> None:
    tool = Tool.objects.get(code="K-114")
    done = Scan.objects.filter(region__tool=tool, region__name="R3", state=ScanState.DONE).latest("finished_at")
    live = Scan.objects.get(state=ScanState.RUNNING)
    failed = Scan.objects.filter(state=ScanState.FAILED).latest("pk")
    paths = [reverse(name) for name in ("overview", "rigs", "schedules", "calibrations", "calibration-new", "recipes",
             "limits", "import", "audit", "health-page", "help", "tool-new", "schedule-new")]  # fmt: skip
    paths += [tool.get_absolute_url(), done.get_absolute_url(), live.get_absolute_url(), failed.get_absolute_url()]
    paths += [Inspection.objects.filter(tool=tool).latest("requested_at").get_absolute_url()]
    paths += [reverse("queue", args=["rig1"]), reverse("scan-order", args=[tool.pk]),
              reverse("limits-edit", args=[tool.tool_type_id]), reverse("scan-compare", args=[done.pk])]  # fmt: skip
    with visitor(live_server.url, screen) as who:
        signed_in(who)
        for path in paths:
            who.go(path)
            assert who.fits(), path
            small = who.page.evaluate(TOO_SMALL)
            assert small == [], (path, "too small for a gloved finger")
        assert who.complaints == []


def test_a_range_image_is_drawn_cut_zoomed_and_turned(plant: dict[str, User], live_server: Any) -> None:
    done = Scan.objects.filter(region__tool__code="K-114", region__name="R3", state=ScanState.DONE).latest(
        "finished_at"
    )
    with visitor(live_server.url) as who:
        page = signed_in(who).go(done.get_absolute_url())
        who.wait_for_surface()
        assert page.evaluate("document.querySelector('[data-map]').data[0].type") == "heatmap"
        drawn = page.locator("[data-map] .heatmaplayer image")
        assert drawn.count() == 1
        page.locator("[data-map] .nsewdrag").first.click()
        page.locator("[data-cut-words]", has_text="Profiles through row").wait_for()
        ranges = page.evaluate(
            "(m => [m.layout.xaxis.range, m.layout.yaxis.range])(document.querySelector('[data-map]'))"
        )
        starts = [pytest.approx(min(one), abs=0.01) for one in ranges]
        assert done.region.start_mm in starts, "positions along the edge count from the datum"
        page.locator("[data-along] .scatterlayer path.js-line").first.wait_for()
        whole = page.evaluate("document.querySelector('[data-map]').layout.xaxis.range")
        with page.expect_response(lambda answer: "rows=" in answer.url and answer.ok):
            page.locator("tr[data-damage]").first.click()
        near = page.evaluate("document.querySelector('[data-map]').layout.xaxis.range")
        assert near[1] - near[0] < whole[1] - whole[0]
        page.get_by_role("button", name="3D").click()
        page.locator("[data-map] .gl-container canvas").first.wait_for()
        assert page.evaluate("document.querySelector('[data-map]').data[0].type") == "surface"
        page.get_by_role("button", name="Map").click()
        page.locator("[data-map] .heatmaplayer image").wait_for()
        page.locator("[data-channel]").select_option("confidence")
        page.locator("#range[data-drawn=confidence]").wait_for()
        page.locator("[data-map] .colorbar", has_text="confidence, 0 to 1").wait_for()
        trace = "(t => [t.zmin, t.zmax])(document.querySelector('[data-map]').data[0])"
        assert page.evaluate(trace) == [0, 1], "never stretched: a sure scan must look sure"
        assert who.complaints == []


def test_the_trend_shows_every_region_and_changes_its_metric(plant: dict[str, User], live_server: Any) -> None:
    tool = Tool.objects.get(code="K-114")
    with visitor(live_server.url) as who:
        page = signed_in(who).go(tool.get_absolute_url())
        page.locator("#trend[data-drawn]").wait_for()
        names = (
            "[...new Set(document.querySelector('[data-chart]').data.map(t => t.name).filter(Boolean))].sort().join()"
        )
        assert page.evaluate(names) == "R1,R2,R3"
        page.locator("[data-metric]").select_option("d_max")
        page.locator("#trend[data-drawn=d_max]").wait_for()
        assert who.complaints == []


def test_a_running_scan_moves_and_becomes_its_end_by_itself(plant: dict[str, User], live_server: Any) -> None:
    live = Scan.objects.get(state=ScanState.RUNNING)
    with visitor(live_server.url) as who:
        page = signed_in(who).go(live.get_absolute_url())
        page.get_by_text("104 of 245").first.wait_for()
        Scan.objects.filter(pk=live.pk).update(done=200)
        page.get_by_text("200 of 245").first.wait_for()
        Scan.objects.filter(pk=live.pk).update(state=ScanState.FAILED, fault="The lamp went out.")
        page.get_by_text("The lamp went out.").wait_for()
        assert who.complaints == []


def test_cancelling_needs_a_second_touch(plant: dict[str, User], live_server: Any) -> None:
    live = Scan.objects.get(state=ScanState.RUNNING)
    with visitor(live_server.url, TABLET) as who:
        page = signed_in(who).go(live.get_absolute_url())
        page.get_by_role("button", name="Cancel…").click()
        page.get_by_role("button", name="Let it run").click()
        live.refresh_from_db()
        assert live.cancel_requested_at is None
        page.get_by_role("button", name="Cancel…").click()
        page.get_by_role("button", name="Cancel the scan").click()
        page.get_by_text("Stopping…").first.wait_for()
        live.refresh_from_db()
        assert live.cancel_requested_at is not None


def test_a_scanned_label_leads_to_a_queued_scan(plant: dict[str, User], live_server: Any) -> None:
    with visitor(live_server.url, TABLET) as who:
        signed_in(who).open_tool("K-204")
        who.order_scan("After the collision")
        assert "After the collision" in who.page.inner_text("main")
        assert Scan.objects.filter(region__tool__code="K-204", state=ScanState.QUEUED).count() == 3
        assert who.complaints == []


def test_a_frozen_screen_says_so_and_recovers(plant: dict[str, User], live_server: Any) -> None:
    with visitor(live_server.url) as who:
        page = signed_in(who).go(reverse("queue", args=["rig1"]))
        page.route("**/rows/", lambda route: route.abort())
        page.get_by_text("No contact with Edgewatch since").wait_for()
        page.unroute("**/rows/")
        page.locator("#lost").wait_for(state="hidden")
