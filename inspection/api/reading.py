"""Reading: tools, visits, scans with their numbers, range images, queues, what is due, trends. Every role may."""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterable
from typing import Annotated, Any, TypeVar

from django.db.models import Model, OuterRef, Prefetch, QuerySet, Subquery
from django.http import FileResponse, Http404, HttpRequest, HttpResponse, HttpResponseBase
from ninja import Path, Query

from inspection.api import shapes
from inspection.api.callers import Caller, caller
from inspection.api.routes import router
from inspection.api.shapes import Id, Word
from inspection.models import Inspection, RangeImage, Rig, Role, Scan, Tool
from inspection.reports.csv import Dialect, write_range_image
from inspection.reports.pdf import inspection_pdf
from inspection.reports.rows import Cell, Selection, latest_verdicts, verdict_of_visit
from inspection.reports.stored import load, path_of
from inspection.reports.views import file_name, newest_result, scan_name, streamed
from inspection.selectors.due import due_list
from inspection.selectors.queue import QueueRow, queue_view
from inspection.selectors.trend import tool_trends, trend_metrics
from inspection.states import ScanState
from scanning.errors import BadInput

Limit = Annotated[int, Query(ge=1, le=500, description="Records per page.")]
Offset = Annotated[int, Query(ge=0, le=10**9, description="Records to skip.")]
M = TypeVar("M", bound=Model)
Key = Annotated[Id, Path()]
FAULTS = {401: shapes.Fault, 403: shapes.Fault, 404: shapes.Fault, 422: shapes.Fault}


@router.get("/me", tags=["reading"], response={200: shapes.Me, 401: shapes.Fault})
def me(request: HttpRequest) -> Any:
    """Who this key or session is, and what it may do."""
    user = caller(request)
    found: Caller = request.auth  # type: ignore[attr-defined]
    return {
        "user": user.get_username(),
        "role": user.role,
        "may_read": found.may(Role.VIEWER),
        "may_queue": found.may(Role.OPERATOR),
        "token": found.token.name if found.token else None,
    }


@router.get("/tools", tags=["reading"], response={200: shapes.Tools, **FAULTS})
def tools(request: HttpRequest, code: Word = "", status: Word = "", limit: Limit = 100, offset: Offset = 0) -> Any:
    """All tools by code, with the verdict of their newest results. ``code`` finds one exactly."""
    caller(request)
    found = Tool.objects.select_related("tool_type").order_by("code")
    if code:
        found = found.filter(code=code)
    if status:
        if status not in Tool.Status.values:
            raise BadInput(f"There is no status {status!r}; tools are {', '.join(Tool.Status.values)}.")
        found = found.filter(status=status)
    return _paged(found, limit, offset, _tool_rows)


@router.get("/tools/{tool_id}", tags=["reading"], response={200: shapes.ToolDetail, **FAULTS})
def tool(request: HttpRequest, tool_id: Key) -> Any:
    """One tool with its regions and the metrics it was measured by."""
    caller(request)
    found = _one(Tool.objects.select_related("tool_type").prefetch_related("regions"), tool_id, "tool")
    return _tool_rows([found])[0] | {
        "note": found.note,
        "bevel_angle_deg": found.tool_type.bevel_angle_deg,
        "edge_length_mm": found.tool_type.edge_length_mm,
        "regions": list(found.regions.all()),
        "metrics": trend_metrics(found),
    }


@router.get("/tools/{tool_id}/regions", tags=["reading"], response={200: list[shapes.Region], **FAULTS})
def regions(request: HttpRequest, tool_id: Key) -> Any:
    """The regions of a tool's edge."""
    caller(request)
    return list(_one(Tool.objects.prefetch_related("regions"), tool_id, "tool").regions.all())


@router.get("/tools/{tool_id}/trend", tags=["reading"], response={200: list[dict[str, Any]], **FAULTS})
def trend(request: HttpRequest, tool_id: Key, metric: Word, region: Word = "") -> Any:
    """The history of one metric per active region: points, events, limits, wear line, forecast, and a sentence."""
    caller(request)
    found = _one(Tool.objects.select_related("tool_type").prefetch_related("regions"), tool_id, "tool")
    trends = tool_trends(found, [metric])
    if region:
        trends = [one for one in trends if one["region"]["name"] == region]
        if not trends:
            raise BadInput(f"Tool {found.code} has no active region {region!r}.")
    return trends


@router.get("/inspections", tags=["reading"], response={200: shapes.Inspections, **FAULTS})
def inspections(request: HttpRequest, tool: Word = "", limit: Limit = 50, offset: Offset = 0) -> Any:
    """Visits, newest first; ``tool`` is a code."""
    caller(request)
    found = _visits()
    if tool:
        found = found.filter(tool__code=tool)
    return _paged(found, limit, offset, lambda rows: [inspection_row(row) for row in rows])


@router.get("/inspections/{inspection_id}", tags=["reading"], response={200: shapes.Inspection, **FAULTS})
def inspection(request: HttpRequest, inspection_id: Key) -> Any:
    """One visit with its scans."""
    caller(request)
    return inspection_row(_one(_visits(), inspection_id, "inspection"))


@router.get("/inspections/{inspection_id}/report.pdf", tags=["reading"], response={**FAULTS})
def report(request: HttpRequest, inspection_id: Key) -> HttpResponseBase:
    """The PDF report of a visit."""
    caller(request)
    found = _one(Inspection.objects.select_related("tool__tool_type", "requested_by"), inspection_id, "inspection")
    answer = HttpResponse(inspection_pdf(found), content_type="application/pdf")
    name = file_name(f"{found.tool.code}_inspection-{found.pk}")
    answer["Content-Disposition"] = f'attachment; filename="{name}.pdf"'
    return answer


@router.get("/scans", tags=["reading"], response={200: shapes.Scans, **FAULTS})
def scans(
    request: HttpRequest,
    tool: Word = "",
    region: Word = "",
    state: Word = "",
    since: dt.date | None = None,
    until: dt.date | None = None,
    limit: Limit = 100,
    offset: Offset = 0,
) -> Any:
    """Scans, newest first, by tool code, region name, state and local day they were queued (both days included)."""
    caller(request)
    if state and state not in ScanState.values:
        raise BadInput(f"There is no state {state!r}; scans are {', '.join(ScanState.values)}.")
    for day in (since, until):
        if day is not None and not 1900 <= day.year <= 9000:
            raise BadInput(f"The day {day} is outside the years 1900 to 9000.")
    chosen = Selection(tool=tool, region=region, state=state, since=since, until=until)
    return _paged(_with_verdict(chosen.scans()), limit, offset, lambda rows: [scan_row(row) for row in rows])


@router.get("/scans/{scan_id}", tags=["reading"], response={200: shapes.ScanDetail, **FAULTS})
def scan(request: HttpRequest, scan_id: Key) -> Any:
    """One scan with its newest result: verdict, numbers with uncertainties, damages, precision and provenance."""
    caller(request)
    found = _one(_with_verdict(Scan.objects.all()), scan_id, "scan")
    results = list(
        found.range_images.select_related("recipe", "calibration", "limit_set", "precision").prefetch_related(
            "measurements", "damages"
        )
    )
    return scan_row(found) | {
        "plan": found.plan,
        "message": found.message,
        "stack_sha256": found.stack_sha256,
        "result": _result(results[0]) if results else None,
        "results": [result.pk for result in results],
    }


@router.get("/scans/{scan_id}/range.npz", tags=["reading"], response={**FAULTS})
def range_npz(request: HttpRequest, scan_id: Key) -> HttpResponseBase:
    """The newest range image: numpy arrays column_px, height_um (NaN = not measured), intensity, width_px, pitches."""
    caller(request)
    found = _scan_for_download(scan_id)
    stored = newest_result(found)
    load(stored)  # refuses a file that is not the one that was judged
    return FileResponse(
        path_of(stored).open("rb"),
        as_attachment=True,
        filename=f"{file_name(scan_name(found))}_range.npz",
        content_type="application/octet-stream",
    )


@router.get("/scans/{scan_id}/range.csv", tags=["reading"], response={**FAULTS})
def range_csv(request: HttpRequest, scan_id: Key, sep: Word = ",", decimal: Word = ".") -> HttpResponseBase:
    """The newest range image as a matrix of heights in um with mm on both axes; empty = not measured."""
    caller(request)
    found = _scan_for_download(scan_id)
    dialect = Dialect.asked_for(sep, decimal)
    stored = newest_result(found)
    about: list[tuple[str, Cell]] = [
        ("tool", found.inspection.tool.code),
        ("region", found.region.name),
        ("scan", found.pk),
    ]
    return streamed(write_range_image(load(stored), about, dialect), f"{scan_name(found)}_range")


@router.get("/rigs", tags=["reading"], response={200: list[shapes.Rig], **FAULTS})
def rigs(request: HttpRequest) -> Any:
    """All rigs with the state of their queues."""
    caller(request)
    return list(Rig.objects.all())


@router.get("/rigs/{slug}/queue", tags=["reading"], response={200: shapes.Queue, **FAULTS})
def queue(request: HttpRequest, slug: Annotated[Word, Path()]) -> Any:
    """What is on the rig, what waits and for what, what is being computed."""
    caller(request)
    rig = Rig.objects.filter(slug=slug).first()
    if rig is None:
        raise Http404(f"There is no rig {slug!r}.")
    view = queue_view(rig)
    return {
        "rig": rig.slug,
        "state": rig.queue_state,
        "reason": rig.queue_reason,
        "worker_silent": view.worker_silent,
        "rows": [_queue_row(row) for row in view.rows],
        "processing": [_queue_row(row) for row in view.processing],
    }


@router.get("/due", tags=["reading"], response={200: list[shapes.Due], **FAULTS})
def due(request: HttpRequest) -> Any:
    """What is due and when, most urgent first."""
    caller(request)
    return [
        {
            "tool": row.schedule.tool.code,
            "schedule": row.schedule.pk,
            "rig": row.schedule.rig.slug,
            "due_on": row.due_on,
            "opens_on": row.opens_on,
            "closes_on": row.closes_on,
            "colour": row.colour,
            "words": row.words,
            "overdue_days": row.overdue_days,
        }
        for row in due_list()
    ]


def _one(rows: QuerySet[M], pk: int, kind: str) -> M:
    found = rows.filter(pk=pk).first()
    if found is None:
        raise Http404(f"There is no {kind} {pk}.")
    return found


def _paged(rows: QuerySet[Any], limit: int, offset: int, shape: Any) -> dict[str, Any]:
    return {
        "count": rows.count(),
        "limit": limit,
        "offset": offset,
        "items": shape(list(rows[offset : offset + limit])),
    }


def _tool_rows(found: Iterable[Tool]) -> list[dict[str, Any]]:
    found = list(found)
    verdicts = latest_verdicts(Tool.objects.filter(pk__in=[row.pk for row in found]))
    rows = []
    for row in found:
        verdict, at = verdicts.get(row.pk, (None, None))
        rows.append(
            {
                "id": row.pk,
                "code": row.code,
                "type": row.tool_type.name,
                "location": row.location,
                "status": row.status,
                "life_used": row.life_used,
                "life_unit": row.tool_type.life_unit,
                "verdict": verdict,
                "last_inspected": at,
            }
        )
    return rows


def _with_verdict(found: QuerySet[Scan]) -> QuerySet[Any]:
    newest = RangeImage.objects.filter(scan=OuterRef("pk")).order_by("-created_at", "-pk").values("verdict")[:1]
    return (
        found.select_related("inspection__tool", "region", "rig")
        .annotate(verdict=Subquery(newest))
        .order_by("-queued_at", "-pk")
    )


def _visits() -> QuerySet[Inspection]:
    return (
        Inspection.objects.select_related("tool", "requested_by")
        .prefetch_related(Prefetch("scans", queryset=_with_verdict(Scan.objects.all()).order_by("region__name", "pk")))
        .order_by("-requested_at", "-pk")
    )


def scan_row(row: Any) -> dict[str, Any]:
    """A scan annotated with its verdict, as `shapes.Scan`."""
    return {
        "id": row.pk,
        "inspection": row.inspection_id,
        "tool": row.inspection.tool.code,
        "region": row.region.name,
        "rig": row.rig.slug,
        "verdict": row.verdict,
        **{
            name: getattr(row, name)
            for name in (
                "state", "source", "partial", "phase", "done", "total", "queued_at", "started_at", "finished_at",
                "fault",
            )
        },
    }  # fmt: skip


def inspection_row(row: Inspection) -> dict[str, Any]:
    """A visit from `_visits`, as `shapes.Inspection`."""
    found: list[Any] = list(row.scans.all())
    return {
        "id": row.pk,
        "tool": row.tool.code,
        "requested_at": row.requested_at,
        "requested_by": row.requested_by.get_username() if row.requested_by else None,
        "reason": row.reason,
        "life_used": row.life_used,
        "verdict": verdict_of_visit([scan.verdict if scan.state == ScanState.DONE else None for scan in found]),
        "scans": [scan_row(scan) for scan in found],
    }


def visit_by_id(pk: int) -> dict[str, Any]:
    return inspection_row(_one(_visits(), pk, "inspection"))


def scan_by_id(pk: int) -> dict[str, Any]:
    return scan_row(_one(_with_verdict(Scan.objects.all()), pk, "scan"))


def _scan_for_download(pk: int) -> Scan:
    return _one(Scan.objects.select_related("inspection__tool", "region"), pk, "scan")


def _result(row: RangeImage) -> dict[str, Any]:
    return {
        "id": row.pk,
        "created_at": row.created_at,
        "verdict": row.verdict,
        "reasons": row.verdict_reasons,
        "rows": row.rows,
        "profiles": row.profiles,
        "row_pitch_um": row.row_pitch_um,
        "profile_pitch_um": row.profile_pitch_um,
        "sha256": row.sha256,
        "recipe": row.recipe.name,
        "recipe_sha256": row.recipe.sha256,
        "limits_version": row.limit_set.version if row.limit_set else None,
        "calibration": row.calibration,
        "baseline": row.baseline_id,
        "measurements": list(row.measurements.all()),
        "damages": list(row.damages.all()),
        "precision": getattr(row, "precision", None),
        "provenance": row.provenance,
    }


def _queue_row(row: QueueRow) -> dict[str, Any]:
    return {
        "scan": row.scan.pk,
        "tool": row.scan.region.tool.code,
        "region": row.scan.region.name,
        "state": row.scan.state,
        "position": row.position,
        "waits_for": row.why,
        "starts_at": row.starts_at,
        "ends_at": row.ends_at,
    }
