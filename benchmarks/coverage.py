"""Whether the stated uncertainty is true, and how small a damage is still found: `python -m benchmarks coverage`.

A 95 % interval that holds the truth in 70 % of the damages is a wrong number with a good reputation. Dents of random
size, place and brightness are laid into a sound bevel, scanned and measured; the truth comes from the dents' closed
forms. Printed are, per group of depths: how many were found, the mean error over the true value of depth and volume,
and in how many the interval value +- 1.96 u holds the truth. Then the found dents by diameter and depth, and what was
found where nothing is. The height scale is exact here, so u holds noise, reference and shape only.
"""

from __future__ import annotations

import argparse
import itertools
from dataclasses import dataclass

import numpy as np

from benchmarks.damage import COLUMNS, ROWS, STEPS, inspected
from scanning.rig.simulated.scenes import STEP_UM, scene
from scanning.rig.simulated.surface import Damage
from scanning.surface import SurfaceReport

SEEDS = tuple(range(8101, 8115))
RECIPES = ("HDRE-II", "PRECISE")
DEPTHS_UM = (0.0, 10.0, 20.0, 40.0, 80.0, 1000.0)
DIAMETERS_UM = (0.0, 150.0, 250.0, 1000.0)
STEEPEST = 0.35
"""Depth over length of the steepest dent; a camera at 60 degrees cannot look into much steeper ones."""


@dataclass(frozen=True)
class Compared:
    """One dent: true values, and what was measured (NaN where it was not found)."""

    length_um: float
    reach_um: float
    depth_um: float
    volume_mm3: float
    found_depth_um: float
    u_depth_um: float
    found_volume_mm3: float
    u_volume_mm3: float


def dents(seed: int) -> tuple[Damage, ...]:
    """Random dents, one in each cell of 550 x 480 um, none near another, the edge or the end of the scan."""
    rng = np.random.default_rng((seed, 4711))
    out = []
    for y_um in np.arange(700.0, 0.00715 * 1000 * ROWS - 700.0, 480.0):
        for s_um in (450.0, 1000.0, 1550.0):
            length = rng.uniform(100.0, 420.0)
            reach = rng.uniform(50.0, 180.0)
            deepest = min(150.0, STEEPEST * min(length, 2.0 * reach))
            depth = float(np.exp(rng.uniform(np.log(5.0), np.log(deepest))))
            out.append(
                Damage(
                    "dent",
                    s_um=s_um + rng.uniform(-40.0, 40.0),
                    length_um=length,
                    reach_um=reach,
                    depth_um=depth,
                    y_um=y_um + rng.uniform(-40.0, 40.0),
                    reflectivity=float(np.exp(rng.uniform(np.log(0.5), np.log(2.0)))),
                )
            )
    return tuple(out)


def compared(seed: int) -> tuple[dict[str, list[Compared]], dict[str, int], dict[str, SurfaceReport]]:
    """Measure one bevel with every recipe: its dents, and how many findings belong to none of them."""
    part = scene("R1", seed=seed, damages=dents(seed))
    reports = inspected(part, seed, RECIPES)
    truths = part.damage_truths()
    numbers = part.truth(rows=ROWS, steps=STEPS, columns=COLUMNS).damage_number
    rows: dict[str, list[Compared]] = {}
    false: dict[str, int] = {}
    for name, report in reports.items():
        ours: dict[int, list[int]] = {}
        false[name] = 0
        for k, one in enumerate(report.damages):
            mask = np.zeros(numbers.shape, dtype=bool)
            for row, first, length in one.mask_runs:
                mask[row, first + 2 : first + 2 + length] = True
            hit = np.unique(numbers[mask])
            hit = hit[hit > 0]
            false[name] += hit.size == 0
            # A finding over two dents measures neither.
            if hit.size == 1:
                ours.setdefault(int(hit[0]) - 1, []).append(k)
        rows[name] = []
        for i, true in enumerate(truths):
            mine = [report.damages[k] for k in ours.get(i, [])]
            one = max(mine, key=lambda d: d.volume_mm3) if mine else None
            nan = float("nan")
            rows[name].append(
                Compared(
                    length_um=1e3 * true["length_mm"],
                    reach_um=1e3 * true["reach_mm"],
                    depth_um=true["depth_um"],
                    volume_mm3=true["volume_mm3"],
                    found_depth_um=one.depth_um if one else nan,
                    u_depth_um=one.u_depth_um if one else nan,
                    found_volume_mm3=one.volume_mm3 if one else nan,
                    u_volume_mm3=one.u_volume_mm3 if one else nan,
                )
            )
    return rows, false, reports


def _held(found: np.ndarray, u: np.ndarray, true: np.ndarray) -> str:
    inside = np.abs(found - true) <= 1.96 * u
    return f"{100.0 * np.mean(inside):.1f}"


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks coverage", description=__doc__)
    parser.add_argument(
        "--scans", type=int, default=len(SEEDS), help=f"bevels of about 36 dents (default {len(SEEDS)})"
    )
    parser.add_argument("--first-seed", type=int, default=SEEDS[0], help="seed of the first bevel")
    chosen = parser.parse_args(arguments)
    everything: dict[str, list[Compared]] = {name: [] for name in RECIPES}
    false = dict.fromkeys(RECIPES, 0)
    for seed in range(chosen.first_seed, chosen.first_seed + chosen.scans):
        rows, wrong, _ = compared(seed)
        for name in RECIPES:
            everything[name] += rows[name]
            false[name] += wrong[name]
        print(f"seed {seed}: " + ", ".join(f"{n} {len(rows[n])} dents, {wrong[n]} false" for n in RECIPES), flush=True)
    print(
        "\n| recipe | true depth um | dents | found % | depth: mean error % | inside 95 % | volume: mean error % "
        "| inside 95 % |\n|---|---|---|---|---|---|---|---|"
    )
    for name in RECIPES:
        table = np.array([tuple(vars(one).values()) for one in everything[name]])
        for low, high in (*itertools.pairwise(DEPTHS_UM), (0.0, 1e9)):
            part = table[(table[:, 2] >= low) & (table[:, 2] < high)]
            seen = part[np.isfinite(part[:, 4])]
            if not seen.size:
                continue
            span = f"{low:g}-{high:g}" if high < 1e9 else "all"
            depth, u_depth, volume, u_volume = seen[:, 4:].T
            print(
                f"| {name} | {span} | {len(part)} | {100.0 * len(seen) / len(part):.0f} "
                f"| {100.0 * np.mean(depth / seen[:, 2] - 1.0):+.1f} | {_held(depth, u_depth, seen[:, 2])} "
                f"| {100.0 * np.mean(volume / seen[:, 3] - 1.0):+.1f} | {_held(volume, u_volume, seen[:, 3])} |"
            )
    print("\n| recipe | least diameter um | depth um with 9 in 10 found | false per 10 mm of edge |\n|---|---|---|---|")
    for name in RECIPES:
        per_10_mm = 10.0 * false[name] / (chosen.scans * STEPS * STEP_UM * 1e-3)
        for low, high in itertools.pairwise(DIAMETERS_UM):
            group = [o for o in everything[name] if low <= min(o.length_um, 2.0 * o.reach_um) < high]
            print(f"| {name} | {low:g}-{high:g} | {_a90(group)} | {per_10_mm:.2f} |")
    return 0


def _a90(dents: list[Compared]) -> str:
    """Depth found in nine of ten, from a logistic curve of hit or miss over log depth (MIL-HDBK-1823A)."""
    if not dents:
        return "-"
    x = np.log([one.depth_um for one in dents])
    hit = np.array([np.isfinite(one.found_depth_um) for one in dents], dtype=float)
    if hit.all():
        return f"under {np.exp(x.min()):.0f}"
    beta = np.array([0.0, 0.0])
    design = np.stack([np.ones_like(x), x - x.mean()], axis=1)
    for _ in range(50):
        p = 1.0 / (1.0 + np.exp(-design @ beta))
        weight = np.maximum(p * (1.0 - p), 1e-6)
        # A little ridge keeps perfectly separated hits and misses from running to infinity.
        beta = beta + np.linalg.solve(
            design.T @ (design * weight[:, None]) + 1e-3 * np.eye(2), design.T @ (hit - p) - 1e-3 * beta
        )
    return f"{np.exp(x.mean() + (np.log(9.0) - beta[0]) / beta[1]):.1f}"
