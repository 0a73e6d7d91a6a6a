"""The PDF report of one visit: a document that still opens, and still says the same, in ten years.

Typst makes it inside this process: no browser, no network, no files. All text reaches it as data, never as markup, so
nothing a person types can change the document. The same records give the same bytes, because the document's date is
that of its newest record.
"""

from __future__ import annotations

import datetime as dt
import json
import logging
from functools import cache
from pathlib import Path
from typing import Any, Literal

import typst

from inspection.models import Inspection
from inspection.reports.content import Json, inspection_content

log = logging.getLogger(__name__)
#: PDF/A-3a for archives, PDF/UA-1 for screen readers.
STANDARDS: list[Literal["a-3a", "ua-1"]] = ["a-3a", "ua-1"]
FONT_NOTE = (
    "Some characters of this document are shown as boxes: no font for them is installed on the server that made it."
)


@cache
def layout() -> bytes:
    return (Path(__file__).parent / "inspection.typ").read_bytes()


def inspection_pdf(inspection: Inspection) -> bytes:
    """Return the report of ``inspection`` as PDF, whatever state its scans are in."""
    content, as_of = inspection_content(inspection)
    return compiled(content, as_of)


def compiled(content: Json, as_of: dt.datetime) -> bytes:
    """Set ``content`` as PDF/A; as plain PDF with a note on it where a character has no font (PDF/A forbids that)."""
    try:
        return _compile(content, as_of, STANDARDS)
    except typst.TypstError as error:
        if "could not be displayed with font" not in str(error):
            raise
        log.warning("report of inspection %s is no PDF/A: %s", content.get("inspection"), error)
    return _compile({**content, "font_note": FONT_NOTE}, as_of, [])


def _compile(content: Json, as_of: dt.datetime, standards: list[Any]) -> bytes:
    return typst.compile(
        layout(),
        format="pdf",
        sys_inputs={"data": json.dumps(content, allow_nan=False)},
        pdf_standards=standards,
        timestamp=int(as_of.timestamp()),
    )
