"""Our own form of a stack: one HDF5 file that grows while the stage moves and survives the death of its writer.

A scan costs minutes of rig time, so frames go to disk as they come; a crash, a pulled plug of the camera or a kill -9
must leave every completed step readable. HDF5's single-writer mode orders its writes so that this holds, a checksum per
frame tells a whole frame from a torn one, and the final name appears only when the file is complete.

Compression is lzf, which every h5py carries: 162 MB/s where the paper's rig delivers some 25 MB/s (gzip-1: 83 MB/s and
a third smaller; none: 377 MB/s). hdf5plugin's bitshuffle would be faster still, but a stack that only opens where a
185 MB extra is installed is not an archive.
"""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import h5py
import numpy as np

from scanning.errors import BadInput
from scanning.frames import Stack, StackHeader
from scanning.rig.protocols import Image
from scanning.stacks.description import header_from_json, header_to_json
from scanning.stacks.identity import Identity, stack_sha256
from scanning.stacks.reason import reason
from scanning.stacks.superblock import open_hdf5

STORE_FORMAT = "edgewatch-frames/1"
PART_SUFFIX = ".part"
"""What an unfinished file's name ends with; `open_stack` reads it as a partial stack."""

Compression = Literal["lzf", "gzip"] | None


class StackWriter:
    """Records a stack step by step with constant memory.

    ``header.steps`` is the number of steps intended (0 when unknown); the number written counts. Until `finish` it
    is called ``<path>.part`` and can already be opened for reading. Leaving the ``with`` block without `finish` keeps
    the part: completed steps are worth keeping. `discard` deletes it.
    """

    def __init__(self, path: Path | str, header: StackHeader, compression: Compression = "lzf") -> None:
        self.path = Path(path)
        self.part = self.path.with_name(self.path.name + PART_SUFFIX)
        self.header = header
        self.steps_written = 0
        self._identity = Identity()
        self._dtype = np.dtype(np.uint8 if header.bits == 8 else "<u2")
        frame = (header.rows, header.columns)
        bracket = len(header.exposures_us)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            # A part left by a dead writer carries its lock flag and cannot be truncated in place.
            self.part.unlink(missing_ok=True)
            self._file: h5py.File | None = h5py.File(self.part, "w", libver=("v110", "v110"))
        except OSError as error:
            raise BadInput(
                f"{self.part} cannot be written ({reason(error)}); check the folder, its rights and the disk"
            ) from error
        # Fixed-length bytes lie in the checksummed head; variable-length text lies in a heap without checksum, and the
        # library never returns from a damaged one.
        self._file.attrs["format"] = np.bytes_(STORE_FORMAT)
        self._file.attrs["header"] = np.bytes_(json.dumps(header_to_json(header), sort_keys=True, allow_nan=False))
        self._frames = self._file.create_dataset(
            "frames",
            shape=(0, bracket, *frame),
            maxshape=(None, bracket, *frame),
            dtype=self._dtype,
            chunks=(1, 1, *frame),
            compression=compression,
            compression_opts=1 if compression == "gzip" else None,
        )
        self._crc32 = self._file.create_dataset(
            "crc32", shape=(0, bracket), maxshape=(None, bracket), dtype="<u4", chunks=(256, bracket)
        )
        self._file.swmr_mode = True

    def append(self, images: Sequence[Image]) -> None:
        """Write one stage position: (rows, columns) images, one per exposure, shortest first.

        When this returns, the step survives the death of the process. Raises `BadInput` for images that do not fit the
        header and when the disk refuses (full, gone).
        """
        if self._file is None:
            raise ValueError("the stack is finished; nothing can be added to it")
        header = self.header
        if len(images) != len(header.exposures_us):
            raise BadInput(
                f"{self.path}: step {self.steps_written} has {len(images)} images where the bracket has "
                f"{len(header.exposures_us)} exposures; record one image per exposure"
            )
        for image in images:
            if image.shape != (header.rows, header.columns) or image.dtype != self._dtype.newbyteorder("="):
                raise BadInput(
                    f"{self.path}: step {self.steps_written} has an image of {image.shape} {image.dtype}, but the "
                    f"stack is {(header.rows, header.columns)} with {header.bits} bits; do not change the camera's mode"
                )
        step = self.steps_written
        try:
            self._frames.resize(step + 1, axis=0)
            for place, image in enumerate(images):
                self._frames[step, place] = image
            self._frames.flush()
            # The checksum is written last: a step without one was never completed.
            self._crc32.resize(step + 1, axis=0)
            self._crc32[step] = [_crc32(image) for image in images]
            self._crc32.flush()
        except (OSError, RuntimeError) as error:
            raise BadInput(f"{self.part} cannot be written ({reason(error)}); make room on the disk") from error
        self._identity.add(images)
        self.steps_written = step + 1

    def finish(self) -> StackHeader:
        """Complete the file, give it its final name and return the header with the steps really written."""
        if self._file is None:
            raise ValueError("the stack is finished already")
        if self.steps_written == 0:
            raise BadInput(f"{self.path}: no step was recorded, so there is no stack to keep")
        done = replace(self.header, steps=self.steps_written)
        try:
            self._file.close()
            self._file = None
            with h5py.File(self.part, "r+", libver=("v110", "v110")) as file:
                file.attrs["steps"] = self.steps_written
                file.attrs["sha256"] = np.bytes_(self._identity.sha256(done))
                file.attrs["complete"] = True
            descriptor = os.open(self.part, os.O_RDWR)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
            os.replace(self.part, self.path)
        except (OSError, RuntimeError) as error:
            raise BadInput(f"{self.part} cannot be finished ({reason(error)}); make room on the disk") from error
        return done

    def close(self) -> None:
        """Stop without finishing: the part stays, readable up to its last completed step."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def discard(self) -> None:
        """Delete the unfinished part."""
        self.close()
        self.part.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class StoredStack:
    """A stack in our HDF5 file, read step by step; every frame is checked against its checksum.

    ``partial`` is True when the recording was not finished, or ended before the intended number of steps (``intended``,
    0 when unknown); the header then counts the completed steps only.
    """

    def __init__(self, path: Path, file: h5py.File, header: StackHeader, intended: int, complete: bool) -> None:
        self.path = path
        self._file: h5py.File = file
        self._header = header
        self._frames: Any = file["frames"]
        self._crc32: Any = file["crc32"][: header.steps]
        self._sha256 = bytes(file.attrs["sha256"]).decode("ascii") if complete else None
        self.intended = intended
        self.partial = not complete or 0 < header.steps < intended

    @classmethod
    def open(cls, path: Path) -> StoredStack:
        """Open a finished file, a part left by a dead writer, or one that is being written now."""
        try:
            file = open_hdf5(path)
        except OSError as error:
            raise BadInput(f"{path} is damaged and cannot be opened ({reason(error)}); use a copy of it") from error
        try:
            return cls._checked(path, file)
        except (KeyError, ValueError, TypeError, OSError, RuntimeError) as error:
            file.close()
            raise BadInput(
                f"{path} is damaged: its index cannot be read ({reason(error)}); use a copy of it"
            ) from error
        except BadInput:
            file.close()
            raise

    @classmethod
    def _checked(cls, path: Path, file: h5py.File) -> StoredStack:
        stored = file.attrs.get("format")
        found = stored.decode("utf-8", "replace") if isinstance(stored, bytes) else stored
        if found != STORE_FORMAT:
            raise BadInput(
                f"{path} is an HDF5 file but no stack of this version (format {found!r}, expected {STORE_FORMAT!r}); "
                "give one recorded or imported here"
            )
        told = json.loads(bytes(file.attrs["header"]))
        intended = int(told["steps"])
        complete = bool(file.attrs.get("complete", False))
        frames: Any = file["frames"]
        crc32: Any = file["crc32"]
        steps = int(file.attrs["steps"]) if complete else min(frames.shape[0], crc32.shape[0])
        if not complete:
            steps = _whole_steps(frames, crc32, steps)
        if steps == 0:
            raise BadInput(f"{path} holds no completed step: its recording broke off at once; scan again")
        header = header_from_json({**told, "steps": steps}, str(path))
        shape = (len(header.exposures_us), header.rows, header.columns)
        if frames.shape[1:] != shape or frames.shape[0] < steps or crc32.shape[0] < steps:
            raise BadInput(f"{path} is damaged: its frames are {frames.shape}, its header says {(steps, *shape)}")
        return cls(path, file, header, intended, complete)

    @property
    def header(self) -> StackHeader:
        return self._header

    def step(self, index: int) -> list[Image]:
        """Return the (rows, columns) images of one stage position, shortest exposure first."""
        if not 0 <= index < self._header.steps:
            raise IndexError(f"step {index} of a stack with {self._header.steps} steps")
        try:
            images = [np.asarray(image) for image in self._frames[index]]
        except (OSError, RuntimeError) as error:
            raise BadInput(f"{self.path} is damaged at step {index} ({reason(error)}); use a copy of it") from error
        for place, image in enumerate(images):
            if _crc32(image) != int(self._crc32[index, place]):
                raise BadInput(f"{self.path} is damaged at step {index}: a frame fails its checksum; use a copy of it")
        return [image.astype(image.dtype.newbyteorder("="), copy=False) for image in images]

    def __iter__(self) -> Iterator[list[Image]]:
        for index in range(self._header.steps):
            yield self.step(index)

    def sha256(self) -> str:
        """Hash over header and pixels. A finished file carries it; of a partial one it is computed once."""
        if self._sha256 is None:
            self._sha256 = stack_sha256(self._header, self)
        return self._sha256

    def verify(self) -> None:
        """Read every frame and compare the hash with the one stored. Raises `BadInput` when they differ."""
        if stack_sha256(self._header, self) != self.sha256():
            raise BadInput(f"{self.path} does not match its own hash: it was altered after recording; use a copy of it")

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def save_stack(
    stack: Stack,
    path: Path,
    progress: Callable[[int, int], None] | None = None,
    compression: Compression = "lzf",
) -> StackHeader:
    """Write any stack into our HDF5 file, all or nothing. ``progress`` gets (steps done, steps in all)."""
    if path.exists():
        raise BadInput(f"{path} exists already; give another name or take the old file away")
    writer = StackWriter(path, stack.header, compression)
    try:
        for done, images in enumerate(stack, start=1):
            writer.append(images)
            if progress is not None:
                progress(done, stack.header.steps)
        return writer.finish()
    except BaseException:
        writer.discard()
        raise


def _whole_steps(frames: Any, crc32: Any, steps: int) -> int:
    """Count back from the end to the last step whose frames match their checksums."""
    while steps > 0:
        try:
            whole = all(
                _crc32(np.asarray(image)) == int(known)
                for image, known in zip(frames[steps - 1], crc32[steps - 1], strict=True)
            )
        except (OSError, RuntimeError):
            whole = False
        if whole:
            return steps
        steps -= 1
    return 0


def _crc32(image: np.ndarray[Any, Any]) -> int:
    plain = np.ascontiguousarray(image)
    if plain.dtype.itemsize > 1:
        plain = plain.astype(plain.dtype.newbyteorder("<"), copy=False)
    return zlib.crc32(plain.data)
