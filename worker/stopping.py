"""Tells the process that drives the rig that its worker is going down.

Celery runs tasks in a child process. When the parent is asked to stop, the child would finish its scan first, which
can take half an hour. It is noticed here at the next step, and the scan ends with the laser off and the stage parked.
A parent that is killed takes its child along on Linux (Celery asks the kernel for that); elsewhere the child would go
on alone, with nobody to stop it, so that is noticed too.
"""

from __future__ import annotations

import mmap
import os

#: One byte shared with the children, which are forked after this module is loaded. A lock could die with its owner.
_flag = mmap.mmap(-1, 1)


def ask_to_stop() -> None:
    """Called in the worker's parent process on shutdown."""
    _flag[0] = 1


def forget() -> None:
    """Called when a worker starts, and by tests."""
    _flag[0] = 0


class Watch:
    """Made at the beginning of a task in the child: remembers whose child it was."""

    def __init__(self) -> None:
        self._parent = os.getppid()

    def reason(self) -> str:
        """Why the work must stop now; empty while it need not."""
        if _flag[0]:
            return "the worker was stopped"
        if os.getppid() != self._parent:
            return "the worker's main process died"
        return ""
