"""The paper's pipeline, one file per operation, in the order the data flows.

compound.py (SCI), exposure.py (HDRE), tone.py (GLT), line.py (MSNN), centroid.py (COG); stream.py composes them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from scanning.frames import StackHeader
from scanning.recipe import Recipe


def warm_up(progress: Callable[[int, int], None] | None = None) -> None:
    """Compile every kernel for 8 and 16 bit, so that the first scan does not wait; later processes load the cache.

    ``progress(done, total)`` is called after each of the parts.
    """
    from scanning.pipeline.stream import ProfileStream

    jobs = [
        (name, kind, bits)
        for bits, kind in ((8, np.uint8), (16, np.uint16))
        for name in ("NF", "SCI", "HDRE-I", "HDRE-II")
    ]
    for done, (name, kind, bits) in enumerate(jobs, start=1):
        times = (1.0, 2.0) if name.startswith("HDRE") else (1.0,)
        header = StackHeader(
            rows=16, columns=64, steps=5, exposures_us=times, step_um=1.0, row_pitch_um=1.0, mm_per_pixel=1.0,
            saturation=(1 << bits) - 1, bits=bits,
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
