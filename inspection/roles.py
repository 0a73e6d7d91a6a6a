"""Which role an address needs: one table, asked for every request.

Rights that are spread over decorators get forgotten on the one view that mattered. Here an address that is not in the
table is refused, so a new page is closed until somebody decides who may see it; a test walks all addresses.
"""

from __future__ import annotations

from typing import Final

from inspection.models import Role

#: Reachable without signing in.
PUBLIC: Final = frozenset({"sign-in", "health"})

#: These check their callers themselves: the API takes a session or a token and answers in JSON.
OWN_AUTHENTICATION: Final = ("api",)

VIEWER, OPERATOR, ENGINEER, ADMIN = Role.VIEWER, Role.OPERATOR, Role.ENGINEER, Role.ADMIN

#: Address name -> the lowest role that may use it, for reading and writing alike.
NEEDED: Final[dict[str, Role]] = {
    "sign-out": VIEWER,
    "own-password": VIEWER,
    "overview": VIEWER,
    "tool-lookup": VIEWER,
    "tool": VIEWER,
    "tool-trend": VIEWER,
    "tool-new": ENGINEER,
    "tool-edit": ENGINEER,
    "tool-event": OPERATOR,
    "tool-type-new": ENGINEER,
    "tool-type-edit": ENGINEER,
    "region-new": ENGINEER,
    "region-edit": ENGINEER,
    "scan-order": OPERATOR,
    "inspection": VIEWER,
    "scan": VIEWER,
    "scan-progress": VIEWER,
    "scan-range": VIEWER,
    "scan-cut": VIEWER,
    "scan-compare": VIEWER,
    "scan-difference": VIEWER,
    "scan-cancel": OPERATOR,
    "scan-pause": OPERATOR,
    "scan-resume": OPERATOR,
    "scan-finish": OPERATOR,
    "scan-again": OPERATOR,
    "scan-continue": OPERATOR,
    "scan-reprocess": ENGINEER,
    "rigs": VIEWER,
    "queue": VIEWER,
    "queue-rows": VIEWER,
    "queue-move": OPERATOR,
    "queue-pause": OPERATOR,
    "queue-resume": OPERATOR,
    "queue-lock": OPERATOR,
    "queue-unlock": OPERATOR,
    "queue-stop": OPERATOR,
    "queue-cart": OPERATOR,
    "again": ENGINEER,
    "again-batch": VIEWER,
    "again-cancel": ENGINEER,
    "again-resume": ENGINEER,
    "calibrations": VIEWER,
    "calibration": VIEWER,
    "calibration-new": ENGINEER,
    "recipes": VIEWER,
    "recipe": VIEWER,
    "limits": VIEWER,
    "limits-history": VIEWER,
    "limits-edit": ENGINEER,
    "schedules": VIEWER,
    "schedule-new": ENGINEER,
    "schedule-edit": ENGINEER,
    "import": OPERATOR,
    "people": ADMIN,
    "person-new": ADMIN,
    "person-edit": ADMIN,
    "report-scans": VIEWER,
    "report-measurements": VIEWER,
    "report-damages": VIEWER,
    "report-tools": VIEWER,
    "report-range": VIEWER,
    "report-inspection": VIEWER,
    "audit": ENGINEER,
    "health-page": VIEWER,
    "help": VIEWER,
}
