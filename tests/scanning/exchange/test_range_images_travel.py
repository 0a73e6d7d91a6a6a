"""A range image survives its own file and X3P unchanged, and other programs' formats say what it says."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import x3pio
from numpy.typing import NDArray

from scanning.errors import BadInput
from scanning.exchange import read_range, read_x3p, write_csv, write_ply, write_tiff, write_x3p
from scanning.range_image import RangeImage

SHARED = Path(__file__).resolve().parents[3].parent / "shared" / "golden" / "x3p"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason="the shared golden files are not here")


def _image(rows: int = 6, profiles: int = 4) -> RangeImage:
    height = np.random.default_rng(1).normal(0, 50, (rows, profiles)).astype(np.float32)
    height[1, 2] = np.nan
    return RangeImage(
        column_px=height / 14,
        height_um=height,
        row_pitch_um=7.150838,
        profile_pitch_um=41.65,
        intensity=np.abs(height),
        width_px=np.full_like(height, 3.0),
        saturated=7,
        frame_pixels=70,
        wall_s=0.5,
        cpu_s=0.25,
        provenance={"recipe": {"name": "NF"}, "calibration": {"measured_on": "2026-11-02"}},
    )


def _same(one: NDArray[Any], other: NDArray[Any]) -> None:
    np.testing.assert_array_equal(one, other)


def test_a_range_image_survives_its_own_file(tmp_path: Path) -> None:
    image = _image()
    image.save(tmp_path / "range.npz")
    again = RangeImage.load(tmp_path / "range.npz")
    for name in ("column_px", "height_um", "intensity", "width_px"):
        _same(getattr(again, name), getattr(image, name))
    for name in ("row_pitch_um", "profile_pitch_um", "saturated", "frame_pixels", "wall_s", "cpu_s", "provenance"):
        assert getattr(again, name) == getattr(image, name)
    assert [path.name for path in tmp_path.iterdir()] == ["range.npz"]


def test_a_foreign_range_file_needs_heights_and_pitches_only(tmp_path: Path) -> None:
    np.savez(tmp_path / "r.npz", height_um=np.array([[1.0, np.inf], [2, 3]]), row_pitch_um=7, profile_pitch_um=8.0)
    image = RangeImage.load(tmp_path / "r.npz")
    _same(image.height_um, np.array([[1, np.nan], [2, 3]], np.float32))
    assert np.isnan(image.column_px).all()


GOOD = {"height_um": np.zeros((3, 4), np.float32), "row_pitch_um": 7.0, "profile_pitch_um": 8.0}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"height_um": None}, "has no height_um"),
        ({"row_pitch_um": None}, "has no row_pitch_um"),
        ({"row_pitch_um": np.nan}, "row_pitch_um must be one number"),
        ({"profile_pitch_um": 0.0}, "profile_pitch_um must be one number"),
        ({"profile_pitch_um": "wide"}, "profile_pitch_um must be one number"),
        ({"height_um": np.zeros(3)}, "height_um is float64 of shape (3,)"),
        ({"height_um": np.zeros((0, 3))}, "height_um is float64 of shape (0, 3)"),
        ({"height_um": np.array([["a"]])}, "height_um is <U1"),
        ({"height_um": np.array([[None]])}, "is not a range image or is damaged"),
        ({"intensity": np.zeros((4, 3))}, "intensity is float64 of shape (4, 3), but height_um is (3, 4)"),
        ({"saturated": "x"}, "saturated must be one number"),
        ({"frame_pixels": np.zeros(3)}, "frame_pixels must be one number"),
        ({"wall_s": np.nan}, "wall_s must be one number"),
        ({"provenance": "{"}, "provenance is not JSON"),
        ({"provenance": "[]"}, "provenance is not a JSON object"),
    ],
)
def test_a_broken_range_file_is_refused(tmp_path: Path, changes: dict[str, Any], said: str) -> None:
    held = {name: value for name, value in {**GOOD, **changes}.items() if value is not None}
    np.savez(tmp_path / "r.npz", **held)
    with pytest.raises(BadInput) as caught:
        read_range(tmp_path / "r.npz")
    assert said in str(caught.value)
    assert "r.npz" in str(caught.value)


@pytest.mark.parametrize("data", [b"", b"hello", b"PK\x03\x04 and no more"])
def test_what_is_no_range_file_is_refused(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "r.npz").write_bytes(data)
    with pytest.raises(BadInput, match=r"r\.npz is not a range image"):
        read_range(tmp_path / "r.npz")
    (tmp_path / "r.x3p").write_bytes(data)
    with pytest.raises(BadInput, match=r"r\.x3p is not a readable X3P"):
        read_range(tmp_path / "r.x3p")


def test_a_single_array_under_the_name_of_a_range_image_is_refused(tmp_path: Path) -> None:
    with (tmp_path / "r.npz").open("wb") as file:
        np.save(file, np.zeros((3, 4)))
    with pytest.raises(BadInput, match=r"r\.npz is not a range image"):
        read_range(tmp_path / "r.npz")


@pytest.mark.parametrize("name", ["r.npz", "r.x3p", "."])
def test_what_is_not_there_is_named(tmp_path: Path, name: str) -> None:
    with pytest.raises(BadInput, match="there is no"):
        read_range(tmp_path / name)


def test_heights_survive_x3p_exactly(tmp_path: Path) -> None:
    image = _image()
    write_x3p(image, tmp_path / "r.x3p", comment="scan 12, calibration 3")
    again = read_range(tmp_path / "r.x3p")
    _same(again.height_um, image.height_um)
    assert again.row_pitch_um == pytest.approx(image.row_pitch_um, rel=1e-12)
    assert again.profile_pitch_um == pytest.approx(image.profile_pitch_um, rel=1e-12)
    assert again.provenance["comment"] == "scan 12, calibration 3"


def test_the_x3p_is_in_metres_and_of_the_widely_read_revision(tmp_path: Path) -> None:
    write_x3p(_image(), tmp_path / "r.x3p")
    file = x3pio.read(tmp_path / "r.x3p")
    assert file.revision is x3pio.Revision.ISO5436_2000
    assert file.layers[0].z[0, 0] == pytest.approx(float(_image().height_um[0, 0]) * 1e-6, rel=1e-12)
    assert file.header.x.increment == pytest.approx(41.65e-6)
    assert file.metadata is not None
    assert file.metadata.probing_system.type is x3pio.ProbingType.NON_CONTACTING
    assert file.metadata.calibration_date is not None
    assert file.metadata.calibration_date.date().isoformat() == "2026-11-02"


@needs_shared
def test_the_known_sine_is_read_as_it_was_made() -> None:
    image = read_x3p(SHARED / "known_sin1d_f64.x3p")
    assert image.height_um.shape == (1000, 240)
    assert image.row_pitch_um == pytest.approx(7.15)
    assert image.profile_pitch_um == pytest.approx(8.33)
    spectrum = np.abs(np.fft.rfft(image.height_um[0].astype(np.float64)))
    assert int(spectrum.argmax()) == 10
    _same(image.height_um[0], image.height_um[999])


@needs_shared
def test_missing_points_of_the_known_file_are_missing() -> None:
    image = read_x3p(SHARED / "known_int16_valid.x3p")
    assert image.height_um.shape == (250, 121)
    assert np.count_nonzero(np.isnan(image.height_um)) == 100
    assert image.row_pitch_um == pytest.approx(28.6)


def _surface(height: NDArray[Any], **options: Any) -> bytes:
    return x3pio.Surface.from_array(height, x_scale=1e-6, y_scale=2e-6, **options).dumps()


def test_the_offset_belongs_to_the_height(tmp_path: Path) -> None:
    placed = x3pio.Placement.translation(0.0, 0.0, -0.5e-3)
    data = _surface(np.full((2, 3), 1e-3), placement=placed, coordinate_system=x3pio.CoordinateSystem.VIEW)
    (tmp_path / "r.x3p").write_bytes(data)
    np.testing.assert_allclose(read_x3p(tmp_path / "r.x3p").height_um, 500.0)


def _rewritten(data: bytes, change: Any) -> bytes:
    """The same archive with its members changed, checksums left as they were."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as source, zipfile.ZipFile(out, "w") as target:
        for member in source.namelist():
            for name, content in change(member, source.read(member)):
                target.writestr(name, content)
    return out.getvalue()


def test_infinite_heights_are_missing_points(tmp_path: Path) -> None:
    stored = np.array([[1e-6, np.inf], [np.nan, 2e-6]])

    def infinite(name: str, content: bytes) -> list[tuple[str, bytes]]:
        if name.endswith("data.bin"):
            return [(name, stored.astype("<f8").tobytes())]
        if name == "main.xml":
            old = hashlib.md5(np.ones((2, 2)).astype("<f8").tobytes()).hexdigest().encode()
            return [(name, content.replace(old, hashlib.md5(stored.astype("<f8").tobytes()).hexdigest().encode()))]
        return [] if name == "md5checksum.hex" else [(name, content)]

    (tmp_path / "r.x3p").write_bytes(_rewritten(_surface(np.ones((2, 2))), infinite))
    image = read_x3p(tmp_path / "r.x3p")
    np.testing.assert_allclose(image.height_um, [[1, np.nan], [np.nan, 2]])


def test_an_altered_file_is_refused_unless_asked_for(tmp_path: Path) -> None:
    def alter(name: str, content: bytes) -> list[tuple[str, bytes]]:
        return [(name, content[:-1] + b"\x01" if name.endswith("data.bin") else content)]

    (tmp_path / "r.x3p").write_bytes(_rewritten(_surface(np.ones((2, 2))), alter))
    with pytest.raises(BadInput, match=r"r\.x3p was altered after it was written"):
        read_x3p(tmp_path / "r.x3p")
    assert "not verified" in read_x3p(tmp_path / "r.x3p", verify=False).provenance["notes"][0]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda name, content: [(name, content), ("../../evil", b"x")], "leads outside the archive"),
        (
            lambda name, content: [
                (name, content.replace(b"?>", b'?><!DOCTYPE p [<!ENTITY e SYSTEM "file:///etc/hosts">]>', 1))
            ],
            "declares a document type",
        ),
        (lambda name, content: [] if name == "main.xml" else [(name, content)], "is not a readable X3P"),
    ],
)
def test_an_unsafe_or_broken_archive_is_refused(tmp_path: Path, change: Any, said: str) -> None:
    (tmp_path / "r.x3p").write_bytes(_rewritten(_surface(np.ones((2, 2))), change))
    with pytest.raises(BadInput, match=said):
        read_x3p(tmp_path / "r.x3p")


def test_steps_in_millimetres_are_refused(tmp_path: Path) -> None:
    data = x3pio.Surface.from_array(np.ones((2, 2)), x_scale=0.0275, y_scale=0.0275).dumps()
    (tmp_path / "r.x3p").write_bytes(data)
    with pytest.raises(BadInput, match=r"step along x is 0\.0275 m"):
        read_x3p(tmp_path / "r.x3p")


def test_a_profile_is_not_a_surface(tmp_path: Path) -> None:
    x3pio.write(tmp_path / "r.x3p", np.zeros(5), x_scale=1e-6)
    with pytest.raises(BadInput, match="holds a profile, not a surface"):
        read_x3p(tmp_path / "r.x3p")


def test_the_table_opens_in_a_european_spreadsheet(tmp_path: Path) -> None:
    write_csv(_image(), tmp_path / "r.csv", separator=";", decimal=",")
    raw = (tmp_path / "r.csv").read_bytes()
    assert raw.startswith(b"\xef\xbb\xbf")
    lines = raw.decode("utf-8-sig").split("\r\n")
    assert lines[0].split(";")[1:] == ["0,000000", "0,041650", "0,083300", "0,124950"]
    assert lines[2].split(";")[3] == ""
    assert lines[2].split(";")[0] == "0,007151"
    assert float(lines[1].split(";")[1].replace(",", ".")) == pytest.approx(float(_image().height_um[0, 0]), abs=5e-4)


def test_the_plain_table_holds_every_height(tmp_path: Path) -> None:
    write_csv(_image(), tmp_path / "r.csv")
    table = np.genfromtxt(tmp_path / "r.csv", delimiter=",", skip_header=1, encoding="utf-8-sig")
    np.testing.assert_allclose(table[:, 1:], _image().height_um, atol=5e-4)


def test_separator_and_decimal_sign_must_differ(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="both"):
        write_csv(_image(), tmp_path / "r.csv", decimal=",")
    assert not list(tmp_path.iterdir())


def test_the_cloud_holds_the_measured_points_in_millimetres(tmp_path: Path) -> None:
    image = _image()
    write_ply(image, tmp_path / "r.ply")
    head, _, body = (tmp_path / "r.ply").read_bytes().partition(b"end_header\n")
    assert b"element vertex 23\n" in head
    points = np.frombuffer(body, "<f4").reshape(23, 4)
    np.testing.assert_allclose(points[0], [0, 0, image.height_um[0, 0] / 1000, image.intensity[0, 0]], rtol=1e-6)
    np.testing.assert_allclose(points[-1, :2], [3 * 0.04165, 5 * 0.007150838], rtol=1e-6)


def test_the_float_image_keeps_heights_and_pitches(tmp_path: Path) -> None:
    write_tiff(_image(), tmp_path / "r.tiff")
    with tifffile.TiffFile(tmp_path / "r.tiff") as tiff:
        _same(tiff.pages.first.asarray(), _image().height_um)
        assert json.loads(tiff.pages.first.description)["profile_pitch_um"] == 41.65


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match=r"r\.npz cannot be written"):
        _image().save(tmp_path / "file" / "r.npz")
