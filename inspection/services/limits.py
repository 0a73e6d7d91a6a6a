"""The limits of a tool type. Changing one adds a whole new set with a reason; verdicts keep the set they were given by.

If a set could be edited, last year's verdicts would change their meaning without anybody noticing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from django.db import IntegrityError, transaction
from django.db.models import Max

from inspection.models import Limit, LimitSet, ToolType, User
from inspection.services.audit import audit
from scanning.errors import BadInput

#: metric: (watch above, replace above, unit). A new tool type starts with these; the plant's own experience replaces
#: them. Depth and length are where our severity classes change (measuring.md 1.3: minor below 50 um and 0.2 mm, large
#: from 150 um or 1 mm). Recession: 45-60 um already spoil a planed surface, chipping knives reach 544 um in 80 h and
#: are reground long before (Ghosh 2015). Volume is a dent of the length and depth above with a triangular section.
DEFAULT_LIMITS: dict[str, tuple[float | None, float | None, str]] = {
    "d_max": (50.0, 150.0, "um"),
    "L_max": (0.2, 1.0, "mm"),
    "V-": (0.002, 0.02, "mm3"),
    "ER_max": (100.0, 250.0, "um"),
}


def set_limits(
    tool_type: ToolType,
    limits: Mapping[str, tuple[float | None, float | None, str]],
    *,
    by: User | None,
    reason: str,
) -> LimitSet:
    """Put a new limit set in force: ``{metric: (watch_above, replace_above, unit)}``, either limit may be None.

    ``reason`` is demanded. Raises `BadInput` for an empty set, a limit that is not a positive number, or a replace
    limit below its watch limit. Metrics left out have no limit any more.
    """
    reason = reason.strip()
    if not reason:
        raise BadInput("Say why the limits change; the reason is kept beside every verdict they lead to.")
    if not limits:
        raise BadInput(f"A limit set needs at least one limit; without any, no verdict on a {tool_type} is possible.")
    for metric, (watch, replace, unit) in limits.items():
        _check(metric, watch, replace, unit)
    before = limits_as_data(tool_type.limit_sets.order_by("-version").first())
    try:
        with transaction.atomic():
            newest = LimitSet.objects.filter(tool_type=tool_type).aggregate(top=Max("version"))["top"] or 0
            row = LimitSet.objects.create(tool_type=tool_type, version=newest + 1, by=by, reason=reason[:300])
            for metric, (watch, replace, unit) in limits.items():
                Limit.objects.create(limit_set=row, metric=metric, watch_above=watch, replace_above=replace, unit=unit)
            audit(by, "limits.set", tool_type, before=before, after=limits_as_data(row), reason=reason)
    except IntegrityError as error:
        raise BadInput(
            f"Somebody else set the limits of {tool_type} at this moment; look at them and try again."
        ) from error
    return row


def add_default_limits(tool_type: ToolType, by: User | None) -> LimitSet:
    """Give a new tool type its first limit set."""
    return set_limits(tool_type, DEFAULT_LIMITS, by=by, reason="Defaults of a new tool type; set your own.")


def limits_as_data(limit_set: LimitSet | None) -> dict[str, list[float | str | None]] | None:
    """``{metric: [watch_above, replace_above, unit]}`` of a set."""
    if limit_set is None:
        return None
    return {limit.metric: [limit.watch_above, limit.replace_above, limit.unit] for limit in limit_set.limits.all()}


def _check(metric: str, watch: float | None, replace: float | None, unit: str) -> None:
    if not metric.strip():
        raise BadInput("A limit needs the name of its metric.")
    if watch is None and replace is None:
        raise BadInput(f"The limit on {metric} is empty; give watch, replace, or both, or leave the metric out.")
    for value, what in ((watch, "watch"), (replace, "replace")):
        if value is not None and (not math.isfinite(value) or value < 0):
            raise BadInput(f"The {what} limit on {metric} is {value}; give a number from 0 up in {unit or 'its unit'}.")
    if watch is not None and replace is not None and replace < watch:
        raise BadInput(f"On {metric} the replace limit {replace:g} lies below the watch limit {watch:g}; swap them.")
