"""How many damages are found where there are none, and how many of the true ones: `python -m benchmarks damage`.

A recipe can be quieter and still report more damage, because the threshold follows the noise down while stray light
goes on pulling the line. Only counting against the scene's truth shows it. The seeds are not the demo's.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanning import Recipe, StackHeader
from scanning.optics import IS1, LINE_WIDTH_UM
from scanning.pipeline.stream import Profile, ProfileStream, heights_um
from scanning.range_image import RangeImage
from scanning.rig.simulated.render import Renderer
from scanning.rig.simulated.scenes import STEP_UM, Scene, scene
from scanning.surface import SurfaceReport, inspect_surface

SEEDS = (5101, 5102, 5103)
REGIONS = ("R1", "R2", "R3")
RECIPES = ("HDRE-II", "PRECISE")
EXPOSURES_US = (100.0, 300.0, 500.0, 700.0, 900.0)
ROWS, COLUMNS, STEPS = 1000, 256, 245
WEAR_UM = 10.0
#: A finding belongs to a true damage when their middles along the edge are this close, in mm.
NEAR_MM = 0.25


def recipe_named(name: str) -> Recipe:
    recipe = Recipe.named(name)
    sliding = recipe.compound is None or recipe.compound.mode == "sliding"
    return recipe if sliding else recipe.with_settings({"sci.mode": "sliding"})


def inspected(part: Scene, seed: int, recipes: tuple[str, ...] = RECIPES) -> dict[str, SurfaceReport]:
    """Scan a part once and inspect it with every recipe."""
    renderer = Renderer(part, rows=ROWS, columns=COLUMNS)
    header = StackHeader(
        rows=ROWS, columns=COLUMNS, steps=STEPS, exposures_us=EXPOSURES_US, step_um=STEP_UM,
        row_pitch_um=IS1.row_pitch_um, mm_per_pixel=IS1.mm_per_pixel, saturation=renderer.sensor.saturation,
        line_width_px=IS1.on_sensor_px(LINE_WIDTH_UM),
    )  # fmt: skip
    streams = {name: ProfileStream(recipe_named(name), header) for name in recipes}
    profiles: dict[str, list[Profile]] = {name: [] for name in recipes}
    for step in range(STEPS):
        light = renderer.irradiance(step * STEP_UM)
        images = [
            renderer.expose(light, exposure, np.random.default_rng((seed, step, number)))
            for number, exposure in enumerate(EXPOSURES_US)
        ]
        for name, stream in streams.items():
            profiles[name] += stream.push(images)
    reports = {}
    for name, stream in streams.items():
        profiles[name] += stream.finish()
        reports[name] = inspect_surface(_image(profiles[name], header))
    return reports


def _image(profiles: list[Profile], header: StackHeader) -> RangeImage:
    def grid(what: str) -> NDArray[np.float32]:
        return np.array([getattr(one, what) for one in profiles], dtype=np.float32).T

    column_px = grid("column_px")
    return RangeImage(
        column_px=column_px,
        height_um=heights_um(column_px.astype(np.float64), header, None).astype(np.float32),
        row_pitch_um=header.row_pitch_um,
        profile_pitch_um=header.step_um,
        intensity=grid("intensity"),
        width_px=grid("width_px"),
    )


def main(arguments: list[str]) -> int:
    if arguments:
        raise SystemExit("`python -m benchmarks damage` takes no arguments; seeds and recipes are named in its file.")
    print("| region | seed | recipe | sigma um | true | found of them | false | deepest false um |")
    print("|---|---|---|---|---|---|---|---|")
    for seed in SEEDS:
        for region in REGIONS:
            part = scene(region, seed=seed, wear_um=WEAR_UM, visit=1)
            reports, places = inspected(part, seed), [float(one["position_mm"]) for one in part.damage_truths()]
            for name, report in reports.items():
                # Profile n of a sliding window of five is the middle of steps n to n + 4.
                late_mm = 2 * STEP_UM * 1e-3
                left = list(report.damages)
                hits = 0
                for place in places:
                    near = [one for one in left if abs(one.s_centroid_mm + late_mm - place) < NEAR_MM]
                    if near:
                        hits += 1
                        left.remove(max(near, key=lambda one: one.volume_mm3))
                deepest = f"{max(one.depth_um for one in left):.0f}" if left else "-"
                print(
                    f"| {region} | {seed} | {name} | {report.sigma_um:.2f} | {len(places)} | {hits} | {len(left)} "
                    f"| {deepest} |",
                    flush=True,
                )
    return 0
