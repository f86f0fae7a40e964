"""Products of blocks with columns, against those of NumPy."""

import numpy as np
import pytest

from mortarbench.problems.feti.blocks import multiply


@pytest.mark.parametrize("n", [1, 3, 4, 7, 256, 257, 600])
@pytest.mark.parametrize("columns", [0, 1, 3, 4, 5, 8, 11, 12, 13, 24, 40])
def test_blocks_multiply_columns(n, columns):
    rng = np.random.default_rng(n + columns)
    M, X = rng.standard_normal((n, n)), rng.standard_normal((n, columns))
    Y = np.full((n + 1, columns), np.nan)

    multiply(M, X, Y[:n])

    assert np.abs(Y[:n] - M @ X).max(initial=0) < 1e-12
    assert np.isnan(Y[n]).all()


def test_blocks_and_columns_that_do_not_fit_are_refused():
    M, X = np.zeros((3, 3)), np.zeros((3, 2))

    with pytest.raises(ValueError, match=r"\(3, 3\) times \(4, 2\)"):
        multiply(M, np.zeros((4, 2)), np.zeros((4, 2)))
    with pytest.raises(ValueError, match="times"):
        multiply(M, X, np.zeros((3, 3)))
    with pytest.raises(ValueError, match="times"):
        multiply(np.zeros((3, 2)), X, X.copy())
