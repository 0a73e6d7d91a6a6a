"""The controller's ``$`` settings and the firmware's rules about them.

The driver compares what it reads with what the rig needs, and writes what differs; a store that took everything would
let it write what a real controller refuses.
"""

from __future__ import annotations

from scanning.rig.simulated.gcode import GcodeError, read_float

#: What a fresh rig's controller holds: 0.49 um steps, 120 mm of screw, homing to the negative end, motor always on.
DEFAULT_SETTINGS: dict[int, float] = {
    0: 10, 1: 255, 2: 0, 3: 0, 4: 0, 5: 0, 6: 0, 10: 3, 11: 0.010, 12: 0.002, 13: 0,
    20: 1, 21: 1, 22: 1, 23: 1, 24: 30.0, 25: 600.0, 26: 25, 27: 1.0, 30: 1000, 31: 0, 32: 0,
    100: 2040.8163, 101: 250.0, 102: 250.0, 110: 720.0, 111: 500.0, 112: 500.0,
    120: 200.0, 121: 10.0, 122: 10.0, 130: 120.0, 131: 200.0, 132: 200.0,
}  # fmt: skip
_WHOLE_NUMBERS = frozenset((0, 1, 2, 3, 4, 5, 6, 10, 13, 20, 21, 22, 23, 26, 30, 31, 32))

Settings = dict[int, float]


def store(settings: Settings, number: int, text: str) -> None:
    """``$number=text``. Raises `GcodeError` as settings.c does."""
    if not any(c.isdigit() for c in text):
        raise GcodeError(2)
    value = read_float(text)
    if number not in settings:
        raise GcodeError(3)
    if value < 0 or (value == 0 and number >= 100):  # the firmware would divide by this zero
        raise GcodeError(4)
    if number == 0 and value < 3:
        raise GcodeError(6)
    if number == 20 and value and not settings[22]:
        raise GcodeError(10)
    settings[number] = int(value) if number in _WHOLE_NUMBERS else value
    if number == 22 and not value:
        settings[20] = 0


def listing(settings: Settings) -> list[str]:
    """The lines of ``$$``."""
    return [
        f"${number}={int(value)}" if number in _WHOLE_NUMBERS else f"${number}={value:.3f}"
        for number, value in sorted(settings.items())
    ]
