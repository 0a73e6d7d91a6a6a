"""Backups that can be trusted: every file with its hash, the database of one moment, all checked before any restore.

A backup place is a folder, best on another disk: ``files/`` holds stacks and range images, each once, because they are
never changed after they were written, so a nightly backup copies only the day's new ones; beside it one folder per
backup with the database and the list of files it needs (``manifest.json``). The secret key is not kept: whoever has the
backup should not be able to sign in; after a restore on a new machine everybody signs in again.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from django.conf import settings
from django.utils import timezone

from inspection.keeping import rows
from inspection.keeping.files import copy_hashed, files_below, sha256_of
from scanning.errors import BadInput

FORMAT = "edgewatch-backup/1"
MANIFEST = "manifest.json"
#: (done, of how many, what)
Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Kept:
    """One file of a backup: its place below ``files/`` (and below the installation's home), size, time and hash."""

    path: str
    size: int
    mtime_ns: int
    sha256: str


@dataclass(frozen=True)
class Backup:
    """One backup in a backup place."""

    folder: Path
    made_at: str
    database: str
    database_sha256: str
    migrations: list[str]
    files: list[Kept]

    @property
    def store(self) -> Path:
        return self.folder.parent / "files"

    @property
    def size(self) -> int:
        return sum(file.size for file in self.files)


def folders() -> dict[str, Path]:
    """What of an installation is kept beside its database, by the name it has in a backup."""
    return {"stacks": Path(settings.STACKS), "ranges": Path(settings.RANGES)}


def make_backup(
    place: Path, *, with_stacks: bool = True, portable: bool = False, progress: Progress = lambda *_: None
) -> Backup:
    """Back this installation up into ``place``, while it runs. The manifest is written last: without it, no backup.

    The database comes first: files are complete before a row names them, so every file that the copied rows name is
    there to be copied afterwards.
    """
    place = place.resolve()
    for name, folder in folders().items():
        if place.is_relative_to(folder.resolve()):
            raise BadInput(f"The backup place {place} lies inside the {name} it would copy; choose another folder.")
    stamp = timezone.now().strftime("%Y%m%dT%H%M%S")
    folder = place / stamp
    unfinished = place / f"{stamp}.unfinished"
    try:
        unfinished.mkdir(parents=True)
    except FileExistsError:
        raise BadInput(f"A backup is being made in {place} at this moment; wait for its end.") from None
    except OSError as error:
        raise BadInput(f"The backup place {place} cannot be written ({error.strerror}); choose another.") from error
    try:
        progress(0, 1, "database")
        migrations = rows.applied_migrations()
        kind = rows.save_rows(unfinished, portable=portable)
        known = {file.path: file for earlier in list_backups(place)[-1:] for file in earlier.files}
        wanted = [(name, path) for name, root in folders().items() for path in files_below(root)]
        if not with_stacks:
            wanted = [(name, path) for name, path in wanted if name != "stacks"]
        kept = []
        for done, (name, path) in enumerate(wanted, start=1):
            inner = f"{name}/{path.relative_to(folders()[name]).as_posix()}"
            progress(done, len(wanted), inner)
            try:
                kept.append(_keep(path, inner, place / "files" / inner, known.get(inner)))
            except FileNotFoundError:  # finished under another name, or removed by the retention rule, meanwhile
                continue
        backup = Backup(
            folder, timezone.now().isoformat(), kind, sha256_of(unfinished / rows.FILES[kind]), migrations, kept
        )
        _write_manifest(unfinished / MANIFEST, backup)
        unfinished.rename(folder)
    except OSError as error:
        raise BadInput(f"The backup could not be written to {place} ({error.strerror}); make room there.") from error
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return backup


def _keep(source: Path, inner: str, target: Path, known: Kept | None) -> Kept:
    """Copy one file unless the same one is in the place already; its copy is not read again for that (see check)."""
    state = source.stat()
    if (
        known is not None
        and (known.size, known.mtime_ns) == (state.st_size, state.st_mtime_ns)
        and target.is_file()
        and target.stat().st_size == known.size
    ):
        return known
    size, sha256 = copy_hashed(source, target)
    return Kept(inner, size, state.st_mtime_ns, sha256)


def _write_manifest(file: Path, backup: Backup) -> None:
    said = asdict(backup)
    del said["folder"]
    file.write_text(json.dumps({"format": FORMAT, **said}, indent=1), encoding="utf-8")


def list_backups(place: Path) -> list[Backup]:
    """The complete backups in ``place``, oldest first; one whose manifest cannot be read is left out."""
    found = []
    for manifest in sorted(place.glob(f"*/{MANIFEST}")):
        if not manifest.parent.name.endswith(".unfinished"):
            try:
                found.append(read_backup(manifest.parent))
            except BadInput:
                continue
    return found


def read_backup(folder: Path) -> Backup:
    """Read the manifest of one backup, or of the newest in a backup place."""
    manifest = folder / MANIFEST
    if not manifest.exists():
        inside = list_backups(folder)
        if not inside:
            raise BadInput(f"{folder} holds no complete backup: there is no {MANIFEST} in it or in a folder below.")
        return inside[-1]
    try:
        said: dict[str, Any] = json.loads(manifest.read_text(encoding="utf-8"))
        if said.pop("format") != FORMAT:
            raise ValueError("another format")
        files = [Kept(**one) for one in said.pop("files")]
        backup = Backup(folder=folder.resolve(), files=files, **said)
        if backup.database not in rows.FILES or any(_leads_out(file.path) for file in files):
            raise ValueError("unknown contents")
    except (ValueError, KeyError, TypeError, OSError) as error:
        raise BadInput(f"{manifest} is no manifest of a backup ({error}); use another backup.") from error
    return backup


def _leads_out(path: str) -> bool:
    parts = Path(path).parts
    return not parts or parts[0] not in folders() or ".." in parts or Path(path).is_absolute()


def check_backup(backup: Backup, progress: Progress = lambda *_: None) -> list[str]:
    """Read everything the backup needs and return one sentence for each file that is missing or damaged."""
    faults = []
    database = backup.folder / rows.FILES[backup.database]
    if not database.is_file():
        faults.append(f"The database {database.name} is missing from the backup.")
    elif sha256_of(database) != backup.database_sha256:
        faults.append(f"The database {database.name} in the backup is damaged: its hash differs.")
    for done, file in enumerate(backup.files, start=1):
        progress(done, len(backup.files), file.path)
        kept = backup.store / file.path
        if not kept.is_file():
            faults.append(f"{file.path} is missing from the backup.")
        elif kept.stat().st_size != file.size or sha256_of(kept) != file.sha256:
            faults.append(f"{file.path} in the backup is damaged: its hash differs.")
    return faults


def restore_backup(
    backup: Backup, *, replace: bool = False, without_damaged: bool = False, progress: Progress = lambda *_: None
) -> list[str]:
    """Bring the installation back as it was; return what could not be brought back, in sentences.

    Everything is checked before anything is changed: one damaged file refuses the whole restore, unless
    ``without_damaged`` says to do without it (a damaged database always refuses). A database that holds records is
    replaced only with ``replace``. Files of this installation that the backup does not know stay where they are.
    """
    if rows.has_records() and not replace:
        raise BadInput(
            "This installation already holds people, tools or scans; restore into an empty one (another EDGEWATCH_HOME "
            "or database), or give --replace to lose what is here."
        )
    faults = check_backup(backup, progress)
    if faults and (not without_damaged or any("database" in fault for fault in faults)):
        raise BadInput(
            f"The backup is not whole, so nothing was restored: {faults[0]} ({len(faults)} in all). Use another "
            f"backup, or --without-damaged to do without these files."
        )
    for done, file in enumerate(backup.files, start=1):
        progress(done, len(backup.files), file.path)
        name, inner = file.path.split("/", 1)
        target = folders()[name] / inner
        if target.is_file() and target.stat().st_size == file.size and sha256_of(target) == file.sha256:
            continue
        try:
            _, sha256 = copy_hashed(backup.store / file.path, target)
        except FileNotFoundError:
            continue  # told among the faults
        if sha256 != file.sha256:
            target.unlink(missing_ok=True)
    progress(1, 1, "database")
    rows.load_rows(backup.folder / rows.FILES[backup.database], backup.database, backup.migrations)
    return faults
