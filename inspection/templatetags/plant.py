"""How numbers, times, verdicts and states are written on pages.

A value with more digits than its uncertainty allows claims a precision nobody has, and a verdict shown by colour alone
is invisible to one man in twelve. Both rules live here once, for every page.
"""

from __future__ import annotations

import datetime as dt
import json
import math
from typing import Any, Final

from django import template
from django.forms import BoundField
from django.utils import timezone
from django.utils.formats import date_format
from django.utils.html import format_html
from django.utils.safestring import SafeString, mark_safe

from inspection.models import AuditEvent, Event, Schedule
from inspection.selectors.due import colour as due_colour
from inspection.states import ScanState, Verdict
from inspection.units import unit_sign as pretty_unit
from inspection.units import with_unit_signs

register = template.Library()

#: Line drawings on a 24 x 24 grid.
ICONS: Final[dict[str, str]] = {
    "ok": '<circle cx="12" cy="12" r="9.5"/><path d="m7.5 12.5 3 3 6-6.5"/>',
    "watch": '<path d="M12 3 1.8 20.5h20.4z"/><path d="M12 9.5v5M12 17.4v.2"/>',
    "replace": '<path d="M8 2h8l6 6v8l-6 6H8l-6-6V8z"/><path d="m8.5 8.5 7 7m0-7-7 7"/>',
    "unknown": (
        '<circle cx="12" cy="12" r="9.5" stroke-dasharray="4 3"/>'
        '<path d="M9 9.3a3 3 0 1 1 4.3 2.7c-.9.5-1.3 1-1.3 2M12 17v.2"/>'
    ),
    "queued": '<circle cx="12" cy="12" r="9.5"/><path d="M12 6.5V12l3.5 2.5"/>',
    "running": '<path d="M3 12h4l3-8 4 16 3-8h4"/>',
    "paused": '<path d="M8 4v16M16 4v16"/>',
    "stop": '<rect x="5" y="5" width="14" height="14" rx="1"/>',
    "lock": '<rect x="4.5" y="10.5" width="15" height="10.5" rx="1.5"/><path d="M8 10.5V7a4 4 0 0 1 8 0v3.5"/>',
    "scan": '<path d="M3 7V4h3M18 4h3v3M21 17v3h-3M6 20H3v-3M3 12h18"/>',
    "search": '<circle cx="10.5" cy="10.5" r="6.5"/><path d="m15.5 15.5 6 6"/>',
    "calendar": '<rect x="3" y="5" width="18" height="16" rx="1.5"/><path d="M3 10h18M8 2.5v4M16 2.5v4"/>',
    "up": '<path d="m5 14 7-7 7 7"/>',
    "down": '<path d="m5 10 7 7 7-7"/>',
    "next": '<path d="m5 18 7-7 7 7M5 11l7-7 7 7"/>',
    "cross": '<path d="m5 5 14 14M19 5 5 19"/>',
    "plus": '<path d="M12 4v16M4 12h16"/>',
    "file": '<path d="M6 2.5h8l5 5v14H6zM14 2.5v5h5"/>',
    "tool": '<path d="M3 17 17 3l4 4L7 21H3z"/><path d="m13 7 4 4"/>',
    "person": '<circle cx="12" cy="8" r="4"/><path d="M4 21c.6-5 4-7 8-7s7.4 2 8 7"/>',
    "info": '<circle cx="12" cy="12" r="9.5"/><path d="M12 11v6M12 7.2v.2"/>',
    "moon": '<path d="M20 14.5A8.5 8.5 0 0 1 9.500 4 8.500 8.500 0 1 0 20 14.500z"/>',
    "rig": '<path d="M3 20h18M6 20v-5h12v5M12 15v-3M8 3h8v5l-4 4-4-4z"/>',
}
MARK: Final = (
    '<svg class="icon" viewBox="0 0 24 24" aria-hidden="true"><path d="M2 19 14 3l8 4"/><path d="M2 19h20"/>'
    '<path d="M9 19 20 9" stroke="#ff5a4e"/></svg>'
)

VERDICT_WORDS: Final[dict[str, str]] = {
    Verdict.OK: "OK",
    Verdict.WATCH: "Watch",
    Verdict.REPLACE: "Replace",
    Verdict.UNKNOWN: "Unknown",
}
#: What a person should do about it, in one sentence.
VERDICT_ADVICE: Final[dict[str, str]] = {
    Verdict.OK: "Keep it in service.",
    Verdict.WATCH: "Keep it in service and scan it again soon.",
    Verdict.REPLACE: "Take it out: change or regrind.",
    Verdict.UNKNOWN: "Nobody knows: do not rely on it before a good scan.",
}
STATE_LOOK: Final[dict[str, tuple[str, str, str]]] = {
    ScanState.QUEUED: ("queued", "live", "Waiting"),
    ScanState.RUNNING: ("running", "live", "Scanning"),
    ScanState.PAUSED: ("paused", "live", "Paused"),
    ScanState.PROCESSING: ("running", "live", "Computing"),
    ScanState.DONE: ("ok", "done", "Done"),
    ScanState.FAILED: ("replace", "bad", "Failed"),
    ScanState.CANCELLED: ("stop", "off", "Cancelled"),
    ScanState.INTERRUPTED: ("watch", "bad", "Interrupted"),
}
NOT_MEASURED: Final = mark_safe('<span class="missing">not measured</span>')


@register.simple_tag
def icon(name: str) -> SafeString:
    drawing = mark_safe(ICONS[name])  # our own constant
    return format_html('<svg class="icon" viewBox="0 0 24 24" aria-hidden="true">{}</svg>', drawing)


@register.simple_tag
def brand_mark() -> SafeString:
    return mark_safe(MARK)  # our own constant


@register.simple_tag
def verdict(value: str | None) -> SafeString:
    """A verdict as word + icon + colour; nothing scanned yet is unknown and says so."""
    if not value:
        return format_html('<span class="verdict unknown">{} Not scanned</span>', icon("unknown"))
    return format_html('<span class="verdict {}">{} {}</span>', value, icon(value), VERDICT_WORDS[value])


@register.filter
def verdict_word(value: str | None) -> str:
    return VERDICT_WORDS[value] if value else "Not scanned yet"


@register.filter
def verdict_advice(value: str | None) -> str:
    return VERDICT_ADVICE[value] if value else "Put it on a rig and scan it."


@register.simple_tag
def scan_state(state: str) -> SafeString:
    name, tone, word = STATE_LOOK[state]
    return format_html('<span class="state {}">{} {}</span>', tone, icon(name), word)


@register.filter
def event_word(kind: str) -> str:
    return str(Event.Kind(kind).label)


def is_number(value: Any) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def significant(value: float, digits: int) -> str:
    """``value`` with so many significant digits and no exponent: 0.00123, 12.3, 1230."""
    if value == 0:
        return "0"
    decimals = digits - 1 - math.floor(math.log10(abs(value)))
    return _written(value, decimals)


def _written(value: float, decimals: int) -> str:
    """Rounded, and never a minus before nothing but zeros."""
    return f"{round(value, decimals) + 0.0:.{max(decimals, 0)}f}"


def trimmed(text: str) -> str:
    """Without the zeros that say nothing: 64.00 -> 64."""
    return text.rstrip("0").rstrip(".") if "." in text else text


def with_uncertainty(value: float | None, u: float | None) -> tuple[str, str]:
    """Value and expanded uncertainty U = 2 u as texts, both cut at U's second significant digit (GUM 7.2.6).

    >>> with_uncertainty(123.456, 1.7)
    ('123.5', '3.4')
    """
    if not is_number(value):
        return "", ""
    assert value is not None
    if u is None or not is_number(u) or u <= 0:
        return trimmed(significant(value, 4)), ""
    expanded = 2 * u
    decimals = 1 - math.floor(math.log10(expanded))
    return _written(value, decimals), _written(expanded, decimals)


@register.simple_tag
def quantity(value: float | None, u: float | None = None, unit: str = "") -> SafeString:
    """``12.3 ± 0.4 µm``, where ± is the expanded uncertainty U with k = 2; NaN and None are "not measured"."""
    text, expanded = with_uncertainty(value, u)
    if not text:
        return NOT_MEASURED
    if expanded:
        return format_html('{} <span class="pm">± {} {}</span>', text, expanded, pretty_unit(unit))
    return format_html('{} <span class="unit">{}</span>', text, pretty_unit(unit))


register.filter("pretty_unit", pretty_unit)
register.filter("with_units", with_unit_signs)


@register.filter
def figure(value: Any, digits: int = 3) -> str | SafeString:
    """A plain number with at most so many significant digits."""
    return trimmed(significant(float(value), digits)) if is_number(value) else NOT_MEASURED


@register.filter
def fixed(value: Any, decimals: int = 1) -> str | SafeString:
    return f"{value:.{decimals}f}" if is_number(value) else NOT_MEASURED


@register.filter
def percent(share: Any) -> str | SafeString:
    """A share as percent, with more digits where it is small."""
    if not is_number(share):
        return NOT_MEASURED
    value = 100 * share
    if 0 < value < 0.01:
        return "below 0.01 %"
    return f"{value:.0f} %" if value >= 10 else f"{value:.2f} %" if 0 < value < 1 else f"{value:.1f} %"


@register.filter
def times(value: Any, factor: float) -> float | None:
    return value * float(factor) if is_number(value) else None


@register.filter
def item(mapping: Any, key: Any) -> Any:
    return mapping.get(key) if mapping else None


@register.filter
def duration(seconds: Any) -> str:
    """``42 s``, ``3 min 10 s``, ``2 h 05 min``."""
    if isinstance(seconds, dt.timedelta):
        seconds = seconds.total_seconds()
    if not is_number(seconds):
        return "unknown"
    whole = max(0, round(seconds))
    if whole < 90:
        return f"{whole} s"
    if whole < 3600:
        minutes, rest = divmod(whole, 60)
        return f"{minutes} min {rest:02d} s" if minutes < 10 else f"{round(whole / 60)} min"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def ago_words(moment: dt.datetime, now: dt.datetime) -> str:
    seconds = (now - moment).total_seconds()
    future = seconds < 0
    seconds = abs(seconds)
    if seconds < 45:
        return "now" if not future else "in a moment"
    for limit, size, unit in ((3600, 60, "min"), (86400, 3600, "h"), (60 * 86400, 86400, "day")):
        if seconds < limit:
            count = round(seconds / size)
            words = f"{count} {unit}{'s' if unit == 'day' and count != 1 else ''}"
            return f"in {words}" if future else f"{words} ago"
    return date_format(timezone.localtime(moment), "j M Y")


@register.simple_tag
def ago(moment: dt.datetime | None) -> SafeString:
    """``3 min ago`` with the exact local time in its title; app.js keeps it true while the page stays open."""
    if moment is None:
        return mark_safe('<span class="missing">never</span>')
    local = timezone.localtime(moment)
    return format_html(
        '<time datetime="{}" title="{}" data-ago>{}</time>',
        local.isoformat(timespec="seconds"),
        date_format(local, "l j F Y H:i:s"),
        ago_words(moment, timezone.now()),
    )


@register.simple_tag
def exact(moment: dt.datetime | None) -> SafeString:
    if moment is None:
        return mark_safe('<span class="missing">never</span>')
    local = timezone.localtime(moment)
    return format_html('<time datetime="{}">{}</time>', local.isoformat(), date_format(local, "j M Y H:i"))


@register.filter
def day(value: dt.date | None) -> str:
    return date_format(value, "D j M Y") if value else "no date"


@register.filter
def day_words(value: dt.date | None) -> str:
    """``today``, ``tomorrow``, ``in 5 days``, ``3 days overdue``."""
    if value is None:
        return "not scheduled"
    days = (value - timezone.localdate()).days
    near = {0: "today", 1: "tomorrow", -1: "1 day overdue"}.get(days)
    return near or (f"in {days} days" if days > 0 else f"{-days} days overdue")


@register.inclusion_tag("_partials/field.html")
def field(bound: BoundField, unit: str = "") -> dict[str, Any]:
    """A form field with its label, help, unit and, below it, what is wrong."""
    return {"field": bound, "unit": unit, "tick": bound.widget_type == "checkbox"}


@register.filter
def may(user: Any, role: str) -> bool:
    """True if this person holds the role: ``{% if user|may:"operator" %}``."""
    return bool(user.is_authenticated and user.at_least(role))


@register.filter
def due_tone(schedule: Schedule) -> str:
    return due_colour(schedule, timezone.localdate())


@register.filter
def add_mm(start: float, length: float) -> str:
    return trimmed(significant(start + length, 4))


@register.filter
def pretty_json(value: Any) -> str:
    return json.dumps(value, indent=2, ensure_ascii=False, default=str)


@register.filter
def unlocalized(value: float) -> str:
    """A number for scripts, whatever the language of the page."""
    return repr(float(value))


@register.filter
def operations(definition: dict[str, Any]) -> str:
    """The steps of a recipe in their order: ``SCI block of 5, HDRE, GLT, MSNN, COG``."""
    steps = []
    for operation in definition.get("operations", []):
        word = str(operation.get("operation") or operation.get("op") or "?").upper()
        if "window" in operation and "mode" in operation:
            word += f" {operation['mode']} of {operation['window']}"
        steps.append(word)
    return ", then ".join(steps)


@register.filter
def changes(event: AuditEvent) -> list[tuple[str, str]]:
    """(name, "before → after") of everything an audit line holds; one side alone when the other is not recorded."""
    before, after = event.before or {}, event.after or {}
    lines = []
    for key in dict.fromkeys([*before, *after]):
        sides = [_said(side[key]) for side in (before, after) if key in side]
        lines.append((key, " → ".join(sides) if key in after else f"was {sides[0]}"))
    return lines


def _said(value: Any) -> str:
    return (
        ", ".join(_said(part) for part in value) if isinstance(value, list) else "none" if value is None else str(value)
    )


@register.filter
def rule(schedule: Schedule) -> str:
    """``every week``, ``every 2 months``."""
    return (
        f"every {schedule.unit.removesuffix('s')}" if schedule.every == 1 else f"every {schedule.every} {schedule.unit}"
    )


@register.filter
def listed(values: list[float] | None) -> str:
    """``100, 300, 900``."""
    return ", ".join(f"{value:g}" for value in values or []) or "none given"
