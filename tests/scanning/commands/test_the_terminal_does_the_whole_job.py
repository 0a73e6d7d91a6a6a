"""`python -m scanning` takes a stack to a damage list, prints one JSON document, and says faults in one sentence."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scanning.__main__ import main
from tests.scanning.stacks.recordings import describe, write_pages

ROWS, COLUMNS, STEPS = 120, 96, 24
EXPOSURES = (100, 200)
TRUE_PX = 40.0
REPOSITORY = Path(__file__).resolve().parents[3]

PAIRS = (
    "height_mm,column_px\n0.14,9.152\n0.25,17.9658\n0.36,25.72\n0.44,29.8984\n0.55,38.65\n0.64,44.7688\n0.745,52.03\n"
)


def line_stack(folder: Path, bad_step: int | None = None) -> Path:
    """A plate 0.05 px/row steep under a Gaussian line of 3 px, two exposures, dark level 2, rows 5 to 9 unlit."""
    folder.mkdir()
    describe(folder, exposures_us=list(EXPOSURES))
    rng = np.random.default_rng(3)
    centre = TRUE_PX + 0.05 * np.arange(ROWS)
    line = np.exp(-4 * np.log(2) * ((np.arange(COLUMNS)[None, :] - centre[:, None]) / 3.03) ** 2)
    for exposure in EXPOSURES:
        light = 2 + 1.7 * exposure * line
        pages = rng.poisson(light, (STEPS, ROWS, COLUMNS)).clip(0, 255).astype(np.uint8)
        pages[:, 5:10] = 2
        write_pages(folder / f"exposure-{exposure}us.tiff", pages if bad_step is None else pages[:bad_step])
        bad_step = None
    return folder


@pytest.fixture(scope="module")
def stack(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return line_stack(tmp_path_factory.mktemp("recorded") / "scan-7")


def run(*words: str | Path) -> int:
    return main([str(word) for word in words])


def _strictly(text: str) -> Any:
    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is no JSON")

    return json.loads(text, parse_constant=refuse)


def test_a_stack_becomes_a_range_image_and_a_report(
    stack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "made" / "out"
    assert run("process", stack, "--recipe", "HDRE-II", "--set", "sci.mode=sliding", "--out", out, "--json") == 0
    printed = capsys.readouterr()
    told = _strictly(printed.out)
    assert printed.err == ""
    assert told == _strictly((out / "report.json").read_text())
    assert sorted(path.name for path in out.iterdir()) == ["range.npz", "report.json"]
    with np.load(out / "range.npz", allow_pickle=False) as held:
        assert held["height_um"].dtype == held["column_px"].dtype == np.float32
        assert held["height_um"].shape == held["intensity"].shape == held["width_px"].shape == (ROWS, STEPS - 4)
        assert float(held["row_pitch_um"]) == 7.150838
        assert float(held["profile_pitch_um"]) == 8.33
        column = held["column_px"]
        np.testing.assert_allclose(held["height_um"], column * 14.2, rtol=1e-5)
    assert told["undefined"]["count"] == np.count_nonzero(np.isnan(column))
    assert told["undefined"]["count"] >= 5 * (STEPS - 4)
    assert told["undefined"]["share"] == pytest.approx(told["undefined"]["count"] / column.size)
    assert told["saturated"]["count"] > 0
    assert 0 < told["saturated"]["share"] < 0.1
    assert 0 < told["sigma_um"] < 10
    assert told["lateral_cell_um"] == pytest.approx([41.65, 7.150838])
    assert told["ns_per_range_pixel"] > 0
    assert told["recipe"]["name"] == "HDRE-II"
    assert {"operation": "sci", "mode": "sliding", "window": 5} in told["recipe"]["operations"]
    assert told["stack"]["name"] == "scan-7"
    assert len(told["stack"]["sha256"]) == 64


@pytest.mark.parametrize("recipe", ["NF", "SCI", "HDRE-I"])
def test_every_recipe_of_the_paper_runs(stack: Path, tmp_path: Path, recipe: str) -> None:
    assert run("process", stack, "--recipe", recipe, "--out", tmp_path) == 0
    told = _strictly((tmp_path / "report.json").read_text())
    profiles = STEPS if recipe == "NF" else STEPS // 5
    assert (told["rows"], told["profiles"]) == (ROWS, profiles)
    assert told["profile_pitch_um"] == pytest.approx(8.33 if recipe == "NF" else 41.65)


def test_the_line_is_found_where_it_lies(stack: Path, tmp_path: Path) -> None:
    """At 100 us nothing saturates, and without tone compression the centroid is not drawn towards its mask."""
    words = ("--set", "exposure=100", "--out", tmp_path)
    assert run("process", stack, "--recipe", "SCI", *words) == 0
    with np.load(tmp_path / "range.npz") as held:
        column = held["column_px"]
    lit = np.r_[0:5, 10:ROWS]
    true = TRUE_PX + 0.05 * np.arange(ROWS)
    assert np.nanmedian(np.abs(np.nanmedian(column[lit], axis=1) - true[lit])) < 0.1
    assert np.isnan(column[5:10]).all()


def test_heights_follow_the_calibration_given(stack: Path, tmp_path: Path) -> None:
    (tmp_path / "pairs.csv").write_text(PAIRS)
    assert run("calibrate", tmp_path / "pairs.csv", "--out", tmp_path / "cal.json") == 0
    for given in ("pairs.csv", "cal.json"):
        assert run("process", stack, "--recipe", "NF", "--calibration", tmp_path / given, "--out", tmp_path / "o") == 0
        with np.load(tmp_path / "o" / "range.npz") as held:
            expected = 2.659732649 + 14.237375949 * held["column_px"].astype(float)
            np.testing.assert_allclose(held["height_um"], expected, rtol=1e-5)
        told = _strictly((tmp_path / "o" / "report.json").read_text())
        assert told["calibration"]["slope_mm_per_px"] == pytest.approx(0.014237375949)


def test_other_formats_lie_beside_when_asked_for(stack: Path, tmp_path: Path) -> None:
    words = ("process", stack, "--recipe", "NF", "--out", tmp_path / "o", "--export", "x3p", "--export", "csv")
    assert run(*words) == 0
    made = sorted(path.name for path in (tmp_path / "o").iterdir())
    assert made == ["range.csv", "range.npz", "range.x3p", "report.json"]


def test_results_of_an_earlier_run_are_replaced_and_other_files_stay(stack: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "report.json").write_text("old")
    assert run("process", stack, "--recipe", "NF", "--out", tmp_path) == 0
    assert (tmp_path / "notes.txt").read_text() == "mine"
    assert _strictly((tmp_path / "report.json").read_text())["recipe"]["name"] == "NF"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["notes.txt", "range.npz", "report.json"]


def test_the_flat_part_can_be_chosen(stack: Path, tmp_path: Path) -> None:
    assert run("process", stack, "--recipe", "NF", "--flat", "20:100,0:24", "--out", tmp_path) == 0
    told = _strictly((tmp_path / "report.json").read_text())
    assert told["flat_region"] == {
        "first_row": 20, "last_row": 100, "first_profile": 0, "last_profile": 24, "chosen": "given",
    }  # fmt: skip


def test_a_person_reads_lines(stack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("process", stack, "--recipe", "SCI", "--out", tmp_path) == 0
    printed = capsys.readouterr().out
    assert "undefined" in printed
    assert "um per cell of 41.65 x 7.151 um" in printed


def test_calibrate_prints_the_numbers_of_table_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "pairs.csv").write_text(PAIRS)
    assert run("calibrate", tmp_path / "pairs.csv", "--json") == 0
    told = _strictly(capsys.readouterr().out)
    assert told["slope_mm_per_px"] == pytest.approx(0.014237375949, rel=1e-10)
    assert told["intercept_mm"] == pytest.approx(0.002659732649, rel=1e-9)
    assert told["max_residual_um"] == pytest.approx(11.6655063, rel=1e-8)
    assert told["residual_sd_um"] == pytest.approx(8.32204059, rel=1e-8)
    assert told["u_slope_mm_per_px"] == pytest.approx(2.251273102e-4, rel=1e-8)
    assert told["leave_one_out_um"] == pytest.approx(14.0126, abs=1e-4)


def test_a_simulated_knife_goes_all_the_way_to_its_damages(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recorded = tmp_path / "R2"
    words = (
        "simulate",
        "R2",
        "--out",
        recorded,
        "--steps",
        "100",
        "--rows",
        "400",
        "--exposures",
        "300",
        "--seed",
        "2",
    )
    assert run(*words) == 0
    assert (recorded / "truth.npz").is_file()
    assert run("process", recorded, "--recipe", "SCI", "--set", "sci.mode=sliding", "--out", tmp_path / "o") == 0
    capsys.readouterr()
    assert run("inspect", tmp_path / "o", "--json") == 0
    told = _strictly(capsys.readouterr().out)
    assert {one["code"] for one in told["measurements"]} >= {"V-", "Sa", "Sq"}
    assert all({"value", "unit", "u"} <= set(one) for one in told["measurements"])
    assert told["damages"]
    assert run("inspect", tmp_path / "o" / "range.npz", "--baseline", tmp_path / "o") == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["R2", "o"]


def test_a_simulation_repeats_itself(tmp_path: Path) -> None:
    for name in ("a", "b"):
        words = ("simulate", "flat", "--out", tmp_path / name, "--steps", "3", "--rows", "60", "--exposures", "300")
        assert run(*words) == 0
    assert (tmp_path / "a" / "exposure-300us.tiff").read_bytes() == (
        tmp_path / "b" / "exposure-300us.tiff"
    ).read_bytes()


def test_a_broken_stack_is_one_sentence_and_leaves_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    broken = line_stack(tmp_path / "scan", bad_step=20)
    assert run("process", broken, "--recipe", "HDRE-II", "--out", tmp_path / "o", "--json") == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    assert "exposure-200us.tiff has 24 steps but exposure-100us.tiff has 20" in printed.err
    assert [path.name for path in tmp_path.iterdir()] == ["scan"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["process", "STACK", "--recipe", "HDRE-III", "--out", "o"], "HDRE-III"),
        (["process", "STACK", "--recipe", "HDR-CAM", "--out", "o"], "logarithmic"),
        (["process", "STACK", "--recipe", "NF", "--set", "sci.mode=sliding", "--out", "o"], "sci.mode"),
        (["process", "STACK", "--recipe", "SCI", "--set", "sliding", "--out", "o"], "write NAME=VALUE"),
        (["process", "STACK", "--recipe", "SCI", "--set", "sci.window=99", "--out", "o"], "sci.window"),
        (["process", "STACK", "--recipe", "SCI", "--set", "sci.window=30", "--out", "o"], "24 steps"),
        (["process", "STACK", "--recipe", "NF", "--flat", "0:900,0:3", "--out", "o"], "is not inside the range image"),
        (["process", "STACK", "--recipe", "NF", "--calibration", "no.csv", "--out", "o"], "no.csv cannot be read"),
        (["process", "STACK", "--recipe", "NF", "--out", "taken"], "taken is a file"),
        (["process", "nowhere", "--recipe", "NF", "--out", "o"], "there is no stack at nowhere"),
        (["calibrate", "no.csv"], "no.csv cannot be read"),
        (["calibrate", "taken"], "taken is empty"),
        (["inspect", "no.npz"], "there is no range image at no.npz"),
        (["inspect", "no.x3p"], "there is no file no.x3p"),
        (["inspect", "taken"], "taken is not a range image"),
        (["simulate", "R9", "--out", "o"], "R9"),
        (["simulate", "flat", "--out", "o", "--exposures", "bright"], "not a list of microseconds"),
        (["simulate", "flat", "--out", "o", "--steps", "0"], "at least one step"),
        (["simulate", "flat", "--out", "taken"], "taken exists and is not an empty folder"),
    ],
)
def test_a_fault_is_one_sentence_and_exit_code_2(
    stack: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    words: list[str], said: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    Path("taken").write_text("")
    assert run(*[stack if word == "STACK" else word for word in words]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert said in printed.err
    assert printed.err.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "COMMAND"),
        (["polish"], "polish"),
        (["process", "x", "--out", "o"], "--recipe"),
        (["process", "x", "--recipe", "NF"], "--out"),
        (["calibrate", "x", "--jsn"], "--jsn"),
    ],
)
def test_a_wrong_word_is_one_sentence_and_exit_code_2(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        main(words)
    assert caught.value.code == 2
    printed = capsys.readouterr().err
    assert said in printed
    assert printed.count("\n") == 1


def test_a_terminal_without_django_is_enough(stack: Path, tmp_path: Path) -> None:
    """The measuring half runs where neither Django nor Celery can be imported."""
    program = (
        "import sys\n"
        "for name in ('django', 'celery', 'inspection', 'worker'):\n"
        "    sys.modules[name] = None\n"
        "from scanning.__main__ import main\n"
        "sys.exit(main(sys.argv[1:]))\n"
    )
    words = ["process", str(stack), "--recipe", "NF", "--out", str(tmp_path / "o"), "--json"]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("DJANGO")}
    done = subprocess.run(
        [sys.executable, "-c", program, *words],
        cwd=REPOSITORY, env=environment, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert _strictly(done.stdout)["recipe"]["name"] == "NF"
    assert run("inspect", tmp_path / "o") == 0


def test_the_module_is_a_program(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "scanning", "calibrate", str(tmp_path / "no.csv")],
        cwd=REPOSITORY, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr == f"{tmp_path}/no.csv cannot be read (No such file or directory); check the path\n"
