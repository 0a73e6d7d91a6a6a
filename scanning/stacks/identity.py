"""The identity of a stack: one hash over its header and its pixels, whichever way it is stored.

A stored number refers to its raw stack by this hash, so it must not change when a folder is imported into HDF5, when a
file is compressed again, or when a number in stack.json is written 8.330 instead of 8.33.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence

import numpy as np

from scanning.frames import StackHeader
from scanning.rig.protocols import Image
from scanning.stacks.description import header_to_json


class Identity:
    """Hashes frames as they come. The header joins last, because a scan's number of steps is known only at its end.

    sha256 over the header as canonical JSON (sorted keys, no blanks) followed by the sha256 digest of all pixels:
    step by step, shortest exposure first, row by row, 16-bit pixels little endian.
    """

    def __init__(self) -> None:
        self._pixels = hashlib.sha256()

    def add(self, images: Sequence[Image]) -> None:
        for image in images:
            plain = np.ascontiguousarray(image)
            if plain.dtype.itemsize > 1:
                plain = plain.astype(plain.dtype.newbyteorder("<"), copy=False)
            self._pixels.update(plain.data)

    def sha256(self, header: StackHeader) -> str:
        told = json.dumps(header_to_json(header), sort_keys=True, separators=(",", ":"), allow_nan=False)
        return hashlib.sha256(told.encode() + self._pixels.digest()).hexdigest()


def stack_sha256(header: StackHeader, steps: Iterable[Sequence[Image]]) -> str:
    """Hash a whole stack, reading it once, step by step."""
    identity = Identity()
    for images in steps:
        identity.add(images)
    return identity.sha256(header)
