"""Cholesky factors of differences on a border that cancel, and independent rows."""

from fractions import Fraction

import numpy as np
import pytest
from scipy.sparse import csc_array, csr_array

from mortarbench.harness.distributed.factor import independent_rows
from mortarbench.harness.distributed.sparse import BorderedFactor, CompressedRows


def rank(A):
    """Return the rank of an integer matrix from elimination in fractions."""
    rows, found = [[Fraction(int(v)) for v in row] for row in A], 0
    for column in range(A.shape[1]):
        pivot = next((r for r in rows if r[column]), None)
        if pivot is None:
            continue
        rows.remove(pivot)
        rows = [
            [a - r[column] / pivot[column] * b for a, b in zip(r, pivot, strict=True)]
            for r in rows
        ]
        found += 1
    return found


def relative_eigenvalues(L_0, share, held):
    """Return eigenvalues of (1 + share)L₀L₀ᵀ − `held` `held`ᵀ relative to L₀L₀ᵀ, with
    the factor L of the difference: the squared singular values of (L⁻¹L₀)⁻¹.
    """
    size = len(L_0)
    whole = BorderedFactor(np.arange(size), csc_array((size, 0)), L_0)
    columns = CompressedRows(csr_array(held.T))
    L = whole.shifted_without(share, columns, np.ones(held.shape[1]))
    inverse = np.column_stack([L.forward(column.copy()) for column in L_0.T])
    assert L.least_pivot > 0
    return np.sort(np.linalg.svd(inverse, compute_uv=False) ** -2.0)


@pytest.mark.parametrize("share", [0.5, 1e-3, 1e-8, 1e-14, 1e-18])
def test_the_factor_of_a_difference_has_the_eigenvalues_that_are_known(share):
    """They are `share` on the span of three orthonormal columns, else 1 + `share`."""
    rng = np.random.default_rng(3)
    L_0 = np.tril(rng.standard_normal((9, 9))) + 2 * np.eye(9)
    W = np.linalg.qr(rng.standard_normal((9, 3)))[0]
    sizes = relative_eigenvalues(L_0, share, L_0 @ W)
    # the small eigenvalues limit the accuracy of L⁻¹
    assert sizes[3:] == pytest.approx(1 + share, rel=1e-12 + 1e-15 / share**0.5)
    assert (sizes[:3] >= 0.9 * share).all()
    assert (sizes[:3] <= share + 1e-13).all()


@pytest.mark.parametrize("seed", range(4))
def test_eigenvalues_below_their_least_value_are_raised_to_it(seed):
    """Two eigenvalues of the difference are negative, as by rounding."""
    rng, share = np.random.default_rng(seed), 1e-3
    L_0 = np.tril(rng.standard_normal((5, 5))) + 3 * np.eye(5)
    Q = np.linalg.qr(rng.standard_normal((5, 5)))[0]
    values = np.array([-0.1, -0.03, 0.25, 0.5, 1.0])
    sizes = relative_eigenvalues(L_0, share, L_0 @ Q * np.sqrt(1 + share - values))
    assert sizes == pytest.approx([share, share, 0.25, 0.5, 1.0])


@pytest.mark.parametrize("length", [0.1, 1.0, 10.0])
def test_positive_pivots_below_their_least_value_are_raised_to_it(length):
    """A pivot of share/2 is positive, but below the lower bound."""
    share = 1e-3
    values = np.array([share / 2, 2 * share, 1.0])
    held = length * np.diag(np.sqrt(1 + share - values))
    sizes = relative_eigenvalues(length * np.eye(3), share, held)
    assert sizes == pytest.approx([share, 2 * share, 1.0])


@pytest.mark.parametrize("seed", range(20))
def test_the_number_of_kept_rows_is_the_rank_in_exact_arithmetic(seed):
    rng = np.random.default_rng(seed)
    G = rng.integers(-2, 3, size=(rng.integers(4, 9), 12))
    mixed = rng.integers(-1, 2, size=(5, len(G))) @ G
    G = rng.permutation(np.vstack([G, mixed, np.zeros((1, 12), dtype=int)]))
    gram = csc_array((G @ G.T).astype(float))
    kept = independent_rows(gram)
    assert kept.size == rank(G) == rank(G[kept])
    assert independent_rows(1e-8 * gram).tolist() == kept.tolist()
    assert (np.diff(kept) > 0).all()
