"""Products of a sparse matrix by rows, against those of a dense one."""

import numpy as np
import pytest
from scipy.sparse import csr_array, random_array

from mortarbench.harness.distributed.sparse import CompressedRows


@pytest.mark.parametrize("shape", [(7, 4), (4, 9), (1, 1), (0, 3), (3, 0), (5, 5)])
def test_products_are_those_of_the_dense_matrix(shape):
    n, k = shape
    rng = np.random.default_rng(n + 10 * k)
    M = csr_array(random_array(shape, density=0.4, rng=rng))
    x, v, weights = rng.standard_normal(k), *rng.standard_normal((2, n))
    rows, dense = CompressedRows(M), M.toarray()

    assert rows.shape == shape
    assert rows @ x == pytest.approx(dense @ x)
    assert rows.transposed_times(v) == pytest.approx(dense.T @ v)
    assert rows.combined(2.0, v, -3.0, x) == pytest.approx(2 * v - 3 * (dense @ x))
    found = rows.weighted_difference(v, x, weights)
    assert found == pytest.approx(weights * (v - dense @ x))


def test_other_formats_and_vectors_are_refused():
    M = csr_array(np.eye(3))
    rows, short, fit = CompressedRows(M), np.zeros(2), np.zeros(3)

    with pytest.raises(ValueError, match="csc matrix; expected one by rows"):
        CompressedRows(M.tocsc())
    for product in (
        lambda: rows @ short,
        lambda: rows.transposed_times(short),
        lambda: rows.combined(1.0, short, 1.0, fit),
        lambda: rows.combined(1.0, fit, 1.0, short),
        lambda: rows.weighted_difference(fit, fit, short),
    ):
        with pytest.raises(ValueError, match="2 components; expected 3"):
            product()
