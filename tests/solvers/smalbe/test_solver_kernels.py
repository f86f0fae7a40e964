"""Compiled vector operations against the same functions in plain Python."""

import numpy as np
import pytest

from solvers.smalbe import kernels
from solvers.smalbe.projected import product


@pytest.fixture
def vectors():
    rng = np.random.default_rng(271828)
    lower, upper = np.where(np.arange(40) % 3 == 0, -np.inf, 0.0), np.full(40, 1.0)
    x = np.clip(rng.normal(0.5, 0.7, 40), lower, upper)
    return x, *rng.standard_normal((3, 40)), lower, upper


@pytest.mark.parametrize("name", ["lengths", "moved", "split", "reduced", "conjugate",
                                  "tilted_step"])  # fmt: skip
def test_compiled_is_interpreted(vectors, name):
    x, g, p, Hp, lower, upper = vectors
    arguments = {
        "lengths": (x, g, p, Hp, lower, upper),
        "moved": (x, g, 0.3, p, Hp, lower, upper),
        "split": (x, g, lower, upper),
        "reduced": (x, g, 0.3, lower, upper),
        "conjugate": (x, p, Hp),
        "tilted_step": (x, g, 0.7, lower, upper),
    }[name]
    function = getattr(kernels, name)

    fast, plain = function(*arguments), function.py_func(*arguments)
    for a, b in (
        zip(np.atleast_2d(fast), np.atleast_2d(plain), strict=True)
        if not (isinstance(fast, tuple))
        else zip(fast, plain, strict=True)
    ):
        assert a == pytest.approx(b, rel=1e-13)


def test_lengths_by_hand():
    """Along p from x: the cost's minimum, and the first bound met; −p moves up."""
    x, p = np.array([1.0, 0.5]), np.array([2.0, -1.0])
    bounds = np.zeros(2), np.full(2, 2.0)

    assert kernels.lengths(x, p, p, 4 * p, *bounds) == (0.25, 0.5)
    assert kernels.lengths(x, p, np.array([0.0, -1.0]), p, *bounds) == (1.0, 1.5)
    assert kernels.lengths(x, p, p, -p, *bounds) == (np.inf, 0.5)


@pytest.mark.parametrize("order", ["C", "F"])
def test_a_product_with_a_dense_matrix_is_the_product(order):
    W = np.random.default_rng(271828).standard_normal((17, 17))
    P = np.array(W + W.T, order=order)
    P.flags.writeable = False
    v = np.arange(17.0)

    assert product(P)(v) == pytest.approx(P @ v, rel=1e-13)
    assert product(P[::2, ::2])(v[:9]) == pytest.approx(P[::2, ::2] @ v[:9], rel=1e-13)
