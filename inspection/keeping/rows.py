"""The database as a file, and back.

On SQLite it is copied through the database's own backup interface, page by page while the product runs. On PostgreSQL
the rows are written as JSON lines from one snapshot: pg_dump would demand a client at least as new as the server in
every image, while this needs nothing, and its file can be brought into either kind of database (which is also how an
installation moves from one machine with SQLite to several with PostgreSQL).
"""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from django.apps import apps
from django.contrib.auth.models import Permission
from django.contrib.contenttypes.models import ContentType
from django.contrib.sessions.models import Session
from django.core import serializers
from django.core.management import call_command
from django.core.management.color import no_style
from django.db import DatabaseError, connection, models, transaction
from django.db.migrations.loader import MigrationLoader

from inspection.models import Scan, Tool, User
from scanning.errors import BadInput

SQLITE, ROWS = "sqlite", "rows"
FILES = {SQLITE: "database.sqlite3", ROWS: "database.jsonl"}
#: Made anew by migrations, or worth nothing elsewhere.
NOT_KEPT: tuple[type[models.Model], ...] = (ContentType, Permission, Session)


def applied_migrations() -> list[str]:
    """``app.name`` of every migration this database has."""
    return sorted(f"{app}.{name}" for app, name in MigrationLoader(connection).applied_migrations)


def known_migrations() -> set[str]:
    """``app.name`` of every migration this version of the product has."""
    return {f"{app}.{name}" for app, name in MigrationLoader(None).disk_migrations}


def has_records() -> bool:
    """Whether anything would be lost if this database were replaced."""
    try:
        return User.objects.exists() or Tool.objects.exists() or Scan.objects.exists()
    except DatabaseError:  # no tables yet
        return False


def save_rows(folder: Path, *, portable: bool = False) -> str:
    """Write the database into ``folder`` as it is at this moment; return its kind, `SQLITE` or `ROWS`."""
    if connection.vendor == "sqlite" and not portable:
        _copy_sqlite(Path(connection.settings_dict["NAME"]), folder / FILES[SQLITE])
        return SQLITE
    _write_rows(folder / FILES[ROWS])
    return ROWS


def _copy_sqlite(source: Path, target: Path) -> None:
    try:
        with (
            closing(sqlite3.connect(source.as_uri() + "?mode=ro", uri=True)) as opened,
            closing(sqlite3.connect(target)) as copy,
        ):
            opened.backup(copy, pages=1000)
            found = copy.execute("PRAGMA integrity_check").fetchone()[0]
    except sqlite3.Error as error:
        raise BadInput(f"The database {source} could not be copied ({error}); nothing was backed up.") from error
    if found != "ok":
        raise BadInput(f"The database {source} is damaged ({found}); restore the last backup before making another.")


def _kept_models() -> list[type[models.Model]]:
    every = [model for model in apps.get_models() if model not in NOT_KEPT and not model._meta.proxy]
    ordered: list[type[models.Model]] = serializers.sort_dependencies([(None, every)])
    return ordered


def _write_rows(target: Path) -> None:
    def every_row() -> Iterator[models.Model]:
        for model in _kept_models():
            yield from model._default_manager.order_by("pk").iterator()

    with transaction.atomic(), target.open("w", encoding="utf-8") as out:
        if connection.vendor == "postgresql":
            with connection.cursor() as cursor:  # all tables as of one moment
                cursor.execute("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ, READ ONLY")
        serializers.serialize("jsonl", every_row(), stream=out)
        out.flush()
        os.fsync(out.fileno())


def load_rows(file: Path, kind: str, migrations: list[str]) -> None:
    """Replace this database by the one kept in ``file``, then bring it up to this version. All or nothing."""
    if newer := sorted(set(migrations) - known_migrations()):
        raise BadInput(
            f"The backup was made by a newer version of Edgewatch (it has {newer[-1]}); install that version first."
        )
    if kind == SQLITE:
        if connection.vendor != "sqlite":
            raise BadInput(
                "The backup holds an SQLite file but DATABASE_URL names another database; restore it on SQLite, then "
                "make a backup with --portable and restore that."
            )
        _replace_sqlite(file, Path(connection.settings_dict["NAME"]))
        call_command("migrate", verbosity=0, interactive=False)
        return
    call_command("migrate", verbosity=0, interactive=False)
    if missing := sorted(set(applied_migrations()) - set(migrations)):
        raise BadInput(
            f"The backup was made by an older version of Edgewatch (it lacks {missing[-1]}); restore it with the "
            f"version that made it, then upgrade."
        )
    _read_rows(file)


def _replace_sqlite(file: Path, target: Path) -> None:
    """Put the kept database in place of the present one; the journals beside it belong to the old one."""
    connection.close()
    arriving = target.with_name(target.name + ".arriving")
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        with closing(sqlite3.connect(file.as_uri() + "?mode=ro", uri=True)) as kept:
            found = kept.execute("PRAGMA integrity_check").fetchone()[0]
            if found != "ok":
                raise BadInput(f"The database in the backup is damaged ({found}); use another backup.")
            arriving.unlink(missing_ok=True)
            with closing(sqlite3.connect(arriving)) as copy:
                kept.backup(copy)
    except sqlite3.Error as error:
        raise BadInput(f"The database in the backup cannot be read ({error}); use another backup.") from error
    for journal in ("-wal", "-shm"):
        target.with_name(target.name + journal).unlink(missing_ok=True)
    os.replace(arriving, target)


def _read_rows(file: Path) -> None:
    loaded = set()
    try:
        with transaction.atomic(), file.open(encoding="utf-8") as lines:
            for model in reversed(_kept_models()):
                model._base_manager.all()._raw_delete(using=connection.alias)
            for line in lines:
                for row in serializers.deserialize("jsonl", line):
                    row.save()
                    loaded.add(type(row.object))
            connection.check_constraints()
            with connection.cursor() as cursor:
                for statement in connection.ops.sequence_reset_sql(no_style(), list(loaded)):
                    cursor.execute(statement)
    except (DatabaseError, serializers.base.DeserializationError, json.JSONDecodeError) as error:
        raise BadInput(
            f"The rows in {file.name} could not be read ({error}); the database is as it was before."
        ) from error
