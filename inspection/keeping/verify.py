"""Reads every stack and every range image again and holds it against the hash in its row.

Disks lose bits without a word. Found while a backup still has the file, that is a copy; found by the auditor, it is a
gap in the history.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from django.conf import settings

from inspection.keeping.files import files_below, sha256_of
from inspection.models import RangeImage, Scan
from inspection.states import LIVE
from scanning.errors import Fault
from scanning.stacks import PART_SUFFIX, open_stack

Progress = Callable[[int, int, str], None]


@dataclass
class Verified:
    """What was read, what is wrong with it (sentences), and files that no row names."""

    stacks: int = 0
    ranges: int = 0
    faults: list[str] = field(default_factory=list)
    nameless: list[str] = field(default_factory=list)


def verify(*, stacks: bool = True, progress: Progress = lambda *_: None) -> Verified:
    """Check every file that a row names. ``stacks`` False leaves out the frames, which take long."""
    found = Verified()
    images = RangeImage.objects.order_by("pk").values_list("pk", "file", "sha256")
    scans = Scan.objects.exclude(stack_file="").exclude(state__in=LIVE).order_by("pk")
    total = images.count() + (scans.count() if stacks else 0)
    for done, (pk, name, sha256) in enumerate(images.iterator(), start=1):
        progress(done, total, name)
        found.ranges += 1
        if fault := _range_fault(Path(settings.RANGES) / name, sha256):
            found.faults.append(f"Range image {pk}: {fault}")
    if stacks:
        for done, scan in enumerate(scans.iterator(), start=found.ranges + 1):
            progress(done, total, scan.stack_file)
            found.stacks += 1
            if fault := _stack_fault(Path(settings.STACKS) / scan.stack_file, scan.stack_sha256):
                found.faults.append(f"Scan {scan.pk}: {fault}")
    found.nameless = _nameless()
    return found


def _range_fault(file: Path, sha256: str) -> str:
    if not file.is_file():
        return f"{file.name} is missing; take it from a backup, or compute the scan again."
    try:
        whole = sha256_of(file) == sha256
    except OSError as error:
        return f"{file.name} cannot be read ({error.strerror}); look at the disk, then take it from a backup."
    return "" if whole else f"{file.name} is damaged (its hash differs); take it from a backup, or compute it again."


def _stack_fault(file: Path, sha256: str) -> str:
    if not file.exists():
        return f"its frames {file.name} are missing; take them from a backup."
    try:
        with open_stack(file) as stack:
            verify_frames = getattr(stack, "verify", None)
            if verify_frames is not None:
                verify_frames()
            told = stack.sha256()
    except Fault as fault:
        return str(fault)
    # The part of a scan that broke off has no hash in its row; its frames have just passed their checksums.
    if sha256 and told != sha256:
        return (
            f"the frames in {file.name} are not those that were recorded (their hash differs); take them from a backup."
        )
    return ""


def _nameless() -> list[str]:
    """Files nobody needs any more, as far as the rows know. They are only named; a person decides."""
    stacks = set(Scan.objects.exclude(stack_file="").values_list("stack_file", flat=True))
    ranges = set(RangeImage.objects.values_list("file", flat=True))
    pending = {f"pending/scan-{pk}.npz" for pk in Scan.objects.filter(state__in=LIVE).values_list("pk", flat=True)}
    found = []
    for root, named in ((Path(settings.STACKS), stacks), (Path(settings.RANGES), ranges | pending)):
        for file in files_below(root):
            inner = file.relative_to(root).as_posix()
            # The row of a scan under way names the part; a moment later the finished file is there.
            if inner not in named and f"{inner}{PART_SUFFIX}" not in named:
                found.append(f"{root.name}/{inner}")
    return found
