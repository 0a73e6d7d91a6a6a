"""The serial line at the controller: every byte takes its time on the wire, and some get lost.

Without the time a byte takes, a protocol that waits for every answer would look as fast as one that does not, and the
receive buffer could never overflow.
"""

from __future__ import annotations

from collections import deque


class Uart:
    """Two wires at ``baud``. Times are machine seconds; the caller says what time it is."""

    def __init__(self, baud: int) -> None:
        self._byte_s = 10.0 / baud
        self._in: deque[tuple[float, int]] = deque()
        self._out: deque[tuple[float, int]] = deque()
        self._in_free = self._out_free = 0.0
        self.drop_in = 0
        """So many of the next bytes from the host are lost."""
        self.drop_out = 0
        """So many of the next bytes towards the host are lost."""

    def from_host(self, data: bytes, now: float) -> None:
        """The host begins to send ``data`` at ``now``."""
        for byte in data:
            if self.drop_in > 0:
                self.drop_in -= 1
                continue
            self._in_free = max(self._in_free, now) + self._byte_s
            self._in.append((self._in_free, byte))

    def to_host(self, data: bytes, now: float) -> None:
        """The controller begins to send ``data`` at ``now``, behind what it is sending already."""
        for byte in data:
            self._out_free = max(self._out_free, now) + self._byte_s
            if self.drop_out > 0:
                self.drop_out -= 1
            else:
                self._out.append((self._out_free, byte))

    def next_byte_in(self) -> float | None:
        """When the next byte from the host will have arrived."""
        return self._in[0][0] if self._in else None

    def take(self, now: float) -> int | None:
        """The next byte that has arrived by ``now``."""
        return self._in.popleft()[1] if self._in and self._in[0][0] <= now else None

    def sent(self, now: float) -> bytes:
        """Bytes whose last bit has reached the host by ``now``."""
        out = bytearray()
        while self._out and self._out[0][0] <= now:
            out.append(self._out.popleft()[1])
        return bytes(out)

    def line_ready(self) -> float | None:
        """When the next whole line will have left: handing lines over whole spares a wake-up per byte."""
        for due, byte in self._out:
            if byte == 10:
                return due
        return self._out[-1][0] if self._out else None

    def forget_in(self) -> None:
        self._in.clear()

    def forget_out(self) -> None:
        self._out.clear()

    def cut_short(self, now: float) -> None:
        """The send buffer is emptied by a reset; the byte on the wire is not called back."""
        while len(self._out) > 1:
            self._out.pop()
        self._out_free = self._out[-1][0] if self._out else now
