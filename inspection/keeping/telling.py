"""How far a long command is: one line on a terminal, a line each tenth in a log."""

from __future__ import annotations

import time
from typing import Protocol

#: A terminal needs no more than this, and printing costs.
EVERY_S = 0.2


class Output(Protocol):
    def write(self, msg: str, style_func: None = None, ending: str | None = None) -> None: ...
    def isatty(self) -> bool: ...


class Telling:
    """Call it with (done, of how many, what); writes to ``out``."""

    def __init__(self, out: Output) -> None:
        self._out = out
        self._tty = out.isatty()
        self._at = 0.0
        self._tenth = -1

    def __call__(self, done: int, total: int, what: str) -> None:
        if self._tty:
            if done < total and time.monotonic() - self._at < EVERY_S:
                return
            self._at = time.monotonic()
            self._out.write(f"\r\033[K{done} of {total}  {what[-60:]}", ending="\n" if done >= total else "")
            return
        tenth = 10 * done // max(total, 1)
        if tenth != self._tenth:
            self._tenth = tenth
            self._out.write(f"{done} of {total}  {what}")
