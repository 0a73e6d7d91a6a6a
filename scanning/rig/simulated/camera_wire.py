"""How a simulated camera and its host talk over a unix socket: a JSON header, then raw pixels.

Each message is a 4-byte big-endian length, that many bytes of JSON, and ``header["bytes"]`` bytes of payload. Both
ends share this file so that neither can drift from the other.
"""

from __future__ import annotations

import json
import os
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

Header = dict[str, Any]

#: Longest header accepted; a length beyond it means the stream is out of step.
MAX_HEADER_BYTES = 65_536


class WireClosed(Exception):
    """The other end hung up, or what came was no message."""


#: Longest socket path handed to the kernel as it is; it takes 107 bytes.
MAX_PATH_BYTES = 100


@contextmanager
def socket_path(path: Path) -> Iterator[str]:
    """A name for ``path`` that a unix socket accepts, however deep the directory lies (on Linux)."""
    if len(os.fsencode(path)) <= MAX_PATH_BYTES:
        yield str(path)
        return
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        yield f"/proc/self/fd/{folder}/{path.name}"
    finally:
        os.close(folder)


def send_message(link: socket.socket, header: Header, payload: bytes | memoryview = b"") -> None:
    text = json.dumps(header).encode()
    link.sendall(struct.pack(">I", len(text)) + text)
    if len(payload):
        link.sendall(payload)


def receive_message(link: socket.socket, deadline: float | None = None) -> tuple[Header, bytes]:
    """Return (header, payload). Raises `TimeoutError` at ``deadline`` (monotonic seconds), `WireClosed` at the end."""
    (length,) = struct.unpack(">I", _exactly(link, 4, deadline))
    if length > MAX_HEADER_BYTES:
        raise WireClosed("no message")
    try:
        header = json.loads(_exactly(link, length, deadline))
        size = int(header.get("bytes", 0))
    except (ValueError, AttributeError) as fault:
        raise WireClosed("no message") from fault
    return header, _exactly(link, size, deadline)


def _exactly(link: socket.socket, count: int, deadline: float | None) -> bytes:
    data = bytearray(count)
    view, filled = memoryview(data), 0
    while filled < count:
        if deadline is not None:
            left = deadline - time.monotonic()
            if left <= 0:
                raise TimeoutError
            link.settimeout(left)
        got = link.recv_into(view[filled:])
        if got == 0:
            raise WireClosed("hung up")
        filled += got
    return bytes(data)
