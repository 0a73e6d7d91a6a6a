"""From photo-electrons to grey values: what the camera adds and what it takes away.

Both sensors are fed with the mean rate of photo-electrons per pixel, so that a whole exposure bracket, in which only
time and noise differ, reuses one computed light field.

The number of electrons is Poisson and the read noise Gaussian. Their sum is drawn as one normal number of variance
``mean + read_noise^2``: with 9 electrons of read noise the sum's skewness stays below 0.05 at every level, far under
one 8-bit code of 35 electrons.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scanning.errors import BadInput
from scanning.rig.protocols import Image
from scanning.rig.simulated.geometry import ImagingSystem

Float32 = NDArray[np.float32]


class Sensor(Protocol):
    @property
    def bits(self) -> int: ...
    @property
    def saturation(self) -> int: ...
    @property
    def response(self) -> Literal["linear", "logarithmic"]: ...
    @property
    def dark_level(self) -> float: ...
    def expose(self, irradiance: Float32, exposure_us: float, rng: np.random.Generator) -> Image:
        """Return the (rows, columns) image of ``irradiance`` in photo-electrons per microsecond and pixel."""
        ...


@njit(cache=True, nogil=True)
def _linear(
    irradiance: Float32,
    gain_map: Float32,
    offset_map: Float32,
    normal: Float32,
    exposure_us: float,
    read_e: float,
    full_well_e: float,
    codes_per_e: float,
    dark: float,
    saturation: int,
    out: Image,
) -> None:
    read2 = np.float32(read_e**2)
    for i in range(out.size):
        mean = irradiance[i] * gain_map[i] * np.float32(exposure_us)
        electrons = mean + np.sqrt(mean + read2) * normal[i]
        if electrons >= full_well_e:
            out[i] = saturation
        else:
            code = np.floor(dark + offset_map[i] + codes_per_e * electrons + 0.5)
            out[i] = int(min(max(code, 0.0), float(saturation)))


@njit(cache=True, nogil=True)
def _logarithmic(
    irradiance: Float32,
    offset_map: Float32,
    normal: Float32,
    codes_per_decade: float,
    floor_rate: float,
    noise: float,
    saturation: int,
    out: Image,
) -> None:
    for i in range(out.size):
        code = codes_per_decade * np.log10(1.0 + irradiance[i] / floor_rate) + offset_map[i] + noise * normal[i]
        out[i] = int(min(max(np.floor(code + 0.5), 0.0), float(saturation)))


def _pattern(cache: dict[tuple[int, ...], Float32], shape: tuple[int, ...], seed: tuple[int, ...]) -> Float32:
    if shape not in cache:
        cache[shape] = np.random.default_rng(seed).standard_normal(shape, dtype=np.float32)
    return cache[shape]


def _check(irradiance: Float32, exposure_us: float) -> Float32:
    if irradiance.ndim != 2:
        raise BadInput(f"An irradiance must be (rows, columns), not {irradiance.ndim}-dimensional.")
    if not np.isfinite(exposure_us) or exposure_us < 0:
        raise BadInput(f"An exposure of {exposure_us:g} us is not possible.")
    return np.ascontiguousarray(irradiance, dtype=np.float32)


@dataclass(frozen=True)
class LinearSensor:
    """A CMOS sensor whose grey value is proportional to light, of 60 dB (full well over read noise).

    ``dark_level`` is in grey values of the chosen ``bits``. Gain and offset differ slightly from pixel to pixel, fixed
    for one camera (``seed``). There is no blooming: a full pixel does not spill into its neighbours.
    """

    bits: int = 8
    full_well_e: float = 9000.0
    read_noise_e: float = 9.0
    dark_current_e_per_us: float = 0.002
    dark_share: float = 2.0 / 255.0
    gain_spread: float = 0.005
    offset_spread_e: float = 4.0
    seed: int = 0
    response: Literal["linear", "logarithmic"] = "linear"
    _gain: dict[tuple[int, ...], Float32] = field(default_factory=dict, init=False, repr=False, compare=False)
    _offset: dict[tuple[int, ...], Float32] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.bits not in (8, 10, 12, 14, 16):
            raise BadInput(f"The simulated camera has 8, 10, 12, 14 or 16 bits, not {self.bits}.")

    @property
    def saturation(self) -> int:
        return int(2**self.bits - 1)

    @property
    def dark_level(self) -> float:
        return round(self.dark_share * self.saturation, 3)

    @property
    def codes_per_e(self) -> float:
        return (self.saturation - self.dark_level) / self.full_well_e

    def expose(self, irradiance: Float32, exposure_us: float, rng: np.random.Generator) -> Image:
        light = _check(irradiance, exposure_us)
        if exposure_us == 0:
            raise BadInput("A linear camera needs an exposure above 0 us.")
        shape = light.shape
        if shape not in self._gain:
            spread = _pattern({}, shape, (self.seed, 31))
            self._gain[shape] = np.asarray(1.0 + self.gain_spread * spread, dtype=np.float32)
            fixed = _pattern({}, shape, (self.seed, 32))
            self._offset[shape] = np.asarray(self.codes_per_e * self.offset_spread_e * fixed, dtype=np.float32)
        out: Image = np.empty(shape, dtype=np.uint8 if self.bits == 8 else np.uint16)
        dark_e = self.dark_current_e_per_us * exposure_us
        _linear(
            light.ravel(),
            self._gain[shape].ravel(),
            self._offset[shape].ravel(),
            rng.standard_normal(light.size, dtype=np.float32),
            exposure_us,
            float(np.sqrt(self.read_noise_e**2 + dark_e)),
            self.full_well_e,
            self.codes_per_e,
            self.dark_level + self.codes_per_e * dark_e,
            self.saturation,
            out.reshape(-1),
        )
        return out


@dataclass(frozen=True)
class LogarithmicSensor:
    """Photovoltaic pixels in open circuit: the grey value follows the logarithm of light, without exposure time.

    ``floor_e_per_us`` is the rate at which the response bends away from zero; the brightest light, ``range_db`` above
    it (20 log10), fills the codes. Noise of such pixels is constant in the logarithm.
    """

    bits: int = 8
    floor_e_per_us: float = 0.01
    range_db: float = 120.0
    noise_share: float = 0.4 / 255.0
    fixed_share: float = 0.3 / 255.0
    ambient_e_per_us: float = 0.01
    seed: int = 0
    response: Literal["linear", "logarithmic"] = "logarithmic"
    _offset: dict[tuple[int, ...], Float32] = field(default_factory=dict, init=False, repr=False, compare=False)

    @property
    def saturation(self) -> int:
        return int(2**self.bits - 1)

    @property
    def codes_per_decade(self) -> float:
        return self.saturation * 20.0 / self.range_db

    @property
    def dark_level(self) -> float:
        """Grey value of a pixel that sees only the room."""
        return round(self.codes_per_decade * float(np.log10(1.0 + self.ambient_e_per_us / self.floor_e_per_us)), 2)

    def expose(self, irradiance: Float32, exposure_us: float, rng: np.random.Generator) -> Image:
        light = _check(irradiance, exposure_us)
        fixed = _pattern(self._offset, light.shape, (self.seed, 33))
        out: Image = np.empty(light.shape, dtype=np.uint8 if self.bits == 8 else np.uint16)
        _logarithmic(
            light.ravel(),
            fixed.ravel() * np.float32(self.fixed_share * self.saturation),
            rng.standard_normal(light.size, dtype=np.float32),
            self.codes_per_decade,
            self.floor_e_per_us,
            self.noise_share * self.saturation,
            self.saturation,
            out.reshape(-1),
        )
        return out


def sensor_for(system: ImagingSystem, *, bits: int = 8, seed: int = 0, ambient_e_per_us: float = 0.01) -> Sensor:
    """Return the sensor that belongs to an imaging system."""
    if system.response == "logarithmic":
        return LogarithmicSensor(bits=bits, seed=seed, ambient_e_per_us=ambient_e_per_us)
    return LinearSensor(bits=bits, seed=seed)
