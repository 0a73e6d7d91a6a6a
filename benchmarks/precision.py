"""How faithfully each recipe follows the surface, and only then how quiet it is.

A low sigma proves nothing by itself: a mask that does not move with the line gives almost no noise and follows the
surface only halfway. So every recipe first has to answer a true displacement with the same displacement:

- shift: a bevel raised by quarters of a pixel, eight scans from 0 to 1.75 px. The slope is the mean difference of the
  columns found over the mean difference of the true ones, for every pair 0.25, 0.5 and 1 px apart, averaged over the
  seeds. The WORST pair counts (in brackets its standard error over the seeds): the mean over all phases of the pixel
  would hide a response that locks to pixels.
- step: the treads of the staircase gauge (100 to 140 um apart), measured over true step
- 10-90 %: over how many micrometres the edge of a step rises, for walls along the laser line (gauge) and for walls
  across it (30 um up and down along the scan). A step of the surface, not of the optics: the lens's blur is in it.

PASS: every one of the slopes within 1.00 +- 0.01, and both edges within 60 um.

Then region R1 of the simulated knife, all recipes on the same images:

- sigma: standard deviation about the least-squares plane of column minus true column, times the height per pixel, in
  60 % of the rows and all profiles (the paper's 600 x 241 of 1000 x 241), and 1.4826 MAD; wrong rows (more than 4 px
  off) are left out and counted. Always with its lateral cell, along the scan x along the line: the recipe's own, and
  after averaging to 42 x 7 and 42 x 36 um (five profiles for NF; five rows), which any recipe may do.
- undefined: of the pixels with a surface, those without a height; saturated: of the pixels read
- ns per range pixel: processor time of the pipeline, one run, not the best of several

Truth is the simulator's own closed form (its projection shares no code with the product), never an image. The seeds
are the parts: texture, stains, speckle. HDR-CAM has its own camera: logarithmic pixels behind the same lens (IS1), and
the paper's IS2, which has lenses of f/7.6 and slower.
"""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanning import Recipe, StackHeader
from scanning.pipeline import warm_up
from scanning.pipeline.stream import ProfileStream
from scanning.precision import plane_residual
from scanning.rig.simulated.geometry import IS1, IS2, ImagingSystem
from scanning.rig.simulated.illumination import LaserLine
from scanning.rig.simulated.recorder import E1_US, stack_header
from scanning.rig.simulated.reflectivity import Uniform
from scanning.rig.simulated.render import Renderer
from scanning.rig.simulated.scenes import STEP_UM, Pose, Scene, scene

Float64 = NDArray[np.float64]
NAMES = ("NF", "SCI", "HDRE-I", "HDRE-II", "HDR-CAM", "PRECISE")
WRONG_PX = 4.0
CELL_IMAGES = 5
CELL_ROWS = 5
SEEDS = (301, 302, 303, 304, 305)
SLOPE_TOLERANCE = 0.01
WIDEST_EDGE_UM = 60.0
WALL_UM = 30.0
WALLS_APART_UM = 403.0
PHASES = 8
"""Scans a quarter of a pixel apart."""
END = 8
"""Profiles at either end of a scan that space-time analysis leaves as they are."""


def named(name: str) -> Recipe:
    """The recipe as shipped, but with a sliding SCI window: as many profiles as NF has, at the same cell."""
    recipe = Recipe.named(name)
    return recipe if recipe.compound is None else recipe.with_settings({"sci.mode": "sliding"})


# -- scans ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Optics:
    """A lens and a line. ``system`` is a row of the paper's Table 1, possibly with other pixels."""

    f_number: float
    width_is: str
    system: ImagingSystem = IS1

    def __str__(self) -> str:
        system = "" if self.system == IS1 else f"{self.system.name}, "
        return f"{system}f/{self.f_number:g}, {'FWHM' if self.width_is == 'fwhm' else '1/e2'}"

    def scene(self, name: str, seed: int, **options: Any) -> Scene:
        line = LaserLine(width_is="1/e2" if self.width_is == "1/e2" else "fwhm")
        return scene(name, seed=seed, system=self.system, f_number=self.f_number, line=line, **options)

    @property
    def um_per_px(self) -> float:
        return self.system.um_per_pixel


LINEAR = tuple(Optics(f, width) for width in ("fwhm", "1/e2") for f in (4.0, 5.6, 8.0))
LOG_IS1 = replace(IS1, name="IS1 log", response="logarithmic")
LOGARITHMIC = tuple(Optics(f, width, LOG_IS1) for width in ("fwhm", "1/e2") for f in (4.0, 5.6, 8.0)) + tuple(
    Optics(f, width, IS2) for width in ("fwhm", "1/e2") for f in (8.0, 14.0, 22.0)
)


@dataclass
class Found:
    """What one recipe made of a scan: (rows, profiles) columns, and the true ones at the same places."""

    column_px: Float64
    true_px: Float64
    window: int
    saturated: int
    pixels: int
    cpu_s: float

    @property
    def right(self) -> NDArray[np.bool_]:
        return np.abs(self.column_px - self.true_px) <= WRONG_PX

    @property
    def sound_px(self) -> Float64:
        """The columns without the wrong ones."""
        return np.where(self.right, self.column_px, np.nan)


def scanned(
    subject: Scene,
    recipes: Mapping[str, Recipe],
    *,
    rows: int,
    steps: int,
    exposures_us: Sequence[float] = E1_US,
    noise_seed: int = 0,
    offset_um: float = 0.0,
) -> dict[str, Found]:
    """Render every image once and push it through all recipes. ``offset_um``: where along the scan the first lies."""
    renderer = Renderer(subject, rows=rows)
    logarithmic = renderer.sensor.response == "logarithmic"
    exposures = [0.0] if logarithmic else list(exposures_us)
    told = stack_header(renderer, exposures, STEP_UM)
    header = _header(told, rows, renderer.columns, steps)
    streams = {name: ProfileStream(recipe, header) for name, recipe in recipes.items()}
    profiles: dict[str, list[Any]] = {name: [] for name in recipes}
    used = dict.fromkeys(recipes, 0.0)
    for step in range(steps):
        light = renderer.irradiance(offset_um + step * STEP_UM)
        images = [
            renderer.expose(light, time_us, np.random.default_rng((noise_seed, subject.seed, step, number)))
            for number, time_us in enumerate(exposures)
        ]
        for name, stream in streams.items():
            started = time.process_time()
            profiles[name] += stream.push(images)
            used[name] += time.process_time() - started
    y = subject.y_um(np.arange(rows, dtype=np.float64))[:, None]
    s = (offset_um + np.arange(steps, dtype=np.float64) * STEP_UM)[None, :]
    true = subject.system.column_px(subject.height_um(np.asarray(s), np.asarray(y)), renderer.columns)
    out: dict[str, Found] = {}
    for name, stream in streams.items():
        started = time.process_time()
        profiles[name] += stream.finish()
        used[name] += time.process_time() - started
        sci = recipes[name].compound
        window = 1 if sci is None else sci.window
        found = np.stack([p.column_px for p in profiles[name]], axis=1)
        first = window // 2
        out[name] = Found(
            column_px=found,
            true_px=true[:, first : first + found.shape[1]],
            window=window,
            saturated=sum(p.saturated for p in profiles[name]),
            pixels=sum(p.frame_pixels for p in profiles[name]),
            cpu_s=used[name],
        )
    return out


def _header(told: dict[str, Any], rows: int, columns: int, steps: int) -> StackHeader:
    return StackHeader(
        rows=rows,
        columns=columns,
        steps=steps,
        exposures_us=tuple(float(e) for e in told["exposures_us"]),
        step_um=told["step_um"],
        row_pitch_um=told["row_pitch_um"],
        mm_per_pixel=told["mm_per_pixel"],
        saturation=told["saturation"],
        line_width_px=told["line_width_px"],
        dark_level=told["dark_level"],
        response=told["response"],
    )


# -- the response -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Walls:
    """A plate that goes up and down by ``height_um`` every ``apart_um`` along the scan."""

    height_um_: float = WALL_UM
    apart_um: float = WALLS_APART_UM

    def height_um(self, s_um: Float64, y_um: Float64) -> Float64:
        up = np.floor(np.asarray(s_um) / self.apart_um).astype(np.int64) % 2
        return np.broadcast_to(self.height_um_ * up, np.broadcast(s_um, y_um).shape).astype(np.float64)

    def nominal_um(self, s_um: Float64, y_um: Float64) -> Float64:
        return self.height_um(s_um, y_um)

    def damage_number(self, s_um: Float64, y_um: Float64) -> NDArray[np.int16]:
        return np.zeros(np.broadcast(s_um, y_um).shape, dtype=np.int16)


@dataclass(frozen=True)
class Size:
    """How much is rendered per optics and seed: rows and steps of each kind of scan."""

    rows: int
    steps: int
    shift_rows: int = 500
    shift_steps: int = 50
    gauge_steps: int = 28
    wall_rows: int = 200
    gauge_rows: int = 1000
    wall_steps: int = 240


FULL = Size(rows=1000, steps=245)
QUICK = Size(
    rows=120, steps=30, shift_rows=60, shift_steps=24, gauge_steps=12, gauge_rows=300, wall_rows=40, wall_steps=110
)


def shifts(optics: Optics, seed: int, recipes: Mapping[str, Recipe], size: Size) -> dict[str, dict[float, Float64]]:
    """Slopes by recipe and by shift in px: one value per pair of scans so far apart."""
    flat = optics.scene("R1", seed, stray="none", tilt_across_deg=0.0, tilt_along_deg=0.0)
    edge = 30
    scans: list[dict[str, Found]] = []
    for k in range(PHASES):
        pose = replace(flat.pose, height_um=flat.pose.height_um + 0.25 * k * optics.um_per_px)
        raised = replace(flat, pose=pose)
        scans.append(scanned(raised, recipes, rows=size.shift_rows + edge, steps=size.shift_steps, noise_seed=k))
    slopes: dict[str, dict[float, Float64]] = {}
    for name in recipes:
        end = END if size.shift_steps > 4 * END else 2
        sound = [one[name].sound_px[edge:, end:-end] for one in scans]
        true = [one[name].true_px[edge:, end:-end] for one in scans]
        slopes[name] = {}
        for apart in (1, 2, 4):
            pairs = []
            for low in range(PHASES - apart):
                moved = sound[low + apart] - sound[low]
                both = np.isfinite(moved)
                pairs.append(moved[both].mean() / (true[low + apart] - true[low])[both].mean())
            slopes[name][0.25 * apart] = np.array(pairs)
    return slopes


def mean(values: Float64, axis: int) -> Float64:
    """The mean of what is finite, NaN where nothing is."""
    finite = np.isfinite(values)
    count = finite.sum(axis=axis)
    return np.asarray(np.where(count > 0, np.where(finite, values, 0.0).sum(axis=axis) / np.maximum(count, 1), np.nan))


@dataclass(frozen=True)
class Edges:
    """Measured over true height of every step, and its 10-90 % width in um."""

    slopes: Float64
    widths_um: Float64


def edges_of(profile_px: Float64, true_px: Float64, pitch_um: float, reach: int, least_px: float = 1.0) -> Edges:
    """The steps of one mean profile (n,), where its true columns jump by more than ``least_px``.

    Plateaus are the places from ``reach`` / 3 to ``reach`` from the wall on either side.
    """
    slopes, widths = [], []
    for wall in np.flatnonzero(np.abs(np.diff(true_px)) > least_px):
        first, last = wall + 1 - reach, wall + 1 + reach
        if first < 0 or last > true_px.size:
            continue
        near = reach // 3
        low, high = slice(first, wall + 1 - near), slice(wall + 1 + near, last)
        below, above = float(mean(profile_px[low], 0)), float(mean(profile_px[high], 0))
        slopes.append((above - below) / (true_px[high].mean() - true_px[low].mean()))
        risen = (profile_px[first:last] - below) / (above - below)
        at = np.arange(risen.size)[np.isfinite(risen)]
        risen = risen[at]
        middle = int(np.searchsorted(at, reach))
        crossed = [_crossing(at, risen, middle, share) for share in (0.1, 0.9)]
        widths.append((crossed[1] - crossed[0]) * pitch_um)
    return Edges(np.array(slopes), np.array(widths))


def _crossing(at: NDArray[np.int64], risen: Float64, middle: int, share: float) -> float:
    """Where the rise crosses ``share``, between samples, walking outwards from the wall: noise far off is no edge."""
    k = min(max(middle, 1), risen.size - 1)
    while share < 0.5 and k > 1 and risen[k - 1] > share:
        k -= 1
    while share > 0.5 and k < risen.size - 1 and risen[k] < share:
        k += 1
    while share < 0.5 and k < risen.size - 1 and risen[k] < share:
        k += 1
    while share > 0.5 and k > 1 and risen[k - 1] > share:
        k -= 1
    rise = risen[k] - risen[k - 1]
    return float(at[k - 1] + (at[k] - at[k - 1]) * ((share - risen[k - 1]) / rise if rise else 0.5))


def steps_along_line(optics: Optics, seed: int, recipes: Mapping[str, Recipe], size: Size) -> dict[str, Edges]:
    """The treads of the gauge: walls across the rows."""
    gauge = optics.scene("gauge", seed, stray="none")
    found = scanned(gauge, recipes, rows=min(size.gauge_rows, optics.system.rows), steps=size.gauge_steps)
    return {
        name: edges_of(mean(one.sound_px[:, 2:-2], axis=1), one.true_px[:, 0], optics.system.row_pitch_um, reach=24)
        for name, one in found.items()
    }


def steps_along_scan(optics: Optics, seed: int, recipes: Mapping[str, Recipe], size: Size) -> dict[str, Edges]:
    """Walls across the scan, each 30 um up or down."""
    plate = optics.scene("flat", seed, stray="none")
    walls = replace(plate, shape=Walls(), reflectivity=Uniform(), pose=Pose(height_um=plate.pose.height_um))
    found = scanned(walls, recipes, rows=size.wall_rows, steps=size.wall_steps)
    return {
        name: edges_of(mean(one.sound_px, axis=0), one.true_px[0], STEP_UM, reach=20) for name, one in found.items()
    }


# -- the noise --------------------------------------------------------------------------------------------------------


def averaged(error: Float64, profiles: int, rows: int) -> Float64:
    """Means of ``profiles`` neighbouring profiles (sliding) and ``rows`` neighbouring rows (blocks); NaN if one is."""
    if profiles > 1:
        error = np.lib.stride_tricks.sliding_window_view(error, profiles, axis=1).mean(axis=2)
    if rows > 1:
        whole = error[: error.shape[0] // rows * rows]
        error = whole.reshape(-1, rows, error.shape[1]).mean(axis=1)
    return error


def spread(error_um: Float64) -> tuple[float, float]:
    """Standard deviation about the least-squares plane, and 1.4826 MAD, of what is finite."""
    left = plane_residual(error_um)
    left = left[np.isfinite(left)]
    if left.size < 4:
        return float("nan"), float("nan")
    return float(left.std(ddof=3)), 1.4826 * float(np.median(np.abs(left - np.median(left))))


def noise(found: Found, um_per_px: float) -> dict[str, float]:
    """The figures of one recipe on one scan of R1."""
    visible = np.isfinite(found.true_px)
    missed = np.isnan(found.column_px)
    rows = found.column_px.shape[0]
    flat = slice(int(0.2 * rows), int(0.8 * rows))
    error = ((found.sound_px - found.true_px) * um_per_px)[flat]
    own, robust = spread(error)
    along = 1 if found.window > 1 else CELL_IMAGES
    return {
        "sigma": own,
        "robust": robust,
        "sigma_42x7": spread(averaged(error, along, 1))[0],
        "sigma_42x36": spread(averaged(error, along, CELL_ROWS))[0],
        "wrong": 100.0 * float(np.mean(visible & ~missed & ~found.right)) / float(np.mean(visible)),
        "undefined": 100.0 * float(np.mean(missed[visible])),
        "saturated": 100.0 * found.saturated / found.pixels,
        "ns": found.cpu_s / found.column_px.size * 1e9,
    }


def order_matters(one: Found, other: Found, um_per_px: float) -> dict[str, float]:
    """Of HDRE-I and HDRE-II on the same images: rms difference of the heights in um and their correlation."""
    difference = (one.sound_px - other.sound_px) * um_per_px
    both = np.isfinite(difference)
    a, b = (one.sound_px - one.true_px)[both], (other.sound_px - other.true_px)[both]
    return {
        "rms_um": float(np.sqrt(np.mean(difference[both] ** 2))),
        "median_um": float(np.median(np.abs(difference[both]))),
        "correlation": float(np.corrcoef(a, b)[0, 1]),
    }


# -- the tables -------------------------------------------------------------------------------------------------------


def _standard_error(values: Float64) -> float:
    return float(values.std(ddof=1) / np.sqrt(values.size)) if values.size > 1 else float("nan")


def _in_brackets(u: float) -> str:
    return f" ({u:.3f})" if np.isfinite(u) else ""


def _rule(kept: object) -> str:
    return "PASS" if kept else "FAIL"


@dataclass
class Response:
    """The slopes of one recipe behind one lens, seed after seed."""

    shifts: list[dict[float, Float64]] = field(default_factory=list)
    along_line: list[Edges] = field(default_factory=list)
    along_scan: list[Edges] = field(default_factory=list)

    def summary(self) -> dict[str, float | bool]:
        worst: dict[str, float | bool] = {}
        slopes = []
        for apart in (0.25, 0.5, 1.0):
            seen = np.array([one[apart] for one in self.shifts])
            pairs = seen.mean(axis=0)
            far = int(np.argmax(np.abs(pairs - 1.0)))
            slope = float(pairs[far])
            worst[f"shift_{apart:g}"] = slope
            worst[f"mean_{apart:g}"] = float(pairs.mean())
            worst[f"u_{apart:g}"] = _standard_error(seen[:, far])
            slopes.append(slope)
        worst["step_line"] = float(np.mean([one.slopes.mean() for one in self.along_line]))
        worst["step_scan"] = float(np.mean([one.slopes.mean() for one in self.along_scan]))
        worst["edge_line"] = float(np.mean([np.median(one.widths_um) for one in self.along_line]))
        worst["edge_scan"] = float(np.mean([np.median(one.widths_um) for one in self.along_scan]))
        slopes += [worst["step_line"], worst["step_scan"]]
        steady = all(abs(one - 1.0) <= SLOPE_TOLERANCE for one in slopes)
        worst["slope_passes"] = steady
        worst["edge_passes"] = max(worst["edge_line"], worst["edge_scan"]) <= WIDEST_EDGE_UM
        return worst


def recipes_for(optics: Optics, names: Sequence[str]) -> dict[str, Recipe]:
    log = optics.system.response == "logarithmic"
    return {name: named(name) for name in names if (name == "HDR-CAM") == log}


def response_table(
    all_optics: Sequence[Optics], seeds: Sequence[int], names: Sequence[str], size: Size
) -> Iterator[tuple[Optics, str, dict[str, float | bool]]]:
    """Print the first table row by row, and yield (optics, recipe, figures)."""
    titles = ("optics", "recipe", "shift 0.25 px", "0.5 px", "1 px", "step along line", "along scan",
              "10-90 % along line um", "along scan um", "slope rule", "edge rule")  # fmt: skip
    print(f"| {' | '.join(titles)} |\n{'|---' * len(titles)}|", flush=True)
    for optics in all_optics:
        recipes = recipes_for(optics, names)
        responses = {name: Response() for name in recipes}
        for seed in seeds:
            for kind, kept in (
                (shifts(optics, seed, recipes, size), "shifts"),
                (steps_along_line(optics, seed, recipes, size), "along_line"),
                (steps_along_scan(optics, seed, recipes, size), "along_scan"),
            ):
                for name, figures in kind.items():
                    getattr(responses[name], kept).append(figures)
        for name, response in responses.items():
            f = response.summary()
            shifted = " | ".join(
                f"{f[f'shift_{one}']:.3f}{_in_brackets(f[f'u_{one}'])}" for one in ("0.25", "0.5", "1")
            )
            print(
                f"| {optics} | {name} | {shifted} | {f['step_line']:.3f} | {f['step_scan']:.3f} | "
                f"{f['edge_line']:.0f} | {f['edge_scan']:.0f} | {_rule(f['slope_passes'])} | "
                f"{_rule(f['edge_passes'])} |",
                flush=True,
            )
            yield optics, name, f


def noise_table(
    all_optics: Sequence[Optics], seeds: Sequence[int], names: Sequence[str], size: Size, passed: Mapping[str, bool]
) -> Iterator[tuple[Optics, str, dict[str, float]]]:
    """Print the second table row by row; means over the seeds, and the spread over seeds of the first sigma."""
    titles = ("optics", "recipe", "slope rule", "own cell um", "sigma, own cell (robust)", "sigma 42 x 7 um",
              "sigma 42 x 36 um", "wrong %", "undefined %", "saturated %", "ns per range pixel")  # fmt: skip
    print(f"| {' | '.join(titles)} |\n{'|---' * len(titles)}|", flush=True)
    for optics in all_optics:
        recipes = recipes_for(optics, names)
        figures: dict[str, list[dict[str, float]]] = {name: [] for name in recipes}
        orders: list[dict[str, float]] = []
        for seed in seeds:
            subject = optics.scene("R1", seed)
            found = scanned(subject, recipes, rows=min(size.rows, optics.system.rows), steps=size.steps)
            for name, one in found.items():
                figures[name].append(noise(one, optics.um_per_px))
            if "HDRE-I" in found and "HDRE-II" in found:
                orders.append(order_matters(found["HDRE-I"], found["HDRE-II"], optics.um_per_px))
        pitch = optics.system.row_pitch_um
        for name, seen in figures.items():
            f = {key: float(np.mean([one[key] for one in seen])) for key in seen[0]}
            f["sigma_sd"] = float(np.std([one["sigma"] for one in seen], ddof=1)) if len(seen) > 1 else float("nan")
            along = STEP_UM * (1 if name == "NF" else CELL_IMAGES)
            verdict = _rule(passed.get(f"{optics} {name}"))
            print(
                f"| {optics} | {name} | {verdict} | {along:.1f} x {pitch:.1f} | {f['sigma']:.2f} ({f['robust']:.2f}) | "
                f"{f['sigma_42x7']:.2f} | {f['sigma_42x36']:.2f} | {f['wrong']:.2f} | {f['undefined']:.2f} | "
                f"{f['saturated']:.3f} | {f['ns']:.0f} |",
                flush=True,
            )
            yield optics, name, f
        if orders:
            f = {key: float(np.mean([one[key] for one in orders])) for key in orders[0]}
            yield optics, "HDRE-I against HDRE-II", f


def machine() -> str:
    """Processor, cores and commit, for the head of a table."""
    try:
        told = Path("/proc/cpuinfo").read_text()
        name = next(line.split(":", 1)[1].strip() for line in told.splitlines() if line.startswith("model name"))
    except (OSError, StopIteration):
        name = platform.processor() or platform.machine()
    here = Path(__file__).parent
    said = subprocess.run(["git", "describe", "--always", "--dirty"], cwd=here, capture_output=True, text=True)
    return f"{name}, Python {platform.python_version()}, commit {said.stdout.strip() or 'unknown'}"


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks precision",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--quick", action="store_true", help="one lens, one seed, small scans: does it run at all?")
    parser.add_argument("--seeds", type=int, default=len(SEEDS), help="how many seeds (default 5)")
    parser.add_argument("--recipes", default=",".join(NAMES), help="which recipes, comma between")
    parser.add_argument("--optics", help="only lenses whose name contains this, for example 'f/5.6, FWHM'")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write every figure to this file")
    chosen = parser.parse_args(arguments)
    names = chosen.recipes.split(",")
    seeds = SEEDS[:1] if chosen.quick else [301 + i for i in range(chosen.seeds)]
    size = QUICK if chosen.quick else FULL
    optics = [one for one in (*LINEAR, *LOGARITHMIC) if chosen.optics is None or chosen.optics in str(one)]
    if chosen.quick:
        optics = [one for one in optics if one.f_number == 5.6 and one.width_is == "fwhm"]
    optics = [one for one in optics if recipes_for(one, names)]
    warm_up()
    kept: dict[str, Any] = {"machine": machine(), "seeds": list(seeds), "response": {}, "noise": {}}
    small = " (quick: too few pixels for the verdicts to mean anything)" if chosen.quick else ""
    print(f"{kept['machine']}; seeds {seeds[0]} to {seeds[-1]}{small}\n\nResponse\n")
    for lens, name, response in response_table(optics, seeds, names, size):
        kept["response"][f"{lens} {name}"] = response
    print(f"\nNoise on R1, {size.rows} rows x {size.steps} steps (IS2: {IS2.rows} rows)\n")
    passed = {key: bool(one["slope_passes"]) for key, one in kept["response"].items()}
    for lens, name, figures in noise_table(optics, seeds, names, size, passed):
        kept["noise"][f"{lens} {name}"] = figures
    print("\nOrder of operations: heights by HDRE-I against those by HDRE-II, same images\n")
    for key, figures in kept["noise"].items():
        if "against" in key:
            print(f"- {key}: rms difference {figures['rms_um']:.2f} um, half of them under {figures['median_um']:.2f} "
                  f"um, errors correlated {figures['correlation']:.2f}")  # fmt: skip
    if chosen.json is not None:
        chosen.json.write_text(json.dumps(kept, indent=1) + "\n")
    return 0
