"""Units as people write them. Records hold plain letters (um, mm3), so that no file or query depends on a sign."""

from __future__ import annotations

import re

SIGNS = {"um": "µm", "um2": "µm²", "um3": "µm³", "mm2": "mm²", "mm3": "mm³", "deg": "°", "1": ""}


def unit_sign(unit: str) -> str:
    """``um`` as µm, ``mm3`` as mm³, ``1`` as nothing."""
    return SIGNS.get(unit, unit)


def with_unit_signs(sentence: str) -> str:
    """A sentence of the measuring side with its units as people write them: ``50 um`` as 50 µm."""
    return re.sub(r"(?<=[\d ])(um|mm)([23]?)\b", lambda found: unit_sign(found[0]), sentence)
