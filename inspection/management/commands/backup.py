"""`manage.py backup PLACE`: the whole installation into a folder, while it runs."""

from __future__ import annotations

from argparse import ArgumentParser
from pathlib import Path
from typing import Any

from django.core.management.base import BaseCommand, CommandError

from inspection.keeping.backup import make_backup
from inspection.keeping.telling import Telling
from scanning.errors import BadInput


class Command(BaseCommand):
    help = "Back up database, stacks and range images into a folder, best on another disk. The product may run."

    def add_arguments(self, parser: ArgumentParser) -> None:
        parser.add_argument("place", type=Path, help="the backup folder; backups made there share unchanged files")
        parser.add_argument("--without-stacks", action="store_true", help="leave the raw frames out")
        parser.add_argument(
            "--portable", action="store_true", help="write the rows so that PostgreSQL can read an SQLite backup"
        )

    def handle(self, *args: Any, **options: Any) -> None:
        try:
            backup = make_backup(
                options["place"],
                with_stacks=not options["without_stacks"],
                portable=options["portable"],
                progress=Telling(self.stderr),
            )
        except BadInput as fault:
            raise CommandError(str(fault)) from fault
        self.stdout.write(
            f"Backed up to {backup.folder}: the database and {len(backup.files)} files, {backup.size / 1e6:.1f} MB."
        )
