"""The interval of a median and the exponent of a power law, for known distributions."""

import numpy as np
import pytest

from mortarbench.reports.statistics.intervals import median_interval, power_law


@pytest.mark.parametrize(
    ("n", "low", "high", "coverage"),
    [
        (1, 1, 1, 0.0),
        (2, 1, 2, 0.5),
        (3, 1, 3, 0.75),
        (5, 1, 5, 1 - 2 / 32),
        (6, 1, 6, 1 - 2 / 64),
        (9, 2, 8, 1 - 2 * 10 / 512),  # P(X < 2) = (1 + 9)/2⁹
    ],
)
def test_the_interval_ends_at_the_correct_order_statistics(n, low, high, coverage):
    shuffled = np.random.default_rng(86).permutation(np.arange(1, n + 1))
    interval = median_interval(shuffled)
    assert interval == ((n + 1) / 2, low, high, pytest.approx(coverage), n)


@pytest.mark.parametrize("n", [3, 5, 9])
def test_the_interval_has_its_coverage_for_a_skewed_law(n):
    samples = np.random.default_rng(4711).exponential(size=(4000, n))
    intervals = [median_interval(s) for s in samples]
    hits = np.mean([i.low <= np.log(2) <= i.high for i in intervals])
    assert hits == pytest.approx(intervals[0].coverage, abs=0.025)  # > 3 σ


def test_a_power_law_without_noise_is_recovered():
    n = np.array([100, 300, 800, 5000])
    fit = power_law(n, 3e-6 * n**1.4)
    assert fit.exponent == pytest.approx(1.4)
    assert fit.factor == pytest.approx(3e-6)
    assert fit.low == pytest.approx(1.4)
    assert fit.high == pytest.approx(1.4)


def test_nearly_equal_sizes_yield_a_law_with_infinite_factor():
    """Values grow by a factor e while sizes grow by 0.01 %: p = 10⁴, c = e^−138155."""
    n = 1e6 * np.array([1, 1 + 5e-5, 1 + 1e-4])
    for sign in (1, -1):
        t = 7.0 * (n / n[0]) ** (sign * 1e4)
        fit = power_law(n, t)
        assert fit.exponent == pytest.approx(sign * 1e4)
        assert fit.at(n) == pytest.approx(t)
        assert fit.factor == (0 if sign > 0 else np.inf)


def test_counts_that_do_not_grow_have_exponent_zero():
    assert power_law([100, 300, 800], [12, 12, 12])[:3] == pytest.approx((0, 0, 0))


@pytest.mark.parametrize("sizes", [3, 6])
def test_the_interval_of_the_exponent_has_nominal_coverage(sizes):
    rng = np.random.default_rng(1729)
    n = np.geomspace(500, 40_000, sizes)
    fits = [
        power_law(n, 2e-6 * n**1.2 * rng.lognormal(0, 0.2, sizes)) for _ in range(2000)
    ]
    hits = np.mean([f.low <= 1.2 <= f.high for f in fits])
    assert hits == pytest.approx(0.95, abs=0.015)  # 3 σ


@pytest.mark.parametrize(
    ("n", "t"),
    [
        ([1, 2], [1, 2]),
        ([5, 5, 9], [1, 2, 3]),
        ([1, 2, 3], [1, 0, 2]),
        ([0, 2, 3], [1, 1, 2]),
    ],
)
def test_data_that_do_not_determine_a_power_law_are_refused(n, t):
    with pytest.raises(ValueError, match="three different sizes"):
        power_law(n, t)
