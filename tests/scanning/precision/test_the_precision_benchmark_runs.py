"""`python -m benchmarks precision` prints both tables, the response before the noise."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from benchmarks.precision import Found, averaged, edges_of, main, noise, spread


def test_the_quick_run_prints_the_response_before_any_sigma(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--quick", "--recipes", "NF,PRECISE", "--json", str(tmp_path / "figures.json")]) == 0
    printed = capsys.readouterr().out
    assert printed.index("slope rule") < printed.index("sigma")
    told = json.loads((tmp_path / "figures.json").read_text())
    assert set(told["response"]) == set(told["noise"]) == {"f/5.6, FWHM NF", "f/5.6, FWHM PRECISE"}
    precise = told["noise"]["f/5.6, FWHM PRECISE"]
    assert 2.0 < precise["sigma"] < 7.0
    assert precise["sigma_42x36"] < precise["sigma_42x7"]


def test_a_step_that_rises_evenly_has_the_width_it_was_given() -> None:
    """A ramp of 10 places has 80 % of it between 10 and 90 %."""
    true = np.where(np.arange(80) < 40, 0.0, 5.0)
    ramp = np.clip((np.arange(80) - 34.5) / 10, 0, 1) * 4.9
    found = edges_of(ramp, true, pitch_um=2.0, reach=24)
    assert found.widths_um == pytest.approx([16.0])
    assert found.slopes == pytest.approx([0.98])


def test_a_response_of_half_the_step_is_seen() -> None:
    true = np.where(np.arange(80) < 40, 0.0, 5.0)
    assert edges_of(0.57 * true, true, 1.0, 24).slopes == pytest.approx([0.57])


def test_cells_are_averaged_over_what_they_say() -> None:
    error = np.random.default_rng(0).normal(0, 10.0, (1000, 200))
    assert spread(error)[0] == pytest.approx(10.0, rel=0.01)
    assert spread(averaged(error, 5, 1))[0] == pytest.approx(10.0 / math.sqrt(5), rel=0.03)
    assert spread(averaged(error, 5, 5))[0] == pytest.approx(2.0, rel=0.04)
    error[3, 7] = np.nan
    assert np.isnan(averaged(error, 5, 5)).sum() == 5


def test_wrong_and_lost_rows_are_counted_and_do_not_enter_sigma() -> None:
    true = np.full((500, 100), 50.0)
    true[:20] = np.nan
    column = true + np.random.default_rng(1).normal(0, 0.3, true.shape)
    column[100:110] += 30.0
    column[200:205] = np.nan
    f = noise(Found(column, true, 5, 10, 1000, 1.0), um_per_px=10.0)
    assert f["sigma"] == pytest.approx(3.0, rel=0.02)
    assert f["wrong"] == pytest.approx(100 * 10 / 480)
    assert f["undefined"] == pytest.approx(100 * 5 / 480)
    assert f["saturated"] == 1.0
