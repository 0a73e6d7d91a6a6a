"""A stack that cannot be trusted is refused with one sentence naming file and fault; nothing is half imported."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile

from scanning.errors import BadInput
from scanning.stacks import import_folder, open_stack
from tests.scanning.stacks.recordings import DESCRIPTION, describe, frames, record, write_image, write_pages

Break = Callable[[Path], object]


def _said(**changes: Any) -> Break:
    return lambda folder: describe(folder, **changes)


def _text(text: str | bytes) -> Break:
    data = text.encode() if isinstance(text, str) else text
    return lambda folder: (folder / "stack.json").write_bytes(data)


def _raw(key: str, written: str) -> Break:
    """Write a value that json.dumps would not, such as NaN or 1e999."""

    def break_it(folder: Path) -> None:
        parts = [f'"{name}": {json.dumps(value)}' for name, value in DESCRIPTION.items() if name != key]
        (folder / "stack.json").write_text("{" + ", ".join([*parts, f'"{key}": {written}']) + "}")

    return break_it


def _cut(name: str, keep: float) -> Break:
    def break_it(folder: Path) -> None:
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: int(len(data) * keep)])

    return break_it


def _without(name: str) -> Break:
    return lambda folder: (folder / name).unlink()


def _pages(name: str, pages: Any, **options: Any) -> Break:
    return lambda folder: write_pages(folder / name, pages, **options)


def _bytes(name: str, data: bytes) -> Break:
    return lambda folder: (folder / name).write_bytes(data)


def _together(*breaks: Break) -> Break:
    def break_it(folder: Path) -> None:
        for one in breaks:
            one(folder)

    return break_it


def _uneven_pages(folder: Path) -> None:
    with tifffile.TiffWriter(folder / "exposure-300us.tiff") as tiff:
        for page in [*frames()[1][:4], frames()[1][0][:10]]:
            tiff.write(page, contiguous=False, photometric="minisblack")


def _uneven_depth(folder: Path) -> None:
    with tifffile.TiffWriter(folder / "exposure-300us.tiff") as tiff:
        for page in [*frames()[1][:4], frames()[1][0].astype(np.uint16)]:
            tiff.write(page, contiguous=False, photometric="minisblack")


def _no_tiffs(folder: Path) -> None:
    for name in ("exposure-100us.tiff", "exposure-300us.tiff"):
        (folder / name).unlink()


def _frames(names: list[str], images: Any = None) -> Break:
    def break_it(folder: Path) -> None:
        _no_tiffs(folder)
        for place, name in enumerate(names):
            write_image(folder / name, frames()[0][place % 5] if images is None else images[place])

    return break_it


def _garble_deflate(folder: Path) -> None:
    path = folder / "exposure-300us.tiff"
    write_pages(path, frames()[1], compression="zlib")
    data = bytearray(path.read_bytes())
    with tifffile.TiffFile(path) as tiff:
        place = tiff.pages[0].dataoffsets[0]  # type: ignore[union-attr]
    data[place + 20 : place + 60] = bytes(40)
    path.write_bytes(bytes(data))


T1, T3 = "exposure-100us.tiff", "exposure-300us.tiff"
COLOUR = np.random.default_rng(3).integers(0, 255, (5, 20, 32, 3), dtype=np.uint8)

# what was done to a good folder -> what the sentence must say
CASES: dict[str, tuple[Break, list[str]]] = {
    "no stack.json": (_without("stack.json"), ["has no stack.json", "add one"]),
    "empty stack.json": (_text(""), ["stack.json is not valid JSON"]),
    "half a stack.json": (_text('{"format": "edgewatch-stack/1",'), ["stack.json is not valid JSON", "line 1"]),
    "stack.json of bytes": (_text(b"\xff\xfe\x00"), ["stack.json is not UTF-8"]),
    "stack.json is a list": (_text("[]"), ["must hold one JSON object"]),
    "stack.json nested without end": (_text("[" * 100_000), ["stack.json is not valid JSON"]),
    "no format": (_said(format=None), ['lacks "format"']),
    "a later format": (_said(format="edgewatch-stack/2"), ['format "edgewatch-stack/2" is unknown']),
    "format is a number": (_said(format=1), ["format 1 is unknown"]),
    "no step": (_said(step_um=None), ['lacks "step_um"', "micrometres"]),
    "no pitch": (_said(row_pitch_um=None), ['lacks "row_pitch_um"']),
    "no scale": (_said(mm_per_pixel=None), ['lacks "mm_per_pixel"']),
    "no exposures": (_said(exposures_us=None), ['lacks "exposures_us"']),
    "a misspelt key": (_said(dark_level=None, dark_levl=3), ['"dark_levl"', 'did you mean "dark_level"?']),
    "step is text": (_said(step_um="8.33"), ['step_um must be a number, not "8.33"']),
    "step is true": (_said(step_um=True), ["step_um must be a number, not true"]),
    "step is zero": (_said(step_um=0), ["step_um is 0", "greater than zero"]),
    "step is negative": (_said(step_um=-8.33), ["step_um is -8.33", "greater than zero"]),
    "step is NaN": (_raw("step_um", "NaN"), ["step_um is nan, not a finite number"]),
    "step in nanometres": (_said(step_um=83300.0), ["step_um is 83300", "check the unit"]),
    "pitch is infinite": (_raw("row_pitch_um", "Infinity"), ["row_pitch_um is inf"]),
    "pitch overflows": (_raw("row_pitch_um", "1" + "0" * 400), ["row_pitch_um is inf"]),
    "pitch is zero": (_said(row_pitch_um=0.0), ["row_pitch_um is 0"]),
    "scale is negative": (_said(mm_per_pixel=-0.0142), ["mm_per_pixel is -0.0142"]),
    "scale in um": (_said(mm_per_pixel=14.2), ["mm_per_pixel is 14.2", "check the unit"]),
    "line width is zero": (_said(line_width_px=0), ["line_width_px is 0"]),
    "line wider than the frame": (_said(line_width_px=40), ["line_width_px 40 is wider than the frame (32 columns)"]),
    "dark level is negative": (_said(dark_level=-1), ["dark_level is -1"]),
    "dark level is text": (_said(dark_level="low"), ['dark_level must be a number, not "low"']),
    "dark over saturation": (_said(dark_level=255), ["dark_level 255 is not below saturation 255"]),
    "saturation is a fraction": (_said(saturation=254.5), ["saturation 254.5 must be a whole grey value"]),
    "saturation is zero": (_said(saturation=0), ["saturation is 0"]),
    "saturation of a deeper camera": (_said(saturation=4095), ["saturation 4095 is beyond the 255 that 8-bit"]),
    "response unknown": (_said(response="gamma"), ['response "gamma" is unknown']),
    "response is a list": (_said(response=["linear"]), ['response ["linear"] is unknown']),
    "exposures is a number": (_said(exposures_us=100), ["exposures_us must be a list"]),
    "exposures is empty": (_said(exposures_us=[]), ["exposures_us must be a list"]),
    "exposures hold text": (_said(exposures_us=[100, "300"]), ['exposures_us must be a number, not "300"']),
    "exposures hold null": (_said(exposures_us=[100, float("nan")]), ["exposures_us is nan"]),
    "exposure of zero": (_said(exposures_us=[0, 100]), ["exposures_us holds 0"]),
    "negative exposure": (_said(exposures_us=[-100, 300]), ["exposures_us holds -100"]),
    "the same exposure twice": (_said(exposures_us=[100, 300, 300]), ["the same exposure twice"]),
    "sixty-five exposures": (_said(exposures_us=list(range(1, 66))), ["lists 65 exposures"]),
    "logarithmic bracket": (_said(response="logarithmic"), ["logarithmic camera has no exposure time", "must be [0]"]),
    "missing exposure": (_without(T3), ["exposure-300us.tiff is missing", "[100, 300]"]),
    "exposure not listed": (_said(exposures_us=[100]), ["exposure-300us.tiff is not among exposures_us [100]"]),
    "exposure listed, not there": (_said(exposures_us=[100, 300, 900]), ["exposure-900us.tiff is missing"]),
    "one exposure in two files": (
        _pages("exposure-300.0us.tif", frames()[1]),
        ["exposure-300.0us.tif", "exposure-300us.tiff", "the same exposure"],
    ),
    "empty tiff": (_bytes(T3, b""), [T3, "is an empty file"]),
    "text as tiff": (_bytes(T3, b"not a picture at all, sorry"), [T3, "is not a readable TIFF"]),
    "head of a tiff only": (_bytes(T3, b"II*\x00\x08\x00\x00\x00"), [T3]),
    "tiff cut in the middle": (_cut(T3, 0.6), [T3, "cut off"]),
    "tiff without its last byte": (_cut(T3, 0.9999), [T3, "cut off"]),
    "volume cut in the middle": (
        _together(
            lambda folder: tifffile.imwrite(folder / T3, frames()[1], photometric="minisblack", truncate=True),
            _cut(T3, 0.6),
        ),
        [T3, "cut off"],
    ),
    "garbled deflate": (_garble_deflate, [T3, "page 1", "damaged"]),
    "one page less": (_pages(T3, frames()[1][:4]), [f"{T3} has 4 steps but {T1} has 5"]),
    "pages of another size": (
        _pages(T3, frames()[1][:, :, :30]),
        [f"{T3} is 20 x 30 pixels", f"{T1} is 20 x 32"],
    ),
    "a page of another size": (_uneven_pages, [T3, "page 5", "10 x 32 pixels"]),
    "a page of another depth": (_uneven_depth, [T3, "page 5", "uint16"]),
    "exposures of other depths": (_pages(T3, frames()[1].astype(np.uint16)), ["with 16 bits", "with 8 bits"]),
    "sixteen bits without saturation": (
        _together(
            _said(saturation=None), _pages(T1, frames(dtype=np.uint16)[0]), _pages(T3, frames(dtype=np.uint16)[1])
        ),
        ["has no saturation", "4095"],
    ),
    "real colour": (_pages(T3, COLOUR, photometric="rgb"), [T3, "page 1 is a colour image"]),
    "floats": (_pages(T3, frames()[1].astype(np.float32)), [T3, "float32", "8 or 16 bit unsigned"]),
    "signed": (_pages(T3, frames()[1].astype(np.int16)), [T3, "int16", "8 or 16 bit unsigned"]),
    "thirty-two bits": (_pages(T3, frames()[1].astype(np.uint32)), [T3, "uint32", "8 or 16 bit unsigned"]),
    "inverted grey": (_pages(T3, frames()[1], photometric="miniswhite"), [T3, "miniswhite", "black as zero"]),
    "too narrow": (
        _together(_pages(T1, frames()[0][:, :, :3]), _pages(T3, frames()[1][:, :, :3])),
        ["20 x 3 pixels are too small"],
    ),
    "no images": (_no_tiffs, ["there is no image beside stack.json"]),
    "only jpeg": (_frames(["a.jpg"]), ["a.jpg is JPEG, which alters the grey values"]),
    "frames that do not say their exposure": (
        _frames(["0.png", "1.png"]),
        ["0.png does not say which of the exposures"],
    ),
    "frames of an unlisted exposure": (
        _frames(["0-100us.png", "0-900us.png"]),
        ["0-900us.png", "not among", "[100, 300]"],
    ),
    "frames of one exposure only": (_frames(["0-100us.png", "1-100us.png"]), ["no frames for 300 us"]),
    "a bracket with a hole": (
        _frames(["0-100us.png", "0-300us.png", "1-100us.png"]),
        ["300us frames has 1 steps but 100us frames has 2"],
    ),
    "a single frame of another exposure": (
        _together(_said(exposures_us=[100]), _frames(["0-100us.png", "1-300us.png"])),
        ["1-300us.png", "not among exposures_us [100]"],
    ),
    "a frame of another size": (
        _together(_said(exposures_us=[100]), _frames(["0.png", "1.png"], [frames()[0][0], frames()[0][1][:9]])),
        ["1.png is 9 x 32 pixels", "0.png is 20 x 32"],
    ),
    "an empty frame": (
        _together(_said(exposures_us=[100]), _frames(["0.png"]), _bytes("1.png", b"")),
        ["1.png", "empty"],
    ),
    "a frame cut off": (
        _together(_said(exposures_us=[100]), _frames(["0.png", "1.png"]), _cut("1.png", 0.7)),
        ["1.png is cut off"],
    ),
    "a bitmap cut off": (
        _together(_said(exposures_us=[100]), _frames(["0.bmp", "1.bmp"]), _cut("1.bmp", 0.7)),
        ["1.bmp is cut off"],
    ),
    "text as a frame": (
        _together(_said(exposures_us=[100]), _frames(["0.png"]), _bytes("1.png", b"hello, I am not a picture " * 3)),
        ["1.png is not a readable image"],
    ),
    "many pages where frames belong": (
        _together(_said(exposures_us=[100]), _no_tiffs, _pages("scan.tiff", frames()[0])),
        ["scan.tiff holds 5 pages", "exposure-<microseconds>us.tiff"],
    ),
    "an empty sub-folder": (
        _together(_no_tiffs, lambda folder: (folder / "100us").mkdir()),
        ["100us holds no PNG, BMP or TIFF frame"],
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_a_broken_folder_is_refused_and_nothing_is_imported(tmp_path: Path, case: str) -> None:
    break_it, said = CASES[case]
    folder = record(tmp_path / "scan")
    break_it(folder)
    with pytest.raises(BadInput) as caught:
        import_folder(folder, tmp_path / "out" / "scan.h5")
    sentence = str(caught.value)
    for part in said:
        assert part in sentence
    assert "\n" not in sentence
    assert str(folder) in sentence
    assert not list(tmp_path.rglob("*.h5*"))


def test_damage_found_on_the_way_leaves_nothing_behind(tmp_path: Path) -> None:
    describe(tmp_path, exposures_us=[100])
    for step, page in enumerate(frames()[0]):
        write_image(tmp_path / f"{step}.png", page)
    whole = (tmp_path / "3.png").read_bytes()
    (tmp_path / "3.png").write_bytes(whole[:50] + bytes(60) + whole[110:])
    with pytest.raises(BadInput, match=r"3\.png"):
        import_folder(tmp_path, tmp_path / "scan.h5")
    assert not list(tmp_path.glob("*.h5*"))


def test_an_import_never_overwrites(tmp_path: Path) -> None:
    (tmp_path / "scan.h5").write_text("precious")
    with pytest.raises(BadInput, match=r"scan\.h5 exists already"):
        import_folder(record(tmp_path / "scan"), tmp_path / "scan.h5")
    assert (tmp_path / "scan.h5").read_text() == "precious"


def test_a_path_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"there is no stack at .*nowhere"):
        open_stack(tmp_path / "nowhere")


def test_an_empty_folder_is_told_what_it_lacks(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"has no stack\.json"):
        open_stack(tmp_path)


def test_a_single_file_is_not_a_stack(tmp_path: Path) -> None:
    write_pages(tmp_path / "scan.tiff", frames()[0])
    with pytest.raises(BadInput, match=r"scan\.tiff is a file, not a stack"):
        open_stack(tmp_path / "scan.tiff")


def test_the_description_itself_opens_its_folder(tmp_path: Path) -> None:
    with open_stack(record(tmp_path) / "stack.json") as stack:
        assert stack.header.steps == 5


@pytest.mark.parametrize("keep", [0.0, 0.1, 0.5, 0.95])
def test_an_hdf5_file_cut_off_is_refused(tmp_path: Path, keep: float) -> None:
    import_folder(record(tmp_path / "scan"), tmp_path / "scan.h5")
    data = (tmp_path / "scan.h5").read_bytes()
    (tmp_path / "scan.h5").write_bytes(data[: int(len(data) * keep)])
    with pytest.raises(BadInput, match=r"scan\.h5 is damaged"):
        open_stack(tmp_path / "scan.h5")


def test_a_foreign_hdf5_file_is_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["frames"] = np.zeros(3)
    with pytest.raises(BadInput, match=r"other\.h5 is an HDF5 file but no stack of this version"):
        open_stack(tmp_path / "other.h5")


def test_a_changed_pixel_in_the_store_is_noticed_when_read(tmp_path: Path) -> None:
    import_folder(record(tmp_path / "scan"), tmp_path / "scan.h5")
    with h5py.File(tmp_path / "scan.h5", "r+") as file:
        frame = file["frames"][2, 1]
        frame[0, 0] ^= 1
        file["frames"][2, 1] = frame
    with open_stack(tmp_path / "scan.h5") as stack:
        stack.step(1)
        with pytest.raises(BadInput, match="damaged at step 2: a frame fails its checksum"):
            stack.step(2)


def test_a_pipe_in_the_place_of_the_description_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "stack.json")
    with pytest.raises(BadInput, match="device or pipe"):
        open_stack(tmp_path)
