"""GLT, grey level transformation, eq. (7): T(g) = g_sat (log(g+1) / log(g_sat+1))^p, g_sat = 255, p = 0.5.

It lifts the dim flanks of the line towards its bright middle so that weak and strong rows look alike. T(0) = 0, so a
subtracted dark level stays dark; a dark level that was not subtracted does not (a code of 3 becomes 127 of 255 at
p = 0.5). T is not scale free: g must run 0..255, which is why HDRE rescales.

Grey values behind HDRE or GLT are kept as whole multiples of 2^-20 grey level (2^-19 for windows over 8 images, 2^-18
over 16, 2^-17 over 32), so that sums are exact and equal pixels stay equal. Every (exposure, code) pair has one value,
so the whole of HDRE + GLT is a table.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

GREY_TOP = 255.0
LIGHT_BITS = 13
"""Grey values after GLT are told apart to this many binary digits where their light is looked up."""
LIGHT_UNIT = 1 << 12
Float = NDArray[np.float64]


def tone(grey: Float, p: float) -> Float:
    """T(g) of eq. (7) for grey values 0..255; the result runs 0..255 too."""
    scaled = np.log(np.clip(grey, 0.0, GREY_TOP) + 1.0) / math.log(GREY_TOP + 1.0)
    return np.asarray(GREY_TOP * scaled**p, dtype=np.float64)


def grey_bits(window: int) -> int:
    """Binary digits kept after the point, so that a sum of ``window`` grey values of 255 stays below 2^31."""
    return 20 - max(0, math.ceil(math.log2(window / 8)))


def fixed_point(grey: Float, bits: int) -> NDArray[np.int32]:
    """Grey values as whole multiples of 2^-bits, int32."""
    return np.rint(grey * float(1 << bits)).astype(np.int32)


def light_table(top: int, p: float) -> tuple[NDArray[np.int64], int]:
    """What the whole numbers 0 .. ``top`` that stand for grey values 0 .. 255 after GLT were before it.

    Returns the table, in 1/4096 grey level, and the shift: entry ``value >> shift``. GLT makes a reflection look like
    the line and joins the two where they touch, so the line is looked for in the light, and only measured after GLT.
    """
    shift = max(0, int(top).bit_length() - LIGHT_BITS)
    middle = (np.arange((top >> shift) + 1) + 0.5) * float(1 << shift) / top * GREY_TOP
    light = (GREY_TOP + 1.0) ** ((np.minimum(middle, GREY_TOP) / GREY_TOP) ** (1.0 / p)) - 1.0
    table = np.rint(light * LIGHT_UNIT).astype(np.int64)
    table[0] = 0
    return table, shift


def scaled_codes(codes: Float, dark_level: float, saturation: int) -> Float:
    """Grey values 0..255 of one exposure: (code - dark) / (saturation - dark) x 255, never below 0."""
    return np.clip((codes - dark_level) / (saturation - dark_level), 0.0, 1.0) * GREY_TOP


def broadening(p: float) -> float:
    """How much wider GLT shows a Gaussian line (full width at half maximum), for a line peaking at a quarter of 255.

    After GLT half height is where T(g) = T(64)/2, far down the flank: 2.27 x at p = 0.5 (2.54 x for a line at 255,
    1.6 x for one at 2), 1.79 x at p = 1. The width check expects this, or it would refuse every well lit row.
    """
    peak = (GREY_TOP + 1.0) / 4.0
    half = math.exp(math.log(peak + 1.0) / 2.0 ** (1.0 / p)) - 1.0
    return math.sqrt(math.log2(peak / half))


def light_share(share: float, p: float) -> float:
    """What a share of a line's light becomes as a share of its grey value after GLT, for a line at a quarter of 255.

    5 % of the light is 59 % of the grey value at p = 0.5. A threshold at 10 % of the row maximum after GLT would lie at
    0.1 % of the light, deep in the noise on both sides of the line, and the centroid would follow the noise.
    """
    peak = (GREY_TOP + 1.0) / 4.0
    return math.pow(math.log(share * peak + 1.0) / math.log(peak + 1.0), p)
