"""The paper's comparisons remade on the simulated R1, as pictures for docs/precision.md.

    python -m benchmarks precision --json figures.json
    python -m benchmarks figures figures.json --out docs/pictures

Reads the figures of a precision run for what compares recipes, and scans three further parts (seeds 311 to 313, f/5.6,
line 25 um FWHM) for what a run does not vary: the exponent of GLT, the bracket of exposures, the number of averaged
images, and the order of SCI and HDRE with GLT. Prints what it draws.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.plots import Mark, Series, bars, lines
from benchmarks.precision import Found, Optics, named, noise, order_matters, scanned
from scanning import Recipe
from scanning.pipeline import warm_up
from scanning.rig.simulated.recorder import E1_US

OPTICS = Optics(5.6, "fwhm")
SEEDS = (311, 312, 313)
E2_US = (100.0, 500.0, 1000.0, 5000.0, 9000.0)
EXPONENTS = (0.25, 0.5, 1.0, 2.0)
WINDOWS = (1, 2, 3, 5, 7, 10)
ROWS, STEPS = 1000, 70
SHOWN = ("NF", "SCI", "HDRE-I", "HDRE-II", "HDR-CAM", "PRECISE")


def key_of(name: str) -> str:
    return f"IS1 log, f/5.6, FWHM {name}" if name == "HDR-CAM" else f"f/5.6, FWHM {name}"


def without_tone(name: str) -> Recipe:
    recipe = named(name)
    return Recipe(name, tuple(o for o in recipe.operations if o.key != "glt"), response="linear")


def sweeps(seeds: tuple[int, ...] = SEEDS, rows: int = ROWS, steps: int = STEPS) -> dict[str, Any]:
    """Means over the seeds of `benchmarks.precision.noise` and `order_matters`, by what was varied."""
    recipes: dict[str, Recipe] = {}
    for p in EXPONENTS:
        for name in ("HDRE-I", "HDRE-II"):
            recipes[f"{name} p={p:g}"] = named(name).with_settings({"glt.p": str(p)})
    for name in ("HDRE-I", "HDRE-II"):
        recipes[f"{name} linear"] = without_tone(name)
    averaged: dict[str, Recipe] = {}
    for n in WINDOWS:
        averaged[f"SCI N={n}"] = named("SCI").with_settings({"sci.window": str(n)}) if n > 1 else named("NF")
        fused = named("HDRE-II").with_settings({"sci.window": str(n)})
        averaged[f"HDRE-II N={n}"] = fused
    kept: dict[str, list[dict[str, float]]] = {}
    orders: dict[str, list[dict[str, float]]] = {}
    for seed in seeds:
        subject = OPTICS.scene("R1", seed)
        for bracket, times in (("E1", E1_US), ("E2", E2_US)):
            used = {**recipes, **averaged} if bracket == "E1" else recipes
            found = scanned(subject, used, rows=rows, steps=steps, exposures_us=times)
            for name, one in found.items():
                kept.setdefault(f"{bracket} {name}", []).append(noise(one, OPTICS.um_per_px))
            for tone in ("linear", *(f"p={p:g}" for p in EXPONENTS)):
                pair = found[f"HDRE-I {tone}"], found[f"HDRE-II {tone}"]
                orders.setdefault(f"{bracket} {tone}", []).append(order_matters(*pair, OPTICS.um_per_px))
            print(f"seed {seed}, {bracket} done", file=sys.stderr, flush=True)
    return {"noise": _means(kept), "order": _means(orders)}


def _means(kept: Mapping[str, list[dict[str, float]]]) -> dict[str, dict[str, float]]:
    return {name: {k: float(np.mean([one[k] for one in seen])) for k in seen[0]} for name, seen in kept.items()}


def compared(run: dict[str, Any]) -> dict[str, str]:
    """The charts that come from a precision run."""
    noise_of, response = run["noise"], run["response"]

    def of(table: dict[str, Any], what: str) -> list[float]:
        return [table[key_of(name)][what] for name in SHOWN]

    paper = (Mark("NF in the paper 7.6", 7.6), Mark("HDR-CAM in the paper 5.6", 5.6), Mark("HDRE-II 4.2", 4.2))
    return {
        "precision-noise.svg": bars(
            "Noise of a height on R1, f/5.6, line 25 um FWHM", "sigma, um", SHOWN,
            [Series("own cell (NF 8 x 7, others 42 x 7 um)", of(noise_of, "sigma")),
             Series("42 x 7 um", of(noise_of, "sigma_42x7")), Series("42 x 36 um", of(noise_of, "sigma_42x36"))],
            paper,
        ),
        "precision-undefined.svg": bars(
            "Undefined range pixels and saturated pixels on R1, f/5.6, FWHM", "% of the pixels", SHOWN,
            [Series("undefined", of(noise_of, "undefined")), Series("saturated", of(noise_of, "saturated"))],
        ),
        "precision-cost.svg": bars(
            "Processor time on R1 (reading five exposures where a recipe does)", "ns per range pixel", SHOWN,
            [Series("one thread", of(noise_of, "ns"))],
        ),
        "precision-response.svg": bars(
            "Response: how far the worst slope is from 1 (limit 1 %)", "% off", SHOWN,
            [Series(f"shift {shift} px", [100 * abs(v - 1) for v in of(response, f"shift_{shift}")])
             for shift in ("0.25", "0.5", "1")]
            + [Series("step of the gauge", [100 * abs(v - 1) for v in of(response, "step_line")])],
            [Mark("limit", 1.0)],
        ),
    }  # fmt: skip


def varied(figures: dict[str, Any]) -> dict[str, str]:
    """The charts that come from the sweeps."""
    seen, order = figures["noise"], figures["order"]

    def tones(bracket: str, name: str, what: str) -> list[float]:
        return [seen[f"{bracket} {name} p={p:g}"][what] for p in EXPONENTS]

    pairs = [(bracket, name) for bracket in ("E1", "E2") for name in ("HDRE-I", "HDRE-II")]
    title = {"E1": "19 dB", "E2": "39 dB"}
    return {
        "precision-tone.svg": lines(
            "Noise against the exponent p of GLT, R1, f/5.6, FWHM, cell 42 x 7 um", "sigma, um", "p", EXPONENTS,
            [Series(f"{name}, {title[bracket]}", tones(bracket, name, "sigma")) for bracket, name in pairs],
            [Mark("no GLT, HDRE-II, 19 dB", seen["E1 HDRE-II linear"]["sigma"])],
        ),
        "precision-bracket.svg": lines(
            "Undefined pixels against the exponent p of GLT", "% of the pixels", "p", EXPONENTS,
            [Series(f"{name}, {title[bracket]}", tones(bracket, name, "undefined")) for bracket, name in pairs],
        ),
        "precision-window.svg": lines(
            "Noise against the number N of averaged images, R1, f/5.6, FWHM", "sigma, um", "N (cell: N x 8.33 um)",
            WINDOWS,
            [Series("SCI", [seen[f"E1 SCI N={n}"]["sigma"] for n in WINDOWS]),
             Series("HDRE-II", [seen[f"E1 HDRE-II N={n}"]["sigma"] for n in WINDOWS]),
             Series("NF over root N", [seen["E1 SCI N=1"]["sigma"] / np.sqrt(n) for n in WINDOWS])],
        ),
        "precision-order.svg": lines(
            "SCI before or after HDRE and GLT: difference of the heights", "rms difference, um", "p", EXPONENTS,
            [Series(title[b], [order[f"{b} p={p:g}"]["rms_um"] for p in EXPONENTS]) for b in ("E1", "E2")],
            [Mark("no GLT, 19 dB", order["E1 linear"]["rms_um"])],
        ),
    }  # fmt: skip


def error_maps(rows: int = 220, steps: int = 119) -> NDArray[np.uint8]:
    """Height minus true height of R1 by four recipes, side by side: blue -15 um, white 0, red +15 um, black nothing."""
    names = ("NF", "SCI", "HDRE-II", "PRECISE")
    found = scanned(OPTICS.scene("R1", 314, stray="none"), {n: named(n) for n in names}, rows=rows, steps=steps)
    tiles = [_labelled(_coloured(found[name]), name) for name in names]
    return np.hstack(tiles)


def _coloured(found: Found) -> NDArray[np.uint8]:
    error = (found.column_px - found.true_px) * OPTICS.um_per_px
    cut = (error.shape[1] - 105) // 2
    error = error[:, cut : cut + 105]
    share = np.round(np.clip(np.nan_to_num(error) / 15.0, -1.0, 1.0) * 8.0) / 8.0
    fade = 255.0 * (1.0 - np.abs(share))
    red, blue = np.where(share > 0, 255.0, fade), np.where(share < 0, 255.0, fade)
    picture = np.stack([blue, fade, red], axis=2)
    picture[np.isnan(error)] = 0.0
    return np.asarray(picture, dtype=np.uint8)


def _labelled(picture: NDArray[np.uint8], name: str) -> NDArray[np.uint8]:
    framed = cv2.copyMakeBorder(picture, 22, 4, 4, 4, cv2.BORDER_CONSTANT, value=(255, 255, 255))
    return np.asarray(cv2.putText(framed, name, (6, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA))


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks figures",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("run", type=Path, help="what `benchmarks precision --json` wrote")
    parser.add_argument("--out", type=Path, required=True, help="folder for the pictures")
    chosen = parser.parse_args(arguments)
    run = json.loads(chosen.run.read_text())
    warm_up()
    figures = sweeps()
    chosen.out.mkdir(parents=True, exist_ok=True)
    for name, chart in {**compared(run), **varied(figures)}.items():
        (chosen.out / name).write_text(chart)
    cv2.imwrite(str(chosen.out / "precision-errors.png"), error_maps())
    titles = "bracket, recipe | sigma (robust) um | 42 x 36 um | wrong % | undefined % | saturated %"
    print(f"| {titles} |\n{'|---' * 6}|")
    for name, f in figures["noise"].items():
        print(
            f"| {name} | {f['sigma']:.2f} ({f['robust']:.2f}) | {f['sigma_42x36']:.2f} | {f['wrong']:.2f} | "
            f"{f['undefined']:.2f} | {f['saturated']:.3f} |"
        )
    print("\n| bracket, tone | rms difference um | median um | correlation |\n|---|---|---|---|")
    for name, f in figures["order"].items():
        print(f"| {name} | {f['rms_um']:.2f} | {f['median_um']:.2f} | {f['correlation']:.3f} |")
    return 0
