"""Calibrating, checking and measuring noise from a terminal; one sentence for everything that goes wrong."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scanning.calibration import read_calibration
from tests.scanning.commands.test_the_terminal_does_the_whole_job import PAIRS, run
from tests.scanning.stacks.recordings import describe, write_pages

MM = "0,0.14,0.25,0.36,0.44"
HEIGHTS = (0.0, 0.14, 0.25, 0.36, 0.44)
MM_PER_PX = 0.0142
COLUMNS, STEPS, TREAD = 96, 20, 36


def stack(folder: Path, centre: np.ndarray[Any, Any], seed: int = 1, steps: int = STEPS) -> Path:
    """A Gaussian line of 3 px at ``centre`` (rows,), one exposure, with grains that differ from row to row."""
    rng = np.random.default_rng(seed)
    folder.mkdir()
    describe(folder, exposures_us=[100], dark_level=2)
    grains = rng.gamma(6.0, 1 / 6.0, (steps, centre.size, COLUMNS))
    line = np.exp(-4 * np.log(2) * ((np.arange(COLUMNS)[None, :] - centre[:, None]) / 3.03) ** 2)
    pages = (2 + rng.poisson(120 * line[None] * grains)).clip(0, 255).astype(np.uint8)
    write_pages(folder / "exposure-100us.tiff", pages)
    return folder


def stairs(scale: float = 1.0, heights: tuple[float, ...] = HEIGHTS) -> np.ndarray[Any, Any]:
    return 30.0 + scale * np.repeat(heights, TREAD) / MM_PER_PX


@pytest.fixture(scope="module")
def gauge(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return stack(tmp_path_factory.mktemp("gauge") / "scan", stairs())


def told_by(capsys: pytest.CaptureFixture[str]) -> Any:
    return json.loads(capsys.readouterr().out)


def test_a_scan_of_the_gauge_becomes_a_calibration_file(
    gauge: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("--gauge-name", "feeler 12", "--measured-on", "2026-11-24", "--expires-on", "2027-05-24")
    out = tmp_path / "cal.json"
    assert run("calibrate", "--gauge", gauge, "--heights", MM, "--lies-true", *words, "--out", out, "--json") == 0
    told = told_by(capsys)
    assert told == json.loads(out.read_text())
    assert told["slope_mm_per_px"] == pytest.approx(MM_PER_PX, rel=4e-3)
    assert told["heights_mm"] == list(HEIGHTS)
    assert [t["first"] // TREAD for t in told["gauge_scan"]["treads"]] == [0, 1, 2, 3, 4]
    assert told["models"]["better"] in ("straight line", "eq. (1)")
    line = read_calibration(out)
    assert (line.gauge, line.measured_on, line.expires_on) == ("feeler 12", "2026-11-24", "2027-05-24")
    assert line.slope_mm_per_px == told["slope_mm_per_px"]


def test_a_gauge_may_be_listed_from_either_end(gauge: Path, capsys: pytest.CaptureFixture[str]) -> None:
    slopes = []
    for heights in (MM, ",".join(reversed(MM.split(",")))):
        assert run("calibrate", "--gauge", gauge, "--heights", heights, "--json") == 0
        slopes.append(told_by(capsys)["slope_mm_per_px"])
    assert slopes[0] == slopes[1]


def test_a_person_reads_both_tables(gauge: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("calibrate", "--gauge", gauge, "--heights", MM) == 0
    printed = capsys.readouterr().out
    assert "5 treads found along the rows" in printed
    assert "eq. (1): residual, left out um" in printed
    assert "no expiry date" in printed
    (tmp_path / "pairs.csv").write_text(PAIRS)
    assert run("calibrate", tmp_path / "pairs.csv") == 0
    printed = capsys.readouterr().out
    assert "left out, rms  straight line 9.63 um, eq. (1) 9.80 um: this gauge cannot tell them apart" in printed
    assert "0.4400     29.8984         11.67" in printed


def test_checks_are_kept_and_a_changed_lens_is_seen(
    gauge: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("calibrate", "--gauge", gauge, "--heights", MM, "--lies-true", "--out", tmp_path / "cal.json") == 0
    words = ("--calibration", tmp_path / "cal.json", "--step", "0.44", "--lies-true", "--u-step-um", "0.5")
    kept = ("--history", tmp_path / "checks.csv")
    for k in range(9):
        scan = stack(tmp_path / f"check-{k}", stairs(heights=(0.0, 0.44)), seed=50 + k)
        capsys.readouterr()
        assert run("check", scan, *words, *kept, "--taken-on", f"2026-12-{k + 1:02}", "--json") == 0
    told = told_by(capsys)
    assert told["holds"]
    assert told["drift"]["state"] == "in control"
    assert abs(told["bias_um"]) < 3.0
    knocked = stack(tmp_path / "knocked", stairs(1.03, (0.0, 0.44)), seed=70)
    assert run("check", knocked, *words, *kept) == 0
    printed = capsys.readouterr().out
    assert "BEYOND its uncertainty" in printed
    assert "Do not release measurements" in printed
    assert len((tmp_path / "checks.csv").read_text().splitlines()) == 11


def test_an_expired_calibration_is_told_with_every_check_and_every_image(
    gauge: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "pairs.csv").write_text("height_mm,column_px\n0,30\n0.14,39.8592\n0.25,47.6056\n")
    expired = ("--measured-on", "2020-01-01", "--expires-on", "2021-01-01")
    assert run("calibrate", tmp_path / "pairs.csv", *expired, "--out", tmp_path / "cal.json") == 0
    assert "expired on 2021-01-01" in capsys.readouterr().out
    assert run("check", gauge, "--calibration", tmp_path / "cal.json", "--heights", MM) == 0
    printed = capsys.readouterr().out
    assert "expired on 2021-01-01" in printed
    assert "2 of 5 treads lie outside the calibrated range" in printed
    words = ("--recipe", "NF", "--calibration", tmp_path / "cal.json", "--out", tmp_path / "o")
    assert run("process", gauge, *words) == 0
    printed = capsys.readouterr().out
    assert "warning       The calibration expired on 2021-01-01" in printed
    report = json.loads((tmp_path / "o" / "report.json").read_text())
    assert len(report["warnings"]) == 2
    with np.load(tmp_path / "o" / "range.npz") as held:
        flags = held["outside_calibrated"]
        assert flags.sum() == report["outside_calibrated"]["count"]
        assert flags[3 * TREAD + 4 :].mean() > 0.95
        assert not flags[TREAD + 4 : 2 * TREAD - 4].any()


def test_noise_is_that_of_the_displaced_repeat(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plane = 40.0 + 0.02 * np.arange(120)
    first = stack(tmp_path / "a", plane, seed=1, steps=40)
    second = stack(tmp_path / "b", plane + 1.0, seed=2, steps=40)
    assert run("noise", first, second, "--moved-um", "200", "--json") == 0
    told = told_by(capsys)
    assert 0.5 < told["noise_um"] < 15.0
    assert told["lateral_cell_um"] == pytest.approx([8.33, 7.150838])
    assert run("process", first, "--recipe", "NF", "--out", tmp_path / "o", "--json") == 0
    assert told["noise_um"] == pytest.approx(told_by(capsys)["sigma_um"], rel=0.1)
    assert run("noise", first, second, "--moved-um", "200", "--flat", "10:110,0:40") == 0
    assert "this is NOT the noise" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["calibrate"], "give either PAIRS.csv or --gauge STACK"),
        (["calibrate", "taken", "--gauge", "GAUGE"], "give either PAIRS.csv or --gauge STACK"),
        (["calibrate", "--gauge", "GAUGE"], "--gauge needs --heights"),
        (["calibrate", "pairs", "--heights", MM], "--heights belongs to --gauge"),
        (["calibrate", "--gauge", "GAUGE", "--heights", "0,0.14"], "more treads than heights: 5 treads"),
        (["calibrate", "--gauge", "GAUGE", "--heights", "0;a"], "is not a list of heights in mm"),
        (["calibrate", "--gauge", "GAUGE", "--heights", "0,nan"], "nan is not a height in mm"),
        (["calibrate", "--gauge", "GAUGE", "--heights", "0,0.25,0.14,0.36,0.44"], "do not rise with the heights"),
        (["calibrate", "--gauge", "GAUGE", "--heights", MM, "--recipe", "BEST"], "BEST"),
        (["calibrate", "--gauge", "GAUGE", "--heights", MM, "--expires-on", "soon"], 'expires_on is "soon"'),
        (["calibrate", "--gauge", "TWO", "--heights", "0,0.44"], "too few for a line"),
        (["calibrate", "--gauge", "FLAT", "--heights", MM], "no steps were found"),
        (["calibrate", "--gauge", "nowhere", "--heights", MM], "there is no stack at nowhere"),
        (["check", "GAUGE", "--calibration", "nowhere", "--step", "0.4"], "nowhere cannot be read"),
        (["check", "GAUGE", "--calibration", "pairs", "--step", "0.4"], "more treads than heights"),
        (["check", "TWO", "--calibration", "pairs", "--step", "nan"], "is not a height in mm"),
        (["check", "TWO", "--calibration", "pairs", "--step", "0.44", "--history", "taken"], "is no history"),
        (["check", "TWO", "--calibration", "pairs", "--step", "0.44", "--u-step-um", "-1"], "from 0 upwards"),
        (["check", "TWO", "--calibration", "pairs", "--step", "0.44", "--taken-on", "1.2."], "is not a date"),
        (["noise", "GAUGE", "GAUGE", "--moved-um", "0"], "without moving the part"),
        (["noise", "FLAT", "FLAT", "--moved-um", "5"], "by at least 21.5 um"),
        (["noise", "FLAT", "TWO", "--moved-um", "50"], "scan the same region twice"),
    ],
)
def test_a_fault_is_one_sentence(
    gauge: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    words: list[str], said: str,
) -> None:  # fmt: skip
    made = tmp_path / "made"
    made.mkdir()
    places = {"GAUGE": gauge}
    if "TWO" in words:
        places["TWO"] = stack(made / "two", stairs(heights=(0.0, 0.44)))
    if "FLAT" in words:
        places["FLAT"] = stack(made / "flat", np.full(100, 40.0))
    monkeypatch.chdir(tmp_path)
    Path("taken").write_text("")
    Path("pairs").write_text(PAIRS)
    assert run(*[places.get(word, word) for word in words]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert said in printed.err
    assert printed.err.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["made", "pairs", "taken"]
    assert Path("taken").read_text() == ""


def test_the_height_of_a_step_is_right_whatever_the_recipe(gauge: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for recipe in ("NF", "PRECISE"):
        assert run("calibrate", "--gauge", gauge, "--heights", MM, "--lies-true", "--recipe", recipe, "--json") == 0
        assert math.isclose(told_by(capsys)["slope_mm_per_px"], MM_PER_PX, rel_tol=5e-3)
