"""`manage.py restore BACKUP`: an installation as it was, into an empty one, checked file by file beforehand."""

from __future__ import annotations

import datetime as dt
from argparse import ArgumentParser
from pathlib import Path
from typing import Any

from django.conf import settings
from django.core.management.base import BaseCommand, CommandError
from django.db import DatabaseError
from django.utils import timezone

from inspection.keeping.backup import read_backup, restore_backup
from inspection.keeping.telling import Telling
from inspection.models import Rig
from inspection.supervise import hold_alone
from scanning.errors import BadInput

#: A worker shows itself every 10 s; one seen this lately is still running.
JUST_SEEN = dt.timedelta(seconds=45)


class Command(BaseCommand):
    help = "Bring back a backup. Stop the product first; everything is checked before anything is changed."

    def add_arguments(self, parser: ArgumentParser) -> None:
        parser.add_argument("backup", type=Path, help="a backup, or a backup folder (its newest is taken)")
        parser.add_argument("--replace", action="store_true", help="lose the records that are here now")
        parser.add_argument("--without-damaged", action="store_true", help="do without files that are damaged")

    def handle(self, *args: Any, **options: Any) -> None:
        lock = hold_alone(settings.HOME)
        if lock is None:
            raise CommandError(f"Edgewatch runs on {settings.HOME}; stop it, then restore.")
        try:
            if busy := _worker_seen():
                raise CommandError(f"The worker of {busy} was seen less than a minute ago; stop it, then restore.")
            backup = read_backup(options["backup"])
            lost = restore_backup(
                backup,
                replace=options["replace"],
                without_damaged=options["without_damaged"],
                progress=Telling(self.stderr),
            )
        except BadInput as fault:
            raise CommandError(str(fault)) from fault
        finally:
            lock.close()
        for sentence in lost:
            self.stderr.write(sentence)
        self.stdout.write(f"Restored {backup.folder.name}: the database and {len(backup.files) - len(lost)} files.")


def _worker_seen() -> str:
    try:
        seen = Rig.objects.filter(worker_seen_at__gt=timezone.now() - JUST_SEEN).first()
    except DatabaseError:  # no tables yet
        return ""
    return str(seen) if seen else ""
