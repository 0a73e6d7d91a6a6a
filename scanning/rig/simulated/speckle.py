"""Coherent imaging: from light scattered by single grains of the surface to the irradiance of camera pixels.

Laser speckle is what limits this instrument, and it is not noise of the camera: it is fixed to the surface, the same in
every exposure, and moves with the tool under the line. Adding independent noise per frame would promise a gain of
sqrt(5) from averaging five scan images where the real one is 1.7. So the light is computed as light: every grain of the
surface scatters with its own fixed complex strength, the fields add at their exact places on the detector, the lens
pupil passes what it can, and only then is the modulus squared and summed over each pixel.

The field is sampled twice per pixel, which carries all frequencies behind the pupil. Grains sit on a grid fixed to the
tool and fall between the samples; they are spread with a short kernel whose attenuation is divided out again (the
gridding step of a non-uniform FFT), accurate to better than 1e-3 of the field.
"""

from __future__ import annotations

import numpy as np
import scipy.fft
from numba import njit
from numpy.typing import NDArray

from scanning.rig.simulated.geometry import ImagingSystem

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Complex64 = NDArray[np.complex64]

SAMPLES_PER_PIXEL = 2
GUARD = 8
"""Samples simulated beyond the first and the last camera row, so that these see both their neighbours."""
_TAPS = 4
_BETA = 9.2
_BINS = 2048
_SIDE = {"linear": 32, "logarithmic": 96}
"""Free samples on either side of the line: the field must have faded before it meets itself on the periodic grid. A
logarithmic camera still sees the pupil's diffraction far from the line, where a linear one reads zero."""


def _spreading_table() -> Float32:
    """Return the spreading kernel exp(beta (sqrt(1 - x^2) - 1)) at (bins, taps)."""
    offset = np.arange(_BINS)[:, None] / _BINS + 1.0 - np.arange(_TAPS)[None, :]
    x = np.clip(1.0 - (offset / (_TAPS / 2)) ** 2, 0.0, None)
    inside = np.abs(offset) <= _TAPS / 2
    return np.asarray(np.where(inside, np.exp(_BETA * (np.sqrt(x) - 1.0)), 0.0), dtype=np.float32)


def _spreading_response(frequency: Float64) -> Float64:
    """Return the continuous Fourier transform of the spreading kernel, frequency in cycles per sample."""
    x = np.linspace(-1.0, 1.0, 4001)
    kernel = np.exp(_BETA * (np.sqrt(np.clip(1.0 - x**2, 0.0, None)) - 1.0))
    half = _TAPS / 2
    return np.asarray(
        np.trapezoid(kernel * np.cos(2 * np.pi * frequency[:, None] * x * half), x * half, axis=1), dtype=np.float64
    )


def _pixel_weights() -> Float32:
    """Return the 7 weights that integrate two samples per pixel over one pixel, centred on it.

    The pixel's response sinc(f) is expanded in cosines of half pixels and the expansion cut with a cosine taper; for
    the frequencies behind an f/5.6 pupil it is right within 1 %.
    """
    f = (np.arange(4000) + 0.5) / 4000
    weights = np.array([np.mean(np.sinc(f) * np.cos(np.pi * n * f)) for n in range(4)])
    weights[1:] *= np.cos(np.pi * np.arange(1, 4) / 9.0)
    full = np.concatenate([weights[:0:-1], weights])
    return np.asarray(full / full.sum(), dtype=np.float32)


def _disc(rows: int, columns: int, cutoff: float) -> Float32:
    """Return the share of each frequency cell inside the pupil, (columns, rows); cutoff in cycles per sample."""
    sub = (np.arange(8) - 3.5) / 8
    f_row = scipy.fft.fftfreq(rows)
    f_column = scipy.fft.fftfreq(columns)
    share = np.zeros((columns, rows), dtype=np.float32)
    for a in sub:
        for b in sub:
            r2 = (f_column[:, None] + a / columns) ** 2 + (f_row[None, :] + b / rows) ** 2
            share += r2 <= cutoff**2
    return np.asarray(share / 64.0, dtype=np.float32)


@njit(cache=True, nogil=True)
def _spread(
    field: Complex64,
    grains: Complex64,
    heights: Float32,
    x_um: Float32,
    amplitude: Float32,
    table: Float32,
    sin_b: float,
    cos_b: float,
    stand_off_um: float,
    samples_per_um: float,
    origin: float,
) -> None:
    """Add every grain (lines, rows) to ``field`` (samples across, rows) where the camera sees it."""
    bins, taps = table.shape
    last = field.shape[0] - taps
    for k in range(grains.shape[0]):
        x = x_um[k]
        a = amplitude[k]
        for i in range(grains.shape[1]):
            z = heights[k, i]
            if not np.isfinite(z):
                continue
            t = origin + samples_per_um * (x * sin_b + z * cos_b) / (1.0 - (z * sin_b - x * cos_b) / stand_off_um)
            whole = int(np.floor(t))
            j = whole - 1
            if j < 0 or j > last:
                continue
            g = a * grains[k, i]
            row = table[int((t - whole) * bins)]
            field[j, i] += row[0] * g
            field[j + 1, i] += row[1] * g
            field[j + 2, i] += row[2] * g
            field[j + 3, i] += row[3] * g


@njit(cache=True, nogil=True)
def _to_pixels(
    field: Complex64, weights: Float32, guard: int, scale: float, rows: int, first_column: int, frame: Float32
) -> None:
    """Square the field, integrate over pixels and add to ``frame`` (rows, columns) from column ``first_column``."""
    half = weights.size // 2
    across = np.empty(field.shape[1], dtype=np.float32)
    pixels = (field.shape[0] - 2 * half) // 2
    for c in range(pixels):
        column = first_column + c
        if column < 0 or column >= frame.shape[1]:
            continue
        across[:] = 0.0
        for tap in range(weights.size):
            w = weights[tap]
            line = field[2 * c + tap]
            for i in range(across.size):
                across[i] += w * (line[i].real ** 2 + line[i].imag ** 2)
        for r in range(rows):
            centre = guard + 2 * r
            total = np.float32(0.0)
            for tap in range(weights.size):
                total += weights[tap] * across[centre - half + tap]
            # The cut expansion undershoots by a hair beside the very brightest grains.
            frame[r, column] += scale * max(total, np.float32(0.0))


class CoherentCamera:
    """Images grains through the lens pupil onto ``rows`` x ``columns`` pixels; holds no state but tables.

    ``defocus_um`` is the distance of the surface from best focus along the axis: a quadratic phase over the pupil.
    """

    def __init__(
        self, system: ImagingSystem, *, rows: int, columns: int, grain_um: float, defocus_um: float = 0.0
    ) -> None:
        self._system = system
        self._rows = rows
        self._columns = columns
        self._grain_um = grain_um
        self._defocus_um = defocus_um
        self._table = _spreading_table()
        self._weights = _pixel_weights()
        self._field_rows = scipy.fft.next_fast_len(self.grain_rows + 2 * GUARD)
        sample_um = system.pixel_um / SAMPLES_PER_PIXEL
        self._cutoff = sample_um / (2.0 * system.wavelength_um * system.working_f_number)
        self._pupils: dict[int, tuple[Complex64, float]] = {}

    @property
    def grain_rows(self) -> int:
        """Rows of grains to hand in: two per camera row and a guard on both ends."""
        return SAMPLES_PER_PIXEL * self._rows + 2 * GUARD

    def _pupil(self, columns: int) -> tuple[Complex64, float]:
        """Return the pupil for a strip ``columns`` samples wide, and the factor that makes a plain surface 1."""
        if columns not in self._pupils:
            disc = _disc(self._field_rows, columns, self._cutoff)
            fill = float(np.mean(disc.astype(np.float64) ** 2))
            f2 = scipy.fft.fftfreq(columns)[:, None] ** 2 + scipy.fft.fftfreq(self._field_rows)[None, :] ** 2
            system = self._system
            sample_um = system.pixel_um / SAMPLES_PER_PIXEL
            image_defocus_um = self._defocus_um * system.magnification**2
            phase = -np.pi * system.wavelength_um * image_defocus_um * f2 / sample_um**2
            response = _spreading_response(scipy.fft.fftfreq(columns))[:, None]
            pupil = np.asarray(disc * np.exp(1j * phase) / response, dtype=np.complex64)
            grains_per_sample = system.travel_per_pixel_um / SAMPLES_PER_PIXEL / self._grain_um
            self._pupils[columns] = (pupil, 1.0 / (grains_per_sample * fill))
        return self._pupils[columns]

    def expose(
        self, frame: Float32, grains: Complex64, heights_um: Float32, x_um: Float64, amplitude: Float64, level: float
    ) -> tuple[int, int]:
        """Add the image of the lit grains to ``frame``; return the columns (first, behind last) that were touched.

        ``grains`` and ``heights_um`` (from the working height, NaN where nothing is) are (lines, grain_rows), one line
        of grains per entry of ``x_um`` and ``amplitude``. A plain surface under an even light of amplitude 1 comes out
        as ``level``.
        """
        if not np.isfinite(heights_um).any():
            return 0, 0
        low = float(np.nanmin(heights_um))
        high = float(np.nanmax(heights_um))
        sin_b, cos_b, stand_off_um, per_um = self._system.projection()
        middle = (self._columns - 1) / 2.0
        corners = [
            middle + per_um * (x * sin_b + z * cos_b) / (1.0 - (z * sin_b - x * cos_b) / stand_off_um)
            for x in (float(x_um.min()), float(x_um.max()))
            for z in (low, high)
        ]
        side = _SIDE[self._system.response] // SAMPLES_PER_PIXEL
        first = int(np.floor(min(corners))) - side
        last = int(np.ceil(max(corners))) + side
        # Widths in steps of 16 samples, so that only a few pupils are ever built.
        width = SAMPLES_PER_PIXEL * (last - first)
        width = scipy.fft.next_fast_len(width + (-width) % 16)
        field = np.zeros((width, self._field_rows), dtype=np.complex64)
        _spread(
            field,
            grains,
            heights_um,
            np.asarray(x_um, dtype=np.float32),
            np.asarray(amplitude, dtype=np.float32),
            self._table,
            sin_b,
            cos_b,
            stand_off_um,
            SAMPLES_PER_PIXEL * per_um,
            SAMPLES_PER_PIXEL * (middle - first),
        )
        pupil, gain = self._pupil(width)
        self._filter(field, pupil)
        half = self._weights.size // 2
        skip = (half + 1) // SAMPLES_PER_PIXEL
        _to_pixels(
            field[SAMPLES_PER_PIXEL * skip - half :],
            self._weights,
            GUARD,
            level * gain,
            self._rows,
            first + skip,
            frame,
        )
        return max(first, 0), min(last, self._columns)

    def _filter(self, field: Complex64, pupil: Complex64) -> None:
        """Pass ``field`` through the pupil in place. Only the row frequencies inside the pupil are carried across."""
        keep = int(np.ceil(self._cutoff * self._field_rows)) + 2
        n = self._field_rows
        spectrum = scipy.fft.fft(field, axis=1, overwrite_x=True)
        inside = np.concatenate([spectrum[:, :keep], spectrum[:, n - keep :]], axis=1)
        inside = scipy.fft.fft(inside, axis=0, overwrite_x=True)
        inside *= np.concatenate([pupil[:, :keep], pupil[:, n - keep :]], axis=1)
        inside = scipy.fft.ifft(inside, axis=0, overwrite_x=True)
        spectrum[:] = 0.0
        spectrum[:, :keep] = inside[:, :keep]
        spectrum[:, n - keep :] = inside[:, keep:]
        field[:] = scipy.fft.ifft(spectrum, axis=1, overwrite_x=True)


def speckle_tile(system: ImagingSystem, size: int, seed: tuple[int, ...]) -> Float32:
    """Return a periodic (size, size) tile of fully developed speckle seen through the pupil, mean 1, per pixel."""
    n = SAMPLES_PER_PIXEL * size
    rng = np.random.default_rng(seed)
    white = rng.standard_normal((n, n, 2), dtype=np.float32).view(np.complex64)[..., 0]
    cutoff = system.pixel_um / SAMPLES_PER_PIXEL / (2.0 * system.wavelength_um * system.working_f_number)
    field = scipy.fft.ifft2(scipy.fft.fft2(white) * _disc(n, n, cutoff))
    intensity = np.abs(field) ** 2
    pixels = intensity.reshape(size, 2, size, 2).mean(axis=(1, 3))
    return np.asarray(pixels / pixels.mean(), dtype=np.float32)
