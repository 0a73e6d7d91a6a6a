"""Opens an HDF5 file whose writer is at work or died, without the library's patience.

Such a file is marked in its head (the superblock) as being written, and the library then reads it only as a
single-writer reader, which repeats every failed read a hundred times with growing pauses: one flipped byte in a part
left by a crash kept a process waiting for over ten minutes. So the head is shown to the library as it would be after a
clean close (mark taken off, length as it is, checksum to match); damage is then refused at once, and nothing on disk is
touched.

Source: HDF5 File Format Specification 3.0, superblock version 3; checksum: Bob Jenkins, lookup3, hashlittle.
"""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import TYPE_CHECKING

import h5py

if TYPE_CHECKING:
    from typing_extensions import Buffer

SIGNATURE = b"\x89HDF\r\n\x1a\n"
LENGTH = 48
_VERSION, _FLAGS, _END, _CHECKSUM = 8, 11, 28, 44
_MASK = 0xFFFFFFFF


def open_hdf5(path: Path) -> h5py.File:
    """Open for reading. Raises OSError for a file that is cut off or whose head is damaged."""
    with path.open("rb") as file:
        head = bytearray(file.read(LENGTH))
    if len(head) < LENGTH or not head.startswith(SIGNATURE) or head[_VERSION] != 3:
        return h5py.File(path, "r")
    (checksum,) = struct.unpack_from("<I", head, _CHECKSUM)
    if checksum != lookup3(bytes(head[:_CHECKSUM])):
        raise OSError("its head fails its checksum")
    (end,) = struct.unpack_from("<Q", head, _END)
    size = path.stat().st_size
    if size < end:
        raise OSError(f"it is cut off: {size} of {end} bytes")
    if not head[_FLAGS]:
        return h5py.File(path, "r")
    head[_FLAGS] = 0
    struct.pack_into("<Q", head, _END, size)
    struct.pack_into("<I", head, _CHECKSUM, lookup3(bytes(head[:_CHECKSUM])))
    return h5py.File(_WithHead(path, bytes(head)), "r")


class _WithHead(io.FileIO):
    """A file whose first bytes read differently from what is on disk."""

    def __init__(self, path: Path, head: bytes) -> None:
        super().__init__(path, "r")
        self._head = head

    def readinto(self, buffer: Buffer) -> int:
        start = self.tell()
        count = super().readinto(buffer)
        if start < len(self._head):
            shown = self._head[start : start + count]
            memoryview(buffer).cast("B")[: len(shown)] = shown
        return count


def lookup3(data: bytes) -> int:
    """Bob Jenkins' hashlittle with initial value 0, which HDF5 uses for all its metadata."""

    x: int
    y: int
    z: int

    def rotated(value: int, bits: int) -> int:
        return ((value << bits) | (value >> (32 - bits))) & _MASK

    a = b = c = (0xDEADBEEF + len(data)) & _MASK
    blocks = max(0, (len(data) - 1) // 12)
    for block in range(blocks):
        x, y, z = struct.unpack_from("<3I", data, 12 * block)
        a, b, c = (a + x) & _MASK, (b + y) & _MASK, (c + z) & _MASK
        a, c = ((a - c) & _MASK) ^ rotated(c, 4), (c + b) & _MASK
        b, a = ((b - a) & _MASK) ^ rotated(a, 6), (a + c) & _MASK
        c, b = ((c - b) & _MASK) ^ rotated(b, 8), (b + a) & _MASK
        a, c = ((a - c) & _MASK) ^ rotated(c, 16), (c + b) & _MASK
        b, a = ((b - a) & _MASK) ^ rotated(a, 19), (a + c) & _MASK
        c, b = ((c - b) & _MASK) ^ rotated(b, 4), (b + a) & _MASK
    rest = data[12 * blocks :]
    if not rest:
        return c
    x, y, z = struct.unpack("<3I", rest.ljust(12, b"\0"))
    a, b, c = (a + x) & _MASK, (b + y) & _MASK, (c + z) & _MASK
    c = ((c ^ b) - rotated(b, 14)) & _MASK
    a = ((a ^ c) - rotated(c, 11)) & _MASK
    b = ((b ^ a) - rotated(a, 25)) & _MASK
    c = ((c ^ b) - rotated(b, 16)) & _MASK
    a = ((a ^ c) - rotated(c, 4)) & _MASK
    b = ((b ^ a) - rotated(a, 14)) & _MASK
    return ((c ^ b) - rotated(b, 24)) & _MASK
