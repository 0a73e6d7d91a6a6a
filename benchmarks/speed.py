"""What a range pixel costs, beside what reading its bytes costs, all in one run on one machine.

A range pixel is one row of one profile. Times alone say more about the machine than about the program, so every figure
stands beside a ratio: to reading the same frames from memory, to NF, to the same operations in NumPy and in OpenCV. All
methods take turns and the best of several rounds counts, and one thread's cost is processor time, so a busy neighbour
hits none of them alone; what two threads gain is of wall time, and means something only on an idle machine.

The frames are simulated scan images of R1 with stray light, all different and many times the size of the cache. The
NumPy reference is the float64 one the tests hold the product to, one equation after the other; it is slow, so it gets a
few frames only. Recipes with SCI run sliding (one profile per step), where a range pixel reads one step's images.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from scanning import ProfileStream, Recipe, StackHeader
from scanning.pipeline import warm_up
from scanning.rig.protocols import Image
from scanning.rig.simulated.recorder import E1_US
from scanning.rig.simulated.render import Renderer
from scanning.rig.simulated.scenes import STEP_UM, scene

Frames = NDArray[np.uint8]
DARK, WIDTH_PX, EXPOSURE = 2.0, 3.03, 1
LITERAL = {"msnn.reading": "literal"}
SLIDING = {"sci.mode": "sliding"}


def simulated(steps: int, rows: int, columns: int, seed: int = 21) -> Frames:
    """(steps, exposures, rows, columns) scan images of R1 in the paper's bracket, with moderate stray light."""
    renderer = Renderer(scene("R1", seed=seed, stray="moderate", wear_um=10.0), rows=rows, columns=columns, bits=8)
    out = np.empty((steps, len(E1_US), rows, columns), np.uint8)
    for step in range(steps):
        light = renderer.irradiance(step * STEP_UM)
        for e, exposure in enumerate(E1_US):
            out[step, e] = renderer.expose(light, exposure, np.random.default_rng((seed, step, e)))
    return out


def header_of(frames: Frames, exposures_us: Sequence[float]) -> StackHeader:
    return StackHeader(
        rows=frames.shape[2], columns=frames.shape[3], steps=len(frames), exposures_us=tuple(exposures_us),
        step_um=STEP_UM, row_pitch_um=7.150838, mm_per_pixel=0.01430168, line_width_px=WIDTH_PX, dark_level=DARK,
    )  # fmt: skip


@nb.njit(nogil=True)
def total(words: NDArray[np.uint64]) -> Any:
    """Every byte is read and nothing else is done."""
    out = np.uint64(0)
    for i in range(words.size):
        out += words[i]
    return out


@dataclass(frozen=True)
class Method:
    """Something that turns frames into range pixels: ``run`` returns how many. ``bytes_read`` per range pixel."""

    name: str
    run: Callable[[], int]
    rounds: int = 0


def in_turn(methods: Sequence[Method], rounds: int) -> tuple[dict[str, float], dict[str, float]]:
    """Best processor time and best wall time per range pixel of every method, ns; they take turns."""
    cpu: dict[str, float] = {}
    wall: dict[str, float] = {}
    for turn in range(rounds):
        for method in methods:
            if turn >= (method.rounds or rounds):
                continue
            wall_started, started = time.perf_counter(), time.process_time()
            pixels = method.run()
            used, took = time.process_time() - started, time.perf_counter() - wall_started
            cpu[method.name] = min(used / pixels * 1e9, cpu.get(method.name, np.inf))
            wall[method.name] = min(took / pixels * 1e9, wall.get(method.name, np.inf))
    return cpu, wall


def extraction(
    frames: Frames, name: str, settings: dict[str, str] | None = None, exposures: int | None = None
) -> Callable[[], int]:
    """The product: one recipe over all frames; returns rows x profiles."""
    recipe = Recipe.named(name).with_settings({**(SLIDING if Recipe.named(name).compound else {}), **(settings or {})})
    bracket = recipe.hdre is not None
    count = exposures or len(E1_US)
    header = header_of(frames, E1_US[:count] if bracket else (E1_US[EXPOSURE],))

    def run() -> int:
        stream = ProfileStream(recipe, header)
        profiles = 0
        for images in frames:
            profiles += len(stream.push(list(images[:count]) if bracket else [images[EXPOSURE]]))
        return int((profiles + len(stream.finish())) * header.rows)

    return run


def at_once(count: int, make: Callable[[int], Callable[[], int]]) -> Callable[[], int]:
    """``count`` threads, each with its own part of the work."""
    runs = [make(n) for n in range(count)]

    def run() -> int:
        done = [0] * count

        def one(n: int) -> None:
            done[n] = runs[n]()

        threads = [threading.Thread(target=one, args=(n,)) for n in range(count)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return sum(done)

    return run


def reading(frames: Frames) -> Callable[[], int]:
    """Reading every byte of these frames; returns the rows of the single images read."""
    words = frames.reshape(-1).view(np.uint64)

    def run() -> int:
        total(words)
        return int(np.prod(frames.shape[:3]))

    return run


def reference(frames: Frames, name: str, settings: dict[str, str] | None = None) -> Callable[[], int]:
    """The float64 NumPy reference of the tests over a few frames; returns rows x profiles."""
    from tests.scanning.pipeline import agreement

    recipe = Recipe.named(name).with_settings({**(SLIDING if Recipe.named(name).compound else {}), **(settings or {})})
    bracket = recipe.hdre is not None
    header = header_of(frames, E1_US if bracket else (E1_US[EXPOSURE],))
    steps: list[list[NDArray[Any]]] = [list(images) if bracket else [images[EXPOSURE]] for images in frames]
    return lambda: int(agreement.reference(steps, header, recipe).size)


def by_opencv(frames: Frames, extract: Callable[[Frames, int, float], NDArray[np.float64]]) -> Callable[[], int]:
    def run() -> int:
        for images in frames:
            extract(images[EXPOSURE], int(DARK), WIDTH_PX)
        return int(len(frames) * frames.shape[2])

    return run


def agreeing(frames: Frames, extract: Callable[[Frames, int, float], NDArray[np.float64]], reading: str) -> float:
    """Share of the rows, in percent, in which a variant says the same as the product to 0.001 px."""
    recipe = Recipe.named("NF").with_settings({"msnn.reading": reading})
    stream = ProfileStream(recipe, header_of(frames, (E1_US[EXPOSURE],)))
    same = []
    for images in frames:
        ours = stream.push([images[EXPOSURE]])[0].column_px
        other = extract(images[EXPOSURE], int(DARK), WIDTH_PX)
        same.append((np.abs(ours - other) < 1e-3) | (np.isnan(ours) & np.isnan(other)))
    return 100.0 * float(np.mean(same))


def machine() -> str:
    """Processor, cores, versions and the commit this ran on."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [line.split(":", 1)[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        model = f"{names[0]}, {len(names)} cores" if names else model
    root = Path(__file__).resolve().parents[1]
    load = f"load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "load unknown"
    git = subprocess.run(["git", "-C", str(root), "describe", "--always", "--dirty"], capture_output=True, text=True)
    return (
        f"{model}; Python {platform.python_version()}, NumPy {np.__version__}, numba {nb.__version__}; "
        f"{load}; commit {git.stdout.strip() or 'unknown'}"
    )


def table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|", *(f"| {' | '.join(row)} |" for row in rows)]
    return "\n".join(lines) + "\n"


OURS: tuple[tuple[str, str, dict[str, str]], ...] = (
    ("NF", "NF", {}),
    ("NF, literal MSNN", "NF", LITERAL),
    ("SCI", "SCI", {}),
    ("HDRE-I", "HDRE-I", {}),
    ("HDRE-II", "HDRE-II", {}),
    ("PRECISE", "PRECISE", {}),
)


def methods(frames: Frames, rounds: int) -> str:
    """The main table: every recipe, its references, and reading alone."""
    from benchmarks import by_opencv as opencv

    few = np.ascontiguousarray(frames[:6])
    half = len(frames) // 2
    parts = [frames[:half], frames[half : 2 * half]]
    entries = [
        Method("read", reading(frames)),
        Method("read, 2 threads", at_once(2, lambda n: reading(parts[n]))),
        *(Method(label, extraction(frames, name, settings)) for label, name, settings in OURS),
        *(
            Method(f"{label}, 2 threads", at_once(2, lambda n, a=name, s=settings: extraction(parts[n], a, s)))  # type: ignore[misc]
            for label, name, settings in OURS
        ),
        Method("opencv NF", by_opencv(few, opencv.shipped), 3),
        Method("opencv NF, literal MSNN", by_opencv(few, opencv.literal), 3),
        Method("numpy NF", reference(frames[:2], "NF"), 1),
        Method("numpy NF, literal MSNN", reference(frames[:2], "NF", LITERAL), 1),
        Method("numpy HDRE-II", reference(frames[:6], "HDRE-II"), 1),
    ]
    ns, wall = in_turn(entries, rounds)
    read = ns["read"]
    gb_s = frames.shape[3] / read
    gain = wall["read"] / wall["read, 2 threads"]
    two = f"{gb_s * gain:.1f} GB/s with two (gain {gain:.2f})"
    out = [f"Reading memory: {gb_s:.1f} GB/s with one thread ({read:.1f} ns per row of one image), {two}.\n"]
    rows = []
    for label, name, settings in OURS:
        own = ns[label]
        images = len(E1_US) if Recipe.named(name).hdre is not None else 1
        reading_label = "NF, literal MSNN" if settings == LITERAL else "NF"
        rows.append([
            label, f"{own:.0f}", f"{own / ns[reading_label]:.2f}", f"{100.0 * images * read / own:.1f}",
            f"{ns[f'numpy {label}'] / own:.0f}" if f"numpy {label}" in ns else "",
            f"{ns[f'opencv {label}'] / own:.0f}" if f"opencv {label}" in ns else "",
            f"{wall[label] / wall[f'{label}, 2 threads']:.2f}",
        ])  # fmt: skip
    titles = (
        "method", "ns per range pixel", "x NF", "% of read bandwidth", "x faster than NumPy", "than OpenCV + NumPy",
        "gain of 2 threads",
    )  # fmt: skip
    out.append(table(titles, rows))
    others = [[name, f"{ns[name]:.0f}"] for name in ns if name.startswith(("numpy", "opencv"))]
    out.append(table(("reference", "ns per range pixel"), others))
    out.append(
        f"The OpenCV + NumPy variant agrees with NF in {agreeing(few, opencv.shipped, 'shipped'):.1f} % of the rows, "
        f"with literal MSNN in {agreeing(few, opencv.literal, 'literal'):.1f} %.\n"
    )
    return "\n".join(out)


def linearity(rounds: int) -> tuple[str, dict[str, list[tuple[float, float]]]]:
    """Cost over rows, columns, steps and exposures: microseconds per step, but per scan for steps."""
    whole = simulated(40, 1000, 512, seed=22)
    cases: dict[str, list[tuple[float, Callable[[], int]]]] = {"rows": [], "columns": [], "steps": [], "exposures": []}
    for rows in (125, 250, 500, 1000):
        cases["rows"].append((rows, extraction(np.ascontiguousarray(whole[:, :, :rows, :256]), "HDRE-II")))
    for columns in (64, 128, 256, 512):
        cases["columns"].append((columns, extraction(np.ascontiguousarray(whole[..., :columns]), "HDRE-II")))
    narrow = np.ascontiguousarray(whole[..., :256])
    for steps in (10, 20, 40):
        cases["steps"].append((steps, extraction(narrow[:steps], "HDRE-II")))
    for exposures in (2, 3, 4, 5):
        cases["exposures"].append((exposures, extraction(narrow, "HDRE-II", exposures=exposures)))
    best: dict[tuple[str, float], float] = {}
    for _ in range(rounds):
        for what, runs in cases.items():
            for size, run in runs:
                started = time.perf_counter()
                run()
                took = time.perf_counter() - started
                best[what, size] = min(took, best.get((what, size), np.inf))
    curves = {what: [(size, best[what, size] * 1e3) for size, _ in runs] for what, runs in cases.items()}
    rows_out = []
    for what, curve in curves.items():
        sizes, took = np.array(curve).T
        slope, start = np.polyfit(sizes, took, 1)
        off = float(np.max(np.abs(took - (slope * sizes + start)) / took[-1]))
        rows_out.append([
            what, ", ".join(f"{s:g}: {t:.1f}" for s, t in curve), f"{100.0 * start / took[-1]:.0f}",
            f"{100.0 * off:.0f}",
        ])  # fmt: skip
    titles = ("HDRE-II over", "ms per scan", "start, % of the largest", "furthest from a straight line, %")
    return table(titles, rows_out), curves


def latency(frames: Frames) -> str:
    """How long after the last frame the last column of the range image is there, and the slowest step."""
    rows = []
    for label, name, settings in OURS:
        recipe = Recipe.named(name).with_settings({**(SLIDING if Recipe.named(name).compound else {}), **settings})
        bracket = recipe.hdre is not None
        stream = ProfileStream(recipe, header_of(frames, E1_US if bracket else (E1_US[EXPOSURE],)))
        took = []
        for images in frames:
            started = time.perf_counter()
            stream.push(list(images) if bracket else [images[EXPOSURE]])
            took.append(time.perf_counter() - started)
        started = time.perf_counter()
        stream.finish()
        last = took[-1] + time.perf_counter() - started
        frames_s = (len(E1_US) if bracket else 1) / float(np.median(took))
        rows.append(
            [label, f"{last * 1e3:.1f}", f"{np.median(took) * 1e3:.2f}", f"{max(took) * 1e3:.1f}", f"{frames_s:.0f}"]
        )
    return table(("method", "last column after, ms", "median step, ms", "slowest step, ms", "frames/s"), rows)


class Repeated:
    """A long stack out of few frames, for the memory of a full scan: frames come from nowhere and are not kept."""

    def __init__(self, frames: Frames, steps: int) -> None:
        self._frames = frames
        self.header = StackHeader(**{**header_of(frames, E1_US).__dict__, "steps": steps})

    def step(self, index: int) -> list[Image]:
        return [image.copy() for image in self._frames[index % len(self._frames)]]

    def __iter__(self) -> Iterator[list[Image]]:
        return (self.step(i) for i in range(self.header.steps))

    def sha256(self) -> str:
        return "0" * 64


def peak_mb() -> float:
    """Peak resident memory of this process, MB; what the process it was forked from once used does not count."""
    status = Path("/proc/self/status")
    if status.exists():
        return int(status.read_text().split("VmHWM:")[1].split()[0]) / 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def memory_of(name: str, steps: int, rows: int, columns: int) -> dict[str, float]:
    """Peak memory of this process after processing such a stack, MB; run in a process of its own."""
    from scanning import process_stack

    frames = simulated(3, min(rows, 1000), 256)
    if (rows, columns) != frames.shape[2:]:
        frames = np.ascontiguousarray(np.tile(frames, (1, 1, -(-rows // frames.shape[2]), -(-columns // 256))))
        frames = np.ascontiguousarray(frames[:, :, :rows, :columns])
    warm_up()
    before = peak_mb()
    recipe = Recipe.named(name)
    recipe = recipe.with_settings(SLIDING) if recipe.compound is not None else recipe
    image = process_stack(Repeated(frames, steps), recipe)
    peak = peak_mb()
    return {"before": before, "peak": peak, "ns": image.wall_s / image.height_um.size * 1e9}


def memory() -> str:
    rows_out = []
    for name, steps, rows, columns in (
        ("HDRE-II", 1205, 1000, 256), ("PRECISE", 1205, 1000, 256), ("HDRE-II", 60, 1536, 2048),
    ):  # fmt: skip
        call = f"memory_of({name!r}, {steps}, {rows}, {columns})"
        code = f"import json; from benchmarks.speed import memory_of; print(json.dumps({call}))"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        got = json.loads(done.stdout.splitlines()[-1])
        size = steps * len(E1_US) * rows * columns / 1e6
        rows_out.append([
            f"{name}, {steps} steps x {len(E1_US)} x {rows} x {columns}", f"{size:.0f}", f"{got['before']:.0f}",
            f"{got['peak']:.0f}",
        ])  # fmt: skip
    return table(("stack", "its size, MB", "after start and kernels, MB", "peak, MB"), rows_out)


def plot(curves: dict[str, list[tuple[float, float]]]) -> str:
    """The four curves as one SVG: small, diffable, and shown by every browser without anything installed."""
    width, height, gap = 230, 200, 46
    box = f"0 0 {4 * (width + gap) + 20} {height + 70}"
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{box}" font-family="sans-serif" font-size="12">',
        '<rect width="100%" height="100%" fill="white"/>',
    ]
    for n, (what, curve) in enumerate(curves.items()):
        left, bottom = 50 + n * (width + gap), height + 24
        most_x, most_y = max(x for x, _ in curve), max(y for _, y in curve) * 1.1
        points = [(left + x / most_x * (width - 20), bottom - y / most_y * height) for x, y in curve]
        slope, start = np.polyfit([x for x, _ in curve], [y for _, y in curve], 1)
        line = [(left + x / most_x * (width - 20), bottom - (start + slope * x) / most_y * height) for x in (0, most_x)]
        parts.append(f'<path d="M{left} 24V{bottom}H{left + width - 10}" fill="none" stroke="#444"/>')
        ends = "L".join(f"{x:.1f} {y:.1f}" for x, y in line)
        parts.append(f'<path d="M{ends}" stroke="#9ab" fill="none"/>')
        for (x, y), (size, took) in zip(points, curve, strict=True):
            parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="#1565c0"/>')
            parts.append(f'<text x="{x:.1f}" y="{bottom + 16}" text-anchor="middle">{size:g}</text>')
            parts.append(f'<text x="{x - 6:.1f}" y="{y - 8:.1f}" text-anchor="end">{took:.0f}</text>')
        parts.append(f'<text x="{left + width / 2:.0f}" y="{bottom + 36}" text-anchor="middle">{what}</text>')
    parts.append('<text x="8" y="16">ms per scan, HDRE-II sliding</text></svg>')
    return "\n".join(parts) + "\n"


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks speed", description=__doc__)
    parser.add_argument("--steps", type=int, default=160, help="stage positions simulated (default 160: 205 MB)")
    parser.add_argument("--rounds", type=int, default=5, help="rounds of which the best counts (default 5)")
    parser.add_argument("--only", choices=("methods", "latency", "linearity", "memory"), help="only this part")
    parser.add_argument("--plot", metavar="FILE", type=Path, help="write the linearity plot there, as SVG")
    chosen = parser.parse_args(arguments)

    def wanted(part: str) -> bool:
        return chosen.only in (None, part)

    warm_up()
    print(f"{machine()}\n", flush=True)
    if wanted("methods") or wanted("latency"):
        frames = simulated(chosen.steps, 1000, 256)
        if wanted("methods"):
            print(methods(frames, chosen.rounds), flush=True)
        if wanted("latency"):
            print(latency(frames), flush=True)
    if wanted("linearity"):
        text, curves = linearity(chosen.rounds)
        print(text, flush=True)
        if chosen.plot is not None:
            chosen.plot.write_text(plot(curves), encoding="utf-8")
    if wanted("memory"):
        print(memory(), flush=True)
    return 0
