"""Factors of differences that cancel, and rows of matrices that are dependent."""

from contextlib import nullcontext
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import solve_triangular
from scipy.sparse import csc_array

from harness.distributed.factor import (
    factor_above,
    independent_rows,
    local_factor,
    touched_rows,
)


def rank(A):
    """Gaussian elimination of integers in fractions."""
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


def parts(share, size=9):
    """L₀, and M = (1 + share)L₀L₀ᵀ − L₀WWᵀL₀ᵀ for three orthonormal columns W."""
    rng = np.random.default_rng(3)
    L_0 = np.tril(rng.standard_normal((size, size))) + 2 * np.eye(size)
    W = np.linalg.qr(rng.standard_normal((size, 3)))[0]
    held = L_0 @ W
    return L_0, (1 + share) * (L_0 @ L_0.T) - held @ held.T


@pytest.mark.parametrize("share", [0.5, 1e-3, 1e-8, 1e-14, 1e-18])
def test_the_factor_of_a_difference_has_the_eigenvalues_that_are_known(share):
    """1 + share of what is not taken away, `share` of what is, to the rounding of M."""
    L_0, M = parts(share)
    L = factor_above(np.asfortranarray(M), share, np.asfortranarray(L_0))
    L = np.tril(L)
    assert L @ L.T == pytest.approx(M, abs=1e-13 * np.abs(M).max())
    inner = solve_triangular(L_0, L, lower=True)
    sizes = np.linalg.svd(inner, compute_uv=False) ** 2
    assert sizes[:-3] == pytest.approx(1 + share, rel=1e-12)
    assert (sizes[-3:] >= 0.9 * share).all()
    assert (sizes[-3:] <= share + 1e-13).all()
    assert (np.diag(L) > 0).all()


def test_where_nothing_cancels_the_factor_is_that_of_cholesky():
    L_0, M = parts(0.5)
    L = factor_above(np.asfortranarray(M), 0.5, np.asfortranarray(L_0))
    assert np.tril(L) == pytest.approx(np.linalg.cholesky(M), rel=1e-13)


@pytest.mark.parametrize("seed", range(20))
def test_as_many_rows_are_kept_as_the_rank_that_fractions_tell(seed):
    rng = np.random.default_rng(seed)
    G = rng.integers(-2, 3, size=(rng.integers(4, 9), 12))
    mixed = rng.integers(-1, 2, size=(5, len(G))) @ G
    G = rng.permutation(np.vstack([G, mixed, np.zeros((1, 12), dtype=int)]))
    kept = independent_rows(csc_array((G @ G.T).astype(float)))
    assert kept.size == rank(G) == rank(G[kept])
    assert (np.diff(kept) > 0).all()


ALONE = SimpleNamespace(
    size=1, total=lambda v: v, extreme=lambda v, of: v,
    clocked=lambda name: nullcontext(), comm=SimpleNamespace(allgather=lambda v: [v]),
)  # fmt: skip


@pytest.mark.parametrize("changing", [[], [0], [2], [0, 1, 2]])
def test_the_least_pivot_of_a_diagonal_is_the_root_of_its_least_entry(changing):
    at = touched_rows(np.arange(3), ALONE)
    A = csc_array(np.diag([4.0, 9.0, 0.25]))
    local = local_factor(A, at, np.isin(np.arange(3), changing))
    assert local.completed().least_pivot == 0.5


def test_without_rows_no_pivot_is_small():
    at = touched_rows(np.zeros(0, dtype=np.int64), ALONE)
    assert local_factor(csc_array((0, 0)), at).completed().least_pivot == np.inf
