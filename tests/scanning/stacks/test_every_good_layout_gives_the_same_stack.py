"""However a stack was stored, the same frames come out in the same order, under the same hash."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from scanning.stacks import import_folder, open_stack
from tests.scanning.stacks.recordings import (
    COLUMNS,
    EXPOSURES,
    ROWS,
    STEPS,
    describe,
    frames,
    record,
    write_image,
    write_pages,
)

Writer = Callable[[Path, NDArray[Any]], None]


def _paged(**options: Any) -> Writer:
    def write(folder: Path, images: NDArray[Any]) -> None:
        for exposure, pages in zip(EXPOSURES, images, strict=True):
            write_pages(folder / f"exposure-{exposure}us.tiff", pages, **options)

    return write


def _opencv(compression: int) -> Writer:
    def write(folder: Path, images: NDArray[Any]) -> None:
        for exposure, pages in zip(EXPOSURES, images, strict=True):
            name = str(folder / f"exposure-{exposure}us.tiff")
            assert cv2.imwritemulti(name, list(pages), [cv2.IMWRITE_TIFF_COMPRESSION, compression])

    return write


def _named(pattern: str) -> Writer:
    def write(folder: Path, images: NDArray[Any]) -> None:
        for exposure, pages in zip(EXPOSURES, images, strict=True):
            write_pages(folder / pattern.format(exposure=exposure), pages)

    return write


def _volume(folder: Path, images: NDArray[Any]) -> None:
    for exposure, pages in zip(EXPOSURES, images, strict=True):
        tifffile.imwrite(folder / f"exposure-{exposure}us.tiff", pages, photometric="minisblack")


def _one_header(folder: Path, images: NDArray[Any]) -> None:
    for exposure, pages in zip(EXPOSURES, images, strict=True):
        tifffile.imwrite(folder / f"exposure-{exposure}us.tiff", pages, photometric="minisblack", truncate=True)


def _rgb_of_equal_channels(folder: Path, images: NDArray[Any]) -> None:
    for exposure, pages in zip(EXPOSURES, images, strict=True):
        coloured = np.repeat(pages[..., None], 3, axis=-1)
        write_pages(folder / f"exposure-{exposure}us.tiff", coloured, photometric="rgb")


def _single(pattern: str, colour: bool = False) -> Writer:
    def write(folder: Path, images: NDArray[Any]) -> None:
        for exposure, pages in zip(EXPOSURES, images, strict=True):
            for step, page in enumerate(pages):
                path = folder / pattern.format(exposure=exposure, step=step + 8)
                path.parent.mkdir(exist_ok=True)
                if path.suffix == ".tif":
                    tifffile.imwrite(path, page, photometric="minisblack")
                else:
                    write_image(path, np.repeat(page[..., None], 3, axis=-1) if colour else page)

    return write


LAYOUTS: dict[str, Writer] = {
    "pages": _paged(),
    "big tiff": _paged(bigtiff=True),
    "deflate": _paged(compression="zlib"),
    "strips of seven rows": _paged(rowsperstrip=7),
    "tiles": _paged(tile=(16, 16)),
    "lzw": _opencv(5),
    "opencv's plain tiff": _opencv(1),
    "one volume": _volume,
    "one header for all pages": _one_header,
    "grey saved as rgb": _rgb_of_equal_channels,
    "fractional name": _named("exposure-{exposure}.0us.tiff"),
    "leading zeros and upper case": _named("Exposure-000{exposure}us.TIF"),
    "png frames named by exposure": _single("scan_{step}_{exposure}us.png"),
    "png frames named exposure first": _single("{exposure}us-{step:04d}.png"),
    "png frames in folders": _single("{exposure}us/{step}.png"),
    "tiff frames in folders": _single("bracket {exposure} us/{step}.tif"),
    "bmp frames": _single("{step:03d}-{exposure}us.bmp"),
    "png frames saved as rgb": _single("{step:03d}-{exposure}us.png", colour=True),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_layout_is_read_page_by_page_as_it_was_recorded(tmp_path: Path, layout: str) -> None:
    images = frames()
    describe(tmp_path)
    LAYOUTS[layout](tmp_path, images)
    with open_stack(tmp_path) as stack, open_stack(record(tmp_path / "plain")) as plain:
        assert (stack.header.rows, stack.header.columns, stack.header.steps) == (ROWS, COLUMNS, STEPS)
        assert stack.header.exposures_us == (100.0, 300.0)
        for step, together in enumerate(stack):
            assert [image.dtype for image in together] == [np.uint8, np.uint8]
            np.testing.assert_array_equal(together, images[:, step])
        assert stack.sha256() == plain.sha256()


@pytest.mark.parametrize("layout", ["pages", "deflate", "lzw", "one volume", "png frames in folders"])
def test_sixteen_bit_frames_come_out_whole(tmp_path: Path, layout: str) -> None:
    images = frames(dtype=np.uint16)
    describe(tmp_path, saturation=4095)
    LAYOUTS[layout](tmp_path, images)
    with open_stack(tmp_path) as stack:
        assert (stack.header.bits, stack.header.saturation) == (16, 4095)
        np.testing.assert_array_equal(list(stack), images.swapaxes(0, 1))


def test_the_byte_order_of_the_recorder_does_not_matter(tmp_path: Path) -> None:
    images = frames(dtype=np.uint16)
    describe(tmp_path, saturation=65535)
    for exposure, pages in zip(EXPOSURES, images, strict=True):
        tifffile.imwrite(tmp_path / f"exposure-{exposure}us.tiff", pages, byteorder=">", photometric="minisblack")
    with open_stack(tmp_path) as stack, open_stack(record(tmp_path / "little", images)) as little:
        np.testing.assert_array_equal(list(stack), images.swapaxes(0, 1))
        assert stack.sha256() == little.sha256()


def test_exposures_listed_in_any_order_are_sorted(tmp_path: Path) -> None:
    with open_stack(record(tmp_path, exposures_us=[300, 100.0])) as stack:
        assert stack.header.exposures_us == (100.0, 300.0)
        np.testing.assert_array_equal(stack.step(3), frames()[:, 3])


def test_with_one_exposure_every_file_is_a_step_and_numbers_count_as_numbers(tmp_path: Path) -> None:
    describe(tmp_path, exposures_us=[100])
    pages = frames()[0]
    for step, page in enumerate(pages):
        write_image(tmp_path / f"frame{step + 8}.png", page)
    (tmp_path / ".DS_Store").write_bytes(b"x")
    (tmp_path / "notes.txt").write_text("knife 12")
    with open_stack(tmp_path) as stack:
        np.testing.assert_array_equal([together[0] for together in stack], pages)


def test_a_logarithmic_camera_has_one_exposure_called_zero(tmp_path: Path) -> None:
    describe(tmp_path, exposures_us=[0], response="logarithmic")
    write_pages(tmp_path / "exposure-0us.tiff", frames()[0])
    with open_stack(tmp_path) as stack:
        assert stack.header.response == "logarithmic"
        assert stack.header.exposures_us == (0.0,)


def test_what_the_recorder_did_not_know_stays_unknown(tmp_path: Path) -> None:
    folder = record(tmp_path, line_width_px=None, dark_level=None, saturation=None, response=None)
    with open_stack(folder) as stack:
        assert stack.header.line_width_px is None
        assert stack.header.dark_level is None
        assert stack.header.saturation == 255
        assert stack.header.response == "linear"


def test_a_folder_and_its_import_are_the_same_stack(tmp_path: Path) -> None:
    folder = record(tmp_path / "scan")
    seen: list[tuple[int, int]] = []
    header = import_folder(folder, tmp_path / "scan.h5", lambda done, of: seen.append((done, of)))
    assert seen == [(step + 1, STEPS) for step in range(STEPS)]
    with open_stack(folder) as stack, open_stack(tmp_path / "scan.h5") as stored:
        assert stored.header == stack.header == header
        assert stored.sha256() == stack.sha256()
        assert not stored.partial
        np.testing.assert_array_equal(list(stored), list(stack))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scan", "scan.h5"]


@pytest.mark.parametrize("change", ["a pixel", "the order of two steps", "the pitch", "the exposure"])
def test_the_hash_changes_with(tmp_path: Path, change: str) -> None:
    images = frames()
    with open_stack(record(tmp_path / "a", images)) as stack:
        before = stack.sha256()
    if change == "a pixel":
        images[1, 2, 3, 4] ^= 1
    if change == "the order of two steps":
        images[:, [1, 2]] = images[:, [2, 1]]
    folder = record(tmp_path / "b", images, **({"row_pitch_um": 7.15} if change == "the pitch" else {}))
    if change == "the exposure":
        describe(folder, exposures_us=[100, 301])
        shutil.move(folder / "exposure-300us.tiff", folder / "exposure-301us.tiff")
    with open_stack(folder) as stack:
        assert stack.sha256() != before
