"""Products with stored matrices in extended precision."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.sparse import csc_array, csr_array

from mortarbench.harness.verify.products import (
    projected_products,
    times_columns,
    times_rows,
)

BEYOND = np.longdouble(2) ** -60  #: below the resolution of doubles near one
LAPLACIAN = csc_array([[1.0, -1, 0, 0], [-1, 2, -1, 0], [0, -1, 2, -1], [0, 0, -1, 1]])
ONES = np.full((4, 1), 0.5)  #: orthonormal kernel of the matrix


def projected(M, R, starts, v, left=0):
    found = np.full_like(v, left)
    projected_products(
        M.data, M.indices, M.indptr, R, np.array(starts, dtype=np.int64), v, found
    )
    return found


def test_products_by_rows_and_by_columns_keep_digits_beyond_those_of_a_double():
    M = np.array([[3.0, 0, -1], [0, 0, 0], [2, 5, 0], [0, 0, 4]])
    x = np.array([1, 2, -1]) + BEYOND * np.array([1, -3, 2])
    by_rows, by_columns = csr_array(M), csc_array(M)
    rows = times_rows(by_rows.data, by_rows.indices, by_rows.indptr, x)
    columns = times_columns(
        by_columns.data, by_columns.indices, by_columns.indptr, x, 4
    )
    expected = np.array([4, 0, 12, -4]) + BEYOND * np.array([1, 0, -13, 8])

    assert_array_equal(rows, expected)
    assert_array_equal(columns, expected)


def test_projected_products_of_a_singular_matrix_keep_digits_beyond_a_double():
    v = np.array([1, 3, -2, 5]) + BEYOND * np.array([1, 0, 4, -2])
    found = projected(LAPLACIAN, ONES, [0], v)
    expected = np.array([-2, 7, -12, 7]) + BEYOND * np.array([1, -5, 10, -6])

    assert np.abs(found - expected).max() < 4 * np.finfo(np.longdouble).eps * 12


@pytest.mark.parametrize("precision", [np.float64, np.longdouble])
def test_rigid_motions_are_removed_on_both_sides_of_the_product(precision):
    rng = np.random.default_rng(1)
    M, R = rng.normal(size=(9, 9)), np.linalg.qr(rng.normal(size=(9, 3)))[0]
    v = rng.normal(size=9)
    P = np.eye(9) - R @ R.T
    found = projected(csc_array(M), R, [0], v.astype(precision))

    assert found.dtype == precision
    assert_allclose(found.astype(float), P @ M @ P @ v, atol=1e-13)


def test_products_of_slices_write_only_their_slice():
    v = np.array([7.0, 1, 3, -2, 5, 0, 0, 0, 0, 7, 5, -2, 3, 1])
    found = projected(LAPLACIAN, ONES, [10, 1, 5], v, left=99)

    assert_allclose(found[1:5], [-2, 7, -12, 7])
    assert_allclose(found[10:], [7, -12, 7, -2])
    assert_array_equal(found[[0, *range(5, 10)]], 99)
