"""The wear line and its forecast give the published numbers."""

from __future__ import annotations

import math

import pytest

from inspection.trends.wear import fit_wear

#: R datasets::cars (Ezekiel 1930): speed, dist.
CARS = [
    (4, 2), (4, 10), (7, 4), (7, 22), (8, 16), (9, 10), (10, 18), (10, 26), (10, 34), (11, 17), (11, 28), (12, 14),
    (12, 20), (12, 24), (12, 28), (13, 26), (13, 34), (13, 34), (13, 46), (14, 26), (14, 36), (14, 60), (14, 80),
    (15, 20), (15, 26), (15, 54), (16, 32), (16, 40), (17, 32), (17, 40), (17, 50), (18, 42), (18, 56), (18, 76),
    (18, 84), (19, 36), (19, 46), (19, 68), (20, 32), (20, 48), (20, 52), (20, 56), (20, 64), (22, 66), (23, 54),
    (24, 70), (24, 92), (24, 93), (24, 120), (25, 85),
]  # fmt: skip

#: NIST StRD Norris: y, x.
NORRIS = [
    (0.1, 0.2), (338.8, 337.4), (118.1, 118.2), (888.0, 884.6), (9.2, 10.1), (228.1, 226.5), (668.5, 666.3),
    (998.5, 996.3), (449.1, 448.6), (778.9, 777.0), (559.2, 558.2), (0.3, 0.4), (0.1, 0.6), (778.1, 775.5),
    (668.8, 666.9), (339.3, 338.0), (448.9, 447.5), (10.8, 11.6), (557.7, 556.0), (228.3, 228.1), (998.0, 995.8),
    (888.8, 887.6), (119.6, 120.2), (0.3, 0.3), (0.6, 0.3), (557.6, 556.8), (339.3, 339.1), (888.0, 887.2),
    (998.5, 999.0), (778.9, 779.0), (10.2, 11.1), (117.6, 118.3), (228.9, 229.2), (668.4, 669.1), (449.2, 448.9),
    (0.2, 0.5),
]  # fmt: skip


def cars():
    fit = fit_wear([x for x, _ in CARS], [y for _, y in CARS])
    assert fit is not None
    return fit


def test_the_line_through_norris_has_the_certified_coefficients():
    fit = fit_wear([x for _, x in NORRIS], [y for y, _ in NORRIS])
    assert fit is not None
    assert fit.rate == pytest.approx(1.00211681802045, rel=1e-12)
    assert fit.intercept == pytest.approx(-0.262323073774029, rel=1e-10)
    assert fit.u_rate == pytest.approx(0.429796848199937e-3, rel=1e-10)
    assert fit.u_intercept == pytest.approx(0.232818234301152, rel=1e-10)
    assert fit.s == pytest.approx(0.884796396144373, rel=1e-10)


@pytest.mark.parametrize(
    ("life", "value", "low", "high"),
    [(12, 29.60981, -1.749529, 60.96915), (19, 57.13667, 25.761756, 88.51159), (24, 76.79872, 44.752478, 108.84495)],
)
def test_the_prediction_interval_is_that_of_r(life, value, low, high):
    fit = cars()
    assert fit.value(life) == pytest.approx(value, abs=6e-6)
    assert fit.value(life) - fit.half_width(life) == pytest.approx(low, abs=6e-6)
    assert fit.value(life) + fit.half_width(life) == pytest.approx(high, abs=6e-6)


def test_the_time_to_limit_has_the_interval_of_the_inverse_prediction():
    forecast = cars().time_to_limit(100)
    assert forecast.at == pytest.approx(29.90002, abs=6e-6)
    assert forecast.earliest == pytest.approx(21.84118, abs=6e-6)
    assert forecast.latest == pytest.approx(39.32966, abs=6e-6)


@pytest.mark.parametrize("limit", [10, 42.98, 60, 100, 1000])
def test_at_the_interval_ends_the_bounds_touch_the_limit(limit):
    fit = cars()
    forecast = fit.time_to_limit(limit)
    assert fit.value(forecast.earliest) + fit.half_width(forecast.earliest) == pytest.approx(limit, abs=1e-8)
    assert fit.value(forecast.latest) - fit.half_width(forecast.latest) == pytest.approx(limit, abs=1e-8)


def test_a_slope_that_may_be_zero_gives_no_upper_bound_but_an_earliest_time():
    fit = fit_wear([0, 1, 2, 3, 4], [10, 12, 9, 13, 11])
    assert fit is not None
    assert fit.rate > 0
    forecast = fit.time_to_limit(40)
    assert forecast.at is not None
    assert forecast.latest is None
    assert fit.value(forecast.earliest) + fit.half_width(forecast.earliest) == pytest.approx(40, abs=1e-9)
    assert forecast.earliest > 4


def test_an_edge_that_does_not_wear_never_reaches_its_limit():
    fit = fit_wear([0, 1, 2, 3], [10, 9, 8, 7.1])
    assert fit is not None
    assert fit.time_to_limit(40).at is None


def test_the_measurement_uncertainty_is_the_floor_of_the_scatter():
    lucky = fit_wear([0, 1, 2, 3], [0, 1, 2, 3], u=[0.5, 0.5, None, 0.5])
    assert lucky is not None
    assert lucky.s_fit == pytest.approx(0, abs=1e-12)
    assert lucky.s == pytest.approx(0.5)
    assert lucky.u_rate == pytest.approx(0.5 / math.sqrt(5))


def test_three_points_give_a_rate_without_an_interval():
    fit = fit_wear([0, 1, 2], [0, 1, 2])
    assert fit is not None
    assert fit.low_confidence
    forecast = fit.time_to_limit(10)
    assert forecast.at == pytest.approx(10)
    assert (forecast.earliest, forecast.latest) == (None, None)
    assert math.isnan(fit.half_width(1.0))


@pytest.mark.parametrize(
    ("life", "values"),
    [([], []), ([1, 2], [3, 4]), ([5, 5, 5, 5], [1, 2, 3, 4]), ([1, 2, 3], [1, float("nan"), 3])],
)
def test_too_little_data_gives_no_line(life, values):
    assert fit_wear(life, values) is None
