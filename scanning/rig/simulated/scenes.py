"""What can lie on the simulated rig, by name, and the truth about it.

A scene is one region of one part as it is mounted: shape, reflectivity, pose, laser line and the stray reflections of
the fixture. Its truth comes from the same closed forms that shape the surface, never from an image, so a measurement
can be judged against something it cannot have influenced.

    scene("R2", seed=7, wear_um=120, visit=3)

is region R2 of knife 7 with 120 um of edge recession, laid on the rig for the third time (every visit lies a few
micrometres differently). A new scene is one function below and one line in `SCENES`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from scanning.errors import BadInput
from scanning.rig.simulated.geometry import IS1, SYSTEMS, WORKING_HEIGHT_UM, ImagingSystem
from scanning.rig.simulated.illumination import LaserLine
from scanning.rig.simulated.reflectivity import GroundSteel, Reflectivity, Treads, Uniform
from scanning.rig.simulated.spurious import Arc, Reflection, SecondLine, Spot
from scanning.rig.simulated.surface import Bevel, Damage, Plate, Shape, Staircase, measure_damage

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

STEP_UM = 8.33
"""The paper's scan step, 17 motor steps of 0.49 um."""
EDGE_MARGIN_UM = 143.0
"""How far the frame looks beyond the as-new edge: 20 rows on IS1, 2 % of a region."""
GAUGE_HEIGHTS_UM = (140.0, 250.0, 360.0, 440.0, 550.0, 640.0, 745.0)
"""The step gauge of the paper's Table 2."""
LEVEL_E_PER_US = 7.0
"""Peak of the line on plain ground steel, photo-electrons per microsecond and pixel: 60 of 255 codes in 0.3 ms."""


@dataclass(frozen=True)
class Pose:
    """How the part lies: mounting height over the rig's datum, tilts, and shifts from its nominal place.

    ``thermal_um_per_mm`` is the drift of the stand-off while the scan goes on, an error of the rig and so no part of
    the truth.
    """

    height_um: float = WORKING_HEIGHT_UM
    tilt_across_deg: float = 0.0
    tilt_along_deg: float = 0.0
    shift_along_um: float = 0.0
    shift_across_um: float = 0.0
    thermal_um_per_mm: float = 0.0

    def plane_um(self, s_um: Float64, y_um: Float64) -> Float64:
        """Return the height of the mounted part's own plane at rig coordinates."""
        return np.asarray(
            self.height_um
            + math.tan(math.radians(self.tilt_across_deg)) * (y_um - 3500.0)
            + math.tan(math.radians(self.tilt_along_deg)) * (s_um - 1000.0)
        )


@dataclass(frozen=True)
class Truth:
    """What a perfect instrument would have measured, on the grid of the scan images (rows, steps).

    ``height_um`` over the rig's datum, NaN where no surface is; ``deviation_um`` from the as-new surface;
    ``column_px`` where the middle of the line falls; ``damage_number`` 0 or i + 1 for ``damages[i]``;
    ``reflectivity`` relative to plain ground steel.
    """

    height_um: Float32
    deviation_um: Float32
    column_px: Float32
    visible: NDArray[np.bool_]
    damage_number: NDArray[np.int16]
    reflectivity: Float32
    row_pitch_um: float
    step_um: float
    damages: list[dict[str, Any]]

    def save(self, path: Path) -> None:
        """Write everything to one compressed npz; ``damages_json`` holds the list of damages as text."""
        with path.open("wb") as file:
            np.savez_compressed(
                file,
                height_um=self.height_um,
                deviation_um=self.deviation_um,
                column_px=self.column_px,
                visible=self.visible,
                damage_mask=self.damage_number > 0,
                damage_number=self.damage_number,
                reflectivity=self.reflectivity,
                row_pitch_um=self.row_pitch_um,
                step_um=self.step_um,
                damages_json=json.dumps(self.damages),
            )


@dataclass(frozen=True)
class Scene:
    """One region of a part on the rig, in coordinates of the rig: s along the scan, y = 0 where an as-new edge lies."""

    name: str
    seed: int
    system: ImagingSystem
    shape: Shape
    reflectivity: Reflectivity
    pose: Pose = field(default_factory=Pose)
    line: LaserLine = field(default_factory=LaserLine)
    reflections: tuple[Reflection, ...] = ()
    damages: tuple[Damage, ...] = ()
    margin_um: float = 0.0
    level_e_per_us: float = LEVEL_E_PER_US
    ambient_e_per_us: float = 0.01
    glare: float = 0.015
    settings: dict[str, Any] = field(default_factory=dict)

    def y_um(self, row: Float64) -> Float64:
        """Return the distance of camera rows from the as-new edge."""
        return np.asarray(row * self.system.row_pitch_um - self.margin_um)

    def height_um(self, s_um: Float64, y_um: Float64) -> Float64:
        """Return the height over the rig's datum at rig coordinates, NaN where there is no surface."""
        pose = self.pose
        own = self.shape.height_um(s_um - pose.shift_along_um, y_um - pose.shift_across_um)
        return np.asarray(own + pose.plane_um(s_um, y_um))

    def returned(self, s_um: Float64, y_um: Float64) -> Float64:
        """Return the reflectivity at rig coordinates, including that of damages."""
        s, y = s_um - self.pose.shift_along_um, y_um - self.pose.shift_across_um
        value = self.reflectivity(s, y)
        for damage in self.damages:
            value = np.where(damage.depth_at(s, y) > 0.0, value * damage.reflectivity, value)
        return value

    def truth(self, *, rows: int = 1000, steps: int = 245, step_um: float = STEP_UM, columns: int = 256) -> Truth:
        """Return the truth on the grid of ``steps`` scan images; column numbers for frames ``columns`` wide."""
        y = self.y_um(np.arange(rows, dtype=np.float64))[:, None]
        height = np.empty((rows, steps), dtype=np.float32)
        deviation = np.empty_like(height)
        column = np.empty_like(height)
        number = np.empty((rows, steps), dtype=np.int16)
        returned = np.empty_like(height)
        pose = self.pose
        for first in range(0, steps, 64):
            part = slice(first, min(first + 64, steps))
            s = (np.arange(part.start, part.stop, dtype=np.float64) * step_um)[None, :]
            z = self.height_um(s, y)
            own = (s - pose.shift_along_um, y - pose.shift_across_um)
            height[:, part] = z
            deviation[:, part] = z - pose.plane_um(s, y) - self.shape.nominal_um(*own)
            column[:, part] = self.system.column_px(z, columns)
            number[:, part] = self.shape.damage_number(*own)
            returned[:, part] = self.returned(s, y)
        return Truth(
            height_um=height,
            deviation_um=deviation,
            column_px=column,
            visible=np.isfinite(height),
            damage_number=number,
            reflectivity=returned,
            row_pitch_um=self.system.row_pitch_um,
            step_um=step_um,
            damages=self.damage_truths(),
        )

    def damage_truths(self) -> list[dict[str, Any]]:
        """Return one plain dictionary per damage: what it is, where it lies on the rig, and its true size."""
        truths: list[dict[str, Any]] = []
        for damage in self.damages:
            samples = 4001
            s = damage.s_um + damage.length_um * ((np.arange(samples) + 0.5) / samples - 0.5)
            worn = self.shape.recession_um(s) if isinstance(self.shape, Bevel) else np.zeros(samples)
            true = measure_damage(damage, worn, samples)
            severity = "large"
            if damage.length_um < 200 and true.depth_um < 50:
                severity = "minor"
            elif damage.length_um < 1000 and true.depth_um < 150:
                severity = "medium"
            truths.append(
                {
                    "kind": damage.kind,
                    "severity": severity,
                    "position_mm": (damage.s_um + self.pose.shift_along_um) * 1e-3,
                    "from_edge_mm": (damage.y_um + self.pose.shift_across_um) * 1e-3,
                    "length_mm": damage.length_um * 1e-3,
                    "reach_mm": damage.reach_um * 1e-3,
                    "depth_um": true.depth_um,
                    "volume_mm3": true.volume_mm3,
                    "volume_removed_mm3": true.volume_removed_mm3,
                    "recession_um": true.recession_um,
                    "reflectivity": damage.reflectivity,
                }
            )
        return truths

    def parameters(self) -> dict[str, Any]:
        """Return everything that made this scene, JSON-serialisable."""
        return {
            "scene": self.name,
            "seed": self.seed,
            "system": asdict(self.system),
            "pose": asdict(self.pose),
            "line": asdict(self.line),
            "reflections": [{"kind": type(r).__name__, **vars(r)} for r in self.reflections],
            "margin_um": self.margin_um,
            "level_e_per_us": self.level_e_per_us,
            "ambient_e_per_us": self.ambient_e_per_us,
            "glare": self.glare,
            **self.settings,
        }


Stray = Literal["none", "moderate", "busy", "hard"]

REFLECTIONS: dict[str, tuple[Reflection, ...]] = {
    "none": (),
    "moderate": (
        SecondLine(0.62, 0.70, -46.0, 0.02, 2.6, 0.3, drift_px_per_mm=-3.0),
        Spot(0.30, 58.0, 5.0, 4.0, 3.0, drift_px_per_mm=2.0),
        Spot(0.88, -76.0, 8.0, 6.0, 1.5),
        Arc(0.16, 46.0, 62.0, 2.0, -65.0, 55.0, 2.5),
    ),
    "busy": (
        SecondLine(0.56, 0.80, -46.0, 0.02, 2.6, 0.45, drift_px_per_mm=-3.0),
        Spot(0.30, 55.0, 7.0, 5.0, 3.0, drift_px_per_mm=2.0),
        Spot(0.87, -72.0, 10.0, 8.0, 1.5),
        Arc(0.16, 40.0, 62.0, 2.0, -65.0, 55.0, 2.5),
    ),
    "hard": (
        SecondLine(0.10, 0.30, 24.0, -0.03, 1.2, 2.0, drift_px_per_mm=5.0),
        SecondLine(0.42, 0.66, -30.0, 0.26, 2.4, 0.8, drift_px_per_mm=-3.0),
        SecondLine(0.68, 0.84, 11.0, 0.01, 5.0, 1.2, drift_px_per_mm=1.5),
        Spot(0.36, 13.0, 9.0, 6.0, 5.0),
        Spot(0.62, -9.0, 5.0, 3.0, 3.0, drift_px_per_mm=4.0),
        Spot(0.90, -22.0, 14.0, 9.0, 6.0),
        Arc(0.22, -86.0, 62.0, 2.5, -60.0, 60.0, 4.0),
    ),
}


@dataclass(frozen=True)
class SceneOptions:
    """Everything a scene can be asked for; see `scene`."""

    seed: int
    system: ImagingSystem
    wear_um: float
    visit: int
    decades: float
    stray: Stray
    tilt_across_deg: float
    tilt_along_deg: float
    thermal_um_per_mm: float
    texture_um: float
    damages: tuple[Damage, ...] | None
    line: LaserLine

    def pose(self, region: int, height_um: float = WORKING_HEIGHT_UM) -> Pose:
        """Return the pose at this visit: visit 0 lies as asked for, every other one is laid anew."""
        along = across = lift = turn = 0.0
        if self.visit:
            rng = np.random.default_rng((self.seed, region, 41, self.visit))
            along, across, lift = (float(v) for v in rng.normal(0.0, (20.0, 12.0, 8.0)))
            turn = float(rng.normal(0.0, 0.02))
        return Pose(
            height_um=height_um + lift,
            tilt_across_deg=self.tilt_across_deg + turn,
            tilt_along_deg=self.tilt_along_deg,
            shift_along_um=along,
            shift_across_um=across,
            thermal_um_per_mm=self.thermal_um_per_mm,
        )


def _bevel(name: str, region: int, usual: tuple[Damage, ...], options: SceneOptions) -> Scene:
    seed = 1000 * options.seed + region
    damages = usual if options.damages is None else options.damages
    shape = Bevel(seed, damages, wear_um=options.wear_um, texture_um=options.texture_um)
    return Scene(
        name,
        seed,
        options.system,
        shape,
        GroundSteel(seed, decades=options.decades),
        pose=options.pose(region),
        line=options.line,
        reflections=REFLECTIONS[options.stray],
        damages=damages,
        margin_um=EDGE_MARGIN_UM,
    )


def _sound_edge(options: SceneOptions) -> Scene:
    return _bevel("R1", 1, (), options)


def _chipped_edge(options: SceneOptions) -> Scene:
    usual = (
        Damage("chip", s_um=430.0, length_um=420.0, reach_um=230.0, depth_um=112.0, reflectivity=1.6),
        Damage("dent", s_um=1090.0, length_um=340.0, reach_um=150.0, depth_um=72.0, y_um=420.0, reflectivity=0.6),
        Damage("chip", s_um=1620.0, length_um=150.0, reach_um=110.0, depth_um=42.0, reflectivity=1.3),
    )
    return _bevel("R2", 2, usual, options)


def _broken_edge(options: SceneOptions) -> Scene:
    usual = (Damage("chip", s_um=1000.0, length_um=1300.0, reach_um=430.0, depth_um=240.0, reflectivity=1.4),)
    return _bevel("R3", 3, usual, options)


def _flat_plate(options: SceneOptions) -> Scene:
    seed = 1000 * options.seed + 8
    look: Reflectivity = GroundSteel(seed, decades=options.decades) if options.decades else Uniform()
    return Scene(
        "flat",
        seed,
        options.system,
        Plate(seed, options.texture_um),
        look,
        pose=options.pose(8),
        line=options.line,
        reflections=REFLECTIONS[options.stray],
    )


def _step_gauge(options: SceneOptions) -> Scene:
    seed = 1000 * options.seed + 9
    heights = (0.0, *GAUGE_HEIGHTS_UM)
    tread_um = min(options.system.rows, 1000) * options.system.row_pitch_um / len(heights)
    brightness = 10.0 ** np.random.default_rng((seed, 51)).normal(0.0, 0.12 * options.decades, len(heights))
    return Scene(
        "gauge",
        seed,
        options.system,
        Staircase(heights, tread_um),
        Treads(tuple(float(v) for v in brightness), tread_um),
        pose=options.pose(9, height_um=0.0),
        line=options.line,
        reflections=REFLECTIONS[options.stray],
    )


SCENES: dict[str, Callable[[SceneOptions], Scene]] = {
    "R1": _sound_edge,
    "R2": _chipped_edge,
    "R3": _broken_edge,
    "gauge": _step_gauge,
    "flat": _flat_plate,
}
_DEFAULT_STRAY: dict[str, Stray] = {"R1": "moderate", "R2": "moderate", "R3": "moderate"}


def scene(
    name: str,
    *,
    seed: int = 1,
    system: ImagingSystem | str = IS1,
    f_number: float | None = None,
    wear_um: float = 0.0,
    visit: int = 0,
    decades: float | None = None,
    stray: Stray | None = None,
    tilt_across_deg: float | None = None,
    tilt_along_deg: float | None = None,
    thermal_um_per_mm: float = 0.0,
    texture_um: float | None = None,
    damages: tuple[Damage, ...] | None = None,
    line: LaserLine | None = None,
) -> Scene:
    """Return the scene ``name`` (R1 sharp edge, R2 two medium and one minor damage, R3 one large, gauge, flat).

    ``seed`` is the individual part: its texture, stains and speckle. ``wear_um`` mean edge recession. ``visit`` lays
    the part on the rig anew (0: exactly as asked). ``decades`` scales the spread of reflectivity (0 uniform; 1 for the
    knife and the gauge, 0 for the plate). ``stray`` reflections: none, moderate (the knife's default), busy, hard.
    Tilts in degrees (knife 0.4 across, 0.1 along; others 0). ``texture_um`` Sq of the grinding marks (0.35 on the
    knife). ``damages`` replaces the scene's own. Raises BadInput for anything unknown.
    """
    if name not in SCENES:
        raise BadInput(f"There is no scene {name!r}; choose one of {', '.join(SCENES)}.")
    if isinstance(system, str):
        if system not in SYSTEMS:
            raise BadInput(f"There is no imaging system {system!r}; choose one of {', '.join(SYSTEMS)}.")
        system = SYSTEMS[system]
    stray = _DEFAULT_STRAY.get(name, "none") if stray is None else stray
    if stray not in REFLECTIONS:
        raise BadInput(f"There are no stray reflections {stray!r}; choose one of {', '.join(REFLECTIONS)}.")
    knife = name in ("R1", "R2", "R3")
    if (wear_um or damages is not None) and not knife:
        raise BadInput(f"The scene {name!r} has no edge that could be worn or damaged; use R1, R2 or R3.")
    if seed < 0 or visit < 0:
        raise BadInput("The seed and the visit of a scene are whole numbers from 0 upwards.")
    options = SceneOptions(
        seed=seed,
        system=system.with_f_number(f_number),
        wear_um=wear_um,
        visit=visit,
        decades=(0.0 if name == "flat" else 1.0) if decades is None else decades,
        stray=stray,
        tilt_across_deg=(0.4 if knife else 0.0) if tilt_across_deg is None else tilt_across_deg,
        tilt_along_deg=(0.1 if knife else 0.0) if tilt_along_deg is None else tilt_along_deg,
        thermal_um_per_mm=thermal_um_per_mm,
        texture_um=(0.35 if knife else 0.0) if texture_um is None else texture_um,
        damages=damages,
        line=line if line is not None else LaserLine(),
    )
    made = SCENES[name](options)
    made.settings.update({"wear_um": wear_um, "visit": visit, "decades": options.decades, "stray": stray})
    made.settings["texture_um"] = options.texture_um
    return made
