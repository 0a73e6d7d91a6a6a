"""A cart of tools in one order: the codes as the scanner read them, in the order they lie on the cart."""

from __future__ import annotations

from collections.abc import Sequence

from django.db import transaction

from inspection.models import Inspection, Rig, Tool, User
from inspection.services.queue import enqueue_inspection
from scanning.errors import BadInput

#: More than a cart can carry is a file dropped into the wrong field.
MOST_TOOLS = 200


def order_cart(*, codes: Sequence[str], rig: Rig, by: User | None, reason: str = "") -> list[Inspection]:
    """Queue all regions of every tool, one tool after the other as the codes stand. All tools, or none.

    Raises `BadInput` for a code that no tool has, one that is given twice, or a tool that cannot be scanned.
    """
    wanted = [code.strip() for code in codes if code.strip()]
    if not wanted:
        raise BadInput("No code was given; scan the label of each tool on the cart, one a line.")
    if len(wanted) > MOST_TOOLS:
        raise BadInput(f"{len(wanted)} codes were given; a cart has {MOST_TOOLS} tools at most.")
    if double := next((code for code in wanted if wanted.count(code) > 1), None):
        raise BadInput(f"Tool {double} is on the list twice; a tool is scanned once a cart.")
    tools = {tool.code: tool for tool in Tool.objects.filter(code__in=wanted).select_related("tool_type")}
    if unknown := [code for code in wanted if code not in tools]:
        raise BadInput(f"No tool has the code {unknown[0]}; check its label, or add the tool. Nothing was queued.")
    with transaction.atomic():
        return [enqueue_inspection(tool=tools[code], rig=rig, by=by, reason=reason) for code in wanted]
