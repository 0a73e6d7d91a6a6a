"""Downloads: tables and range images as CSV, the report of a visit as PDF. Everybody who may look may take along."""

from __future__ import annotations

import datetime as dt
import re
from collections.abc import Callable, Iterator
from functools import wraps

from django.contrib.auth.decorators import login_required
from django.http import HttpRequest, HttpResponse, HttpResponseBase, StreamingHttpResponse
from django.shortcuts import get_object_or_404
from django.utils import timezone
from django.views.decorators.http import require_safe

from inspection.models import Inspection, RangeImage, Scan
from inspection.reports.csv import Dialect, write_range_image, write_table
from inspection.reports.pdf import inspection_pdf
from inspection.reports.rows import Cell, Selection, Table, damages_table, measurements_table, scans_table, tools_table
from inspection.reports.stored import load
from inspection.states import ScanState
from scanning.errors import BadInput

View = Callable[..., HttpResponseBase]


def download(view: View) -> View:
    """A signed-in GET whose bad input is answered with its one sentence."""

    @wraps(view)
    def answer(request: HttpRequest, **kwargs: int) -> HttpResponseBase:
        try:
            return view(request, **kwargs)
        except BadInput as fault:
            return HttpResponse(f"{fault}\n", status=422, content_type="text/plain; charset=utf-8")

    return require_safe(login_required(answer))


@download
def scans_csv(request: HttpRequest) -> HttpResponseBase:
    return table_csv(request, scans_table)


@download
def measurements_csv(request: HttpRequest) -> HttpResponseBase:
    return table_csv(request, measurements_table)


@download
def damages_csv(request: HttpRequest) -> HttpResponseBase:
    return table_csv(request, damages_table)


@download
def tools_csv(request: HttpRequest) -> HttpResponseBase:
    return table_csv(request, tools_table)


@download
def range_csv(request: HttpRequest, pk: int) -> HttpResponseBase:
    """The newest range image of a scan as a matrix of heights."""
    scan = get_object_or_404(Scan.objects.select_related("inspection__tool", "region", "rig"), pk=pk)
    stored = newest_result(scan)
    about: list[tuple[str, Cell]] = [
        ("tool", scan.inspection.tool.code),
        ("region", scan.region.name),
        ("scan", scan.pk),
        ("scanned", scan.finished_at),
        ("recipe", stored.recipe.name),
        ("calibration", str(stored.calibration or "none")),
        ("verdict", stored.verdict),
        ("sha256 of the range image", stored.sha256),
    ]
    return streamed(write_range_image(load(stored), about, dialect(request)), f"{scan_name(scan)}_range")


@download
def inspection_report(request: HttpRequest, pk: int) -> HttpResponseBase:
    """The PDF report; ``?inline=1`` shows it in the browser instead of saving it."""
    visit = get_object_or_404(Inspection.objects.select_related("tool__tool_type", "requested_by"), pk=pk)
    answer = HttpResponse(inspection_pdf(visit), content_type="application/pdf")
    way = "inline" if request.GET.get("inline") else "attachment"
    day = timezone.localdate(visit.requested_at)
    name = file_name(f"{visit.tool.code}_{day}_inspection-{visit.pk}")
    answer["Content-Disposition"] = f'{way}; filename="{name}.pdf"'
    answer["Cache-Control"] = "private, no-cache"
    return answer


def newest_result(scan: Scan) -> RangeImage:
    """The result shown for a scan; raises BadInput when there is none."""
    result: RangeImage | None = scan.range_images.select_related("recipe", "calibration").first()
    if result is None:
        raise BadInput(f"Scan {scan.pk} has no range image: it is {scan.state}.")
    return result


def table_csv(request: HttpRequest, make: Callable[[Selection], Table]) -> HttpResponseBase:
    chosen = selection(request)
    table = make(chosen)
    tool = f"{chosen.tool}_" if chosen.tool else ""
    return streamed(write_table(table, dialect(request)), f"{tool}{table.title.lower()}_{timezone.localdate()}")


def selection(request: HttpRequest) -> Selection:
    """Read ``?tool= ?region= ?state= ?since= ?until=``; raises BadInput for a state or a day that is none."""
    state = request.GET.get("state", "")
    if state and state not in ScanState.values:
        raise BadInput(f"There is no state {state!r}; scans are {', '.join(ScanState.values)}.")
    return Selection(
        tool=request.GET.get("tool", ""),
        region=request.GET.get("region", ""),
        state=state,
        since=_day(request, "since"),
        until=_day(request, "until"),
    )


def _day(request: HttpRequest, name: str) -> dt.date | None:
    text = request.GET.get(name, "")
    if not text:
        return None
    try:
        day = dt.date.fromisoformat(text)
    except ValueError:
        raise BadInput(f"{name}={text!r} is not a day; write it as year-month-day, such as 2026-11-24.") from None
    if not 1900 <= day.year <= 9000:
        raise BadInput(f"{name}={text!r} is outside the years 1900 to 9000.")
    return day


def dialect(request: HttpRequest) -> Dialect:
    return Dialect.asked_for(request.GET.get("sep", ","), request.GET.get("decimal", "."))


def scan_name(scan: Scan) -> str:
    day = timezone.localdate(scan.finished_at or scan.queued_at)
    return f"{scan.inspection.tool.code}_{scan.region.name}_{day}_scan-{scan.pk}"


def streamed(parts: Iterator[str], name: str) -> StreamingHttpResponse:
    answer = StreamingHttpResponse((part.encode("utf-8") for part in parts), content_type="text/csv; charset=utf-8")
    answer["Content-Disposition"] = f'attachment; filename="{file_name(name)}.csv"'
    return answer


def file_name(text: str) -> str:
    """Letters, digits, dot, dash and underscore only: a tool's code may hold anything, a header may not."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", text).strip("-.") or "export"
