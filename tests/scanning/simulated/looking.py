"""How the tests look at simulated light: a centroid of their own, so that no product code judges the simulator."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanning.rig.simulated.render import Renderer

Array = NDArray[np.float64]


def centroid(frame: NDArray[np.float32], start_px: Array | float, half_px: float = 7.0, rounds: int = 5) -> Array:
    """Return the centre of gravity of each row in a window of +-``half_px`` that follows it."""
    rows, columns = frame.shape
    column = np.arange(columns)[None, :]
    middle = np.broadcast_to(np.asarray(start_px, dtype=np.float64), (rows,)).copy()
    for _ in range(rounds):
        light = frame * np.clip(half_px + 0.5 - np.abs(column - middle[:, None]), 0.0, 1.0)
        middle = (light * column).sum(axis=1) / light.sum(axis=1)
    return middle


def scan(renderer: Renderer, steps: int, step_um: float = 8.33, first_um: float = 0.0) -> NDArray[np.float32]:
    """Return the light of ``steps`` positions without room light, (steps, rows, columns)."""
    frames = np.stack([renderer.irradiance(first_um + step_um * i) for i in range(steps)])
    return frames - np.float32(renderer.scene.ambient_e_per_us)


def correlation(error: Array, lag: int, axis: int) -> float:
    """Return the autocorrelation of a mean-free field at one lag along one axis."""
    n = error.shape[axis]
    a = np.take(error, np.arange(n - lag), axis=axis)
    b = np.take(error, np.arange(lag, n), axis=axis)
    return float((a * b).mean() / (error**2).mean())
