"""How often each recipe follows something else than the line, how much it loses, and how much noise is left.

Truth is the simulator's own closed form (its projection shares no code with the product), never an image. Per scene,
seed, lens and recipe:

- wrong: of the rows where the line can be seen, those found more than 4 px from it
- lost: those not found although the line stands above the noise there. "Stands above" is judged on the noise-free
  truth of the light: the mean over the true column +-1 px of the images the recipe reads is above dark by 4 x the noise
- beyond: of the rows without surface, those where a line was reported
- sigma, robust (1.4826 MAD) and plain: of column minus truth, times the height of a pixel, wrong rows left out

First the response: the mean step of the gauge measured over the true step (slope), and over how many micrometres along
the line it rises from 10 to 90 %.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanning import Recipe, Stack, open_stack
from scanning.pipeline.stream import ProfileStream
from scanning.rig.simulated.illumination import LaserLine
from scanning.rig.simulated.recorder import record
from scanning.rig.simulated.scenes import scene

RECIPES = ("NF", "SCI", "HDRE-I", "HDRE-II", "PRECISE")
WRONG_PX = 4.0
ABOVE_NOISE = 4.0
Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class Case:
    """One scan to measure: scene, stray reflections, individual part, lens, kind of laser line."""

    name: str
    stray: str
    seed: int
    f_number: float = 5.6
    width_is: str = "fwhm"

    def __str__(self) -> str:
        line = "" if self.width_is == "fwhm" else f", {self.width_is}"
        return f"{self.name} {self.stray}, seed {self.seed}, f/{self.f_number:g}{line}"


SMALL = (
    Case("flat", "none", 11),
    Case("flat", "none", 11, 4.0),
    Case("flat", "none", 11, 8.0),
    Case("flat", "none", 11, 5.6, "1/e2"),
    Case("gauge", "none", 12),
    Case("R1", "moderate", 13),
    Case("R2", "moderate", 14),
    Case("R3", "moderate", 15),
    Case("R2", "busy", 16),
    Case("R1", "hard", 17),
    Case("R2", "moderate", 18, 8.0),
)


@dataclass(frozen=True)
class Recorded:
    """A scan and its truth, arrays (rows, steps)."""

    stack: Stack
    column_px: Float64
    visible: NDArray[np.bool_]
    um_per_px: float


def recorded(case: Case, folder: Path, steps: int, rows: int | None) -> Recorded:
    """Simulate the case into ``folder``."""
    laser = LaserLine(width_is="1/e2" if case.width_is == "1/e2" else "fwhm")
    what = scene(case.name, seed=case.seed, f_number=case.f_number, stray=case.stray, line=laser)  # type: ignore[arg-type]
    record(what, folder, steps=steps, rows=rows)
    stack = open_stack(folder)
    with np.load(folder / "truth.npz") as truth:
        column, visible = truth["column_px"].astype(np.float64), truth["visible"].astype(bool)
    return Recorded(stack, column, visible, stack.header.mm_per_pixel * 1000.0)


def standing_out(images: list[NDArray[Any]], dark: float, column: Float64) -> NDArray[np.bool_]:
    """(rows,) whether the mean of 3 x 3 pixels around the true column is above the noise in the best exposure."""
    rows, columns = images[0].shape
    seen = np.zeros(rows, bool)
    at = np.clip(np.rint(np.nan_to_num(column)).astype(int), 1, columns - 2)
    for image in images:
        light = image.astype(np.float64) - dark
        noise = 1.4826 / np.sqrt(2.0) * np.median(np.abs(np.diff(light, axis=1)))
        three = np.stack([light[np.arange(rows), at + c] for c in (-1, 0, 1)]).mean(axis=0)
        padded = np.pad(three, 1, mode="edge")
        nine = (padded[:-2] + padded[1:-1] + padded[2:]) / 3.0
        seen |= nine > ABOVE_NOISE * max(noise, 0.5) / 3.0
    return seen


def measured(scan: Recorded, name: str) -> dict[str, float]:
    """The figures of one recipe on one scan."""
    header = scan.stack.header
    recipe = Recipe.named(name)
    if recipe.compound is not None:
        recipe = recipe.with_settings({"sci.mode": "sliding"})
    stream = ProfileStream(recipe, header)
    profiles, above = [], []
    used = 0.0
    for step, images in enumerate(scan.stack):
        started = time.process_time()
        profiles += stream.push(images)
        used += time.process_time() - started
        above.append((images, scan.column_px[:, step]))
    profiles += stream.finish()
    settled = stream.settled
    assert settled is not None
    read = [header.exposures_us.index(e) for e in settled.exposures_us]
    stands = np.stack([standing_out([i[e] for e in read], settled.dark_levels[0], c) for i, c in above], axis=1)
    found = np.stack([p.column_px for p in profiles], axis=1)
    window = recipe.compound.window if recipe.compound is not None else 1
    span = slice(window // 2, window // 2 + found.shape[1])
    true, visible = scan.column_px[:, span], scan.visible[:, span]
    off = found - true
    near = visible & (np.abs(off) <= WRONG_PX)
    must = visible & stands[:, span]
    error_um = off[near] * scan.um_per_px
    missed = np.isnan(found)
    return {
        "wrong": 100.0 * float(np.mean(np.abs(off[visible]) > WRONG_PX)),
        "lost": 100.0 * float(np.mean(missed[must])) if must.any() else 0.0,
        "undefined": 100.0 * float(np.mean(missed[visible])),
        "beyond": 100.0 * float(np.mean(~missed[~visible])) if not visible.all() else 0.0,
        "robust": 1.4826 * float(np.median(np.abs(error_um - np.median(error_um)))),
        "plain": float(error_um.std()),
        "ns": used / found.size * 1e9,
    } | (response(found, true, scan) if np.ptp(true[visible]) > 20.0 and visible.all() else {})


def response(found: Float64, true: Float64, scan: Recorded) -> dict[str, float]:
    """Slope and rise of the steps along the line: measured mean step over true step; 10-90 % in micrometres."""
    mean, truth = np.nanmedian(found, axis=1), np.median(true, axis=1)
    edges = np.flatnonzero(np.abs(np.diff(truth)) > 4.0)
    slopes, rises = [], []
    reach = 15
    for edge in edges:
        if edge < reach or edge + reach + 2 > truth.size:
            continue
        below, over = slice(edge - reach, edge - 4), slice(edge + 6, edge + reach)
        height = np.nanmean(mean[over]) - np.nanmean(mean[below])
        slopes.append(height / (np.mean(truth[over]) - np.mean(truth[below])))
        rise = (mean[edge - 5 : edge + 7] - np.nanmean(mean[below])) / height
        rises.append(np.count_nonzero((rise > 0.1) & (rise < 0.9)) * scan.stack.header.row_pitch_um)
    if not slopes:
        return {}
    return {"slope": float(np.mean(slopes)), "rise": float(np.mean(rises))}


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks precision", description=__doc__)
    parser.add_argument("--steps", type=int, default=40, help="scan images per case (default 40)")
    parser.add_argument("--rows", type=int, help="rows (default: the scene's)")
    parser.add_argument("--recipes", default=",".join(RECIPES), help="which recipes, comma between")
    parser.add_argument("--scenes", help="only cases whose name contains this")
    parser.add_argument("--seeds", type=int, default=1, help="how many seeds per case (default 1)")
    chosen = parser.parse_args(arguments)
    names = chosen.recipes.split(",")
    titles = ("scan", "recipe", "wrong %", "lost %", "undefined %", "beyond %", "sigma robust / plain um", "step slope",
              "10-90 % um", "ns per range pixel")  # fmt: skip
    print(f"| {' | '.join(titles)} |\n{'|---' * len(titles)}|")
    for case in SMALL:
        for extra in range(chosen.seeds):
            one = Case(case.name, case.stray, case.seed + 100 * extra, case.f_number, case.width_is)
            if chosen.scenes and chosen.scenes not in str(one):
                continue
            with tempfile.TemporaryDirectory() as folder:
                scan = recorded(one, Path(folder) / "scan", chosen.steps, chosen.rows)
                for name in names:
                    f = measured(scan, name)
                    slope = f"{f['slope']:.3f}" if "slope" in f else "-"
                    rise = f"{f['rise']:.0f}" if "rise" in f else "-"
                    print(
                        f"| {one} | {name} | {f['wrong']:.2f} | {f['lost']:.2f} | {f['undefined']:.2f} | "
                        f"{f['beyond']:.0f} | {f['robust']:.2f} / {f['plain']:.2f} | {slope} | {rise} | "
                        f"{f['ns']:.0f} |",
                        flush=True,
                    )
    return 0
