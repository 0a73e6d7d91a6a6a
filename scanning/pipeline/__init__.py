"""The paper's pipeline, one file per operation, in the order the data flows.

compound.py (SCI), exposure.py (HDRE), tone.py (GLT), line.py (MSNN, with standing_out.py and path.py), centroid.py
(COG). settle.py says what to work with, chain.py composes the operations, stream.py takes frames and gives profiles,
whole.py does whole stacks.

Compiled kernels are kept under a name made of all the sources here. Numba itself looks only at the file a kernel is
written in: after an update that changed a kernel called from another file it would go on using the old one, and give
the old numbers.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np

from scanning.frames import StackHeader
from scanning.recipe import Recipe


def _cache_for_these_sources() -> None:
    here = Path(__file__).parent
    sources = hashlib.sha256(b"".join(file.read_bytes() for file in sorted(here.glob("*.py")))).hexdigest()[:16]
    places = [Path(os.environ.get("NUMBA_CACHE_DIR") or here / "__pycache__"), Path.home() / ".cache" / "edgewatch"]
    for place in places:
        kept = place / f"kernels-{sources}"
        try:
            kept.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(kept, os.W_OK):
            numba.config.CACHE_DIR = str(kept)  # type: ignore[attr-defined]
            return


_cache_for_these_sources()


def warm_up(progress: Callable[[int, int], None] | None = None) -> None:
    """Compile every kernel for 8, 10 and 16 bit, so that the first scan does not wait; later processes load the cache.

    ``progress(done, total)`` is called after each of the parts.
    """
    from scanning.pipeline.stream import ProfileStream

    # Integers are as narrow as saturation and dark level allow, so each of these meets kernels the others do not.
    jobs = [
        ("NF", 255, 2.0), ("NF", 255, 2.3), ("SCI", 255, 2.0), ("SCI", 255, 2.3), ("HDRE-I", 255, 2.0),
        ("HDRE-II", 255, 2.0), ("PRECISE", 255, 2.0), ("NF", 1023, 2.0), ("NF", 65535, 2.0), ("SCI", 65535, 2.0),
        ("HDRE-I", 65535, 2.0), ("HDRE-II", 65535, 2.0), ("NF", 255, None),
    ]  # fmt: skip
    for done, (name, saturation, dark) in enumerate(jobs, start=1):
        kind = np.uint8 if saturation < 256 else np.uint16
        times = (1.0, 2.0) if name[:4] in ("HDRE", "PREC") else (1.0,)
        header = StackHeader(
            rows=16, columns=64, steps=5, exposures_us=times, step_um=1.0, row_pitch_um=1.0, mm_per_pixel=1.0,
            saturation=saturation, dark_level=dark, line_width_px=None if dark is None else 3.0,
            bits=8 * np.dtype(kind).itemsize,
        )  # fmt: skip
        recipe = Recipe.named(name)
        stream = ProfileStream(recipe.with_settings({"sci.mode": "sliding"}) if recipe.compound else recipe, header)
        image = np.zeros((16, 64), kind)
        image[:, 30:33] = (100, 200, 100)
        for _ in range(6):
            stream.push([image] * len(times))
        stream.finish()
        if progress is not None:
            progress(done, len(jobs))
