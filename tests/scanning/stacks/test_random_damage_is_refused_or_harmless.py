"""Whatever bytes are damaged, opening and reading ends at once: in frames, or in one sentence. Never in a hang.

Found by this fuzzing: single-writer retries of ten minutes, an endless loop over a damaged text heap, and decoders'
errors of several lines.
"""

from __future__ import annotations

import random
import shutil
from pathlib import Path

import cv2
import pytest

from scanning.errors import BadInput
from scanning.stacks import StackWriter, import_folder, open_stack
from tests.scanning.stacks.recordings import EXPOSURES, frames, record, write_pages

ROUNDS = 60


def _recorded(tmp_path: Path, kind: str) -> tuple[Path, Path]:
    """What to open, and which file of it to damage."""
    folder = record(tmp_path / "scan")
    last = folder / "exposure-300us.tiff"
    if kind == "stored":
        import_folder(folder, tmp_path / "scan.h5")
        return tmp_path / "scan.h5", tmp_path / "scan.h5"
    if kind == "part of a dead writer":
        with open_stack(folder) as stack, StackWriter(tmp_path / "scan.h5", stack.header) as writer:
            for images in stack:
                writer.append(images)
            shutil.copy(writer.part, tmp_path / "copy.part")
        return tmp_path / "copy.part", tmp_path / "copy.part"
    if kind == "deflate":
        write_pages(last, frames()[1], compression="zlib")
    if kind == "lzw":
        for exposure, pages in zip(EXPOSURES, frames(), strict=True):
            name = str(folder / f"exposure-{exposure}us.tiff")
            assert cv2.imwritemulti(name, list(pages), [cv2.IMWRITE_TIFF_COMPRESSION, 5])
    return folder, last


@pytest.mark.timeout(60)
@pytest.mark.parametrize("kind", ["plain", "deflate", "lzw", "stored", "part of a dead writer"])
def test_random_damage_ends_in_frames_or_in_one_sentence(tmp_path: Path, kind: str) -> None:
    place, damaged = _recorded(tmp_path, kind)
    whole = damaged.read_bytes()
    chance = random.Random(kind)
    refused: list[str] = []
    for _ in range(ROUNDS):
        data = bytearray(whole)
        for _ in range(chance.choice([1, 2, 8, 40])):
            end = len(data) if chance.random() < 0.6 else min(len(data), 2000)
            data[chance.randrange(end)] = chance.randrange(256)
        if chance.random() < 0.2:
            del data[chance.randrange(len(data)) :]
        damaged.write_bytes(bytes(data))
        try:
            with open_stack(place) as stack:
                for _images in stack:
                    pass
        except BadInput as fault:
            refused.append(str(fault))
    assert refused
    assert [said for said in refused if "\n" in said or damaged.name not in said] == []
