"""What `python -m scanning` can do: one file per command, listed here once.

A command module has ``NAME``, ``HELP``, ``add_arguments(parser)`` and ``run(arguments) -> (result, lines)``: the
result is what ``--json`` prints, the lines are what a person reads.
"""

from __future__ import annotations

import argparse
from typing import Any, Protocol

from scanning.commands import calibrate, check, inspect, noise, process, simulate


class Command(Protocol):
    NAME: str
    HELP: str

    def add_arguments(self, parser: argparse.ArgumentParser) -> None: ...
    def run(self, arguments: argparse.Namespace) -> tuple[dict[str, Any], list[str]]: ...


COMMANDS: tuple[Command, ...] = (process, calibrate, check, noise, inspect, simulate)
