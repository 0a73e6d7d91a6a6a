"""Ordering: queue an inspection, cancel a scan. For operators and above, with a token of scope queue."""

from __future__ import annotations

from typing import Annotated, Any

from django.http import Http404, HttpRequest
from ninja import Path, Status

from inspection.api import shapes
from inspection.api.callers import caller
from inspection.api.reading import FAULTS, scan_by_id, visit_by_id
from inspection.api.routes import router
from inspection.api.shapes import Id
from inspection.models import Rig, Role, Scan, Tool
from inspection.services.queue import cancel_scan, enqueue_inspection
from inspection.services.recipes import recipe_named
from scanning.errors import BadInput


@router.post(
    "/inspections",
    tags=["ordering"],
    response={201: shapes.Inspection, 400: shapes.Fault, 409: shapes.Conflict, **FAULTS},
)
def order_inspection(request: HttpRequest, order: shapes.Order) -> Any:
    """Queue one scan per region of a tool at a rig. All are queued, or none."""
    by = caller(request, Role.OPERATOR)
    tool = Tool.objects.select_related("tool_type").filter(code=order.tool).first()
    if tool is None:
        raise BadInput(f"There is no tool {order.tool!r}; GET /api/v1/tools lists the codes.")
    rig = Rig.objects.filter(slug=order.rig).first()
    if rig is None:
        raise BadInput(f"There is no rig {order.rig!r}; GET /api/v1/rigs lists them.")
    regions = None
    if order.regions is not None:
        by_name = {region.name: region for region in tool.regions.all()}
        if unknown := [name for name in order.regions if name not in by_name]:
            raise BadInput(f"Tool {tool.code} has no region {unknown[0]!r}; it has {', '.join(by_name) or 'none'}.")
        regions = [by_name[name] for name in dict.fromkeys(order.regions)]
    visit = enqueue_inspection(
        tool=tool,
        rig=rig,
        by=by,
        regions=regions,
        recipe=recipe_named(order.recipe) if order.recipe else None,
        reason=order.reason,
        exposures_us=order.exposures_us,
    )
    return Status(201, visit_by_id(visit.pk))


@router.post("/scans/{scan_id}/cancel", tags=["ordering"], response={200: shapes.Scan, 409: shapes.Conflict, **FAULTS})
def cancel(request: HttpRequest, scan_id: Annotated[Id, Path()]) -> Any:
    """Take a queued scan out of the queue, or stop a running one at its next step (it stays running until then)."""
    by = caller(request, Role.OPERATOR)
    scan = Scan.objects.filter(pk=scan_id).first()
    if scan is None:
        raise Http404(f"There is no scan {scan_id}.")
    cancel_scan(scan, by)
    return scan_by_id(scan.pk)
