"""Frame numbers that only go up, from device counters that wrap and start again.

The acquisition loop tells a stuck camera by a frame number that does not rise. Device counters are no such numbers as
they come: GigE Vision's has 16 bits and skips 0, and every counter starts again with each acquisition. Taken as they
are, frame 65536 of a long scan would end it.
"""

from __future__ import annotations


class FrameNumbers:
    """Turns each device's ``frame id`` into a number that rises unless the device sends the same frame twice."""

    def __init__(self) -> None:
        self._number = 0
        self._device: int | None = None

    def restart(self) -> None:
        """The device's counter begins anew: the next frame is a new one whatever its id."""
        self._device = None

    def number(self, device_id: int) -> int:
        if device_id == self._device:
            return self._number
        # Frames that were lost on the way count; a counter that went back has wrapped.
        lost = device_id - self._device if self._device is not None and device_id > self._device else 1
        self._device = device_id
        self._number += lost
        return self._number
