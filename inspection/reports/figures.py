"""Numbers as a person should read them: no more digits than the uncertainty allows."""

from __future__ import annotations

from math import floor, isfinite, log10

NOT_MEASURED = "not measured"
#: Coverage factor of every uncertainty shown to people: about 95 %.
COVERAGE = 2.0


def with_uncertainty(value: float | None, u: float | None) -> str:
    """``value ± U`` with U = 2u to two digits and the value to the same place; without u, four significant digits."""
    if value is None or not isfinite(value):
        return NOT_MEASURED
    if u is None or not isfinite(u) or u <= 0:
        return plain(value)
    wide = COVERAGE * u
    places = 1 - floor(log10(wide))
    if places <= 0:
        return f"{round(value, places):.0f} ± {round(wide, places):.0f}"
    if places > 9:
        return f"{value:.3g} ± {wide:.2g}"
    return f"{value:.{places}f} ± {wide:.{places}f}"


def plain(value: float | None, digits: int = 4) -> str:
    """``digits`` significant digits, without an exponent between 0.0001 and a million."""
    if value is None or not isfinite(value):
        return NOT_MEASURED
    if value == 0:
        return "0"
    size = floor(log10(abs(value)))
    if size < -4 or size >= 6:
        return f"{value:.{digits - 1}e}"
    text = f"{value:.{max(0, digits - 1 - size)}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text
