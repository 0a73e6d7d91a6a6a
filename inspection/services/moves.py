"""Changing a scan's state: one compare-and-set, in one place.

Two workers, a person and the sweep may all want to move the same scan at the same moment. Whoever's UPDATE matches the
old state wins; the others are told, and nobody's result is overwritten.
"""

from __future__ import annotations

from typing import Any
from uuid import UUID

from inspection.models import Scan
from inspection.states import MOVES
from scanning.errors import BadInput


class WrongState(BadInput):
    """What was asked does not fit the state the scan or queue is in. ``state`` is that state (the API answers 409)."""

    def __init__(self, sentence: str, state: str) -> None:
        super().__init__(sentence)
        self.state = state


def move(scan_id: int, *, frm: str, to: str, token: UUID | None = None, **fields: Any) -> bool:
    """Return True if this call made the move, False if somebody else was first.

    With ``token`` the move is made only while the lease is still that worker's. ``fields`` change in the same UPDATE.
    """
    assert to in MOVES[frm], (frm, to)
    scans = Scan.objects.filter(pk=scan_id, state=frm)
    if token is not None:
        scans = scans.filter(lease_token=token)
    return scans.update(state=to, **fields) == 1
