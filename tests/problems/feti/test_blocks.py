"""Products of blocks with columns, compared with those of NumPy."""

import numpy as np
import pytest
from scipy.linalg import lapack

from mortarbench.problems.feti.blocks import BlockDiagonal


@pytest.mark.parametrize("n", [1, 3, 4, 7, 256, 257, 600])
@pytest.mark.parametrize("columns", [0, 1, 3, 4, 5, 8, 11, 12, 13, 24, 40])
def test_blocks_multiply_columns(n, columns):
    rng = np.random.default_rng(n + columns)
    M, X = rng.standard_normal((n, n)), rng.standard_normal((n, columns))
    both = BlockDiagonal([2 * np.ones((1, 1)), M], [1, n], [3, columns])

    Y = both(np.append([1.0, 2.0, 3.0], X))

    assert np.abs(Y[3:].reshape(n, -1) - M @ X).max(initial=0) < 1e-12
    assert Y[:3].tolist() == [2, 4, 6]  # the second block does not overwrite


@pytest.mark.parametrize(("rows", "n"), [(3, 7), (9, 2), (0, 4), (5, 0)])
def test_blocks_need_not_be_square(rows, n):
    M, X = np.arange(1.0, rows * n + 1).reshape(rows, n), np.ones((n, 13))
    maps = BlockDiagonal([M, 2 * np.ones((1, 1))], [n, 1], [13, 2])

    Y = maps(np.append(X, [1.0, 2.0]))

    assert maps.shape == (13 * rows + 2, 13 * n + 2)
    assert np.append(M @ X, [2.0, 4.0]).tolist() == Y.tolist()


@pytest.mark.parametrize("columns", [1, 2, 5])
def test_triangles_and_objects_multiply_matrices_like_arrays(columns):
    rng = np.random.default_rng(columns)
    M = rng.standard_normal((4, 4))
    M += M.T

    class Halved:
        def __matmul__(self, X):
            return X / 2

    blocks = BlockDiagonal([lapack.dtrttp(M)[0], Halved(), M], [4, 3, 4], [1, 2, 2])
    X = rng.standard_normal((4 + 3 * 2 + 4 * 2, columns))

    first, second, third = np.split(blocks(X), [4, 10])
    assert first == pytest.approx(M @ X[:4], abs=1e-14)
    assert second == pytest.approx(X[4:10] / 2)
    columns_of_both = X[10:].reshape(4, -1)
    assert third.reshape(4, -1) == pytest.approx(M @ columns_of_both, abs=1e-14)


def test_blocks_and_columns_that_do_not_fit_are_refused():
    M = np.zeros((3, 3))

    with pytest.raises(ValueError, match=r"\(3, 3\) cannot multiply a \(4, 2\)"):
        BlockDiagonal([M], [4], [2])
    with pytest.raises(ValueError, match="9 components; expected 6"):
        BlockDiagonal([M], [3], [2])(np.zeros(9))
    with pytest.raises(ValueError, match="cannot multiply"):
        BlockDiagonal([np.zeros((3, 2))], [3], [2])
    # triangles need one subdomain
    with pytest.raises(ValueError, match="cannot multiply"):
        BlockDiagonal([np.zeros(6)], [3], [2])
