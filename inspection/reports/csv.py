"""CSV that opens right in a spreadsheet, wherever in the world, and cannot run anything there.

Spreadsheets take text that starts with = + - @ for a formula, so such *text* gets a leading apostrophe; numbers never
do, or a negative height would stop being a number. A byte order mark makes Excel read UTF-8. European installations
want ; between columns and a comma in numbers: without that, 22.5 opens as the 22nd of May.
"""

from __future__ import annotations

import csv
import datetime as dt
import io
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from math import isfinite

import numpy as np
from django.utils import timezone

from inspection.reports.rows import Cell, Table
from scanning.errors import BadInput
from scanning.range_image import RangeImage

BOM = "\ufeff"
FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n", "＝", "＋", "－", "＠")
SEPARATORS = {",": ",", ";": ";", "tab": "\t", "\t": "\t"}
#: Lines sent at once: one write per line would spend its time on chunk headers.
LINES_PER_CHUNK = 200


@dataclass(frozen=True)
class Dialect:
    separator: str = ","
    decimal: str = "."

    @classmethod
    def asked_for(cls, separator: str, decimal: str) -> Dialect:
        """The dialect of ``?sep=`` and ``?decimal=``; raises BadInput for others and for comma in both places."""
        if separator not in SEPARATORS:
            raise BadInput(f"The separator {separator!r} is not offered; use a comma, a semicolon or tab.")
        if decimal not in (".", ","):
            raise BadInput(f"The decimal sign {decimal!r} is not offered; use a point or a comma.")
        if separator == decimal:
            raise BadInput("A comma cannot separate both columns and decimals; choose sep=; with decimal=, instead.")
        return cls(SEPARATORS[separator], decimal)

    def number(self, value: float, spec: str = ".9g") -> str:
        """Nine significant digits, enough for every float32 to come back unchanged."""
        text = format(value, spec)
        return text if self.decimal == "." else text.replace(".", self.decimal)

    def cell(self, value: Cell) -> str:
        """The text of one cell. What was not measured is empty."""
        match value:
            case None:
                return ""
            case bool():
                return "yes" if value else "no"
            case int():
                return str(value)
            case float():
                return self.number(value) if isfinite(value) else ""
            case dt.datetime():
                local = timezone.localtime(value) if timezone.is_aware(value) else value
                return local.isoformat(sep=" ", timespec="seconds")
            case dt.date():
                return value.isoformat()
            case _:
                return safe_text(str(value))


def safe_text(text: str) -> str:
    """Text that a spreadsheet shows and does not run."""
    return f"'{text}" if text.startswith(FORMULA) or text.lstrip().startswith(FORMULA) else text


def write_table(table: Table, dialect: Dialect) -> Iterator[str]:
    """Yield the file piece by piece: byte order mark, headings, rows."""

    def lines() -> Iterator[list[str]]:
        yield [safe_text(column) for column in table.columns]
        for row in table.rows:
            yield [dialect.cell(cell) for cell in row]

    yield BOM
    yield from _written(lines(), dialect)


def write_range_image(image: RangeImage, about: Iterable[tuple[str, Cell]], dialect: Dialect) -> Iterator[str]:
    """Yield one range image: ``about`` it, then a matrix of heights in um with mm on both axes, empty = undefined.

    The scan runs to the right (x), the laser line downwards (y). Heights to 0.01 um, positions to 0.1 um.
    """
    rows, profiles = image.height_um.shape
    x_mm = np.arange(profiles) * image.profile_pitch_um / 1e3

    def lines() -> Iterator[list[str]]:
        for name, value in about:
            yield [safe_text(name), dialect.cell(value)]
        yield ["rows", str(rows)]
        yield ["profiles", str(profiles)]
        yield ["row pitch µm", dialect.number(image.row_pitch_um)]
        yield ["profile pitch µm", dialect.number(image.profile_pitch_um)]
        yield []
        yield ["height µm (right: x mm along the scan, down: y mm along the line)"]
        yield ["y mm \\ x mm", *(dialect.number(x, ".4f") for x in x_mm)]
        for row in range(rows):
            heights = image.height_um[row].tolist()
            yield [
                dialect.number(row * image.row_pitch_um / 1e3, ".4f"),
                *(dialect.number(height, ".2f") if isfinite(height) else "" for height in heights),
            ]

    yield BOM
    yield from _written(lines(), dialect)


def _written(lines: Iterator[list[str]], dialect: Dialect) -> Iterator[str]:
    buffer = io.StringIO()
    writer = csv.writer(buffer, delimiter=dialect.separator, lineterminator="\r\n")
    for count, line in enumerate(lines, 1):
        writer.writerow(line)
        if count % LINES_PER_CHUNK == 0:
            yield buffer.getvalue()
            buffer.seek(0)
            buffer.truncate()
    yield buffer.getvalue()
