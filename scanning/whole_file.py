"""A file appears whole or not at all.

A report that was cut off by a full disk or a kill looks like a report. Every result therefore goes to a neighbour with
a temporary name first and takes its own name in one step at the end.
"""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from scanning.errors import BadInput


@contextmanager
def whole_file(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; what was written there takes its name when the block ends well.

    Raises `BadInput` when the folder cannot be written or the disk is full; nothing is left behind then.
    """
    place = Path(path)
    part = place.with_name(f".{place.name}.{secrets.token_hex(4)}.part")
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        yield part
        os.replace(part, place)
    except OSError as error:
        raise BadInput(
            f"{place} cannot be written ({error.strerror or error}); check the folder and the disk"
        ) from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)
