"""A cable between a host and a board that loses bytes, spoils bytes and can be pulled."""

from __future__ import annotations

import os
import pty
import random
import select
import threading
import tty


class NoisyCable:
    """Carries bytes between ``board_port`` and its own ``port``; ``loss`` and ``spoiling`` are shares of all bytes."""

    def __init__(self, board_port: str, *, seed: int) -> None:
        self.loss = self.spoiling = 0.0
        self.harmed = 0
        self._rng = random.Random(seed)
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        self.port = os.ttyname(slave)
        self._slave = slave  # kept open: a host that closes its end must not hang us up
        self._board = os.open(board_port, os.O_RDWR | os.O_NOCTTY)
        self._wake, self._stop = os.pipe()
        self._thread = threading.Thread(target=self._carry, name="cable", daemon=True)
        self._thread.start()

    def pull(self) -> None:
        """Nothing passes any more, and the host's port is gone."""
        os.write(self._stop, b".")
        self._thread.join()
        for end in (self._master, self._slave, self._board, self._wake, self._stop):
            os.close(end)

    def _carry(self) -> None:
        other = {self._master: self._board, self._board: self._master}
        while True:
            ready, _, _ = select.select([*other, self._wake], [], [])
            if self._wake in ready:
                return
            for end in ready:
                try:
                    os.write(other[end], self._harm(os.read(end, 4096)))
                except OSError:  # an end is gone for now; what it would have carried is lost
                    continue

    def _harm(self, data: bytes) -> bytes:
        out = bytearray()
        for byte in data:
            fate = self._rng.random()
            if fate < self.loss:
                self.harmed += 1
            elif fate < self.loss + self.spoiling:
                self.harmed += 1
                out.append(self._rng.randrange(256))
            else:
                out.append(byte)
        return bytes(out)
