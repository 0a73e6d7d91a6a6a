"""Pages of one exposure, one grey image per step, read one at a time from a multi-page TIFF or from single files.

TIFF readers are forgiving: a file cut off in the middle opens with fewer pages, and a compression that is not built in
fails at page 700. Here a damaged file is refused at once, with its name, and uncompressed pages are read straight from
their place in the file, which is as fast as the disk.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from io import FileIO
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import tifffile

from scanning.errors import BadInput
from scanning.rig.protocols import Image
from scanning.stacks.reason import reason

PNG_START = b"\x89PNG\r\n\x1a\n"
PNG_END = b"IEND\xaeB`\x82"
TIFF_SUFFIXES = (".tif", ".tiff")
FRAME_SUFFIXES = (".png", ".bmp", *TIFF_SUFFIXES)

_BLACK_IS_ZERO = 1
_RGB = 2


class Pages(Protocol):
    """The frames of one exposure, in step order; ``bits`` is 8 or 16."""

    name: str
    count: int
    rows: int
    columns: int
    bits: int

    def read(self, index: int) -> Image: ...
    def close(self) -> None: ...


def grey(image: np.ndarray[Any, Any], what: str) -> Image:
    """Turn a decoded image into (rows, columns) grey values, or refuse it.

    A grey picture saved as RGB (equal channels) is accepted. Real colour is refused rather than mixed: a mix of three
    channels has neither the linearity nor the saturation level that stack.json states.
    """
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[:, :, 0]
    if image.ndim == 3 and image.shape[2] in (3, 4):
        first = image[:, :, 0]
        if not (np.array_equal(first, image[:, :, 1]) and np.array_equal(first, image[:, :, 2])):
            raise BadInput(f"{what} is a colour image; save the channel that sees the laser as grey values")
        image = np.ascontiguousarray(first)
    if image.ndim != 2:
        raise BadInput(f"{what} is not a grey image (its shape is {image.shape}); save it as 8 or 16 bit grey values")
    if image.dtype == np.uint8:
        return image
    if image.dtype.kind == "u" and image.dtype.itemsize == 2:
        return image.astype(np.uint16, copy=False)
    raise BadInput(f"{what} holds {image.dtype} values; save it as 8 or 16 bit unsigned grey values")


class TiffPages:
    """A multi-page TIFF, classic or BigTIFF, page = step; also one written as a single three-dimensional series."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.name = path.name
        self._file: FileIO | None = None
        self._tiff: tifffile.TiffFile | None = None
        self._by_opencv = False
        self._offsets: list[int] | None = None
        self._dtype: np.dtype[Any] = np.dtype(np.uint8)
        with self._faults():
            self._survey()

    def _survey(self) -> None:
        size = self.path.stat().st_size
        if size == 0:
            raise BadInput(f"{self.path} is an empty file; copy it again")
        with _quiet(), tifffile.TiffFile(self.path) as tiff:
            pages = list(tiff.pages)
            if not pages:
                raise BadInput(f"{self.path} holds no page; record it again")
            self._refuse_cut_chain(tiff, pages[-1].offset)
            first = tiff.pages.first
            self._refuse_foreign(first)
            self._dtype = np.dtype(first.dtype).newbyteorder(tiff.byteorder)
            self.bits = 8 * self._dtype.itemsize
            shape = tuple(first.shape)
            samples = first.samplesperpixel
            self.rows, self.columns = int(first.imagelength), int(first.imagewidth)
            series = tiff.series[0] if len(pages) == 1 else None
            plain = first.compression == 1 and first.predictor == 1 and first.fillorder == 1 and samples == 1
            if series is not None and len(shape) == 2 and len(series.shape) == 3 and tuple(series.shape[1:]) == shape:
                start = series.dataoffset
                if start is None or not plain:
                    raise BadInput(
                        f"{self.path} is a three-dimensional TIFF that cannot be streamed; save page by page"
                    )
                bytes_each = self.rows * self.columns * self._dtype.itemsize
                self._offsets = [int(start) + i * bytes_each for i in range(int(series.shape[0]))]
            elif len(shape) == 2 or (len(shape) == 3 and shape[2] == samples):
                for number, page in enumerate(pages, start=1):
                    same = tuple(page.shape) == shape and page.dtype == first.dtype
                    if not same:
                        raise BadInput(
                            f"{self.path}, page {number}: {_size(page)} where page 1 is {_size(first)}; "
                            "all pages must have the same size and depth"
                        )
                    if any(o + n > size for o, n in zip(page.dataoffsets, page.databytecounts, strict=False)) or (
                        len(page.dataoffsets) != len(page.databytecounts) or not page.dataoffsets
                    ):
                        raise BadInput(f"{self.path} is cut off in page {number} of {len(pages)}; copy it again")
                if plain and all(page.is_contiguous for page in pages):
                    self._offsets = [int(page.dataoffsets[0]) for page in pages]
            else:
                raise BadInput(f"{self.path} has pages of shape {shape}; save one grey image per page")
            self.count = len(pages) if self._offsets is None else len(self._offsets)
        if self._offsets is not None:
            end = self._offsets[-1] + self.rows * self.columns * self._dtype.itemsize
            if end > size:
                raise BadInput(f"{self.path} is cut off ({size} bytes where {end} are needed); copy it again")
        self.read(0)
        self.close()

    def _refuse_cut_chain(self, tiff: tifffile.TiffFile, last_offset: int) -> None:
        """The reader stops silently where the chain of pages leaves the file; the last link must say "end"."""
        form, file = tiff.tiff, tiff.filehandle
        file.seek(last_offset)
        (tags,) = struct.unpack(form.tagnoformat, file.read(form.tagnosize))
        file.seek(last_offset + form.tagnosize + tags * form.tagsize)
        link = file.read(form.offsetsize)
        if len(link) != form.offsetsize or any(link):
            raise BadInput(f"{self.path} is cut off after {len(tiff.pages)} pages; copy it again")

    def _refuse_foreign(self, page: tifffile.TiffPage) -> None:
        kind = None if page.dtype is None else np.dtype(page.dtype)
        if kind is None or kind.kind != "u" or kind.itemsize not in (1, 2) or page.bitspersample not in (8, 16):
            held = f"{page.bitspersample}-bit {kind or 'unknown'}"
            raise BadInput(f"{self.path} holds {held} values; save it as 8 or 16 bit unsigned grey values")
        if int(page.photometric) not in (_BLACK_IS_ZERO, _RGB):
            name = getattr(page.photometric, "name", str(page.photometric)).lower()
            raise BadInput(f"{self.path} stores its pixels as {name}; save it as grey values with black as zero")

    def read(self, index: int) -> Image:
        """Return one page as (rows, columns). Raises `BadInput` when its data cannot be decoded."""
        with self._faults(index):
            image = self._plain(index) if self._offsets is not None else self._decoded(index)
            if image.shape != (self.rows, self.columns):
                raise BadInput(f"{self.path}, page {index + 1} is damaged: it decodes to {image.shape}; copy it again")
            return image

    def _plain(self, index: int) -> Image:
        if self._file is None:
            self._file = FileIO(self.path)
        assert self._offsets is not None
        image = np.empty((self.rows, self.columns), dtype=self._dtype)
        self._file.seek(self._offsets[index])
        if self._file.readinto(image.data) != image.nbytes:
            raise BadInput(f"{self.path} is cut off in page {index + 1}; copy it again")
        return image if image.dtype.isnative else image.astype(image.dtype.newbyteorder("="))

    def _decoded(self, index: int) -> Image:
        what = f"{self.path}, page {index + 1}"
        if not self._by_opencv:
            try:
                with _quiet():
                    if self._tiff is None:
                        self._tiff = tifffile.TiffFile(self.path)
                    page: Any = self._tiff.pages[index]
                    return grey(np.asarray(page.asarray()), what)
            except ValueError as error:
                # LZW and other codecs live in tifffile's optional imagecodecs; OpenCV carries its own libtiff.
                if "imagecodecs" not in str(error):
                    raise
                self._by_opencv = True
        known, images = cv2.imreadmulti(str(self.path), index, 1, flags=cv2.IMREAD_UNCHANGED)
        if not known or len(images) != 1:
            raise BadInput(f"{what} cannot be decoded; save the file uncompressed, or with LZW or deflate")
        return grey(np.asarray(images[0]), what)

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
        if self._tiff is not None:
            self._tiff.close()
        self._file = self._tiff = None

    @contextmanager
    def _faults(self, index: int | None = None) -> Iterator[None]:
        """Decoders raise dozens of kinds of errors on damaged files; all of them mean the same to a person."""
        try:
            yield
        except BadInput:
            raise
        except FileNotFoundError:
            raise BadInput(f"{self.path} is no longer there; put it back") from None
        except PermissionError as error:
            raise BadInput(f"{self.path} cannot be read ({error.strerror}); check its rights") from None
        except Exception as error:
            part = "" if index is None else f", page {index + 1},"
            raise BadInput(
                f"{self.path}{part} is not a readable TIFF or is damaged ({reason(error)}); copy it again"
            ) from error


class ImageFiles:
    """Single PNG, BMP or TIFF frames, one file per step, in the order given."""

    def __init__(self, paths: list[Path], name: str) -> None:
        self.name = name
        self.paths = paths
        self.count = len(paths)
        self.rows, self.columns, self.bits = _peek(paths[0])
        for path in paths[1:]:
            rows, columns, bits = _peek(path)
            if (rows, columns, bits) != (self.rows, self.columns, self.bits):
                raise BadInput(
                    f"{path} is {rows} x {columns} pixels with {bits} bits, but {paths[0].name} is {self.rows} x "
                    f"{self.columns} with {self.bits} bits; all frames must agree"
                )

    def read(self, index: int) -> Image:
        path = self.paths[index]
        if path.suffix.lower() in TIFF_SUFFIXES:
            pages = TiffPages(path)
            image = pages.read(0)
            pages.close()
        else:
            try:
                stored = np.fromfile(path, dtype=np.uint8)
            except OSError as error:
                raise BadInput(f"{path} cannot be read ({error.strerror}); check that it is still there") from None
            decoded = cv2.imdecode(stored, cv2.IMREAD_UNCHANGED)
            if decoded is None:
                raise BadInput(f"{path} is not a readable image or is damaged; copy it again")
            image = grey(np.asarray(decoded), str(path))
        if image.shape != (self.rows, self.columns) or 8 * image.dtype.itemsize != self.bits:
            raise BadInput(
                f"{path} decodes to {image.shape[0]} x {image.shape[1]} pixels of {image.dtype}, not to the size of "
                f"{self.paths[0].name}; all frames must agree"
            )
        return image

    def close(self) -> None:
        """Nothing stays open between frames."""


def _peek(path: Path) -> tuple[int, int, int]:
    """Rows, columns and bits of a frame from its head, refusing one whose end is missing."""
    if path.suffix.lower() in TIFF_SUFFIXES:
        pages = TiffPages(path)
        if pages.count != 1:
            raise BadInput(
                f"{path} holds {pages.count} pages where single frames were expected; name a multi-page file "
                "exposure-<microseconds>us.tiff"
            )
        return pages.rows, pages.columns, pages.bits
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            head = file.read(32)
            file.seek(max(0, size - 64))
            tail = file.read()
    except OSError as error:
        raise BadInput(f"{path} cannot be read ({error.strerror}); check its rights") from None
    if head.startswith(PNG_START) and len(head) >= 26:
        if PNG_END not in tail:
            raise BadInput(f"{path} is cut off; copy it again")
        columns, rows, bits = struct.unpack(">IIB", head[16:25])
        return rows, columns, 16 if bits == 16 else 8
    if head.startswith(b"BM") and len(head) >= 30:
        (told,) = struct.unpack("<I", head[2:6])
        columns, rows, _planes, _bits = struct.unpack("<iiHH", head[18:30])
        if told > size:
            raise BadInput(f"{path} is cut off ({size} of {told} bytes); copy it again")
        return abs(rows), abs(columns), 8
    fault = "is an empty file" if size == 0 else "is not a readable image"
    raise BadInput(f"{path} {fault}; copy it again")


def _size(page: Any) -> str:
    return f"{' x '.join(str(n) for n in page.shape)} pixels of {page.dtype}"


@contextmanager
def _quiet() -> Iterator[None]:
    """The TIFF reader logs what it tolerates; what matters of it is refused here by name."""
    logger = logging.getLogger("tifffile")
    before = logger.disabled
    logger.disabled = True
    try:
        yield
    finally:
        logger.disabled = before
