"""Serves plotly.js from the installed plotly wheel, so that no page needs the internet and no copy sits in the repo.

Only that one file: the wheel's folder also holds megabytes of widgets and data sets that no page uses.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from django.contrib.staticfiles.finders import BaseFinder
from django.core.checks import CheckMessage
from django.core.files.storage import FileSystemStorage


def plotly_folder() -> Path:
    spec = importlib.util.find_spec("plotly")
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError("plotly is not installed; run the set-up command in README.md again.")
    return Path(spec.origin).parent / "package_data"


class PlotlyFinder(BaseFinder):
    """Offer ``plotly.min.js`` of the installed wheel as ``vendor/plotly.min.js``."""

    path = "vendor/plotly.min.js"

    def check(self, **kwargs: Any) -> list[CheckMessage]:
        return []

    def find(self, path: str, find_all: bool = False, **kwargs: Any) -> Any:
        hit = str(plotly_folder() / "plotly.min.js") if path == self.path else None
        return ([hit] if hit else []) if find_all else (hit or [])

    def list(self, ignore_patterns: Any) -> Iterator[tuple[str, Any]]:
        storage = FileSystemStorage(location=plotly_folder())
        storage.prefix = "vendor"  # type: ignore[attr-defined]  # collectstatic reads it off the storage
        yield "plotly.min.js", storage
