"""Progress on stderr, and only where somebody watches: a log file does not want 1205 lines."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

_REDRAW_S = 0.1


def shown(what: str) -> Callable[[int, int], None] | None:
    """A callback for (done, in all) that redraws one line on a terminal; None when stderr is not one."""
    if not sys.stderr.isatty():
        return None
    drawn = -_REDRAW_S

    def show(done: int, total: int) -> None:
        nonlocal drawn
        now = time.monotonic()
        if done < total and now - drawn < _REDRAW_S:
            return
        drawn = now
        end = "\n" if done >= total else ""
        sys.stderr.write(f"\r{what}: {done} of {total}{end}")
        sys.stderr.flush()

    return show
