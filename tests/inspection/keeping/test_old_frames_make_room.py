"""Files are held against their hashes; raw frames go by rule, results never."""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from django.conf import settings
from django.utils import timezone

from inspection.keeping.retention import remove_old_stacks
from inspection.keeping.verify import verify
from inspection.models import AuditEvent, RangeImage, Rig, Scan, Tool, User
from inspection.services import queue
from inspection.services.recipes import recipe_named
from inspection.states import ScanState
from scanning.errors import BadInput
from tests.worker.fakes import FakeRig
from worker import compute
from worker.rig import serve

pytestmark = pytest.mark.django_db(transaction=True)
LATER = dt.timedelta(days=100)


@pytest.fixture(autouse=True)
def own_folders(settings: Any, tmp_path: Path) -> None:
    settings.STACKS, settings.RANGES = tmp_path / "stacks", tmp_path / "ranges"


@pytest.fixture
def visits(make_tool: Callable[..., Tool], rig: Rig, olga: User) -> list[Scan]:
    """Three measured visits of one region."""
    tool = make_tool(regions=1, length_mm=0.5, rows=80, flat_row=5, flat_rows=60)
    scans = []
    for _ in range(3):
        scan = queue.enqueue_inspection(tool=tool, rig=rig, by=olga, recipe=recipe_named("NF")).scans.get()
        serve("rig1", opening=FakeRig().opening)
        compute.measure(scan.pk)
        scans.append(Scan.objects.get(pk=scan.pk))
    return scans


def stack(scan: Scan) -> Path:
    return Path(settings.STACKS) / scan.stack_file


def test_old_frames_go_and_results_stay(visits: list[Scan]) -> None:
    would = remove_old_stacks(90, dry_run=True, now=timezone.now() + LATER)
    assert all(stack(scan).exists() for scan in visits)
    removed = remove_old_stacks(90, now=timezone.now() + LATER)

    assert [scan.pk for scan in removed.scans] == [scan.pk for scan in would.scans] == [s.pk for s in visits[:2]]
    assert removed.bytes == would.bytes > 0
    assert [stack(scan).exists() for scan in visits] == [False, False, True]  # the newest of a region always stays
    assert RangeImage.objects.count() == 3
    first = Scan.objects.get(pk=visits[0].pk)
    assert (first.stack_file, first.stack_sha256) == ("", visits[0].stack_sha256)
    assert first.stack_removed_at is not None
    assert AuditEvent.objects.filter(verb="stack.removed").count() == 2
    found = verify()
    assert (found.stacks, found.ranges, found.faults, found.nameless) == (1, 3, [], [])
    assert remove_old_stacks(90, now=timezone.now() + LATER).scans == []
    with pytest.raises(BadInput, match="no stored frames"):
        queue.reprocess(first, None, recipe_named("SCI"))


def test_frames_that_are_young_needed_or_without_a_result_stay(visits: list[Scan], olga: User) -> None:
    assert remove_old_stacks(90).scans == []  # young
    queue.reprocess(visits[0], olga, recipe_named("SCI"))
    Scan.objects.filter(pk=visits[1].pk).update(state=ScanState.INTERRUPTED)
    assert remove_old_stacks(90, now=timezone.now() + LATER).scans == []
    with pytest.raises(BadInput, match="from 1 up"):
        remove_old_stacks(0)


def test_damaged_and_missing_files_are_named_each_in_a_sentence(visits: list[Scan]) -> None:
    assert verify().faults == []
    raw = bytearray(stack(visits[0]).read_bytes())
    raw[len(raw) // 2] ^= 0x10
    stack(visits[0]).write_bytes(raw)
    stack(visits[1]).unlink()
    images = [Path(settings.RANGES) / RangeImage.objects.get(scan=scan).file for scan in visits]
    images[0].write_bytes(images[0].read_bytes() + b"x")
    images[1].unlink()
    (Path(settings.STACKS) / "left.h5").write_bytes(b"nobody's")

    found = verify()
    assert len(found.faults) == 4
    assert "is missing; take it from a backup" in found.faults[1]
    assert "is damaged (its hash differs)" in found.faults[0]
    assert f"Scan {visits[0].pk}: " in found.faults[2]
    assert "are missing; take them from a backup" in found.faults[3]
    assert found.nameless == ["stacks/left.h5"]


def test_frames_swapped_for_other_whole_frames_are_found(visits: list[Scan]) -> None:
    """A file that is sound in itself but is not the one that was recorded."""
    Scan.objects.filter(pk=visits[0].pk).update(stack_sha256="0" * 64)
    (fault,) = verify().faults
    assert "not those that were recorded" in fault
