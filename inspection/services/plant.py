"""Tools, tool types and regions, and what happens to them. Every change leaves a line in the audit trail.

Old results never change with it: a scan holds its own frozen plan, and limits are rows of their own.
"""

from __future__ import annotations

import datetime as dt
import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from django.db import Error, IntegrityError, models, transaction
from django.utils import timezone

from inspection.models import Event, Region, Rig, Tool, ToolType, User
from inspection.models.plant import LifeUnit
from inspection.services.audit import audit
from inspection.services.limits import add_default_limits
from scanning.errors import BadInput

#: Regions of a new tool (the paper scans three stretches of the edge), spread evenly over it.
DEFAULT_REGIONS = ("R1", "R2", "R3")
#: 245 steps of 8.33 um: 241 profiles after sliding SCI, as wide as the paper's range images.
DEFAULT_LENGTH_MM = 245 * 0.00833
DEFAULT_ROWS = 1000
DEFAULT_FLAT_ROWS = 600
#: The cutting edge is at the first rows; the flat part keeps clear of it and of the damage behind it.
DEFAULT_FLAT_ROW = 350

Row = TypeVar("Row", bound=models.Model)


def create_tool_type(
    *,
    by: User | None,
    name: str,
    edge_length_mm: float,
    bevel_angle_deg: float = 55.0,
    life_unit: str = LifeUnit.HOURS,
    note: str = "",
) -> ToolType:
    """Add a kind of tool, with the default limits as its first limit set (version 1)."""
    name = _name(name, "tool type")
    _positive(edge_length_mm, "The edge length", "mm")
    _check_angle(bevel_angle_deg)
    _check_unit(life_unit)
    with transaction.atomic():
        row = ToolType(
            name=name, edge_length_mm=edge_length_mm, bevel_angle_deg=bevel_angle_deg, life_unit=life_unit, note=note
        )
        _save(row, f"There is already a tool type {name}; choose another name.")
        audit(by, "tool type.created", row, after={"name": name, "edge_length_mm": edge_length_mm})
        add_default_limits(row, by)
    return row


def update_tool_type(tool_type: ToolType, *, by: User | None, **changes: Any) -> ToolType:
    """Change name, bevel_angle_deg, edge_length_mm, life_unit or note."""
    _allow(changes, {"name", "bevel_angle_deg", "edge_length_mm", "life_unit", "note"}, "tool type")
    if "name" in changes:
        changes["name"] = _name(changes["name"], "tool type")
    if "edge_length_mm" in changes:
        _positive(changes["edge_length_mm"], "The edge length", "mm")
    if "bevel_angle_deg" in changes:
        _check_angle(changes["bevel_angle_deg"])
    if "life_unit" in changes:
        _check_unit(changes["life_unit"])
    return _update(tool_type, by, "tool type.changed", changes, "There is already a tool type of that name.")


def create_tool(
    *,
    by: User | None,
    code: str,
    tool_type: ToolType,
    location: str = "",
    status: str = Tool.Status.IN_SERVICE,
    life_used: float = 0.0,
    note: str = "",
    with_default_regions: bool = True,
) -> Tool:
    """Add a tool, with the regions R1, R2 and R3 spread over its edge unless told otherwise."""
    code = _name(code, "tool")
    _check_status(status)
    _not_negative(life_used, "The use so far")
    with transaction.atomic():
        tool = Tool(
            code=code, tool_type=tool_type, location=location.strip(), status=status, life_used=life_used, note=note
        )
        _save(tool, f"There is already a tool {code}; look it up or choose another code.")
        audit(by, "tool.created", tool, after={"code": code, "type": tool_type.name})
        if with_default_regions:
            _add_default_regions(tool)
    return tool


def _add_default_regions(tool: Tool) -> None:
    edge_mm = tool.tool_type.edge_length_mm
    length_mm = min(DEFAULT_LENGTH_MM, edge_mm / len(DEFAULT_REGIONS))
    for number, name in enumerate(DEFAULT_REGIONS):
        centre_mm = edge_mm * (number + 0.5) / len(DEFAULT_REGIONS)
        Region.objects.create(
            tool=tool,
            name=name,
            start_mm=round(centre_mm - length_mm / 2.0, 3),
            length_mm=length_mm,
            rows=DEFAULT_ROWS,
            flat_row=DEFAULT_FLAT_ROW,
            flat_rows=DEFAULT_FLAT_ROWS,
        )


def update_tool(tool: Tool, *, by: User | None, **changes: Any) -> Tool:
    """Change code, location, status, life_used or note."""
    _allow(changes, {"code", "location", "status", "life_used", "note"}, "tool")
    if "code" in changes:
        changes["code"] = _name(changes["code"], "tool")
    if "status" in changes:
        _check_status(changes["status"])
    if "life_used" in changes:
        _not_negative(changes["life_used"], "The use so far")
    return _update(tool, by, "tool.changed", changes, f"There is already a tool {changes.get('code')}.")


def create_region(
    tool: Tool,
    *,
    by: User | None,
    name: str,
    start_mm: float,
    length_mm: float,
    rows: int = DEFAULT_ROWS,
    row_offset: int = 0,
    flat_row: int = 0,
    flat_rows: int = DEFAULT_FLAT_ROWS,
) -> Region:
    """Add a stretch of the edge.

    Refused outside the edge, outside every rig's travel, or with a flat part outside itself.
    """
    region = Region(
        tool=tool,
        name=_name(name, "region"),
        start_mm=start_mm,
        length_mm=length_mm,
        rows=rows,
        row_offset=row_offset,
        flat_row=flat_row,
        flat_rows=flat_rows,
    )
    check_region(region)
    with transaction.atomic():
        _save(region, f"Tool {tool.code} already has a region {region.name}; choose another name.")
        audit(by, "region.created", region, after=_values(region, REGION_FIELDS))
    return region


REGION_FIELDS = ("name", "start_mm", "length_mm", "row_offset", "rows", "flat_row", "flat_rows", "active")


def update_region(region: Region, *, by: User | None, **changes: Any) -> Region:
    """Change a region. Scans already ordered keep the plan they were given."""
    _allow(changes, set(REGION_FIELDS), "region")
    if "name" in changes:
        changes["name"] = _name(changes["name"], "region")
    trial = Region(tool=region.tool, **{**_values(region, REGION_FIELDS), **changes})
    check_region(trial)
    return _update(region, by, "region.changed", changes, f"The tool already has a region {changes.get('name')}.")


def check_region(region: Region) -> None:
    """Raise `BadInput` if the region makes no sense on its tool, or lies beyond what any rig can reach."""
    for value, what in ((region.start_mm, "start"), (region.length_mm, "length")):
        if not math.isfinite(value):
            raise BadInput(f"The {what} of region {region.name} is not a number; give millimetres.")
    edge_mm = region.tool.tool_type.edge_length_mm
    if region.start_mm < 0 or region.length_mm <= 0 or region.start_mm + region.length_mm > edge_mm + 1e-6:
        raise BadInput(
            f"Region {region.name} reaches from {region.start_mm:g} to {region.start_mm + region.length_mm:g} mm; it "
            f"must lie within the tool's edge, 0 to {edge_mm:g} mm."
        )
    reach_mm = max(Rig.objects.filter(active=True).values_list("travel_mm", flat=True), default=None)
    if reach_mm is not None and region.start_mm + region.length_mm > reach_mm + 1e-6:
        raise BadInput(
            f"Region {region.name} ends at {region.start_mm + region.length_mm:g} mm, beyond the {reach_mm:g} mm "
            f"that the longest stage can travel; move or shorten it."
        )
    if not 1 <= region.rows <= 65535:
        raise BadInput(f"Region {region.name} asks for {region.rows} sensor rows; give 1 to 65535.")
    if region.row_offset < 0 or region.flat_row < 0:
        raise BadInput(f"Region {region.name} has a negative row; rows count from 0.")
    last_flat_row = region.flat_row + region.flat_rows
    if region.flat_rows < 3 or last_flat_row > region.rows:
        raise BadInput(
            f"The flat part of region {region.name} is rows {region.flat_row} to {last_flat_row}; it needs at least 3 "
            f"rows within the region's {region.rows}."
        )


def record_event(
    tool: Tool,
    kind: str,
    *,
    at: dt.datetime,
    by: User | None,
    life_used: float | None = None,
    removed_mm: float | None = None,
    note: str = "",
) -> Event:
    """Note something done to a tool. After a regrind, a turn or a replacement its use counts from zero again.

    ``life_used`` is the tool's reading at that moment (default: the one known), ``removed_mm`` the stock a regrind
    took.
    """
    if kind not in Event.Kind.values:
        raise BadInput(f"There is no event {kind!r}; choose one of {', '.join(Event.Kind.values)}.")
    if timezone.is_naive(at):
        at = timezone.make_aware(at)
    if at > timezone.now() + dt.timedelta(minutes=5):
        raise BadInput("The event lies in the future; enter when it happened.")
    if life_used is not None:
        _not_negative(life_used, "The use at the event")
    if removed_mm is not None:
        _not_negative(removed_mm, "The stock removed")
    with transaction.atomic():
        event = Event.objects.create(
            tool=tool,
            kind=kind,
            at=at,
            by=by,
            life_used=tool.life_used if life_used is None else life_used,
            removed_mm=removed_mm,
            note=note.strip()[:300],
        )
        after: dict[str, Any] = {"kind": kind, "at": at}
        if kind in Event.SEGMENT_ENDS:
            # An event entered late must not wipe the use counted since a newer one.
            newer = tool.events.filter(kind__in=Event.SEGMENT_ENDS, at__gt=at).exists()
            if not newer:
                Tool.objects.filter(pk=tool.pk).update(life_used=0.0)
                after["life_used"] = 0.0
        audit(by, "tool.event", tool, before={"life_used": tool.life_used}, after=after, reason=note)
    tool.refresh_from_db()
    return event


def _update(row: Row, by: User | None, verb: str, changes: dict[str, Any], taken: str) -> Row:
    changed = {name: value for name, value in changes.items() if getattr(row, name) != value}
    if not changed:
        return row
    before = _values(row, changed)
    with transaction.atomic():
        for name, value in changed.items():
            setattr(row, name, value)
        try:
            _save(row, taken, update_fields=list(changed))
        except BadInput:
            for name, value in before.items():
                setattr(row, name, value)
            raise
        audit(by, verb, row, before=before, after=changed)
    return row


def _save(row: models.Model, taken: str, **options: Any) -> None:
    try:
        with transaction.atomic():
            row.save(**options)
    except IntegrityError as error:
        raise BadInput(taken) from error
    except (Error, ValueError, TypeError) as error:
        raise BadInput(f"That cannot be stored: {error}") from error


def _values(row: models.Model, names: Sequence[str] | Mapping[str, Any]) -> dict[str, Any]:
    return {name: getattr(row, name) for name in names}


def _allow(changes: Mapping[str, Any], allowed: set[str], what: str) -> None:
    if unknown := set(changes) - allowed:
        raise BadInput(f"A {what} has no {sorted(unknown)[0]} to change; it has {', '.join(sorted(allowed))}.")


def _name(text: str, what: str) -> str:
    text = text.strip()
    if not text:
        raise BadInput(f"The {what} needs a name.")
    return text


def _positive(value: float, what: str, unit: str) -> None:
    if not math.isfinite(value) or value <= 0:
        raise BadInput(f"{what} is {value:g}; give a number of {unit} above 0.")


def _not_negative(value: float, what: str) -> None:
    if not math.isfinite(value) or value < 0:
        raise BadInput(f"{what} is {value:g}; give a number from 0 up.")


def _check_angle(degrees: float) -> None:
    if not 1.0 <= degrees <= 179.0:
        raise BadInput(f"A bevel angle of {degrees:g} degrees is impossible; give 1 to 179.")


def _check_unit(unit: str) -> None:
    if unit not in LifeUnit.values:
        raise BadInput(f"There is no life unit {unit!r}; choose one of {', '.join(LifeUnit.values)}.")


def _check_status(status: str) -> None:
    if status not in Tool.Status.values:
        raise BadInput(f"There is no status {status!r}; choose one of {', '.join(Tool.Status.values)}.")
