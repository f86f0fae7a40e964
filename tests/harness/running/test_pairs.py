"""Intervals of ratios of times, compared with tables of Student's t."""

import doctest

import numpy as np
import pytest

from mortarbench.harness.running import pairs
from mortarbench.harness.running.pairs import paired_ratio, ratio_of, unpaired_ratio

#: 97.5 % quantile of Student's t, by degrees of freedom
STUDENT = {1: 12.706204736, 2: 4.302652730, 3: 3.182446305}


def logs(ratio):
    return np.log([ratio.low, ratio.value, ratio.high])


def interval(middle, half):
    return pytest.approx([middle - half, middle, middle + half], rel=1e-8)


def test_the_interval_of_two_pairs_has_one_degree_of_freedom():
    """The logarithms of the ratios are 0 and 2, with mean 1 and standard error 1."""
    ratio = paired_ratio({0: 1.0, 1: 5 * np.exp(2)}, {0: 1.0, 1: 5.0})

    assert logs(ratio) == interval(1, STUDENT[1])
    assert ratio.paired
    assert ratio.pairs == 2


def test_welchs_interval_of_equally_scattered_samples_is_students():
    """For the logarithms 0, 2 and 10, 12, both means have variance 1, and the number of
    degrees of freedom is 2.
    """
    ratio = unpaired_ratio(np.exp([0.0, 2.0]), np.exp([10.0, 12.0]))

    assert logs(ratio) == interval(-10, STUDENT[2] * np.sqrt(2))
    assert not ratio.paired
    assert ratio.pairs == 2


@pytest.mark.parametrize("scatter", [1e-3, 1.0, 10.0])
def test_a_constant_sample_leaves_the_degrees_of_freedom_of_the_other(scatter):
    """Four values have variance s², and their mean s²/4; the other three are equal."""
    noisy = np.exp(scatter * np.sqrt(3) / 2 * np.array([-1, -1, 1, 1]))
    still = np.exp(np.full(3, 5.0))

    half = STUDENT[3] * scatter / 2
    assert logs(unpaired_ratio(noisy, still)) == interval(-5, half)
    assert logs(unpaired_ratio(still, noisy)) == interval(5, half)


def test_constant_samples_have_an_interval_of_width_zero():
    ratio = unpaired_ratio([2.0, 2.0], [1.0, 1.0, 1.0])

    assert logs(ratio) == interval(np.log(2), 0)


def test_one_value_has_no_interval():
    assert unpaired_ratio([1.0], [1.0, 2.0]) is None
    assert unpaired_ratio([1.0, 2.0], [1.0]) is None


def test_solvers_of_different_sessions_are_compared_as_samples():
    here, there = {("a", 0): 1.0, ("a", 1): 2.0}, {("b", 0): 3.0, ("b", 1): 5.0}

    assert ratio_of(here, there) == unpaired_ratio(here.values(), there.values())
    assert ratio_of(here, here).paired


def test_the_example_of_the_documentation_holds():
    assert doctest.testmod(pairs).failed == 0
