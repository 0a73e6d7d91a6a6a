"""Stacks that other software recorded, brought in through a page or a command: wholly, or not at all.

What arrives is a stranger's archive. It is unpacked under limits into a folder of its own, checked and copied into our
file form before a single row is written, so that a broken stack leaves one sentence and nothing else.
"""

from __future__ import annotations

import shutil
import stat
import tempfile
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import IO, Any, Protocol
from uuid import uuid4

from django.conf import settings
from django.db import transaction
from django.utils import timezone

from inspection.models import Calibration, Inspection, Recipe, Region, Rig, Scan, User
from inspection.services.audit import audit
from inspection.services.queue import limits_in_force
from inspection.services.recipes import recipe_of, recipe_row, usual_recipe
from inspection.services.ring import ring_measure
from inspection.states import ScanState
from scanning import stacks
from scanning.errors import BadInput
from scanning.frames import StackHeader

#: More files than a bracket of nine exposures over the longest stage has frames; an archive with more is a bomb.
MOST_FILES = 20_000
#: Scan images shrink to a tenth at most losslessly; black ones further. A thousandfold is an archive made to explode.
MOST_EXPANSION = 1000
PIECE_BYTES = 1 << 20


class Upload(Protocol):
    """What Django hands over for an uploaded file."""

    @property
    def name(self) -> str | None: ...

    def chunks(self) -> Iterator[bytes]: ...


def import_stack(
    folder: Path,
    *,
    region: Region,
    rig: Rig,
    by: User | None,
    recipe: Recipe | None = None,
    original_name: str = "",
    calibration: Calibration | None = None,
) -> Scan:
    """Store the stack in ``folder`` (contract 2 of the design, or our HDF5 file) as a scan and ring for its numbers.

    ``calibration`` is given only when the stack was recorded on that rig with that setting; otherwise heights rest on
    the stack's own mm_per_pixel, and the verdict says that nobody vouches for it. ``recipe`` defaults to what fits the
    stack's exposures. Raises `BadInput` in one sentence; then neither a file nor a row remains.
    """
    place = f"imported/{timezone.now():%Y/%m}/{uuid4().hex}.h5"
    target = settings.STACKS / place
    with stacks.open_stack(folder) as stack:
        header = stack.header
        recipe = recipe or recipe_row(usual_recipe(header.response, header.steps))
        _check_fits(recipe, header)
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        header = stacks.import_folder(folder, target)
        with stacks.open_stack(target) as stored:
            sha256 = stored.sha256()
        with transaction.atomic():
            scan = _add_scan(header, region, rig, by, recipe, calibration, original_name, place, sha256)
            ring_measure(scan.pk)
    except BaseException:
        target.unlink(missing_ok=True)
        raise
    return scan


def _add_scan(
    header: StackHeader,
    region: Region,
    rig: Rig,
    by: User | None,
    recipe: Recipe,
    calibration: Calibration | None,
    original_name: str,
    place: str,
    sha256: str,
) -> Scan:
    now = timezone.now()
    inspection = Inspection.objects.create(
        tool=region.tool,
        requested_by=by,
        requested_at=now,
        reason=f"Imported {original_name}".strip()[:200],
        life_used=region.tool.life_used,
    )
    scan = Scan.objects.create(
        inspection=inspection,
        region=region,
        rig=rig,
        source=Scan.Source.IMPORT,
        state=ScanState.PROCESSING,
        requested_by=by,
        queued_at=now,
        started_at=now,
        progress_at=now,
        phase="surface",
        plan=_plan(header, region, original_name),
        recipe=recipe,
        calibration=calibration,
        limit_set=limits_in_force(region.tool),
        done=header.steps,
        total=header.steps,
        stack_file=place,
        stack_sha256=sha256,
    )
    audit(by, "stack.imported", scan, after={"from": original_name, "sha256": sha256})
    return scan


def _plan(header: StackHeader, region: Region, original_name: str) -> dict[str, Any]:
    flat_rows = min(region.flat_rows, max(0, header.rows - region.flat_row))
    return {
        "region": region.name,
        "start_mm": region.start_mm,
        "length_mm": header.steps * header.step_um / 1000.0,
        "steps": header.steps,
        "step_um": header.step_um,
        "exposures_us": list(header.exposures_us),
        "rows": header.rows,
        "row_offset": region.row_offset,
        "columns": header.columns,
        "flat_row": region.flat_row if flat_rows >= 3 else 0,
        "flat_rows": flat_rows if flat_rows >= 3 else header.rows,
        "imported_from": original_name,
    }


def _check_fits(recipe: Recipe, header: StackHeader) -> None:
    working = recipe_of(recipe)
    working.check_fits(header)
    if working.profiles(header.steps) < 1:
        raise BadInput(
            f"The stack has {header.steps} steps, too few for a single profile with {recipe.name}; choose NF or "
            f"record more."
        )


def unpack_upload(files: Iterable[Upload]) -> Path:
    """Write an upload (one zip, one .h5, or the single files of a stack) into a new folder and return it.

    The caller removes it with `discard_upload` when done. Refused with `BadInput`, leaving nothing: paths that lead out
    of the folder, links, encrypted entries, more than STACK_UPLOAD_MAX_BYTES in all (counted while unpacking, whatever
    the archive says), too many files, two files of one name.
    """
    arrived = list(files)
    if not arrived:
        raise BadInput("No file arrived; choose a zip of the stack folder, or stack.json together with its images.")
    settings.UPLOADS.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix="stack-", dir=settings.UPLOADS))
    try:
        names = [_leaf(upload.name or "") for upload in arrived]
        if len(arrived) > MOST_FILES:
            raise BadInput(f"{len(arrived)} files arrived; a stack may have {MOST_FILES} at most.")
        if len(arrived) == 1 and names[0].lower().endswith(".zip"):
            archive = folder / "upload.zip"
            _write(archive, arrived[0].chunks(), settings.STACK_UPLOAD_MAX_BYTES)
            inside = folder / "stack"
            _unzip(archive, inside, names[0])
            archive.unlink()
            return _stack_inside(inside, names[0])
        if len(set(names)) != len(names):
            double = next(name for name in names if names.count(name) > 1)
            raise BadInput(f"Two of the files are called {double}; upload a zip of the stack folder instead.")
        inside = folder / "stack"
        inside.mkdir()
        room = settings.STACK_UPLOAD_MAX_BYTES
        for upload, name in zip(arrived, names, strict=True):
            room -= _write(inside / name, upload.chunks(), room)
        return _stack_inside(inside, "The upload")
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def discard_upload(path: Path) -> None:
    """Remove what `unpack_upload` returned, together with the folder it made around it."""
    uploads = settings.UPLOADS.resolve()
    inside = path.resolve().relative_to(uploads)  # never anything outside the uploads folder
    shutil.rmtree(uploads / inside.parts[0], ignore_errors=True)


def _leaf(name: str) -> str:
    leaf = PurePosixPath(name.replace("\\", "/")).name
    if leaf in ("", ".", "..") or "\0" in leaf:
        raise BadInput(f"A file named {name!r} cannot be stored; rename it.")
    return leaf


def _write(target: Path, pieces: Iterable[bytes], room: int) -> int:
    """Write ``pieces`` to ``target`` and return their size; never more than ``room`` bytes."""
    written = 0
    with target.open("wb") as out:
        for piece in pieces:
            written += len(piece)
            if written > room:
                raise BadInput(
                    f"The upload is larger than {settings.STACK_UPLOAD_MAX_BYTES // 2**20} MB; import it from the "
                    f"command line instead, or raise STACK_UPLOAD_MAX_MB."
                )
            out.write(piece)
    return written


def _unzip(archive: Path, inside: Path, name: str) -> None:
    inside.mkdir()
    try:
        with zipfile.ZipFile(archive) as opened:
            entries = [entry for entry in opened.infolist() if not entry.is_dir() and not _clutter(entry.filename)]
            if len(entries) > MOST_FILES:
                raise BadInput(f"{name} holds {len(entries)} files; a stack may have {MOST_FILES} at most.")
            room = min(settings.STACK_UPLOAD_MAX_BYTES, MOST_EXPANSION * max(archive.stat().st_size, 1))
            if sum(entry.file_size for entry in entries) > room:
                raise BadInput(f"{name} unpacks to more than {room // 2**20} MB; that is no stack of scan images.")
            for entry in entries:
                target = _target(inside, entry, name)
                target.parent.mkdir(parents=True, exist_ok=True)
                if target.exists():
                    raise BadInput(f"{name} holds {entry.filename} twice; make the archive again.")
                with opened.open(entry) as packed:
                    room -= _write(target, _pieces(packed), room)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, OSError, ValueError) as error:
        raise BadInput(f"{name} cannot be unpacked ({error}); make the archive again, without a password.") from error


def _pieces(packed: IO[bytes]) -> Iterator[bytes]:
    while piece := packed.read(PIECE_BYTES):
        yield piece


def _clutter(name: str) -> bool:
    """Files that archivers of some systems add by themselves."""
    parts = PurePosixPath(name).parts
    return bool(parts) and (parts[0] == "__MACOSX" or parts[-1] in (".DS_Store", "Thumbs.db", "desktop.ini"))


def _target(inside: Path, entry: zipfile.ZipInfo, name: str) -> Path:
    inner = PurePosixPath(entry.filename.replace("\\", "/"))
    if inner.is_absolute() or ".." in inner.parts or ":" in entry.filename or "\0" in entry.filename:
        raise BadInput(
            f"{name} holds the path {entry.filename!r}, which leads out of the archive; it was not unpacked."
        )
    if stat.S_ISLNK(entry.external_attr >> 16):
        raise BadInput(f"{name} holds the link {entry.filename!r}; put the file itself into the archive.")
    return inside.joinpath(*inner.parts)


def _stack_inside(folder: Path, name: str) -> Path:
    """The folder that holds stack.json, however deep an archiver put it, or the one .h5 file."""
    found = sorted(folder.rglob(stacks.STACK_JSON))
    if len(found) == 1:
        return found[0].parent
    if len(found) > 1:
        raise BadInput(f"{name} holds {len(found)} stacks; upload them one by one.")
    ours = sorted(folder.rglob("*.h5"))
    if len(ours) == 1:
        return ours[0]
    raise BadInput(f"{name} holds no {stacks.STACK_JSON}; a stack is a folder with that file and its images.")
