"""The records. One file per idea; everything a number depends on is linked and never edited."""

from inspection.models.events import AuditEvent, Event
from inspection.models.people import Role, SignInFailure, User
from inspection.models.plant import Region, Tool, ToolType
from inspection.models.results import (
    Damage,
    Measurement,
    PrecisionReport,
    RangeImage,
    Recomputation,
    RecomputationBatch,
)
from inspection.models.rigs import Calibration, Limit, LimitSet, Recipe, Rig
from inspection.models.scans import Inspection, Scan
from inspection.models.schedules import DueSlot, Schedule
from inspection.models.tokens import ApiToken

__all__ = [
    "ApiToken",
    "AuditEvent",
    "Calibration",
    "Damage",
    "DueSlot",
    "Event",
    "Inspection",
    "Limit",
    "LimitSet",
    "Measurement",
    "PrecisionReport",
    "RangeImage",
    "Recipe",
    "Recomputation",
    "RecomputationBatch",
    "Region",
    "Rig",
    "Role",
    "Scan",
    "Schedule",
    "SignInFailure",
    "Tool",
    "ToolType",
    "User",
]
