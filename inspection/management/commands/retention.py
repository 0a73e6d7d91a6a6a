"""`manage.py retention --days 90`: makes room by removing old raw frames, never results."""

from __future__ import annotations

from argparse import ArgumentParser
from typing import Any

from django.conf import settings
from django.core.management.base import BaseCommand, CommandError

from inspection.keeping.retention import remove_old_stacks
from inspection.keeping.telling import Telling
from scanning.errors import BadInput


class Command(BaseCommand):
    help = "Remove raw frames older than a number of days. Results stay; so does the newest stack of each region."

    def add_arguments(self, parser: ArgumentParser) -> None:
        parser.add_argument("--days", type=int, default=settings.STACK_KEEP_DAYS, help="default: STACK_KEEP_DAYS")
        parser.add_argument("--dry-run", action="store_true", help="only say what would go")

    def handle(self, *args: Any, **options: Any) -> None:
        if not options["days"]:
            raise CommandError("Raw frames are kept for ever: STACK_KEEP_DAYS is 0. Give --days to remove old ones.")
        try:
            removed = remove_old_stacks(options["days"], dry_run=options["dry_run"], progress=Telling(self.stderr))
        except BadInput as fault:
            raise CommandError(str(fault)) from fault
        for scan in removed.scans:
            self.stdout.write(f"{scan} of {scan.finished_at:%Y-%m-%d}")
        would = "would free" if options["dry_run"] else "freed"
        self.stdout.write(
            f"{len(removed.scans)} stacks older than {options['days']} days, {would} {removed.bytes / 1e6:.1f} MB."
        )
