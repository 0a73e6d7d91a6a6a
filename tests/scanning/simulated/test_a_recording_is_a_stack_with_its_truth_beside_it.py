"""`record` writes what design.md's contract 2 says, and nothing that could be taken for a stack when interrupted."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile

from scanning.errors import BadInput
from scanning.rig.simulated.recorder import record


def test_one_page_per_step_and_one_file_per_exposure(tmp_path: Path) -> None:
    folder = record("R2", tmp_path / "r2", steps=6, rows=80, columns=128, exposures_us=(900, 100, 300), seed=4)
    header = json.loads((folder / "stack.json").read_text())
    assert header == {
        "format": "edgewatch-stack/1",
        "exposures_us": [100, 300, 900],
        "step_um": 8.33,
        "row_pitch_um": 7.150838,
        "mm_per_pixel": 0.01430168,
        "line_width_px": 3.03,
        "dark_level": 2.0,
        "saturation": 255,
        "response": "linear",
    }
    means = []
    for exposure in (100, 300, 900):
        with tifffile.TiffFile(folder / f"exposure-{exposure}us.tiff") as file:
            pages = np.stack([page.asarray() for page in file.pages])
        assert pages.shape == (6, 80, 128)
        assert pages.dtype == np.uint8
        means.append(float(pages.mean()))
    assert means[0] < means[1] < means[2]


def test_the_truth_has_the_grid_of_the_frames(tmp_path: Path) -> None:
    folder = record("R3", tmp_path / "r3", steps=5, rows=60, columns=96, exposures_us=(300,), wear_um=30.0)
    truth = np.load(folder / "truth.npz")
    for name in ("height_um", "column_px", "deviation_um", "visible", "damage_mask", "reflectivity"):
        assert truth[name].shape == (60, 5)
    assert truth["height_um"].dtype == np.float32
    assert np.array_equal(np.isfinite(truth["height_um"]), truth["visible"])
    damages = json.loads(str(truth["damages_json"]))
    assert [d["severity"] for d in damages] == ["large"]
    assert json.loads((folder / "scene.json").read_text())["wear_um"] == 30.0


def test_the_line_stands_where_the_truth_says(tmp_path: Path) -> None:
    folder = record("flat", tmp_path / "flat", steps=8, rows=120, columns=64, exposures_us=(300,), step_um=50.0)
    frames = tifffile.imread(folder / "exposure-300us.tiff").astype(float) - 2.0
    mean = np.clip(frames.mean(axis=(0, 1)), 0, None)
    column = float((mean * np.arange(64)).sum() / mean.sum())
    assert column == pytest.approx(float(np.load(folder / "truth.npz")["column_px"].mean()), abs=0.15)


def test_the_same_recording_twice_is_the_same_and_another_draw_changes_noise_only(tmp_path: Path) -> None:
    options = {"steps": 3, "rows": 60, "columns": 64, "exposures_us": (300,), "seed": 9}
    images = [
        tifffile.imread(record("flat", tmp_path / str(i), noise_seed=draw, **options) / "exposure-300us.tiff")  # type: ignore[arg-type]
        for i, draw in enumerate((0, 0, 1))
    ]
    assert np.array_equal(images[0], images[1])
    assert not np.array_equal(images[0], images[2])
    assert np.corrcoef(images[0].ravel(), images[2].ravel())[0, 1] > 0.98


def test_the_logarithmic_camera_has_one_exposure_called_zero(tmp_path: Path) -> None:
    folder = record("R1", tmp_path / "log", steps=2, rows=50, columns=64, system="IS2")
    header = json.loads((folder / "stack.json").read_text())
    assert (header["exposures_us"], header["response"], header["mm_per_pixel"]) == ([0], "logarithmic", 0.02)
    assert (folder / "exposure-0us.tiff").is_file()
    with pytest.raises(BadInput, match="no exposure time"):
        record("R1", tmp_path / "log2", steps=2, rows=50, columns=64, system="IS2", exposures_us=(100,))


def test_twelve_bit_frames_are_sixteen_bit_pages_with_their_own_saturation(tmp_path: Path) -> None:
    folder = record("flat", tmp_path / "deep", steps=2, rows=50, columns=64, exposures_us=(300,), bits=12)
    assert json.loads((folder / "stack.json").read_text())["saturation"] == 4095
    assert tifffile.imread(folder / "exposure-300us.tiff").dtype == np.uint16


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"exposures_us": (100, 100)}, "different numbers"),
        ({"exposures_us": (0,)}, "above 0"),
        ({"steps": 0}, "at least one step"),
        ({"line_width_is": "waist"}, "'fwhm' or '1/e2'"),
    ],
)
def test_impossible_recordings_leave_nothing_behind(tmp_path: Path, options: dict[str, object], sentence: str) -> None:
    with pytest.raises(BadInput, match=sentence):
        record("flat", tmp_path / "no", rows=50, columns=64, **options)  # type: ignore[arg-type]
    assert not (tmp_path / "no").exists()


def test_a_folder_in_use_is_never_written_into(tmp_path: Path) -> None:
    (tmp_path / "kept.txt").write_text("mine")
    with pytest.raises(BadInput, match="not an empty folder"):
        record("flat", tmp_path, steps=2, rows=50, columns=64)
    assert [p.name for p in tmp_path.iterdir()] == ["kept.txt"]


def test_an_interrupted_recording_is_not_a_stack(tmp_path: Path) -> None:
    def interrupt(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record("flat", tmp_path / "half", steps=3, rows=50, columns=64, progress=interrupt)
    assert not (tmp_path / "half" / "stack.json").exists()
