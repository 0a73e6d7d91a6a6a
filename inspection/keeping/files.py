"""The files of an installation as others must find them again: copied with their hash, never half.

A copy that was cut off looks like a file. Here it has another name until it is whole and on the disk.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from pathlib import Path

from scanning.errors import BadInput

PIECE_BYTES = 4 << 20
#: Copies under way end with this; whoever finds one may delete it.
UNFINISHED = ".unfinished"


def sha256_of(file: Path) -> str:
    """SHA-256 of a file's bytes, read in pieces."""
    digest = hashlib.sha256()
    with file.open("rb") as opened:
        while piece := opened.read(PIECE_BYTES):
            digest.update(piece)
    return digest.hexdigest()


def copy_hashed(source: Path, target: Path) -> tuple[int, str]:
    """Copy ``source`` to ``target`` (replacing it) and return the copy's size in bytes and its SHA-256.

    ``target`` appears only when it is whole and on the disk. Raises `BadInput` if either side's disk refuses,
    `FileNotFoundError` if the source is gone.
    """
    digest, size = hashlib.sha256(), 0
    target.parent.mkdir(parents=True, exist_ok=True)
    unfinished = target.with_name(target.name + UNFINISHED)
    try:
        with source.open("rb") as opened, unfinished.open("wb") as out:
            while piece := opened.read(PIECE_BYTES):
                digest.update(piece)
                out.write(piece)
                size += len(piece)
            out.flush()
            os.fsync(out.fileno())
        os.replace(unfinished, target)
    except FileNotFoundError:
        unfinished.unlink(missing_ok=True)
        raise
    except OSError as error:
        unfinished.unlink(missing_ok=True)
        raise BadInput(
            f"{source} could not be copied to {target} ({error.strerror}); check the disk and its room, then try again."
        ) from error
    return size, digest.hexdigest()


def files_below(folder: Path) -> Iterator[Path]:
    """Every plain file below ``folder``, in name order; links are not followed."""
    if folder.is_dir():
        for path in sorted(folder.rglob("*")):
            if path.is_file() and not path.is_symlink() and not path.name.endswith(UNFINISHED):
                yield path
