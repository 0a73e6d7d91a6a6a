"""Frames recorded while the stage moves are on disk when they are written, whatever happens to the process after."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from scanning.errors import BadInput
from scanning.frames import StackHeader
from scanning.stacks import StackWriter, open_stack, save_stack
from tests.scanning.stacks.recordings import frames

HEADER = StackHeader(
    rows=20, columns=32, steps=5, exposures_us=(100.0, 300.0), step_um=8.33, row_pitch_um=7.15, mm_per_pixel=0.0142
)

# Writes four steps, then dies by kill -9 inside the fifth: its frames are out, its checksums are not.
WRITER = """
import os, signal, sys
from tests.scanning.stacks.recordings import frames
from tests.scanning.stacks.test_a_recording_survives_the_death_of_its_writer import HEADER
from scanning.stacks import StackWriter, store
writer = StackWriter(sys.argv[1], HEADER)
images = frames()
for step in range(4):
    writer.append(list(images[:, step]))
if sys.argv[2] == "torn":
    store._crc32 = lambda image: os.kill(os.getpid(), signal.SIGKILL)
    writer.append(list(images[:, 4]))
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize("moment", ["between", "torn"])
def test_kill_9_leaves_every_completed_step_readable(tmp_path: Path, moment: str) -> None:
    path = tmp_path / "scan.h5"
    here = Path(__file__).resolve().parents[3]
    died = subprocess.run([sys.executable, "-c", WRITER, str(path), moment], cwd=here, timeout=60, check=False)
    assert died.returncode == -signal.SIGKILL
    assert not path.exists()
    with open_stack(tmp_path / "scan.h5.part") as stack:
        assert stack.partial
        assert stack.header.steps == 4
        np.testing.assert_array_equal(list(stack), frames()[:, :4].swapaxes(0, 1))
        told = stack.sha256()
        saved = save_stack(stack, tmp_path / "saved.h5")
    assert saved.steps == 4
    with open_stack(tmp_path / "saved.h5") as again:
        assert again.sha256() == told


def test_the_part_of_a_dead_writer_does_not_block_the_next_scan(tmp_path: Path) -> None:
    path = tmp_path / "scan.h5"
    here = Path(__file__).resolve().parents[3]
    subprocess.run([sys.executable, "-c", WRITER, str(path), "between"], cwd=here, timeout=60, check=False)
    with StackWriter(path, HEADER) as writer:
        writer.append(list(frames()[:, 0]))
        writer.finish()
    with open_stack(path) as stack:
        assert stack.header.steps == 1


def test_a_damaged_last_step_is_dropped_from_a_partial_stack(tmp_path: Path) -> None:
    writer = StackWriter(tmp_path / "scan.h5", HEADER)
    for step in range(3):
        writer.append(list(frames()[:, step]))
    writer.close()
    with h5py.File(writer.part, "r+") as file:
        file["frames"][2, 1] = 0
    with open_stack(writer.part) as stack:
        assert stack.header.steps == 2


def test_a_stack_can_be_read_while_it_is_being_written(tmp_path: Path) -> None:
    with StackWriter(tmp_path / "scan.h5", HEADER) as writer:
        for step in range(3):
            writer.append(list(frames()[:, step]))
            with open_stack(writer.part) as stack:
                assert stack.partial
                assert stack.header.steps == step + 1
                np.testing.assert_array_equal(stack.step(step), frames()[:, step])


def test_only_a_finished_stack_gets_its_name(tmp_path: Path) -> None:
    path = tmp_path / "new" / "scan.h5"
    with StackWriter(path, HEADER) as writer:
        for step in range(5):
            writer.append(list(frames()[:, step]))
        assert not path.exists()
        assert writer.finish() == HEADER
    assert [one.name for one in path.parent.iterdir()] == ["scan.h5"]
    with open_stack(path) as stack:
        assert not stack.partial
        stack.verify()


def test_a_scan_that_ended_early_says_that_it_is_partial(tmp_path: Path) -> None:
    with StackWriter(tmp_path / "scan.h5", HEADER) as writer:
        writer.append(list(frames()[:, 0]))
        assert writer.finish().steps == 1
    with open_stack(tmp_path / "scan.h5") as stack:
        assert stack.partial
        assert (stack.header.steps, stack.intended) == (1, 5)


def test_an_exception_in_the_scan_keeps_what_was_recorded(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="stage"), StackWriter(tmp_path / "scan.h5", HEADER) as writer:  # noqa: PT012
        writer.append(list(frames()[:, 0]))
        raise RuntimeError("stage")
    with open_stack(tmp_path / "scan.h5.part") as stack:
        assert stack.header.steps == 1


def test_a_recording_without_a_step_is_no_stack(tmp_path: Path) -> None:
    writer = StackWriter(tmp_path / "scan.h5", HEADER)
    with pytest.raises(BadInput, match="no step was recorded"):
        writer.finish()
    writer.close()
    with pytest.raises(BadInput, match="holds no completed step"):
        open_stack(writer.part)
    writer.discard()
    assert not list(tmp_path.iterdir())


def test_a_frame_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    images = frames()
    with StackWriter(tmp_path / "scan.h5", HEADER) as writer:
        with pytest.raises(BadInput, match="has 1 images where the bracket has 2"):
            writer.append([images[0, 0]])
        with pytest.raises(BadInput, match=r"an image of \(10, 32\) uint8"):
            writer.append([images[0, 0], images[1, 0, :10]])
        with pytest.raises(BadInput, match="uint16"):
            writer.append([images[0, 0], images[1, 0].astype(np.uint16)])
        writer.append(list(images[:, 0]))
        assert writer.finish().steps == 1


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_rights_is_named(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(BadInput, match=r"scan\.h5\.part cannot be written"):
        StackWriter(tmp_path / "scan.h5", HEADER)


def test_a_file_where_the_folder_should_be_is_named(tmp_path: Path) -> None:
    (tmp_path / "scans").write_text("")
    with pytest.raises(BadInput, match=r"scan\.h5\.part cannot be written"):
        StackWriter(tmp_path / "scans" / "scan.h5", HEADER)


@pytest.mark.parametrize("compression", ["lzf", "gzip", None])
def test_sixteen_bits_come_back_with_every_compression(tmp_path: Path, compression: str | None) -> None:
    header = StackHeader(20, 32, 5, (100.0, 300.0), 8.33, 7.15, 0.0142, saturation=4095, bits=16)
    images = frames(dtype=np.uint16)
    with StackWriter(tmp_path / "scan.h5", header, compression) as writer:  # type: ignore[arg-type]
        for step in range(5):
            writer.append(list(images[:, step]))
        writer.finish()
    with open_stack(tmp_path / "scan.h5") as stack:
        assert stack.step(0)[0].dtype == np.uint16
        np.testing.assert_array_equal(list(stack), images.swapaxes(0, 1))


def test_memory_does_not_grow_with_the_number_of_steps(tmp_path: Path) -> None:
    header = StackHeader(500, 256, 0, (100.0,), 8.33, 7.15, 0.0142)
    image = np.random.default_rng(0).integers(0, 9, (500, 256), dtype=np.uint8)
    with StackWriter(tmp_path / "scan.h5", header) as writer:
        for _ in range(20):
            writer.append([image])
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        for _ in range(300):
            writer.append([image])
        writer.finish()
    with open_stack(tmp_path / "scan.h5") as stack:
        for _ in stack:
            pass
    grown_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown_kb < 15_000, f"300 steps of 128 kB left {grown_kb} kB in memory"
