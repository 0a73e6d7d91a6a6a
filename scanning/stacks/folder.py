"""A folder of images with a stack.json, as other software records it, read as a stack.

Which file holds which exposure is decided here and nowhere else: a wrong guess would divide grey values by the wrong
time and still look like a range image. Hence every layout is either one of the three below or refused.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Self

from scanning.errors import BadInput
from scanning.frames import StackHeader
from scanning.rig.protocols import Image
from scanning.stacks.description import STACK_JSON, Description, read_description
from scanning.stacks.identity import stack_sha256
from scanning.stacks.pages import FRAME_SUFFIXES, ImageFiles, Pages, TiffPages

_NUMBER = r"(\d+(?:[.,]\d+)?)"
_EXPOSURE_FILE = re.compile(rf"exposure[-_]{_NUMBER}\s*us\.tiff?", re.IGNORECASE)
_EXPOSURE_IN_NAME = re.compile(rf"(?<![\d.,]){_NUMBER}\s*us(?![a-z])", re.IGNORECASE)
_SAME = 1e-6


class FolderStack:
    """A stack of contract 2. Three layouts, all beside one ``stack.json``:

    - one multi-page TIFF per exposure, ``exposure-<microseconds>us.tiff``, page = step;
    - with ONE exposure: single PNG, BMP or TIFF frames, each file a step, in name order (numbers in names count as
      numbers: frame2 comes before frame10);
    - with SEVERAL exposures: single frames that carry their exposure in the name (``0007-300us.png``), or lie in one
      sub-folder per exposure (``300us/0007.png``); inside each exposure name order is step order.

    Other files and hidden ones are passed over. Frames are read on demand; nothing is kept.
    """

    partial = False

    def __init__(self, path: Path, header: StackHeader, exposures: list[Pages]) -> None:
        self.path = path
        self._header = header
        self._exposures = exposures
        self._sha256: str | None = None

    @classmethod
    def open(cls, path: Path) -> FolderStack:
        """Check the whole folder and open it, or raise `BadInput` with one sentence."""
        described = read_description(path / STACK_JSON)
        try:
            files = sorted(one for one in path.iterdir() if one.is_file() and not one.name.startswith("."))
        except OSError as error:
            raise BadInput(f"{path} cannot be listed ({error.strerror}); check its rights") from None
        bracket = [one for one in files if _EXPOSURE_FILE.fullmatch(one.name)]
        exposures: list[Pages] = []
        if bracket:
            exposures += _tiff_per_exposure(path, described, bracket)
        else:
            exposures += _single_frames(path, described, files)
        first = exposures[0]
        for other in exposures[1:]:
            if other.count != first.count:
                raise BadInput(
                    f"{path}: {other.name} has {other.count} steps but {first.name} has {first.count}; "
                    "every exposure must have one image per step"
                )
            if (other.rows, other.columns, other.bits) != (first.rows, first.columns, first.bits):
                raise BadInput(
                    f"{path}: {other.name} is {other.rows} x {other.columns} pixels with {other.bits} bits but "
                    f"{first.name} is {first.rows} x {first.columns} with {first.bits} bits; all exposures must agree"
                )
        header = described.header(
            rows=first.rows, columns=first.columns, steps=first.count, bits=first.bits, where=str(path)
        )
        return cls(path, header, exposures)

    @property
    def header(self) -> StackHeader:
        return self._header

    def step(self, index: int) -> list[Image]:
        """Return the (rows, columns) images of one stage position, shortest exposure first."""
        if not 0 <= index < self._header.steps:
            raise IndexError(f"step {index} of a stack with {self._header.steps} steps")
        return [pages.read(index) for pages in self._exposures]

    def __iter__(self) -> Iterator[list[Image]]:
        for index in range(self._header.steps):
            yield self.step(index)

    def sha256(self) -> str:
        """Hash over header and pixels (see `identity`). Reads the stack once, then remembers."""
        if self._sha256 is None:
            self._sha256 = stack_sha256(self._header, self)
        return self._sha256

    def close(self) -> None:
        for pages in self._exposures:
            pages.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _tiff_per_exposure(path: Path, described: Description, files: list[Path]) -> list[TiffPages]:
    found: dict[int, Path] = {}
    for file in files:
        match = _EXPOSURE_FILE.fullmatch(file.name)
        assert match is not None
        place = _place(float(match[1].replace(",", ".")), described)
        if place is None:
            raise BadInput(
                f"{path}: {file.name} is not among exposures_us {_listed(described)} of {STACK_JSON}; "
                "add its exposure there or take the file away"
            )
        if place in found:
            raise BadInput(f"{path}: {found[place].name} and {file.name} are the same exposure; keep one of them")
        found[place] = file
    for place, exposure in enumerate(described.exposures_us):
        if place not in found:
            raise BadInput(
                f"{path}: exposure-{exposure:g}us.tiff is missing, but exposures_us of {STACK_JSON} is "
                f"{_listed(described)}; add the file or take the exposure out"
            )
    return [TiffPages(found[place]) for place in range(len(found))]


def _single_frames(path: Path, described: Description, files: list[Path]) -> list[ImageFiles]:
    frames = sorted((one for one in files if one.suffix.lower() in FRAME_SUFFIXES), key=name_order)
    folders = [
        (one, match)
        for one in sorted(path.iterdir())
        if one.is_dir() and (match := _EXPOSURE_IN_NAME.search(one.name)) is not None
    ]
    groups: dict[int, list[Path]] = {}
    if frames:
        if len(described.exposures_us) == 1:
            return [ImageFiles(_of_this_exposure(path, described, frames), path.name)]
        for frame in frames:
            match = _EXPOSURE_IN_NAME.search(frame.stem)
            if match is None:
                raise BadInput(
                    f"{path}: {frame.name} does not say which of the exposures {_listed(described)} it belongs to; "
                    "name single frames like 0007-300us.png or use one sub-folder per exposure"
                )
            groups.setdefault(_known(match, frame.name, path, described), []).append(frame)
    elif folders:
        for folder, match in folders:
            inside = [one for one in folder.iterdir() if one.is_file() and not one.name.startswith(".")]
            images = sorted((one for one in inside if one.suffix.lower() in FRAME_SUFFIXES), key=name_order)
            if not images:
                raise BadInput(f"{folder} holds no PNG, BMP or TIFF frame; add the frames or take the folder away")
            groups.setdefault(_known(match, folder.name, path, described), []).extend(images)
    else:
        lossy = next((one for one in files if one.suffix.lower() in (".jpg", ".jpeg")), None)
        fault = (
            f"{lossy.name} is JPEG, which alters the grey values" if lossy else "there is no image beside " + STACK_JSON
        )
        raise BadInput(
            f"{path}: {fault}; add exposure-{described.exposures_us[0]:g}us.tiff or single PNG, BMP or TIFF frames"
        )
    for place, exposure in enumerate(described.exposures_us):
        if place not in groups:
            raise BadInput(
                f"{path}: there are no frames for {exposure:g} us, but exposures_us of {STACK_JSON} is "
                f"{_listed(described)}; add them or take the exposure out"
            )
    return [ImageFiles(groups[place], f"{described.exposures_us[place]:g}us frames") for place in range(len(groups))]


def _of_this_exposure(path: Path, described: Description, frames: list[Path]) -> list[Path]:
    """With one exposure a name need not say it, but when it says another one, something is mixed up."""
    for frame in frames:
        match = _EXPOSURE_IN_NAME.search(frame.stem)
        if match is not None and described.exposures_us[0] > 0:
            _known(match, frame.name, path, described)
    return frames


def _known(match: re.Match[str], name: str, path: Path, described: Description) -> int:
    place = _place(float(match[1].replace(",", ".")), described)
    if place is None:
        raise BadInput(
            f"{path}: {name} is of an exposure that is not among exposures_us {_listed(described)} of {STACK_JSON}; "
            "add it there or take the file away"
        )
    return place


def _place(exposure_us: float, described: Description) -> int | None:
    for place, known in enumerate(described.exposures_us):
        if abs(exposure_us - known) <= _SAME * max(known, 1e-3):
            return place
    return None


def _listed(described: Description) -> str:
    return "[" + ", ".join(f"{one:g}" for one in described.exposures_us) + "]"


def name_order(path: Path) -> tuple[list[tuple[int, int, str]], str]:
    """Sort key: name order in which runs of digits count as numbers, so that frame2 comes before frame10."""
    parts = re.split(r"(\d+)", path.name.lower())
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts if part], path.name
