"""What the controller says of itself: status, modal state and offsets, field by field as in report.c.

The rhythm matters as much as the words: the offset comes only with every tenth or thirtieth report, and a driver that
expects it each time would work with a simulation that sends it each time and with nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanning.rig.simulated.statement import Modal

Float3 = np.ndarray  # float32 (3,), as in screw.py


@dataclass(frozen=True)
class Seen:
    """What one status report tells. Positions are (3,) float32 mm, the speed is mm/s."""

    state: str
    busy: bool
    machine_mm: Float3
    offset_mm: Float3
    speed_mm_s: float
    spindle: int
    spindle_rpm: float
    on_switch: bool
    free_blocks: int
    free_bytes: int


class Reporter:
    """Keeps the rhythm of the fields that do not come every time."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        self._offset_in = self._overrides_in = 0

    def status(self, seen: Seen, mask: int) -> str:
        """The answer to ``?``; ``mask`` is setting $10."""
        place = f"MPos:{triple(seen.machine_mm)}" if mask & 1 else f"WPos:{triple(seen.machine_mm - seen.offset_mm)}"
        fields = [seen.state, place]
        if mask & 2:
            fields.append(f"Bf:{seen.free_blocks},{seen.free_bytes}")
        rpm = seen.spindle_rpm if seen.spindle != 5 else 0.0
        fields.append(f"FS:{seen.speed_mm_s * 60:.0f},{rpm:.0f}")
        if seen.on_switch:
            fields.append("Pn:X")
        if self._offset_in > 0:
            self._offset_in -= 1
        else:
            self._offset_in = 29 if seen.busy else 9
            self._overrides_in = self._overrides_in or 1
            fields.append(f"WCO:{triple(seen.offset_mm)}")
        if self._overrides_in > 0:
            self._overrides_in -= 1
        else:
            self._overrides_in = 19 if seen.busy else 9
            fields.append("Ov:100,100,100")
            if seen.spindle != 5:
                fields.append("A:S" if seen.spindle == 3 else "A:C")
        return "<" + "|".join(fields) + ">"


def modal_state(m: Modal) -> str:
    """The answer to ``$G``."""
    return (
        f"[GC:G{m.motion} G54 G17 G{20 if m.inches else 21} G{90 if m.absolute else 91} G94 "
        f"M{m.spindle} M9 T0 F{m.feed_mm_min:.0f} S{m.spindle_speed:.0f}]"
    )


def offsets(g54: Float3, g92: Float3) -> list[str]:
    """The answer to ``$#``."""
    zero = triple(np.zeros(3, np.float32))
    systems = [
        f"[{name}:{triple(g54) if name == 'G54' else zero}]"
        for name in ("G54", "G55", "G56", "G57", "G58", "G59", "G28", "G30")
    ]
    return [*systems, f"[G92:{triple(g92)}]", "[TLO:0.000]", f"[PRB:{zero}:0]"]


def triple(mm: Float3) -> str:
    return ",".join(f"{float(v):.3f}" for v in mm)
