"""The control charts give the numbers of their handbooks."""

from __future__ import annotations

import pytest

from inspection.trends.control import cusum, ewma, individuals

FLOW_RATE = [49.6, 47.6, 49.9, 51.3, 47.8, 51.2, 52.6, 52.4, 53.6, 52.1]  # NIST 6.3.2.2
NIST_EWMA = [52.0, 47.0, 53.0, 49.3, 50.1, 47.0, 51.0, 50.1, 51.2, 50.5, *FLOW_RATE]  # NIST 6.3.2.4
NIST_EWMA_OUT = [
    50.6, 49.52, 50.56, 50.18, 50.16, 49.21, 49.75, 49.85, 50.26, 50.33,
    50.11, 49.36, 49.52, 50.05, 49.38, 49.92, 50.73, 51.23, 51.94, 51.99,
]  # fmt: skip
MONTGOMERY = [
    9.45, 7.99, 9.29, 11.66, 12.16, 10.18, 8.04, 11.46, 9.2, 10.34, 9.03, 11.47, 10.51, 9.4, 10.08,
    9.37, 10.62, 10.31, 8.52, 10.84, 10.9, 9.33, 12.29, 11.5, 10.6, 11.08, 10.38, 11.62, 11.31, 10.52,
]  # fmt: skip
MONTGOMERY_C_PLUS = [
    0, 0, 0, 1.16, 2.82, 2.5, 0.04, 1.0, 0, 0, 0, 0.97, 0.98, 0, 0,
    0, 0.12, 0, 0, 0.34, 0.74, 0, 1.79, 2.79, 2.89, 3.47, 3.35, 4.47, 5.28, 5.3,
]  # fmt: skip


def test_individuals_of_the_nist_flow_rate():
    chart = individuals(FLOW_RATE)
    assert chart is not None
    assert chart.mean == pytest.approx(50.81, abs=5e-5)
    assert chart.mean_range == pytest.approx(1.8778, abs=5e-5)
    assert chart.upper == pytest.approx(55.8041, abs=1e-4)
    assert chart.lower == pytest.approx(45.8159, abs=1e-4)
    assert chart.range_upper == pytest.approx(6.1349, abs=2e-4)
    assert chart.outside == ()


def test_no_moving_range_spans_an_event():
    chart = individuals([1, 2, 1, 2, 101, 102, 101], breaks=[4])
    assert chart is not None
    assert chart.mean_range == pytest.approx(1.0)
    assert individuals([1.0]) is None
    assert individuals([1.0, 2.0], breaks=[1]) is None


def test_ewma_of_the_nist_example():
    chart = ewma(NIST_EWMA, target=50, sigma=2.0539, weight=0.3, width=3)
    assert chart.values == pytest.approx(NIST_EWMA_OUT, abs=0.00501)
    assert (chart.upper, chart.lower) == pytest.approx((52.5884, 47.4115), abs=0.0015)
    assert chart.outside == ()


def test_ewma_finds_a_drift():
    drifting = [10 + 0.1 * i for i in range(30)]
    assert ewma(drifting, target=10, sigma=0.5).outside[0] < 15


def test_cusum_of_montgomerys_table():
    chart = cusum(MONTGOMERY, target=10, sigma=1)
    assert chart.above == pytest.approx(MONTGOMERY_C_PLUS, abs=1e-9)
    assert chart.signals[0] == 28  # observation 29, counted from one
    assert chart.run_above[28] == 7
    assert chart.mean_after_shift(28, target=10, sigma=1) == pytest.approx(11.25, abs=0.01)
