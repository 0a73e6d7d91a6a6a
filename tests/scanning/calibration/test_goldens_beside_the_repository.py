"""The public reference sets that lie beside the repository come out exactly, read from their files."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from scanning.calibration import fit_line
from scanning.control_charts import cusum, ewma, individuals

GOLDEN = Path(__file__).resolve().parents[3].parent / "shared" / "golden"
pytestmark = [pytest.mark.shared, pytest.mark.skipif(not GOLDEN.is_dir(), reason="no reference data beside the tree")]


def test_norris() -> None:
    lines = (GOLDEN / "nist_strd_Norris.dat").read_text().splitlines()
    y, x = np.array([[float(v) for v in line.split()] for line in lines[60:96]]).T
    fit = fit_line(x, y)
    assert fit.intercept == pytest.approx(-0.262323073774029, rel=1e-10)
    assert fit.slope == pytest.approx(1.00211681802045, rel=1e-12)
    assert np.sqrt(np.diag(fit.covariance)) == pytest.approx([0.232818234301152, 0.429796848199937e-03], rel=1e-10)
    assert fit.residual_sd == pytest.approx(0.884796396144373, rel=1e-11)


def test_the_papers_own_check_holds() -> None:
    done = subprocess.run(
        [sys.executable, str(GOLDEN / "paper_golden.py")], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0
    assert "FAIL " not in done.stdout


def test_nists_flow_rate() -> None:
    told = json.loads((GOLDEN / "nist_imr_flowrate.json").read_text())
    chart = individuals(told["x"])
    assert chart is not None
    assert chart.mean == pytest.approx(told["xbar"], abs=5e-5)
    assert chart.mean_range == pytest.approx(told["mrbar"], abs=5e-5)
    assert (chart.upper, chart.lower) == pytest.approx((told["UCL"], told["LCL"]), abs=5e-5)
    assert chart.range_upper == pytest.approx(told["MR_UCL"], abs=2.5e-4), "printed from a rounded MRbar"


def test_nists_ewma() -> None:
    told = json.loads((GOLDEN / "nist_ewma.json").read_text())
    chart = ewma(told["x"], told["target"], told["sigma"], weight=told["lam"], width=told["L"])
    assert chart.values == pytest.approx(told["ewma"], abs=0.00501)


def test_montgomerys_cusum() -> None:
    told = json.loads((GOLDEN / "montgomery_cusum_ewma.json").read_text())
    chart = cusum(told["x"], told["target"], told["sigma"], slack=told["k"], decision=told["h"])
    assert chart.above == pytest.approx(told["C_plus"], abs=0.0051)
    assert chart.signals[0] == 28, "observation 29, counted from 1"
