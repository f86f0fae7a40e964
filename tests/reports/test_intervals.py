"""Intervals: coverage by simulation, and laws that were planted."""

import numpy as np
import pytest

from mortarbench.reports.intervals import (
    PROCESS,
    median_interval,
    pooled,
    power_law,
    student,
    widened,
)


@pytest.mark.parametrize("cases", [2, 4, 7])
@pytest.mark.parametrize("repeats", [3, 9])
@pytest.mark.parametrize("scatter", [0.0, 0.3])
def test_pooled_intervals_contain_the_planted_ratio(cases, repeats, scatter):
    """Noise differs between cases, and a tenth of the repeats is disturbed.

    Each of the two processes has a factor that all of its repeats share.
    """
    rng, found, trials = np.random.default_rng(cases * repeats), 0, 1500
    for _ in range(trials):
        processes = PROCESS * (rng.standard_normal(2) @ [1, -1])
        middle = np.log(2) + processes + scatter * rng.standard_normal(cases)
        noise = 0.05 * rng.lognormal(0, 0.3, (cases, 1))
        logs = middle[:, None] + noise * rng.standard_normal((cases, repeats))
        disturbed = rng.random(logs.shape) < 0.1
        logs += disturbed * rng.choice([-1, 1], logs.shape) * rng.exponential(0.3)
        ratio = pooled(logs).ratio
        found += ratio.low <= 2 <= ratio.high
    assert found / trials >= 0.93


def test_a_single_case_has_an_interval_from_three_repeats_on():
    assert not pooled([[0.1, 0.2]]).ratio.is_known
    three = pooled([[0.1, 0.2, 0.3]]).ratio
    half = np.hypot(student(2) * 0.1 / np.sqrt(3), 1.96 * np.sqrt(2) * PROCESS)
    assert np.allclose(np.log(three), [0.2, 0.2 - half, 0.2 + half], atol=1e-5)


def test_sessions_reduce_the_error_of_processes_and_repeats_do_not():
    assert widened(0.0, 4) == pytest.approx(widened(0.0, 1) / 2)
    many = pooled([np.zeros(100)]).ratio
    assert np.log(many.high) == pytest.approx(widened(0.0, 1))


def test_more_repeats_separate_smaller_factors_unless_cases_differ():
    rng = np.random.default_rng(1)
    noisy = pooled(0.2 * rng.standard_normal((6, 3)))
    assert noisy.separable(27) < noisy.separable(3)
    apart = pooled(np.repeat(rng.standard_normal((6, 1)), 3, axis=1))
    assert apart.separable(27) == pytest.approx(apart.separable(3))


def test_the_interval_of_a_median_has_the_coverage_of_order_statistics():
    assert median_interval([5, 1, 4, 2, 3]) == (3, 1, 5)
    assert median_interval(range(1, 10)) == (5, 2, 8)  # 1 − 2·10/2⁹ = 0.961


def test_one_exponent_is_fitted_to_series_with_different_factors():
    x = np.array([10.0, 20, 40])
    fit = power_law([(x, 3 * x**1.5), (2 * x, 70 * (2 * x) ** 1.5)])
    assert fit.exponent.value == pytest.approx(1.5)
    assert fit.exponent.low == pytest.approx(1.5, abs=1e-9)
    assert power_law([(x[:2], x[:2]), (x[:1], x[:1])]) is None


def test_the_interval_of_an_exponent_covers():
    rng, found = np.random.default_rng(2), 0
    x = np.array([10.0, 20, 40, 80])
    for _ in range(1000):
        noise = rng.lognormal(0, 0.2, (2, 4))
        p = power_law([(x, x**1.2 * noise[0]), (x, 5 * x**1.2 * noise[1])]).exponent
        found += p.low <= 1.2 <= p.high
    assert 0.93 <= found / 1000 <= 0.97
