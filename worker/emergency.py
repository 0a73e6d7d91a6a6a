"""Looks for the emergency stop while a scan drives the rig, outside the scan's own loop.

The loop asks once a step, and a step can take a second or hang in a camera. This thread asks forty times a second and
acts by itself: the controller gets hold and reset in one write, whatever the loop is doing. The loop then finds its
stage halted and ends.
"""

from __future__ import annotations

import logging
import threading

from django.db import DatabaseError, connection

from inspection.models import Scan
from scanning.rig.protocols import Stage
from worker.lease import Lease, drop_connection

log = logging.getLogger(__name__)

#: With the click's own way through the web server and the write to the controller, 100 ms are kept (measured).
LOOK_EVERY_S = 0.025


class EmergencyStopped(Exception):
    """A person pressed the emergency stop."""


class StopLine:
    """``with StopLine(lease, stage) as line:`` stops the stage when asked; ``line.pressed`` says that it was."""

    def __init__(self, lease: Lease, stage: Stage) -> None:
        self._lease = lease
        self._stage = stage
        self._enough = threading.Event()
        self._pressed = threading.Event()
        self._thread = threading.Thread(target=self._look, name=f"stop of scan {lease.scan_id}", daemon=True)

    @property
    def pressed(self) -> bool:
        return self._pressed.is_set()

    def __enter__(self) -> StopLine:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._enough.set()
        self._thread.join()

    def _look(self) -> None:
        try:
            while not self._enough.wait(LOOK_EVERY_S):
                try:
                    asked = Scan.objects.filter(pk=self._lease.scan_id, stop_requested_at__isnull=False).exists()
                except DatabaseError as error:
                    log.warning("The emergency stop of scan %s cannot be asked for: %s", self._lease.scan_id, error)
                    drop_connection()
                    continue
                if asked:
                    self._pressed.set()
                    log.error("Emergency stop of scan %s.", self._lease.scan_id)
                    self._stage.emergency_stop()
                    return
        finally:
            connection.close()
