"""`manage.py verify`: every stack and range image against its hash; exit code 1 if one is missing or damaged."""

from __future__ import annotations

from argparse import ArgumentParser
from pathlib import Path
from typing import Any

from django.core.management.base import BaseCommand, CommandError

from inspection.keeping.backup import check_backup, read_backup
from inspection.keeping.telling import Telling
from inspection.keeping.verify import verify
from scanning.errors import BadInput


class Command(BaseCommand):
    help = "Read every stack and range image again and compare it with its hash."

    def add_arguments(self, parser: ArgumentParser) -> None:
        parser.add_argument("--without-stacks", action="store_true", help="range images only, which is quick")
        parser.add_argument("--backup", type=Path, help="check this backup instead of the installation")

    def handle(self, *args: Any, **options: Any) -> None:
        telling = Telling(self.stderr)
        if options["backup"]:
            try:
                backup = read_backup(options["backup"])
            except BadInput as fault:
                raise CommandError(str(fault)) from fault
            faults, what = (
                check_backup(backup, telling),
                f"the database and {len(backup.files)} files of {backup.folder}",
            )
        else:
            found = verify(stacks=not options["without_stacks"], progress=telling)
            faults, what = found.faults, f"{found.stacks} stacks and {found.ranges} range images"
            for name in found.nameless:
                self.stdout.write(f"No row names {name}; it can be removed.")
        for sentence in faults:
            self.stdout.write(sentence)
        if faults:
            raise CommandError(f"{len(faults)} of {what} are missing or damaged; see the sentences above.")
        self.stdout.write(f"Checked {what}: all as they were written.")
