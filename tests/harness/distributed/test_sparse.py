"""Linear maps of compiled code, against dense matrices."""

import numpy as np
import pytest
from scipy.linalg import lapack
from scipy.sparse import csc_array, csr_array, eye_array, kron, random_array

from mortarbench.harness.distributed import factor as factor_module
from mortarbench.harness.distributed.factor import DependentRowsError, bordered_factor
from mortarbench.harness.distributed.sparse import (
    Block,
    Composition,
    CompressedRows,
    DirectSum,
    Identity,
)

SEED = 1952


@pytest.mark.parametrize("shape", [(7, 4), (4, 9), (1, 1), (0, 3), (3, 0), (5, 5)])
def test_products_are_those_of_the_dense_matrix(shape):
    n, k = shape
    rng = np.random.default_rng(n + 10 * k)
    M = csr_array(random_array(shape, density=0.4, rng=rng))
    x, v = rng.standard_normal(k), rng.standard_normal(n)
    rows, dense = CompressedRows(M), M.toarray()

    assert rows.shape == shape
    assert rows @ x == pytest.approx(dense @ x)
    assert rows.transposed_times(v) == pytest.approx(dense.T @ v)


def test_other_formats_and_vectors_are_refused():
    M = csr_array(np.eye(3))
    rows, short = CompressedRows(M), np.zeros(2)

    with pytest.raises(ValueError, match="csc matrix; expected one by rows"):
        CompressedRows(M.tocsc())
    for product in (lambda: rows @ short, lambda: rows.transposed_times(short)):
        with pytest.raises(ValueError, match="2 components; expected 3"):
            product()


@pytest.fixture
def M():
    """Return a matrix (7, 5) with two empty rows and one empty column."""
    dense = random_array((7, 5), density=0.6, rng=np.random.default_rng(SEED)).toarray()
    dense[[2, 6]], dense[:, 3] = 0, 0
    return dense


def test_outer_products_of_selected_rows_are_summed(M):
    rows, weights = CompressedRows(csr_array(M)), np.array([1.0, 0, 1, 0, 0, 2, 1])
    # the empty column has no new number
    place = np.array([2, 0, 1, -1, 3], dtype=np.int32)
    found = rows.outer_products(weights, place, 4)
    order = np.array([1, 2, 0, 4])

    assert found == pytest.approx((M.T @ (weights[:, None] * M))[np.ix_(order, order)])


@pytest.mark.parametrize("columns", [None, 1, 3])
def test_maps_are_composed_and_summed(M, columns):
    rng = np.random.default_rng(SEED)
    A, B = rng.standard_normal((4, 7)), rng.standard_normal((3, 3))
    rows = [CompressedRows(csr_array(part)) for part in (A, M, B)]
    x = rng.standard_normal(5 if columns is None else (5, columns))
    y = rng.standard_normal(10 if columns is None else (10, columns))

    product = Composition(rows[0], rows[1])
    assert product.shape == (4, 5)
    assert product(x) == pytest.approx(A @ M @ x)
    # reuses the workspace of the first call
    assert product(x) == pytest.approx(A @ M @ x)
    assert Composition(rows[2])(x[:3]) == pytest.approx(B @ x[:3])
    both = DirectSum(Identity(2), rows[1], rows[2])
    assert both.shape == (12, 10)
    expected = np.concatenate([y[:2], M @ y[2:7], B @ y[7:]])
    assert both(y) == pytest.approx(expected)
    with pytest.raises(ValueError, match="5 components; expected 7"):
        Composition(rows[0], CompressedRows(csr_array(M.T)))


def grid(cells):
    """Return a Laplacian plus the identity on a square grid."""
    path = 2 * eye_array(cells) - eye_array(cells, k=1) - eye_array(cells, k=-1)
    one = eye_array(cells)
    return csc_array(kron(path, one) + kron(one, path) + eye_array(cells**2))


@pytest.fixture(params=["dense", "sparse"])
def way(request, monkeypatch):
    """Use a dense factor, or the sparse one that is used for large matrices."""
    if request.param == "sparse":
        monkeypatch.setattr(factor_module, "MAX_ARRAY_ROWS", -1)


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize("last", [[], [30, 3, 12, 11], range(36)])
def test_a_factor_with_a_border_solves(last):
    A, border = grid(6), np.array(last, dtype=np.int64)
    L, dense = bordered_factor(A, border), A.toarray()
    t, inverse = np.random.default_rng(SEED).standard_normal(36), np.linalg.inv(dense)

    assert L(t) == pytest.approx(inverse @ t)
    assert L(np.eye(36)) == pytest.approx(inverse)
    assert L.backward(L.forward(t)) == pytest.approx(inverse @ t)
    assert L.forward(t) @ L.forward(t) == pytest.approx(t @ inverse @ t)
    # the squared pivots are between the extreme eigenvalues
    least, largest = np.linalg.eigvalsh(dense)[[0, -1]]
    assert least <= L.least_pivot**2 <= largest


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize("shift", [0.5, 1e-3, 1e-14])
def test_changes_of_the_border_are_changes_of_the_matrix(shift):
    """The products of the columns `held` are subtracted from A, and in row 4 of A, only
    the shift remains.
    """
    rng = np.random.default_rng(SEED)
    free, held = rng.standard_normal((6, 12)), np.zeros((6, 4))
    held[[1, 4]] = rng.standard_normal((2, 4))
    free[4] = 0  # a row with entries only in `held`
    G, border = np.hstack([free, held]), np.array([4, 1])
    L = bordered_factor(csc_array(G @ G.T), border)
    columns = CompressedRows(csr_array(held.T))
    expected = free @ free.T + shift * G @ G.T
    t = free @ rng.standard_normal(12)

    changed = L.shifted_without(shift, columns, np.ones(4))
    y = changed(t)
    assert expected @ y == pytest.approx(t, abs=1e-10)
    assert changed.backward(changed.forward(t)) == pytest.approx(y, abs=1e-10)
    one = np.array([0.0, 1, 0, 0])
    some = (1 + shift) * (G @ G.T) - np.outer(held[:, 1], held[:, 1])
    y = L.shifted_without(shift, columns, one)(some @ t)
    assert y == pytest.approx(t, abs=1e-9)
    with pytest.raises(ValueError, match="3 components; expected 4"):
        L.shifted_without(shift, columns, one[:3])


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize("last", [[], [0], [0, 1, 2]])
def test_dependent_rows_have_no_factor(last):
    G = np.array([[1.0, 2, 0, 0], [0, 1, 1, 3], [2, 3, -1, -3]])  # third: 2·1st − 2nd
    gram = G @ G.T
    gram[2, 2] -= 1e-3

    with pytest.raises(DependentRowsError):
        bordered_factor(csc_array(gram), np.array(last, dtype=np.int64))


@pytest.mark.parametrize(
    ("rows", "n"), [(1, 1), (3, 7), (9, 2), (0, 4), (5, 0), (257, 60)]
)
@pytest.mark.parametrize("members", [1, 3, 24])
@pytest.mark.parametrize("columns", [0, 1, 5])
def test_blocks_multiply_the_columns_of_all_members(rows, n, members, columns):
    rng = np.random.default_rng(n + columns)
    M, X = rng.standard_normal((rows, n)), rng.standard_normal((n, members * columns))
    both = DirectSum(Block(2 * np.ones((1, 1)), 1, 3), Block(M, n, members))
    before = np.arange(3.0 * columns).reshape(3, columns)
    x = np.vstack([before, X.reshape(n * members, columns)])

    y = both(x)

    assert y[:3].tolist() == (2 * before).tolist()
    product = y[3:].reshape(rows, members * columns)
    assert product == pytest.approx(M @ X, abs=1e-12)


@pytest.mark.parametrize("columns", [1, 2, 5])
def test_triangles_and_objects_multiply_like_arrays(columns):
    rng = np.random.default_rng(columns)
    M = rng.standard_normal((4, 4))
    M += M.T

    class Halved:
        def __matmul__(self, X):
            return X / 2

    x = rng.standard_normal((10, columns))
    blocks = DirectSum(Block(lapack.dtrttp(M)[0], 4, 1), Block(Halved(), 3, 2))

    assert blocks(x) == pytest.approx(np.vstack([M @ x[:4], x[4:] / 2]), abs=1e-14)


@pytest.mark.parametrize(
    ("shape", "n", "members"), [((3, 3), 4, 2), ((3, 2), 3, 2), ((6,), 3, 2)]
)
def test_blocks_that_do_not_fit_are_refused(shape, n, members):
    """A triangle needs a class with one member."""
    with pytest.raises(ValueError, match=rf"cannot multiply a \({n}, {members}\)"):
        Block(np.zeros(shape), n, members)
    with pytest.raises(ValueError, match="9 components; expected 6"):
        Block(np.zeros((3, 3)), 3, 2)(np.zeros(9))
