"""What one line of G-code asks for, and whether GRBL takes it: the rules of gcode.c, before anything moves.

The firmware judges a whole line first and does it only when every word in it fits; a line that is half done when its
error is found would leave the stage where the driver does not expect it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from scanning.rig.simulated.gcode import GcodeError, words

DWELL, SET_OFFSET, SHIFT_ORIGIN, UNSHIFT_ORIGIN = 40, 100, 920, 921  # G4, G10, G92, G92.1 in tenths


@dataclass
class Modal:
    """What stays in force from line to line."""

    motion: int = 0
    absolute: bool = True
    inches: bool = False
    spindle: int = 5
    feed_mm_min: float = 0.0
    spindle_speed: float = 0.0


@dataclass
class Statement:
    """One line that may be done. ``axes`` are axis number -> word, in the units of ``scale``."""

    modal: Modal
    axes: dict[int, float] = field(default_factory=dict)
    values: dict[str, float] = field(default_factory=dict)
    nonmodal: int | None = None
    machine: bool = False
    """G53: the axis words are machine positions."""
    groups: set[str] = field(default_factory=set)

    @property
    def scale(self) -> np.float32:
        return np.float32(25.4) if self.modal.inches else np.float32(1.0)

    @property
    def moves(self) -> bool:
        return bool(self.axes) and self.nonmodal is None


def read_statement(line: str, modal: Modal, *, jog: bool = False) -> Statement:
    """Judge ``line`` against what is in force. Raises `GcodeError` with the firmware's own number."""
    s = Statement(replace(modal))
    for letter, value in words(line):
        if letter == "G":
            _take_g(s, round(value * 10))
        elif letter == "M":
            _take_m(s, value)
        elif letter in "XYZ":
            if "XYZ".index(letter) in s.axes:
                raise GcodeError(25)
            s.axes["XYZ".index(letter)] = value
        elif letter in "FSPLNT":
            if letter in s.values:
                raise GcodeError(25)
            if value < 0:
                raise GcodeError(4)
            s.values[letter] = value
        else:
            raise GcodeError(20)
    if jog:
        _judge_jog(s)
    else:
        _judge(s)
    return s


def _group(s: Statement, name: str) -> None:
    if name in s.groups:
        raise GcodeError(21)
    s.groups.add(name)


def _take_g(s: Statement, code: int) -> None:
    if code in (0, 10):
        _group(s, "motion")
        s.groups.add("motion word")
        s.modal.motion = code // 10
    elif code == 800:
        _group(s, "motion")
        s.modal.motion = 80
    elif code in (DWELL, SET_OFFSET, SHIFT_ORIGIN, UNSHIFT_ORIGIN):
        _group(s, "nonmodal")
        s.nonmodal = code
    elif code == 530:
        _group(s, "nonmodal")
        s.machine = True
    elif code in (200, 210):
        _group(s, "units")
        s.modal.inches = code == 200
    elif code in (900, 910):
        _group(s, "distance")
        s.modal.absolute = code == 900
    elif code in (170, 400, 490, 540, 610, 940, 911):
        _group(s, f"g{code}")
    else:
        raise GcodeError(20)


def _take_m(s: Statement, value: float) -> None:
    code = round(value)
    if value != code:
        raise GcodeError(23)
    if code in (3, 4, 5):
        _group(s, "spindle")
        s.modal.spindle = code
    elif code in (0, 1, 2, 7, 8, 9, 30):
        _group(s, "program")
    else:
        raise GcodeError(20)


def _judge_jog(s: Statement) -> None:
    if s.groups - {"units", "distance", "nonmodal"} or s.nonmodal is not None or not s.axes:
        raise GcodeError(16)
    if "F" not in s.values:
        raise GcodeError(22)


def _judge(s: Statement) -> None:
    values, nonmodal = s.values, s.nonmodal
    if "motion word" in s.groups and s.axes and nonmodal is not None:
        raise GcodeError(24)
    if nonmodal in (SET_OFFSET, SHIFT_ORIGIN) and not s.axes:
        raise GcodeError(26)
    if nonmodal == DWELL and "P" not in values:
        raise GcodeError(28)
    if nonmodal == SET_OFFSET and (values.get("L") not in (2, 20) or values.get("P") not in (0, 1)):
        raise GcodeError(20 if "L" in values else 28)
    if s.moves and s.modal.motion == 80:
        raise GcodeError(31)
    if "P" in values and nonmodal not in (DWELL, SET_OFFSET):
        raise GcodeError(36)
    if "F" in values:
        s.modal.feed_mm_min = values["F"] * float(s.scale)
    if s.moves and s.modal.motion == 1 and s.modal.feed_mm_min <= 0:
        raise GcodeError(22)
    if "S" in values:
        s.modal.spindle_speed = values["S"]
