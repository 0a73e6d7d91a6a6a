"""Random surfaces that depend on nothing but the seed and the place.

A real tool looks the same whenever it is visited, in whatever order. Drawing random numbers while rendering would
tie the surface to the order of the frames; here every value belongs to a point of the tool.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]
Complex64 = NDArray[np.complex64]

_LATTICE = 128


@njit(cache=True, nogil=True)
def _spline_noise(table: Float64, u: Float64, v: Float64, out: Float64) -> None:
    n = table.shape[0]
    w_u = np.empty(4)
    w_v = np.empty(4)
    for i in range(u.size):
        iu = int(np.floor(u[i]))
        iv = int(np.floor(v[i]))
        fu = u[i] - iu
        fv = v[i] - iv
        for w, f in ((w_u, fu), (w_v, fv)):
            w[0] = (1.0 - f) ** 3 / 6.0
            w[1] = (3.0 * f**3 - 6.0 * f**2 + 4.0) / 6.0
            w[2] = (-3.0 * f**3 + 3.0 * f**2 + 3.0 * f + 1.0) / 6.0
            w[3] = f**3 / 6.0
        total = 0.0
        for a in range(4):
            for b in range(4):
                total += w_u[a] * w_v[b] * table[(iu + a - 1) % n, (iv + b - 1) % n]
        out[i] = total


class SmoothNoise:
    """A smooth Gaussian random field of unit variance over the plane, with cells of a given size.

    Cubic B-spline over a lattice of independent normal numbers, repeating after 128 cells.
    """

    def __init__(self, seed: tuple[int, ...], cell_u_um: float, cell_v_um: float | None = None) -> None:
        rng = np.random.default_rng(seed)
        self._table = rng.standard_normal((_LATTICE, _LATTICE))
        self._cell = (cell_u_um, cell_v_um if cell_v_um is not None else cell_u_um)
        # Mean over a cell of the sum of squared spline weights, per direction.
        self._table /= 151.0 / 315.0

    def __call__(self, u_um: Float64, v_um: Float64) -> Float64:
        """Return the field at the points (u, v), in micrometres; the two broadcast against each other."""
        u, v = np.broadcast_arrays(u_um / self._cell[0], v_um / self._cell[1])
        out = np.empty(u.size)
        _spline_noise(self._table, np.ascontiguousarray(u).ravel(), np.ascontiguousarray(v).ravel(), out)
        return out.reshape(u.shape)


def grain_field(seed: int, column: int, first_row: int, rows: int) -> Complex64:
    """Return the scattering strengths of one line of grains across the tool, complex64 of shape (rows,).

    Circular complex normal with mean |g|^2 = 1: what a metal surface rougher than the wavelength does to laser light
    (fully developed speckle). The numbers belong to the grains (column, first_row ...), however many are asked for.
    """
    skip = first_row + GRAIN_ROWS_BEFORE
    if skip < 0:
        raise ValueError(f"grain row {first_row} lies before the first one, {-GRAIN_ROWS_BEFORE}")
    rng = np.random.default_rng((seed, 0x5BEC, column + 2**31))
    pairs = rng.standard_normal(2 * (skip + rows), dtype=np.float32)[2 * skip :]
    field: Complex64 = pairs.view(np.complex64) * np.float32(np.sqrt(0.5))
    return field


GRAIN_ROWS_BEFORE = 1024
"""How many rows of grains exist before row 0, so that a part laid shifted on the rig still has a surface there."""
