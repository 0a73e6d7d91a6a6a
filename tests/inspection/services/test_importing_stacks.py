"""A stranger's stack comes in whole or leaves nothing: no row, no file, one sentence."""

from __future__ import annotations

import io
import json
import stat
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from django.conf import settings
from django.core.files.uploadedfile import SimpleUploadedFile

from inspection.models import AuditEvent, Inspection, Rig, Scan, Tool, User
from inspection.services import importing
from inspection.services.recipes import recipe_named
from inspection.states import ScanState
from scanning import open_stack
from scanning.errors import BadInput
from tests.worker.fakes import line_image

DESCRIPTION = {
    "format": "edgewatch-stack/1", "exposures_us": [100, 300], "step_um": 8.33, "row_pitch_um": 7.150838,
    "mm_per_pixel": 0.0142, "line_width_px": 3.03, "dark_level": 2, "saturation": 255, "response": "linear",
}  # fmt: skip


@pytest.fixture(autouse=True)
def own_folders(settings: Any, tmp_path: Path) -> None:
    settings.STACKS, settings.RANGES, settings.UPLOADS = (tmp_path / name for name in ("stacks", "ranges", "uploads"))


def stack_files(steps: int = 10, **described: Any) -> dict[str, bytes]:
    """The files of a small stack by name."""
    files = {"stack.json": json.dumps({**DESCRIPTION, **described}).encode()}
    for exposure in (100, 300):
        out = io.BytesIO()
        tifffile.imwrite(
            out, np.stack([line_image(40, 120, step, exposure) for step in range(steps)]), photometric="minisblack"
        )
        files[f"exposure-{exposure}us.tiff"] = out.getvalue()
    return files


def folder_of(files: dict[str, bytes], folder: Path) -> Path:
    folder.mkdir(parents=True)
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return folder


def zipped(files: dict[str, bytes], *, inside: str = "", method: int = zipfile.ZIP_DEFLATED) -> SimpleUploadedFile:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as archive:
        for name, content in files.items():
            archive.writestr(inside + name, content)
    return SimpleUploadedFile("knife.zip", out.getvalue())


def nothing_stored() -> bool:
    stored = [path for path in settings.STACKS.rglob("*") if path.is_file()] if settings.STACKS.exists() else []
    return (
        not stored and not Scan.objects.exists() and not Inspection.objects.exists() and not AuditEvent.objects.exists()
    )


def no_upload_left() -> bool:
    return not settings.UPLOADS.exists() or not any(settings.UPLOADS.iterdir())


def test_a_folder_becomes_a_scan_waiting_for_its_numbers(tool: Tool, rig: Rig, olga: User, tmp_path: Path) -> None:
    folder = folder_of(stack_files(), tmp_path / "recorded")
    scan = importing.import_stack(
        folder, region=tool.regions.get(name="R2"), rig=rig, by=olga, original_name="knife.zip"
    )

    assert (scan.state, scan.source, scan.recipe.name) == (ScanState.PROCESSING, "import", "PRECISE")
    assert scan.plan["steps"] == scan.total == 10
    assert scan.inspection.reason == "Imported knife.zip"
    with open_stack(settings.STACKS / scan.stack_file) as stored, open_stack(folder) as original:
        assert stored.sha256() == original.sha256() == scan.stack_sha256
    assert AuditEvent.objects.get().actor == olga


@pytest.mark.parametrize("inside", ["", "knife/", "a/b/c/"])
def test_a_zip_is_accepted_however_deep_the_folder_lies(inside: str) -> None:
    place = importing.unpack_upload([zipped({**stack_files(), ".DS_Store": b"x"}, inside=inside)])

    with open_stack(place) as stack:
        assert stack.header.steps == 10
    importing.discard_upload(place)
    assert no_upload_left()


def test_single_files_are_accepted_together() -> None:
    uploads = [SimpleUploadedFile(f"some/folder/{name}", content) for name, content in stack_files().items()]
    place = importing.unpack_upload(uploads)

    with open_stack(place) as stack:
        assert stack.header.steps == 10


def broken(**changes: Any) -> dict[str, bytes]:
    files = stack_files(**changes.pop("described", {}))
    for name, content in changes.pop("files", {}).items():
        if content is None:
            del files[name]
        else:
            files[name] = content
    return files


@pytest.mark.parametrize(
    "files",
    [
        broken(files={"stack.json": None}),
        broken(files={"stack.json": b"{"}),
        broken(files={"exposure-300us.tiff": None}),
        broken(files={"exposure-300us.tiff": b"not a tiff"}),
        broken(files={"exposure-300us.tiff": stack_files()["exposure-300us.tiff"][:30000]}),
        broken(files={"exposure-300us.tiff": stack_files(steps=9)["exposure-300us.tiff"]}),
        broken(described={"step_um": -1}),
        broken(described={"step_um": float("nan")}),
        broken(described={"format": "edgewatch-stack/9"}),
        broken(described={"exposures_us": [100, 500]}),
    ],
    ids=[
        "no stack.json", "bad JSON", "missing exposure", "unreadable TIFF", "truncated TIFF", "other page count",
        "negative step", "NaN step", "other format", "exposures do not match",
    ],
)  # fmt: skip
def test_a_broken_stack_leaves_one_sentence_and_nothing_else(
    tool: Tool, rig: Rig, olga: User, tmp_path: Path, files: dict[str, bytes]
) -> None:
    with pytest.raises(BadInput) as refused:
        importing.import_stack(
            folder_of(files, tmp_path / "recorded"), region=tool.regions.get(name="R1"), rig=rig, by=olga
        )

    assert len(str(refused.value).splitlines()) == 1
    assert nothing_stored()


@pytest.mark.parametrize(("recipe", "says"), [("HDR-CAM", "logarithmic"), ("SCI", "too few for a single profile")])
def test_a_recipe_that_does_not_fit_is_refused_before_anything_is_copied(
    tool: Tool, rig: Rig, olga: User, tmp_path: Path, recipe: str, says: str
) -> None:
    folder = folder_of(stack_files(steps=3), tmp_path / "recorded")
    with pytest.raises(BadInput, match=says):
        importing.import_stack(
            folder, region=tool.regions.get(name="R1"), rig=rig, by=olga, recipe=recipe_named(recipe)
        )

    assert nothing_stored()


def test_a_database_that_refuses_takes_the_file_away_again(
    tool: Tool, rig: Rig, olga: User, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise RuntimeError("no")

    monkeypatch.setattr(importing, "audit", refuse)
    with pytest.raises(RuntimeError):
        importing.import_stack(
            folder_of(stack_files(), tmp_path / "recorded"), region=tool.regions.get(name="R1"), rig=rig, by=olga
        )

    assert nothing_stored()


def evil(name: str, content: bytes = b"x", *, link: bool = False) -> SimpleUploadedFile:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        entry = zipfile.ZipInfo(name)
        if link:
            entry.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(entry, content)
    return SimpleUploadedFile("evil.zip", out.getvalue())


@pytest.mark.parametrize(
    ("upload", "says"),
    [
        (evil("../../outside.txt"), "leads out of the archive"),
        (evil("/etc/outside.txt"), "leads out of the archive"),
        (evil("..\\outside.txt"), "leads out of the archive"),
        (evil("C:/outside.txt"), "leads out of the archive"),
        (evil("stack.json", b"/etc/passwd", link=True), "holds the link"),
        (SimpleUploadedFile("evil.zip", b"PK\x03\x04 broken"), "cannot be unpacked"),
        (zipped({"bomb.tiff": bytes(20_000_000)}), "unpacks to more than"),
        (zipped({"readme.txt": b"hello"}), "holds no stack.json"),
    ],
    ids=["dotdot", "absolute", "backslash", "drive", "link", "broken", "bomb", "no stack"],
)
def test_an_archive_that_means_harm_is_not_unpacked(upload: SimpleUploadedFile, says: str) -> None:
    with pytest.raises(BadInput, match=says):
        importing.unpack_upload([upload])

    assert no_upload_left()


def test_an_upload_over_the_limit_is_refused_while_it_arrives(settings: Any) -> None:
    settings.STACK_UPLOAD_MAX_BYTES = 10_000
    uploads = [SimpleUploadedFile(name, content) for name, content in stack_files().items()]
    with pytest.raises(BadInput, match="larger than"):
        importing.unpack_upload(uploads)

    assert no_upload_left()


def test_an_archive_that_lies_about_its_sizes_is_stopped_while_unpacking(settings: Any) -> None:
    """The directory says 100 bytes; what comes out is counted."""
    honest = zipped({"exposure-100us.tiff": bytes(range(256)) * 4000}, method=zipfile.ZIP_STORED)
    raw = bytearray(honest.read())
    size = (256 * 4000).to_bytes(4, "little")
    raw = bytearray(bytes(raw).replace(size, (100).to_bytes(4, "little")))
    with pytest.raises(BadInput):
        importing.unpack_upload([SimpleUploadedFile("lie.zip", bytes(raw))])

    assert no_upload_left()


def test_two_files_of_one_name_are_refused() -> None:
    same = [SimpleUploadedFile("a/frame.png", b"1"), SimpleUploadedFile("b/frame.png", b"2")]
    with pytest.raises(BadInput, match=r"called frame\.png"):
        importing.unpack_upload(same)

    assert no_upload_left()


def test_only_uploads_are_discarded(tmp_path: Path) -> None:
    outside = folder_of({"keep.txt": b"x"}, tmp_path / "elsewhere")
    with pytest.raises(ValueError, match="is not in the subpath"):
        importing.discard_upload(outside)

    assert (outside / "keep.txt").exists()
