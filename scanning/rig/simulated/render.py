"""Scene and stage position in, light on the detector out.

The one place where the optical world is put together. What it returns is the mean rate of photo-electrons, so one
computed field serves a whole exposure bracket: in reality too only time and noise differ between its images.

The same position always gives the same speckle. Light is only computed where the line is; the rest of the frame holds
what a dark frame holds: room light, glare and stray reflections.
"""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
import scipy.ndimage
from numba import njit
from numpy.typing import NDArray

from scanning.errors import BadInput
from scanning.rig.protocols import Image
from scanning.rig.simulated.geometry import IS1, IS2, WORKING_HEIGHT_UM
from scanning.rig.simulated.randomness import grain_field
from scanning.rig.simulated.scenes import Scene, scene
from scanning.rig.simulated.sensor import Sensor, sensor_for
from scanning.rig.simulated.speckle import GUARD, SAMPLES_PER_PIXEL, CoherentCamera, speckle_tile

Float32 = NDArray[np.float32]
Complex64 = NDArray[np.complex64]

GRAIN_UM = 4.0
"""Pitch of the scattering grains along the scan: half the width of what an f/5.6 lens resolves."""
_GLARE_ROWS = 41
_GLARE_PX = 18.0


@njit(cache=True, nogil=True)
def _row_light(frame: Float32, first: int, last: int, energy: Float32, moment: Float32, ambient: float) -> None:
    for r in range(frame.shape[0]):
        for c in range(first, last):
            light = frame[r, c] - ambient
            energy[r] += light
            moment[r] += light * c


@njit(cache=True, nogil=True)
def _add_glare(frame: Float32, energy: Float32, moment: Float32, halo: Float32) -> None:
    for r in range(frame.shape[0]):
        if energy[r] <= 0.0:
            continue
        middle = int(moment[r] / energy[r] + 0.5)
        for c in range(frame.shape[1]):
            frame[r, c] += energy[r] * halo[abs(c - middle)]


def warm_up() -> None:
    """Compile everything a first frame needs, so that no camera seems silent for seconds on a fresh machine."""
    for system in (IS1, IS2):
        renderer = Renderer(scene("R2", system=system, wear_um=1.0), rows=32, columns=32)
        renderer.expose(renderer.irradiance(0.0), 100.0, np.random.default_rng(0))


class Renderer:
    """The light of one scene on a region of interest of ``rows`` x ``columns`` pixels.

    The region of interest is centred on the optical axis in the columns and starts at camera row 0. ``seed`` is the
    individual camera (its fixed pattern), not the part. ``sensor`` turns the result into images. Memory does not grow
    with the length of a scan. Not thread safe: one renderer per thread.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        rows: int | None = None,
        columns: int = 256,
        bits: int = 8,
        seed: int = 0,
        defocus_um: float = 0.0,
    ) -> None:
        rows = min(1000, scene.system.rows) if rows is None else rows
        if not (1 <= rows <= scene.system.rows and 16 <= columns <= scene.system.columns):
            raise BadInput(
                f"A frame of {rows} rows x {columns} columns does not fit the camera of {scene.system.name}; "
                f"use up to {scene.system.rows} rows and 16 to {scene.system.columns} columns."
            )
        self.scene = scene
        self.rows = rows
        self.columns = columns
        self.sensor: Sensor = sensor_for(scene.system, bits=bits, seed=seed, ambient_e_per_us=scene.ambient_e_per_us)
        self._camera = CoherentCamera(
            scene.system, rows=rows, columns=columns, grain_um=GRAIN_UM, defocus_um=defocus_um
        )
        row = (np.arange(self._camera.grain_rows) - GUARD) / SAMPLES_PER_PIXEL
        self._y_um = scene.y_um(row)
        self._strength = np.sqrt(scene.line.along(self._y_um, float(scene.y_um(np.asarray((rows - 1) / 2)))))
        part_y = self._y_um[0] - scene.pose.shift_across_um
        self._first_grain_row = round(part_y / (scene.system.row_pitch_um / SAMPLES_PER_PIXEL))
        self._lines: OrderedDict[int, tuple[Complex64, Float32]] = OrderedDict()
        halo = np.exp(-np.arange(columns + scene.system.columns) / _GLARE_PX)
        self._halo = np.asarray(scene.glare * halo / (2.0 * halo.sum()), dtype=np.float32)
        self._tile = speckle_tile(scene.system, 256, (scene.seed, 61)) if scene.reflections else None

    def irradiance(self, position_um: float, laser_on: bool = True) -> Float32:
        """Return photo-electrons per microsecond and pixel, float32 (rows, columns), with the stage at ``position_um``.

        The part's point s = ``position_um`` lies under the middle of the line.
        """
        if not np.isfinite(position_um):
            raise BadInput("The stage position must be a number of micrometres.")
        scene = self.scene
        frame = np.full((self.rows, self.columns), scene.ambient_e_per_us, dtype=np.float32)
        if not laser_on:
            return frame
        reach = scene.line.reach_um
        shift = scene.pose.shift_along_um
        first = int(np.ceil((position_um - reach - shift) / GRAIN_UM))
        last = int(np.floor((position_um + reach - shift) / GRAIN_UM))
        lines = [self._line(k) for k in range(first, last + 1)]
        x_um = np.asarray(np.arange(first, last + 1) * GRAIN_UM + (shift - position_um), dtype=np.float64)
        heights = np.stack([height for _, height in lines])
        if scene.pose.thermal_um_per_mm:
            heights += np.float32(scene.pose.thermal_um_per_mm * position_um * 1e-3)
        lit = self._camera.expose(
            frame,
            np.stack([grains for grains, _ in lines]),
            heights,
            x_um,
            scene.line.amplitude(x_um),
            scene.level_e_per_us,
        )
        if scene.glare > 0.0 and lit[0] < lit[1]:
            self._glare(frame, *lit)
        if self._tile is not None:
            for reflection in scene.reflections:
                reflection.add(frame, self._tile, position_um, scene.level_e_per_us)
        return frame

    def expose(self, irradiance: Float32, exposure_us: float, rng: np.random.Generator) -> Image:
        """Return the camera's image of ``irradiance``; same as ``self.sensor.expose``."""
        return self.sensor.expose(irradiance, exposure_us, rng)

    def _line(self, k: int) -> tuple[Complex64, Float32]:
        """Return strengths and heights (from the working height) of the k-th line of grains across the part."""
        if k in self._lines:
            self._lines.move_to_end(k)
            return self._lines[k]
        scene = self.scene
        s = np.full_like(self._y_um, k * GRAIN_UM + scene.pose.shift_along_um)
        height = np.asarray(scene.height_um(s, self._y_um) - WORKING_HEIGHT_UM, dtype=np.float32)
        strength = np.sqrt(scene.returned(s, self._y_um)) * self._strength
        grains = grain_field(scene.seed, k, self._first_grain_row, self._y_um.size)
        grains = grains * np.asarray(strength, dtype=np.float32)
        self._lines[k] = (grains, height)
        while len(self._lines) > 2 * int(2.0 * scene.line.reach_um / GRAIN_UM + 2):
            self._lines.popitem(last=False)
        return self._lines[k]

    def _glare(self, frame: Float32, first: int, last: int) -> None:
        """Add the faint halo that lens and cover glass put around the line."""
        energy = np.zeros(self.rows, dtype=np.float32)
        moment = np.zeros(self.rows, dtype=np.float32)
        _row_light(frame, first, last, energy, moment, self.scene.ambient_e_per_us)
        energy = scipy.ndimage.uniform_filter1d(energy, _GLARE_ROWS, mode="constant")
        moment = scipy.ndimage.uniform_filter1d(moment, _GLARE_ROWS, mode="constant")
        _add_glare(frame, energy, moment, self._halo)
