"""How often a recipe follows a reflection, loses the line, or reports one where there is none.

`python -m benchmarks ghosts`. Every scene draws its reflections anew from its seed: lines narrower than, as wide as and
wider than the laser line, ones that touch or cross it, spots, arcs, light beside and beyond the edge, and the
simulator's own "hard" set; on a sound, a chipped and a broken edge, at f/4, f/5.6 and f/8. A recipe tuned to a few
drawn scenes looks perfect on them, so the seeds of the last look (``--held-out``) are others, and nobody looks at them
while changing the code.

Truth is the simulator's closed form and its light before the camera, never the pipeline. Rows of the surface count as

- wrong: the column is more than 5 px off (1.5 line widths) what the surface is anywhere in the images of the window
- lost: no column, though the line alone, without reflections, is 4 x the noise above dark (mean of 3 x 3 px)
- covered: the reflections' light at the line's own place is more than the line's. No extractor can tell them apart
  there, so wrong and lost are also given without these rows; rows without surface are counted by
- beyond: a column is reported where there is no surface
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from scanning import Recipe, StackHeader
from scanning.optics import IS1, LINE_WIDTH_UM
from scanning.pipeline.stream import ProfileStream
from scanning.rig.simulated.render import Renderer
from scanning.rig.simulated.scenes import REFLECTIONS, STEP_UM, scene
from scanning.rig.simulated.spurious import Arc, Reflection, SecondLine, Spot

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
RECIPES = ("NF", "SCI", "HDRE-I", "HDRE-II", "PRECISE")
APERTURES = (4.0, 5.6, 8.0)
DEVELOPED_ON = (101, 102)
HELD_OUT = (9301, 9302, 9303)
EXPOSURES_US = (100.0, 300.0, 500.0, 700.0, 900.0)
ROWS, COLUMNS, STEPS = 1000, 256, 20
#: Steps at which a scan of a region begins: in the middle of its largest damage.
FIRST_STEP = {"R1": 0, "R2": 42, "R3": 110}
WRONG_PX = 5.0
ABOVE_NOISE = 4.0
LEAST_NOISE = 0.5
#: Confidence classes of the table that says how often a confidence is right.
CLASSES = (0.0, 0.5, 0.8, 0.9, 0.95, 1.0)


def _lines(rng: np.random.Generator, narrowest: float, widest: float, near: float, far: float) -> Iterator[SecondLine]:
    for _ in range(3):
        first = float(rng.uniform(0.03, 0.8))
        yield SecondLine(
            first, min(1.0, first + float(rng.uniform(0.06, 0.25))),
            float(rng.choice([-1, 1]) * rng.uniform(near, far)),
            float(rng.uniform(-0.06, 0.06)), float(rng.uniform(narrowest, widest)), float(rng.uniform(0.5, 4.0)),
            float(rng.uniform(-5.0, 5.0)),
        )  # fmt: skip


def _touching(rng: np.random.Generator) -> Iterator[SecondLine]:
    for _ in range(3):
        first = float(rng.uniform(0.05, 0.8))
        yield SecondLine(
            first, first + float(rng.uniform(0.06, 0.2)), float(rng.uniform(-14.0, 14.0)),
            float(rng.uniform(-0.15, 0.15)), float(np.exp(rng.uniform(np.log(0.7), np.log(5.0)))),
            float(rng.uniform(0.3, 2.0)), float(rng.uniform(-5.0, 5.0)),
        )  # fmt: skip


def _spots(rng: np.random.Generator, first: float = 0.03, last: float = 0.97) -> Iterator[Spot]:
    for _ in range(6):
        yield Spot(
            float(rng.uniform(first, last)), float(rng.choice([-1, 1]) * rng.uniform(6.0, 80.0)),
            float(rng.uniform(3.0, 15.0)), float(rng.uniform(2.0, 8.0)), float(rng.uniform(1.0, 6.0)),
            float(rng.uniform(-4.0, 4.0)),
        )  # fmt: skip


def _arcs(rng: np.random.Generator) -> Iterator[Arc]:
    for _ in range(2):
        start = float(rng.uniform(-180.0, 100.0))
        yield Arc(
            float(rng.uniform(0.1, 0.9)), float(rng.uniform(-90.0, 90.0)), float(rng.uniform(30.0, 80.0)),
            float(rng.uniform(0.9, 3.5)), start, start + float(rng.uniform(60.0, 120.0)), float(rng.uniform(1.0, 4.0)),
            float(rng.uniform(-2.0, 2.0)),
        )  # fmt: skip


def _at_the_edge(rng: np.random.Generator) -> Iterator[Reflection]:
    """Light beyond the edge and beside it, where chips break the line."""
    yield SecondLine(
        0.0, float(rng.uniform(0.03, 0.15)), float(rng.choice([-1, 1]) * rng.uniform(8.0, 50.0)),
        float(rng.uniform(-0.3, 0.3)), float(rng.uniform(0.9, 3.0)), float(rng.uniform(0.5, 3.0)),
        float(rng.uniform(-5.0, 5.0)),
    )  # fmt: skip
    yield from list(_spots(rng, 0.0, 0.1))[:3]


def reflections(kind: str, rng: np.random.Generator) -> tuple[Reflection, ...]:
    """The stray light of one scene."""
    drawn: dict[str, Iterator[Reflection]] = {
        "narrower": _lines(rng, 0.6, 0.9, 8.0, 60.0),
        "as wide": _lines(rng, 1.2, 1.7, 8.0, 60.0),
        "wider": _lines(rng, 2.5, 7.0, 20.0, 70.0),
        "touching": _touching(rng),
        "spots": _spots(rng),
        "arcs": _arcs(rng),
        "edge": _at_the_edge(rng),
        "hard": iter(REFLECTIONS["hard"]),
    }
    return tuple(drawn[kind])


KINDS = ("narrower", "as wide", "wider", "touching", "spots", "arcs", "edge", "hard")


@dataclass(frozen=True)
class Case:
    kind: str
    seed: int
    f_number: float

    @property
    def region(self) -> str:
        """Sound, chipped and broken edges take turns."""
        return ("R1", "R2", "R3")[(KINDS.index(self.kind) + self.seed + APERTURES.index(self.f_number)) % 3]


@dataclass(frozen=True)
class Shown:
    """A scan and its truth. ``frames`` (steps, exposures, rows, columns); the rest (rows, steps).

    ``line`` and ``stray`` are the light of the line and of the reflections at the line's own place (mean of 3 x 3 px),
    in grey levels per microsecond.
    """

    frames: NDArray[np.uint8]
    column_px: Float64
    line: Float64
    stray: Float64
    header: StackHeader


def shown(case: Case) -> Shown:
    """Simulate the scan of one case."""
    rng = np.random.default_rng((case.seed, KINDS.index(case.kind), round(10 * case.f_number)))
    part = replace(
        scene(case.region, seed=case.seed, wear_um=float(rng.uniform(0.0, 20.0)), visit=1, f_number=case.f_number),
        reflections=reflections(case.kind, rng),
    )
    renderer = Renderer(part, rows=ROWS, columns=COLUMNS)
    alone = Renderer(replace(part, reflections=()), rows=ROWS, columns=COLUMNS)
    first = FIRST_STEP[case.region]
    truth = part.truth(rows=ROWS, steps=first + STEPS, columns=COLUMNS)
    column_px = np.where(truth.visible, truth.column_px, np.nan).astype(np.float64)[:, first:]
    frames = np.empty((STEPS, len(EXPOSURES_US), ROWS, COLUMNS), np.uint8)
    line, stray = np.zeros((ROWS, STEPS)), np.zeros((ROWS, STEPS))
    grey_per_e = (renderer.sensor.saturation - renderer.sensor.dark_level) / 9000.0
    for step in range(STEPS):
        light, own = (which.irradiance((first + step) * STEP_UM) for which in (renderer, alone))
        line[:, step] = _around(own, column_px[:, step]) * grey_per_e
        stray[:, step] = _around(light - own, column_px[:, step]) * grey_per_e
        for number, exposure in enumerate(EXPOSURES_US):
            draw = np.random.default_rng((case.seed, step, number))
            frames[step, number] = renderer.expose(light, exposure, draw)
    header = StackHeader(
        rows=ROWS, columns=COLUMNS, steps=STEPS, exposures_us=EXPOSURES_US, step_um=STEP_UM,
        row_pitch_um=IS1.row_pitch_um, mm_per_pixel=IS1.mm_per_pixel, saturation=renderer.sensor.saturation,
        line_width_px=IS1.on_sensor_px(LINE_WIDTH_UM), dark_level=renderer.sensor.dark_level,
    )  # fmt: skip
    return Shown(frames, column_px, line, stray, header)


def _around(light: NDArray[np.float32], column_px: Float64) -> Float64:
    rows = np.arange(light.shape[0])
    at = np.clip(np.rint(np.nan_to_num(column_px)).astype(int), 1, light.shape[1] - 2)
    three = np.stack([light[rows, at + c] for c in (-1, 0, 1)]).mean(axis=0)
    padded = np.pad(three, 1, mode="edge")
    return np.asarray((padded[:-2] + padded[1:-1] + padded[2:]) / 3.0, dtype=np.float64)


@dataclass
class Judged:
    """Counts of points; several may be added."""

    seen: int = 0
    wrong: int = 0
    clear: int = 0
    wrong_clear: int = 0
    stands: int = 0
    lost: int = 0
    stands_clear: int = 0
    lost_clear: int = 0
    nowhere: int = 0
    beyond: int = 0
    told: NDArray[np.int64] = field(default_factory=lambda: np.zeros((2, len(CLASSES) - 1), np.int64))

    def add(self, other: Judged) -> None:
        for name in self.__dataclass_fields__:
            setattr(self, name, getattr(self, name) + getattr(other, name))

    def cells(self) -> list[str]:
        def share(part: int, whole: int) -> str:
            return f"{100.0 * part / whole:.2f}" if whole else "-"

        return [
            share(self.wrong, self.seen), share(self.wrong_clear, self.clear), share(self.lost, self.stands),
            share(self.lost_clear, self.stands_clear), share(self.seen - self.clear, self.seen),
            f"{share(self.beyond, self.nowhere)}",
        ]  # fmt: skip


TITLES = ("wrong %", "without covered", "lost %", "without covered", "covered %", "beyond %")


@dataclass(frozen=True)
class Verdict:
    """What became of every point (rows, profiles)."""

    found: Float64
    confidence: Float64
    lowest: Float64
    highest: Float64
    wrong: Bool
    lost: Bool
    beyond: Bool
    covered: Bool
    stands: Bool


def sliding(name: str) -> Recipe:
    recipe = Recipe.named(name)
    block = recipe.compound is not None and recipe.compound.mode == "block"
    return recipe.with_settings({"sci.mode": "sliding"}) if block else recipe


def measured(scan: Shown, name: str) -> Verdict:
    """Process one scan with one recipe and hold it against the truth."""
    recipe = sliding(name)
    stream = ProfileStream(recipe, scan.header)
    profiles = [p for images in scan.frames for p in stream.push(list(images))] + stream.finish()
    settled = stream.settled
    assert settled is not None
    found = np.stack([p.column_px for p in profiles], axis=1)
    told = [getattr(p, "confidence", None) for p in profiles]
    confidence = np.stack([np.zeros(ROWS) if c is None else c for c in told], axis=1)
    window = recipe.compound.window if recipe.compound is not None else 1
    spans = np.lib.stride_tricks.sliding_window_view
    true = spans(scan.column_px, window, axis=1)
    visible = np.isfinite(true).all(axis=2)
    nowhere = ~np.isfinite(true).any(axis=2)
    lowest, highest = true.min(axis=2), true.max(axis=2)
    line, stray = spans(scan.line, window, axis=1).mean(axis=2), spans(scan.stray, window, axis=1).mean(axis=2)
    exposure = max(settled.exposures_us)
    noise = max(LEAST_NOISE, _noise(scan.frames[0, scan.header.exposures_us.index(exposure)]))
    stands = visible & (line * exposure > ABOVE_NOISE * noise / 3.0)
    with np.errstate(invalid="ignore"):
        wrong = visible & ((found < lowest - WRONG_PX) | (found > highest + WRONG_PX))
    missed = np.isnan(found)
    return Verdict(
        found, confidence, lowest, highest, wrong, stands & missed, nowhere & ~missed, visible & (stray > line), stands
    )


def _noise(image: NDArray[np.uint8]) -> float:
    return float(1.4826 / np.sqrt(2.0) * np.median(np.abs(np.diff(image.astype(np.float64), axis=1))))


def counted(verdict: Verdict) -> Judged:
    visible = np.isfinite(verdict.lowest)
    clear = visible & ~verdict.covered
    nowhere = ~visible
    bad = verdict.wrong | verdict.beyond
    given = np.isfinite(verdict.found)
    told = np.stack([
        np.histogram(verdict.confidence[given], CLASSES)[0], np.histogram(verdict.confidence[given & bad], CLASSES)[0]
    ])  # fmt: skip
    return Judged(
        seen=int(visible.sum()), wrong=int(verdict.wrong.sum()),
        clear=int(clear.sum()), wrong_clear=int((verdict.wrong & clear).sum()),
        stands=int(verdict.stands.sum()), lost=int(verdict.lost.sum()),
        stands_clear=int((verdict.stands & clear).sum()), lost_clear=int((verdict.lost & clear).sum()),
        nowhere=int(nowhere.sum()), beyond=int(verdict.beyond.sum()), told=told.astype(np.int64),
    )  # fmt: skip


def cases(seeds: tuple[int, ...], kinds: tuple[str, ...] = KINDS) -> Iterator[Case]:
    for kind in kinds:
        for seed in seeds:
            for f_number in APERTURES:
                yield Case(kind, seed, f_number)


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks ghosts", description=__doc__)
    parser.add_argument("--held-out", action="store_true", help="the seeds nothing was changed after looking at")
    parser.add_argument("--kinds", default=",".join(KINDS), help="which reflections, comma between")
    parser.add_argument("--recipes", default=",".join(RECIPES), help="which recipes, comma between")
    chosen = parser.parse_args(arguments)
    names, kinds = tuple(chosen.recipes.split(",")), tuple(chosen.kinds.split(","))
    by: dict[tuple[str, str], Judged] = {}
    for case in cases(HELD_OUT if chosen.held_out else DEVELOPED_ON, kinds):
        scan = shown(case)
        for name in names:
            judged = counted(measured(scan, name))
            for key in ((case.kind, name), (f"f/{case.f_number:g}", name), ("all", name)):
                by.setdefault(key, Judged()).add(judged)
    print_tables(by, names)
    return 0


def print_tables(by: dict[tuple[str, str], Judged], names: tuple[str, ...]) -> None:
    print(f"| reflections | recipe | {' | '.join(TITLES)} |\n|---|---|{'---|' * len(TITLES)}")
    for (kind, name), judged in sorted(by.items(), key=lambda entry: names.index(entry[0][1])):
        print(f"| {kind} | {name} | {' | '.join(judged.cells())} |")
    spans = [f"{low:g}-{high:g}" for low, high in pairwise(CLASSES)]
    print(f"\nWrong or beyond, % of the points of a confidence\n\n| recipe | {' | '.join(spans)} |")
    print(f"|---|{'---|' * len(spans)}")
    for name in names:
        all_, bad = by["all", name].told
        shares = [f"{100.0 * b / a:.3f} of {a}" if a else "-" for a, b in zip(all_, bad, strict=True)]
        print(f"| {name} | {' | '.join(shares)} |", flush=True)
