"""Stacks of scan images on disk, opened the same way whoever recorded them.

`open_stack` takes a folder with ``stack.json`` and images, or our own HDF5 file; `StackWriter` records one while the
stage moves; `save_stack` and `import_folder` turn any stack into our file, all or nothing. Without this one door, the
import page, the command line and the reprocessing of an old scan would each accept, and mistake, something else.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import h5py

from scanning.errors import BadInput
from scanning.stacks.description import FORMAT, STACK_JSON, header_from_json, header_to_json
from scanning.stacks.folder import FolderStack
from scanning.stacks.identity import Identity, stack_sha256
from scanning.stacks.store import PART_SUFFIX, StackWriter, StoredStack, save_stack

if TYPE_CHECKING:
    from collections.abc import Callable

    from scanning.frames import StackHeader

__all__ = [
    "FORMAT",
    "PART_SUFFIX",
    "STACK_JSON",
    "FolderStack",
    "Identity",
    "StackWriter",
    "StoredStack",
    "header_from_json",
    "header_to_json",
    "import_folder",
    "open_stack",
    "save_stack",
    "stack_sha256",
]


def open_stack(path: Path | str) -> FolderStack | StoredStack:
    """Open a stack for reading step by step: a folder (or its ``stack.json``), or our HDF5 file, even a partial one.

    Everything that can be known without decoding every frame is checked here, so a broken stack is refused before the
    first step. Raises `BadInput` with one sentence naming the file and the fault.
    """
    place = Path(path)
    if place.is_dir():
        return FolderStack.open(place)
    if not place.exists():
        raise BadInput(f"there is no stack at {place}; give a folder with {STACK_JSON}, or an .h5 stack")
    if place.name == STACK_JSON:
        return FolderStack.open(place.parent)
    if place.is_file() and h5py.is_hdf5(place):
        return StoredStack.open(place)
    if place.suffix.lower() in {".h5", ".hdf5", ".part"}:
        raise BadInput(f"{place} is damaged or no HDF5 file at all; copy it again from where it was recorded")
    raise BadInput(
        f"{place} is a file, not a stack; give the folder that holds {STACK_JSON} and its images, or an .h5 stack"
    )


def import_folder(
    path: Path | str, out_h5: Path | str, progress: Callable[[int, int], None] | None = None
) -> StackHeader:
    """Copy a recorded stack into our HDF5 file, all or nothing, and return its header.

    ``progress`` is called with (steps done, steps in all). When anything is wrong, `BadInput` is raised and neither
    ``out_h5`` nor a part of it is left behind.
    """
    with open_stack(path) as stack:
        return save_stack(stack, Path(out_h5), progress)
