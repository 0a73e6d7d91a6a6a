"""stack.json: what somebody else's recording says about itself, checked before it is believed.

A wrong pitch or a forgotten saturation level spoils every number that follows without spoiling the picture, so each
value is refused here, by name and with the way out, rather than found later in a report.
"""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from scanning.errors import BadInput
from scanning.frames import Response, StackHeader

FORMAT = "edgewatch-stack/1"
STACK_JSON = "stack.json"

REQUIRED = ("format", "exposures_us", "step_um", "row_pitch_um", "mm_per_pixel")
OPTIONAL = ("line_width_px", "dark_level", "saturation", "response")

MOST_EXPOSURES = 64
LARGEST_PIXELS = 100_000_000
FEWEST_COLUMNS = 4
# Far outside anything a laser line scanner does: whoever writes such a value has mistaken the unit.
LARGEST_UM = 10_000.0
LARGEST_MM_PER_PIXEL = 10.0
LONGEST_EXPOSURE_US = 1e9


@dataclass(frozen=True)
class Description:
    """The content of stack.json, exposures ascending. Units as in `StackHeader`; None where it may be left out."""

    exposures_us: tuple[float, ...]
    step_um: float
    row_pitch_um: float
    mm_per_pixel: float
    line_width_px: float | None
    dark_level: float | None
    saturation: int | None
    response: Response

    def header(self, *, rows: int, columns: int, steps: int, bits: int, where: str) -> StackHeader:
        """Join the description with what the images turned out to be; ``where`` names the stack in a `BadInput`."""
        if rows < 1 or columns < FEWEST_COLUMNS:
            raise BadInput(
                f"{where}: frames of {rows} x {columns} pixels are too small to hold a laser line; check them"
            )
        if rows * columns > LARGEST_PIXELS:
            raise BadInput(
                f"{where}: frames of {rows} x {columns} pixels are larger than any camera's; check the files"
            )
        if steps < 1:
            raise BadInput(f"{where}: the stack is empty; record at least one step")
        highest = 2**bits - 1
        saturation = self.saturation
        if saturation is None:
            if bits != 8:
                raise BadInput(
                    f"{where}: {STACK_JSON} has no saturation, which {bits}-bit frames need; "
                    "add the camera's highest grey value, for example 4095 for 12 bits"
                )
            saturation = highest
        if saturation > highest:
            raise BadInput(
                f"{where}: saturation {saturation} is beyond the {highest} that {bits}-bit frames can hold; "
                f"correct it in {STACK_JSON}"
            )
        if self.line_width_px is not None and self.line_width_px >= columns:
            raise BadInput(
                f"{where}: line_width_px {self.line_width_px:g} is wider than the frame ({columns} columns); "
                f"correct it in {STACK_JSON}"
            )
        return StackHeader(
            rows=rows,
            columns=columns,
            steps=steps,
            exposures_us=self.exposures_us,
            step_um=self.step_um,
            row_pitch_um=self.row_pitch_um,
            mm_per_pixel=self.mm_per_pixel,
            saturation=saturation,
            line_width_px=self.line_width_px,
            dark_level=self.dark_level,
            response=self.response,
            bits=bits,
        )


def read_description(path: Path) -> Description:
    """Read and check a stack.json. Raises `BadInput` naming the file, the key and what to write instead."""
    if path.exists() and not path.is_file() and not path.is_dir():
        raise BadInput(f"{path} is not a file but a device or pipe; put the description itself there")
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise BadInput(
            f'{path.parent} has no {STACK_JSON}; add one with {", ".join(REQUIRED[1:])} and "format": "{FORMAT}"'
        ) from None
    except OSError as error:
        raise BadInput(f"{path} cannot be read ({error.strerror}); check the path and its rights") from error
    except UnicodeDecodeError:
        raise BadInput(f"{path} is not UTF-8 text; save it as plain JSON") from None
    try:
        said = json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        fault = f"line {error.lineno}: {error.msg}" if isinstance(error, json.JSONDecodeError) else "nested too deep"
        raise BadInput(f"{path} is not valid JSON ({fault}); correct it there") from None
    return description_from_json(said, str(path))


def description_from_json(said: object, where: str) -> Description:
    """Check already parsed JSON; ``where`` names its origin in a `BadInput`."""
    if not isinstance(said, dict):
        raise BadInput(f"{where} must hold one JSON object with the keys {', '.join(REQUIRED)}")
    for key in said:
        if key not in REQUIRED + OPTIONAL:
            meant = difflib.get_close_matches(key, REQUIRED + OPTIONAL, n=1, cutoff=0.8)
            if meant and meant[0] not in said:
                raise BadInput(f'{where}: unknown key "{key}"; did you mean "{meant[0]}"?')
    for key in REQUIRED:
        if key not in said:
            raise BadInput(f'{where} lacks "{key}"; add it ({_MEANINGS[key]})')
    if said["format"] != FORMAT:
        raise BadInput(f'{where}: format {json.dumps(said["format"])} is unknown; this version reads "{FORMAT}" only')
    response = said.get("response", "linear")
    if response not in ("linear", "logarithmic"):
        raise BadInput(f'{where}: response {json.dumps(response)} is unknown; write "linear" or "logarithmic"')
    saturation = _number(said, "saturation", where, lowest=1.0, highest=65535.0) if _given(said, "saturation") else None
    if saturation is not None and saturation != int(saturation):
        raise BadInput(f"{where}: saturation {saturation:g} must be a whole grey value, such as 255")
    dark = _number(said, "dark_level", where, lowest=0.0, highest=65535.0) if _given(said, "dark_level") else None
    if dark is not None and saturation is not None and dark >= saturation:
        raise BadInput(f"{where}: dark_level {dark:g} is not below saturation {saturation:g}; correct one of them")
    return Description(
        exposures_us=_exposures(said["exposures_us"], response == "logarithmic", where),
        step_um=_positive(said, "step_um", where, LARGEST_UM),
        row_pitch_um=_positive(said, "row_pitch_um", where, LARGEST_UM),
        mm_per_pixel=_positive(said, "mm_per_pixel", where, LARGEST_MM_PER_PIXEL),
        line_width_px=(_positive(said, "line_width_px", where, LARGEST_UM) if _given(said, "line_width_px") else None),
        dark_level=dark,
        saturation=None if saturation is None else int(saturation),
        response=cast("Response", response),
    )


_MEANINGS: Mapping[str, str] = {
    "format": f'"{FORMAT}"',
    "exposures_us": "the exposure times in microseconds, as a list",
    "step_um": "the distance between two steps in micrometres",
    "row_pitch_um": "the distance between two rows on the tool in micrometres",
    "mm_per_pixel": "the height per column in millimetres",
}


def _given(said: Mapping[str, Any], key: str) -> bool:
    return said.get(key) is not None


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _number(said: Mapping[str, Any], key: str, where: str, *, lowest: float, highest: float) -> float:
    value = said[key]
    if not _is_number(value):
        raise BadInput(f"{where}: {key} must be a number, not {json.dumps(value)}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise BadInput(f"{where}: {key} is {number}, not a finite number; write the measured value")
    if not lowest <= number <= highest:
        raise BadInput(f"{where}: {key} is {number:g}, but must lie between {lowest:g} and {highest:g}; check the unit")
    return number


def _positive(said: Mapping[str, Any], key: str, where: str, highest: float) -> float:
    number = _number(said, key, where, lowest=-math.inf, highest=highest)
    if number <= 0:
        raise BadInput(f"{where}: {key} is {number:g}, but must be greater than zero")
    return number


def _exposures(value: object, logarithmic: bool, where: str) -> tuple[float, ...]:
    if not isinstance(value, list) or not value:
        raise BadInput(
            f"{where}: exposures_us must be a list of microseconds such as [100, 300], not {json.dumps(value)}"
        )
    if len(value) > MOST_EXPOSURES:
        raise BadInput(f"{where}: exposures_us lists {len(value)} exposures; no more than {MOST_EXPOSURES} are read")
    numbers = [
        _number({"exposures_us": one}, "exposures_us", where, lowest=-math.inf, highest=LONGEST_EXPOSURE_US)
        for one in value
    ]
    if logarithmic:
        if numbers != [0.0]:
            raise BadInput(
                f"{where}: a logarithmic camera has no exposure time: exposures_us must be [0], not {json.dumps(value)}"
            )
        return (0.0,)
    for number in numbers:
        if number <= 0:
            raise BadInput(f"{where}: exposures_us holds {number:g}, but an exposure must be longer than zero")
    if len(set(numbers)) != len(numbers):
        raise BadInput(f"{where}: exposures_us holds the same exposure twice: {json.dumps(value)}; list each one once")
    return tuple(sorted(numbers))


def header_to_json(header: StackHeader) -> dict[str, Any]:
    """A header as plain JSON values, every number of one type, so that equal headers give equal text."""
    return {
        "format": FORMAT,
        "rows": int(header.rows),
        "columns": int(header.columns),
        "steps": int(header.steps),
        "bits": int(header.bits),
        "exposures_us": [float(one) for one in header.exposures_us],
        "step_um": float(header.step_um),
        "row_pitch_um": float(header.row_pitch_um),
        "mm_per_pixel": float(header.mm_per_pixel),
        "saturation": int(header.saturation),
        "line_width_px": None if header.line_width_px is None else float(header.line_width_px),
        "dark_level": None if header.dark_level is None else float(header.dark_level),
        "response": header.response,
    }


def header_from_json(said: object, where: str) -> StackHeader:
    """Read back what `header_to_json` gave, with the same checks as for a foreign stack.json."""
    description = description_from_json(said, where)
    sizes = cast("dict[str, Any]", said)
    for key in ("rows", "columns", "steps", "bits"):
        if not isinstance(sizes.get(key), int) or isinstance(sizes[key], bool):
            raise BadInput(f"{where}: {key} must be a whole number, not {json.dumps(sizes.get(key))}")
    if sizes["bits"] not in (8, 16):
        raise BadInput(f"{where}: bits must be 8 or 16, not {sizes['bits']}")
    return description.header(
        rows=sizes["rows"], columns=sizes["columns"], steps=sizes["steps"], bits=sizes["bits"], where=where
    )
