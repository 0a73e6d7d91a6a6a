"""Reading one line of G-code the way GRBL does, down to the last bit of its numbers.

The firmware reads numbers with eight digits and float32 steps; a relative move of 0.00833 mm drifts by a whole motor
step after some 1800 repetitions because of it. A reader that is better than the firmware would hide that from the
driver."""

from __future__ import annotations

import re

import numpy as np


class GcodeError(Exception):
    """GRBL refuses the line: ``error:<code>``."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


def words(line: str) -> list[tuple[str, float]]:
    """Split ``G1X5.2F100`` into words; errors as gcode.c: 1 no letter, 2 no number."""
    found: list[tuple[str, float]] = []
    at = 0
    while at < len(line):
        if not line[at].isalpha():
            raise GcodeError(1)
        match = re.match(r"[-+]?(\d+\.?\d*|\.\d+)", line[at + 1 :])
        if match is None:
            raise GcodeError(2)
        found.append((line[at], read_float(match[0])))
        at += 1 + match.end()
    return found


def read_float(text: str) -> float:
    """GRBL's own number reader (nuts_bolts.c): eight digits, scaled in float32; its last bit decides about drift."""
    sign, digits = (-1.0, text[1:]) if text[0] == "-" else (1.0, text.lstrip("+"))
    whole, _, part = digits.partition(".")
    used = (whole + part)[:8]
    exponent = len(whole) - len(used) if len(whole) > len(used) else -(len(used) - len(whole))
    value = np.float32(int(used or "0"))
    while exponent <= -2:
        value, exponent = np.float32(float(value) * 0.01), exponent + 2
    if exponent == -1:
        value = np.float32(float(value) * 0.1)
    elif exponent > 0:
        value = np.float32(float(value) * 10.0**exponent)
    return sign * float(value)
