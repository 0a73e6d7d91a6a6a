"""Recorded frames of a laser line on a metal plate, where they are at hand."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

RECORDED = Path(__file__).resolve().parents[3].parent / "shared" / "data" / "metal_line"


@pytest.fixture(scope="session")
def metal_line() -> dict[str, NDArray[np.uint8]]:
    """Name -> (1024, 1280) frame: utframe0007-0010 are steps, utest5, 4, 3 a bracket of 1 : 1.99 : 3.59."""
    files = sorted(RECORDED.glob("*.png"))
    if not files:
        pytest.skip("the recorded frames of the metal plate are not beside this repository")
    frames = {}
    for file in files:
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        assert image.dtype == np.uint8
        frames[file.name] = np.asarray(image, dtype=np.uint8)
    return frames
