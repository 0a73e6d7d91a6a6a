"""Frames of a real laser line on metal open as a stack of steps and as a bracket of exposures."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from scanning.stacks import import_folder, open_stack
from tests.scanning.stacks.recordings import describe

FRAMES = Path(__file__).resolve().parents[3].parent / "shared" / "data" / "metal_line"
pytestmark = pytest.mark.skipif(not FRAMES.is_dir(), reason="the shared real frames are not here")


def test_as_steps_with_one_exposure(tmp_path: Path) -> None:
    for name in ("utframe0010", "utframe0007", "utframe0009", "utframe0008"):
        shutil.copy(FRAMES / f"{name}.png", tmp_path)
    describe(tmp_path, exposures_us=[100], line_width_px=None, dark_level=None)
    with open_stack(tmp_path) as stack:
        assert stack.header.steps == 4
        for number, (image,) in enumerate(stack, start=7):
            stored = cv2.imread(str(FRAMES / f"utframe{number:04d}.png"), cv2.IMREAD_UNCHANGED)
            assert stored is not None
            np.testing.assert_array_equal(image, stored if stored.ndim == 2 else stored[..., 0])


def test_as_a_bracket_of_one_step(tmp_path: Path) -> None:
    for name, exposure in (("utest5", 100), ("utest4", 199), ("utest3", 359)):
        shutil.copy(FRAMES / f"{name}.png", tmp_path / f"0001-{exposure}us.png")
    describe(tmp_path, exposures_us=[100, 199, 359], line_width_px=None, dark_level=None)
    header = import_folder(tmp_path, tmp_path / "scan.h5")
    assert (header.rows, header.columns, header.steps) == (1024, 1280, 1)
    with open_stack(tmp_path / "scan.h5") as stack:
        means = [float(image.mean()) for image in stack.step(0)]
        assert means == sorted(means)
