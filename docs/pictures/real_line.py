"""Draw real-line.png: recorded frames of a metal plate, the line that was found, the reflections that were not taken.

    python docs/pictures/real_line.py FOLDER_WITH_THE_RECORDED_FRAMES

The frames are 1280 x 1024: utframe0007 and 0008 are two steps of a scan over a step in the plate, beside a bright
nozzle; utest5, 4, 3 are one bracket (exposures 1 : 1.99 : 3.59) of a plate lit by a lamp. Nothing is known about them
but that, so the level off the line and the line's width are estimated.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

from scanning.frames import StackHeader
from scanning.pipeline.stream import ProfileStream
from scanning.recipe import Recipe

LINE, REJECTED = (60, 60, 255), (255, 190, 0)  # blue, green, red


def drawn(frames: list[np.ndarray], times: tuple[float, ...], recipe: Recipe, caption: str) -> np.ndarray:
    rows, columns = frames[0].shape
    stream = ProfileStream(recipe, StackHeader(rows, columns, 1, times, 1.0, 1.0, 1.0))
    profile = [*stream.push(frames), *stream.finish()][0]
    taken, rejected = stream.candidates()
    picture = cv2.cvtColor(frames[0], cv2.COLOR_GRAY2BGR)
    for r, c in rejected:
        cv2.circle(picture, (round(c), round(r)), 2, REJECTED, -1)
    for r, c in enumerate(profile.column_px):
        if np.isfinite(c):
            cv2.circle(picture, (round(float(c)), r), 2, LINE, -1)
    print(f"{caption}: {len(taken)} rows with a line, {len(rejected)} peaks rejected, {stream.settled}")
    picture = cv2.resize(picture[:, :1000], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return cv2.copyMakeBorder(
        cv2.putText(picture, caption, (150, 505), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA),
        2, 2, 2, 2, cv2.BORDER_CONSTANT, value=(90, 90, 90),
    )  # fmt: skip


def main(folder: Path) -> None:
    def frame(name: str) -> np.ndarray:
        return np.asarray(cv2.imread(str(folder / f"{name}.png"), cv2.IMREAD_GRAYSCALE))

    nf = Recipe.named("NF")
    fused = Recipe.named("HDRE-II").with_settings({"sci.window": "1"})
    bracket = [frame(n) for n in ("utest5", "utest4", "utest3")]
    parts = [
        drawn([frame("utframe0007")], (1.0,), nf, "NF, utframe0007"),
        drawn([frame("utframe0008")], (1.0,), nf, "NF, utframe0008"),
        drawn(bracket, (1.0, 1.99, 3.59), fused, "HDRE + GLT, utest5, 4, 3"),
    ]
    picture = np.hstack(parts)
    cv2.imwrite(str(Path(__file__).with_name("real-line.png")), quantised(picture))


def quantised(picture: np.ndarray) -> np.ndarray:
    """Fewer grey levels, so that the file stays small."""
    coloured = picture.max(axis=2).astype(int) - picture.min(axis=2) > 40
    return np.where(coloured[..., None], picture, picture // 24 * 24).astype(np.uint8)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
