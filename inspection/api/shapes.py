"""The shapes of what the API takes and gives. They are the contract: the OpenAPI document is made of them.

Lengths, volumes and times carry their unit in the name; null means not measured. ``u`` is a standard uncertainty
(k = 1).
"""

from __future__ import annotations

import datetime as dt
from typing import Annotated, Any

from ninja import Field, Schema
from pydantic import StringConstraints

from scanning.recipe import Recipe

#: A database key: what lies outside cannot exist, and must not reach the database as a number too large for it.
Id = Annotated[int, Field(ge=1, le=2**63 - 1)]
#: A word from outside, without control characters that a database refuses.
Word = Annotated[str, StringConstraints(max_length=200, pattern=r"^[^\x00-\x08\x0b\x0c\x0e-\x1f]*$")]


class Fault(Schema):
    detail: str = Field(description="One sentence: what is wrong, where, what to do.")


class Conflict(Fault):
    state: str = Field(description="The state that made the request impossible.")


class Me(Schema):
    user: str
    role: str
    may_read: bool
    may_queue: bool
    token: str | None = Field(description="Name of the token in use, null for a session.")


class Region(Schema):
    id: int
    name: str
    start_mm: float
    length_mm: float
    row_offset: int
    rows: int
    flat_row: int
    flat_rows: int
    active: bool


class Tool(Schema):
    id: int
    code: str
    type: str
    location: str
    status: str
    life_used: float
    life_unit: str
    verdict: str | None = Field(description="Worst over the newest result of every region; null if never measured.")
    last_inspected: dt.datetime | None


class ToolDetail(Tool):
    note: str
    bevel_angle_deg: float
    edge_length_mm: float
    regions: list[Region]
    metrics: list[Metric]


class Metric(Schema):
    code: str
    label: str
    unit: str


class Rig(Schema):
    slug: str
    name: str
    active: bool
    travel_mm: float
    exposures_us: list[float]
    queue_state: str
    queue_reason: str
    worker_seen_at: dt.datetime | None


class Scan(Schema):
    id: int
    inspection: int
    tool: str
    region: str
    rig: str
    state: str
    source: str
    verdict: str | None
    partial: bool
    phase: str
    done: int
    total: int
    queued_at: dt.datetime
    started_at: dt.datetime | None
    finished_at: dt.datetime | None
    fault: str


class Measurement(Schema):
    metric: str
    label: str
    value: float | None
    unit: str
    u: float | None
    origin: str


class Damage(Schema):
    number: int
    severity: str
    volume_mm3: float
    u_volume_mm3: float | None
    depth_um: float
    u_depth_um: float | None
    area_mm2: float
    length_mm: float
    start_mm: float
    end_mm: float
    touches_edge: bool


class Precision(Schema):
    undefined_count: int
    undefined_share: float
    saturated_count: int
    saturated_share: float
    sigma_um: float | None
    cell_row_um: float
    cell_scan_um: float
    ns_per_range_pixel: float | None = Field(description="null: not computed from frames.")
    cpu_ns_per_range_pixel: float | None
    confident_share: float | None = Field(
        description="Share of the measured points whose confidence is above confident_above; null: not told."
    )
    confident_above: float | None
    outside_calibrated_share: float | None = Field(
        description="Share of the heights beyond the range of the gauge; null: no gauge."
    )


class CalibrationUsed(Schema):
    id: int
    done_on: dt.date
    valid_until: dt.date
    slope_mm_per_px: float
    u_slope_mm_per_px: float
    max_residual_um: float


class Result(Schema):
    id: int
    created_at: dt.datetime
    verdict: str
    reasons: list[str]
    rows: int
    profiles: int
    row_pitch_um: float
    profile_pitch_um: float
    sha256: str
    recipe: str
    recipe_sha256: str
    limits_version: int | None
    calibration: CalibrationUsed | None
    baseline: int | None = Field(description="Id of the range image this one was compared with.")
    measurements: list[Measurement]
    damages: list[Damage]
    precision: Precision | None
    provenance: dict[str, Any]


class ScanDetail(Scan):
    plan: dict[str, Any]
    message: str
    stack_sha256: str
    result: Result | None = Field(description="The newest result.")
    results: list[int] = Field(description="Ids of all results, newest first.")


class Inspection(Schema):
    id: int
    tool: str
    requested_at: dt.datetime
    requested_by: str | None = Field(description="null: ordered by a schedule.")
    reason: str
    life_used: float | None
    verdict: str = Field(description="Worst region; a region without a result makes it unknown at the least.")
    scans: list[Scan]


class Order(Schema):
    """An inspection to be queued."""

    model_config = {"extra": "forbid"}

    tool: Word = Field(description="The tool's code, as on its label.")
    rig: Word = Field(description="The rig's slug.")
    regions: list[Word] | None = Field(None, max_length=200, description="Names; left out: all active regions.")
    recipe: Word | None = Field(
        None, description=f"{', '.join(Recipe.NAMES)}; left out: PRECISE, or HDR-CAM for a logarithmic camera."
    )
    exposures_us: list[float] | None = Field(None, max_length=32, description="Left out: the rig's bracket.")
    reason: Word = ""


class QueueRow(Schema):
    scan: int
    tool: str
    region: str
    state: str
    position: int = Field(description="0 is on the rig, 1 is next.")
    waits_for: str = Field(description="In words.")
    starts_at: dt.datetime | None
    ends_at: dt.datetime | None


class Queue(Schema):
    rig: str
    state: str
    reason: str
    worker_silent: bool
    rows: list[QueueRow]
    processing: list[QueueRow]


class Due(Schema):
    tool: str
    schedule: int
    rig: str
    due_on: dt.date
    opens_on: dt.date
    closes_on: dt.date
    colour: str
    words: str
    overdue_days: int


class Page(Schema):
    count: int
    limit: int
    offset: int


class Tools(Page):
    items: list[Tool]


class Scans(Page):
    items: list[Scan]


class Inspections(Page):
    items: list[Inspection]


ToolDetail.model_rebuild()
