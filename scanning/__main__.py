"""`python -m scanning`: the same measuring without a web server, a database or a queue.

Whoever has a folder of scan images and a terminal gets the numbers here, and so do scripts: ``--json`` prints one JSON
document on stdout and nothing else. A fault that a person can put right is one sentence on stderr and exit code 2, and
leaves no file behind; anything else is a bug and shows its traceback.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from typing import NoReturn

from scanning.commands import COMMANDS
from scanning.errors import Fault
from scanning.report import to_text

FAULT = 2
INTERRUPTED = 130


class _Parser(argparse.ArgumentParser):
    """A parser that says what is wrong in one sentence instead of printing its whole usage."""

    def error(self, message: str) -> NoReturn:
        self.exit(FAULT, f"{message} (see {self.prog} --help)\n")


def parser() -> argparse.ArgumentParser:
    top = _Parser(prog="python -m scanning", description="Measure cutting edges from scan images.")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for command in COMMANDS:
        own = commands.add_parser(command.NAME, help=command.HELP, description=command.HELP)
        command.add_arguments(own)
        own.add_argument("--json", action="store_true", help="print the result as JSON on stdout")
        own.set_defaults(run=command.run)
    return top


def main(words: Sequence[str] | None = None) -> int:
    """Run one command and return the exit code: 0 done, 2 a fault that a person can put right, 130 interrupted."""
    _silence_decoders()
    arguments = parser().parse_args(words)
    try:
        result, lines = arguments.run(arguments)
    except Fault as fault:
        print(fault, file=sys.stderr)
        return FAULT
    except KeyboardInterrupt:
        print("stopped; nothing was written", file=sys.stderr)
        return INTERRUPTED
    try:
        sys.stdout.write(to_text(result) if arguments.json else "\n".join(lines) + "\n")
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader, `head` perhaps, has gone; Python would complain once more when it closes stdout.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


def _silence_decoders() -> None:
    """OpenCV reports a damaged image on stderr before we say so in a sentence."""
    import cv2

    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


if __name__ == "__main__":
    sys.exit(main())
