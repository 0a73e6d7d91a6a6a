"""What was backed up can be had again, whole, elsewhere; and a backup that is not whole says so before it does harm."""

from __future__ import annotations

import datetime as dt
import json
import os
import sqlite3
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from django.conf import settings
from django.db import connection

from inspection.keeping.backup import Backup, check_backup, list_backups, make_backup, read_backup, restore_backup
from inspection.keeping.verify import verify
from inspection.models import RangeImage, Rig, Scan, Tool, User
from inspection.services import queue
from inspection.services.recipes import recipe_named
from scanning.errors import BadInput
from tests.postgres import ROOT
from tests.worker.fakes import FakeRig
from worker import compute
from worker.rig import serve

pytestmark = pytest.mark.django_db(transaction=True)


@pytest.fixture(autouse=True)
def own_folders(settings: Any, tmp_path: Path) -> None:
    settings.STACKS, settings.RANGES = tmp_path / "home" / "stacks", tmp_path / "home" / "ranges"


@pytest.fixture
def measure(make_tool: Callable[..., Tool], rig: Rig, olga: User) -> Callable[[str], Scan]:
    """Scan and measure a tool of this code."""

    def one(code: str) -> Scan:
        tool = make_tool(code, regions=1, length_mm=0.5, rows=80, flat_row=5, flat_rows=60)
        scan = queue.enqueue_inspection(tool=tool, rig=rig, by=olga, recipe=recipe_named("NF")).scans.get()
        serve("rig1", opening=FakeRig().opening)
        compute.measure(scan.pk)
        Rig.objects.update(worker_seen_at=None)
        return Scan.objects.get(pk=scan.pk)

    return one


def elsewhere(home: Path, *command: str) -> subprocess.CompletedProcess[str]:
    """Run a command of the product in another, fresh installation on SQLite."""
    environment = {k: v for k, v in os.environ.items() if k not in ("DATABASE_URL", "STACK_KEEP_DAYS")}
    return subprocess.run(
        [sys.executable, "manage.py", *command], cwd=ROOT, text=True, capture_output=True, check=False, timeout=100,
        env={**environment, "EDGEWATCH_HOME": str(home), "DJANGO_SETTINGS_MODULE": "inspection.settings"},
    )  # fmt: skip


def test_an_installation_comes_back_row_for_row_and_file_for_file(
    measure: Callable[[str], Scan], tmp_path: Path
) -> None:
    """Restored on SQLite from whatever this run's database is, checked there, and backed up again: the same rows."""
    measure("K-1"), measure("K-2")
    place, home = tmp_path / "place", tmp_path / "other"
    make_backup(place)
    told = make_backup(tmp_path / "portable", portable=True)

    restored = elsewhere(home, "restore", str(place))
    assert restored.returncode == 0, restored.stderr
    assert "and 4 files" in restored.stdout
    checked = elsewhere(home, "verify")
    assert checked.returncode == 0, checked.stdout + checked.stderr
    assert "2 stacks and 2 range images: all as they were written" in checked.stdout
    again = elsewhere(home, "backup", "--portable", str(tmp_path / "again"))
    assert again.returncode == 0, again.stderr

    there = read_backup(tmp_path / "again")
    assert (there.folder / "database.jsonl").read_bytes() == (told.folder / "database.jsonl").read_bytes()
    assert {(file.path, file.sha256) for file in there.files} == {(file.path, file.sha256) for file in told.files}


def test_rows_written_portably_come_back_into_this_database(measure: Callable[[str], Scan], tmp_path: Path) -> None:
    scan = measure("K-1")
    backup = make_backup(tmp_path / "place", portable=True)
    Scan.objects.filter(pk=scan.pk).update(message="altered since")
    measure("K-2")

    with pytest.raises(BadInput, match="already holds people, tools or scans"):
        restore_backup(backup)
    assert restore_backup(backup, replace=True) == []

    assert Scan.objects.get().message == ""
    assert Tool.objects.get().code == "K-1"
    # Numbers given out from now on do not collide with those that came back.
    assert measure("K-3").pk > scan.pk


def test_one_damaged_file_refuses_the_whole_restore(measure: Callable[[str], Scan], tmp_path: Path) -> None:
    scan = measure("K-1")
    backup = make_backup(tmp_path / "place", portable=True)
    kept = backup.store / "stacks" / scan.stack_file
    raw = bytearray(kept.read_bytes())
    raw[len(raw) // 2] ^= 0x01
    kept.write_bytes(raw)
    here = Path(settings.STACKS) / scan.stack_file
    here.unlink()
    Scan.objects.update(message="as it is now")

    with pytest.raises(BadInput) as refused:
        restore_backup(backup, replace=True)
    assert str(refused.value).startswith(
        f"The backup is not whole, so nothing was restored: stacks/{scan.stack_file} in the backup is damaged: its "
        f"hash differs. (1 in all)"
    )
    assert Scan.objects.get().message == "as it is now"
    assert not here.exists()

    assert len(restore_backup(backup, replace=True, without_damaged=True)) == 1
    assert Scan.objects.get().message == ""
    assert not here.exists()  # a damaged copy is not brought back as if it were whole
    assert len(verify().faults) == 1


def test_a_damaged_database_in_a_backup_is_never_restored(measure: Callable[[str], Scan], tmp_path: Path) -> None:
    measure("K-1")
    backup = make_backup(tmp_path / "place")
    database = next(backup.folder.glob("database.*"))
    database.write_bytes(database.read_bytes()[:-200])

    assert check_backup(backup) == [f"The database {database.name} in the backup is damaged: its hash differs."]
    with pytest.raises(BadInput, match="not whole"):
        restore_backup(backup, replace=True, without_damaged=True)
    assert Scan.objects.count() == 1


def test_the_next_backup_copies_only_what_is_new(
    measure: Callable[[str], Scan], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from inspection.keeping import backup as module

    measure("K-1")
    first = make_backup(tmp_path / "place")
    scan = measure("K-2")
    copied: list[str] = []
    copy = module.copy_hashed
    monkeypatch.setattr(module, "copy_hashed", lambda source, to: copied.append(source.name) or copy(source, to))
    monkeypatch.setattr("django.utils.timezone.now", lambda: dt.datetime(2030, 1, 1, tzinfo=dt.UTC))
    second = make_backup(tmp_path / "place")

    assert sorted(copied) == sorted([Path(RangeImage.objects.get(scan=scan).file).name, Path(scan.stack_file).name])
    assert set(first.files) < set(second.files)
    assert [one.folder.name for one in list_backups(tmp_path / "place")] == [first.folder.name, "20300101T000000"]
    assert check_backup(first) == check_backup(second) == []


def test_a_backup_of_a_running_product_is_one_moment(
    make_tool: Callable[..., Tool], rig: Rig, olga: User, tmp_path: Path
) -> None:
    """Orders come in while the database is copied; each is in the copy with all its scans, or not at all."""
    tool = make_tool("K-1")
    enough = threading.Event()

    def order() -> None:
        while not enough.is_set():
            queue.enqueue_inspection(tool=tool, rig=rig, by=olga)
        connection.close()

    ordering = threading.Thread(target=order)
    ordering.start()
    try:
        backups = [make_backup(tmp_path / f"place{n}") for n in range(4)]
    finally:
        enough.set()
        ordering.join()

    assert any(scans_per_visit(backup) for backup in backups)
    for backup in backups:
        assert set(scans_per_visit(backup).values()) <= {3}


def scans_per_visit(backup: Backup) -> Counter[int]:
    """Count in the copy itself, without the product."""
    if backup.database == "sqlite":
        with closing(sqlite3.connect(backup.folder / "database.sqlite3")) as copy:
            return Counter(
                dict(
                    copy.execute(
                        "SELECT i.id, count(s.id) FROM inspection_inspection i LEFT JOIN inspection_scan s "
                        "ON s.inspection_id = i.id GROUP BY i.id"
                    )
                )
            )
    rows = [json.loads(line) for line in (backup.folder / "database.jsonl").read_text().splitlines()]
    counted = Counter({row["pk"]: 0 for row in rows if row["model"] == "inspection.inspection"})
    for row in rows:
        if row["model"] == "inspection.scan":
            counted[row["fields"]["inspection"]] += 1
    return counted


def test_a_backup_place_inside_the_stacks_is_refused(db: None) -> None:
    with pytest.raises(BadInput, match="lies inside the stacks it would copy"):
        make_backup(Path(settings.STACKS) / "backup")


def test_a_place_that_cannot_be_written_gets_one_sentence(db: None, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(BadInput, match=r"The backup place .* cannot be written"):
        make_backup(tmp_path / "file" / "place")


def test_a_folder_that_is_no_backup_and_one_that_leads_out_are_refused(db: None, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="holds no complete backup"):
        read_backup(tmp_path)
    backup = make_backup(tmp_path / "place")
    manifest = backup.folder / "manifest.json"
    evil = '"files": [{"path": "stacks/../../x", "size": 1, "mtime_ns": 1, "sha256": "0"}]'
    manifest.write_text(manifest.read_text().replace('"files": []', evil))
    with pytest.raises(BadInput, match="no manifest of a backup"):
        read_backup(backup.folder)
