"""Vector operations of MPRGP, checked by hand."""

import numpy as np

from tests.support.textbook import kernels


def test_lengths_by_hand():
    """The lengths from x along −p lead to the minimum of the cost and to the first
    bound.
    """
    x, p = np.array([1.0, 0.5]), np.array([2.0, -1.0])
    bounds = np.zeros(2), np.full(2, 2.0)

    assert kernels.lengths(x, p, p, 4 * p, *bounds) == (0.25, 0.5)
    assert kernels.lengths(x, p, np.array([0.0, -1.0]), p, *bounds) == (1.0, 1.5)
    assert kernels.lengths(x, p, p, -p, *bounds) == (np.inf, 0.5)


def test_a_step_does_not_stop_short_of_a_bound():
    """A feasible step to 0.3 − 3·0.1 = 5.6e-17 ends exactly at the bound."""
    x, p = np.array([0.3, 1.0]), np.array([0.1, 0.0])

    new, g = kernels.moved(x, p, 3.0, p, p, np.zeros(2), np.ones(2))
    assert new[0] == 0
    assert new[1] == 1
    assert g[0] == p[0] - 3 * p[0]
