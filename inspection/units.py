"""Units as people write them. Records hold plain letters (um, mm3), so that no file or query depends on a sign."""

from __future__ import annotations

SIGNS = {"um": "µm", "mm2": "mm²", "mm3": "mm³", "um2": "µm²", "1": ""}


def unit_sign(unit: str) -> str:
    """``um`` as µm, ``mm3`` as mm³, ``1`` as nothing."""
    return SIGNS.get(unit, unit)
