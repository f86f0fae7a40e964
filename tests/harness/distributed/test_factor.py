"""Distributed factors: cancelling differences, sums over ranks and dependent rows."""

from contextlib import nullcontext
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import solve_triangular
from scipy.sparse import csc_array

from mortarbench.harness.distributed import factor
from mortarbench.harness.distributed.factor import (
    MAX_FILL,
    DependentRowsError,
    factor_above,
    independent_rows,
    local_factor,
    touched_rows,
)
from tests.support import on_ranks
from tests.support.threads import on_threads


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


def parts(share, size=9):
    """Return L₀ and M = (1 + share)L₀L₀ᵀ − L₀WWᵀL₀ᵀ with orthonormal W (size, 3)."""
    rng = np.random.default_rng(3)
    L_0 = np.tril(rng.standard_normal((size, size))) + 2 * np.eye(size)
    W = np.linalg.qr(rng.standard_normal((size, 3)))[0]
    held = L_0 @ W
    return L_0, (1 + share) * (L_0 @ L_0.T) - held @ held.T


@pytest.mark.parametrize("share", [0.5, 1e-3, 1e-8, 1e-14, 1e-18])
def test_the_factor_of_a_difference_has_the_eigenvalues_that_are_known(share):
    """The relative eigenvalues are `share` on the span of W, otherwise 1 + `share`."""
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


@pytest.mark.parametrize("seed", range(4))
def test_eigenvalues_below_their_least_value_are_raised_to_it(seed):
    """M has known eigenvalues relative to L₀L₀ᵀ; two are negative, as by rounding."""
    rng, share = np.random.default_rng(seed), 1e-3
    L_0 = np.tril(rng.standard_normal((5, 5))) + 3 * np.eye(5)
    Q = np.linalg.qr(rng.standard_normal((5, 5)))[0]
    values = np.array([4.0, 1.0, 0.25, -0.03, -0.1])
    raised = np.array([4.0, 1.0, 0.25, share, share])

    def with_values(v):
        return L_0 @ (Q * v) @ Q.T @ L_0.T

    L = factor_above(
        np.asfortranarray(with_values(values)), share, np.asfortranarray(L_0)
    )
    assert (np.diag(L) > 0).all()
    assert not np.triu(L, 1).any()
    assert L @ L.T == pytest.approx(with_values(raised), abs=1e-13)


@pytest.mark.parametrize("length", [0.1, 1.0, 10.0])
def test_positive_pivots_below_their_least_value_are_raised_to_it(length):
    """A pivot of share/2 is positive, but below the lower bound."""
    share = 1e-3
    L_0 = length * np.eye(3)
    M = np.diag([1.0, share / 2, 2 * share]) * length**2
    L = factor_above(np.asfortranarray(M), share, np.asfortranarray(L_0))
    assert L @ L.T == pytest.approx(np.diag([1.0, share, 2 * share]) * length**2)


def test_without_cancellation_the_factor_is_that_of_cholesky():
    L_0, M = parts(0.5)
    L = factor_above(np.asfortranarray(M), 0.5, np.asfortranarray(L_0))
    assert np.tril(L) == pytest.approx(np.linalg.cholesky(M), rel=1e-13)


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


@pytest.mark.parametrize("size", [1, 2, 4, 5])
def test_factors_of_a_sum_over_ranks_are_those_of_the_whole(size):
    """If one rank has only dependent rows, all ranks raise the error."""
    gathered, *others = on_threads(size, on_ranks.factors)
    assert others == [None] * (size - 1)
    for error, refused, shared in gathered:
        assert error < 1e-12
        assert refused
        assert shared == (list(range(0, 24, 3)) if size > 1 else [])


def laplacians(size, cells=4):
    """Return the number of rows, and the rows (k,) and A_p of each rank, for a chain of
    springs with fixed ends.
    """
    nodes = np.arange(size * cells + 1)
    parts = []
    for p in range(size):
        own = nodes[p * cells : (p + 1) * cells + 1]
        A = np.diag(np.r_[1.0, np.full(cells - 1, 2.0), 1.0])
        A -= np.eye(cells + 1, k=1) + np.eye(cells + 1, k=-1)
        A[0, 0] += p == 0
        A[-1, -1] += p == size - 1
        parts.append((own, A / 2))
    return nodes.size, parts


@pytest.mark.parametrize("changing", [0, 1, 3])
def test_the_factor_of_a_chain_of_springs_is_that_of_the_whole(changing):
    """The part between two shared nodes is singular; only the sum is definite."""
    size = 3
    n, parts = laplacians(size)
    whole = np.zeros((n, n))
    for own, A in parts:
        whole[np.ix_(own, own)] += A
    t, s = np.random.default_rng(7).standard_normal((2, n))
    x = np.linalg.solve(whole, t)

    def work(ranks):
        own, A = parts[ranks.rank]
        at = touched_rows(own, ranks)
        assert at.shared.tolist() == [4, 8]
        assert at.few_shared
        change = np.zeros(own.size, dtype=bool)
        change[np.flatnonzero(~at.is_shared)[:changing]] = True
        local = local_factor(csc_array(A), at, change)
        assert sorted(local.factor.rows.tolist()) == list(range(own.size))
        assert local.border.size == changing + at.is_shared.sum()
        inner = np.setdiff1d(np.arange(own.size), local.border)
        schur = A - A[:, inner] @ np.linalg.solve(A[np.ix_(inner, inner)], A[inner])
        complement = np.tril(local.complement)
        border = np.ix_(local.border, local.border)
        assert complement == pytest.approx(np.tril(schur[border]), abs=1e-13)
        L = local.completed()
        forward = L.forward(at.additive(t[own]))
        assert np.asarray(L(at.additive(t[own]))) == pytest.approx(x[own])
        assert np.asarray(L.backward(forward)) == pytest.approx(x[own])
        assert forward @ L.forward(at.additive(s[own])) == pytest.approx(s @ x)
        assert np.linalg.norm(forward) == pytest.approx(np.sqrt(t @ x))
        twice = L.shifted(1.0, np.zeros(border[0].shape[:1] * 2))
        assert np.asarray(twice(at.additive(t[own]))) == pytest.approx(x[own] / 2)
        assert twice.least_pivot == pytest.approx(np.sqrt(2) * L.least_pivot)
        assert set(ranks.seconds) >= {"coarse"}
        assert ranks.seconds["coarse"] > 0
        return L.least_pivot

    least = on_threads(size, work)
    assert len(set(least)) == 1
    # the determinant of the whole matrix is the squared product of all pivots
    assert 0 < least[0] <= np.linalg.det(whole) ** (0.5 / n) + 1e-12


@pytest.mark.parametrize("where", ["inner", "changing", "shared"])
def test_dependent_rows_of_one_rank_are_refused_on_all(where):
    """All ranks raise the error, wherever the rows are; otherwise, some would wait
    forever.
    """

    def work(ranks):
        own = np.array([[0, 1, 2], [2, 3, 4]])[ranks.rank]
        at = touched_rows(own, ranks)
        A = np.eye(3)
        row = {"inner": 3, "changing": 3, "shared": 2}[where]
        A[own == row, own == row] = 0.0
        with pytest.raises(DependentRowsError, match="linearly dependent"):
            local_factor(
                csc_array(A), at, (own == 3) & (where == "changing")
            ).completed()
        return True

    assert on_threads(2, work) == [True, True]


@pytest.mark.parametrize(
    ("shared", "few"), [(0, True), (MAX_FILL, True), (MAX_FILL + 1, False)]
)
def test_few_rows_are_shared_if_their_dense_factor_costs_less(shared, few):
    """Without inner rows, s² entries are compared with MAX_FILL·s."""
    at = on_threads(2, lambda ranks: touched_rows(np.arange(shared), ranks).few_shared)
    assert at == [few, few]


@pytest.mark.parametrize(("inner", "few"), [(6, True), (5, False)])
def test_inner_rows_of_all_ranks_reduce_the_number_of_shared_rows(
    inner, few, monkeypatch
):
    """For MAX_FILL = 8 and s = 12, s² = 144 ≤ 8 (12 + inner) requires six
    inner rows.
    """
    monkeypatch.setattr(factor, "MAX_FILL", 8)

    def work(ranks):
        mine = 12 + np.array_split(np.arange(inner), 2)[ranks.rank]
        return touched_rows(np.append(np.arange(12), mine), ranks).few_shared

    assert on_threads(2, work) == [few, few]


def test_rows_store_the_number_of_ranks_that_share_them():
    def work(ranks):
        own = np.array([[0, 2, 5, 7], [2, 3, 5, 9], [1, 5, 6, 8]])[ranks.rank]
        at = touched_rows(own, ranks)
        t = np.asarray(at.additive(np.full(4, 6.0)))
        return (at.touching.tolist(), at.shared.tolist(), at.place.tolist(), t.tolist())

    assert on_threads(3, work) == [
        ([1, 2, 3, 1], [2, 5], [0, 1], [6, 3, 2, 6]),
        ([2, 1, 3, 1], [2, 5], [0, 1], [3, 6, 2, 6]),
        ([1, 3, 1, 1], [2, 5], [1], [6, 2, 6, 6]),
    ]


def test_the_least_pivot_is_one_of_the_sum_and_not_of_a_part():
    """Diagonal A: inner entries are 100, and each of three ranks adds 4 to a shared
    entry.
    """

    def work(ranks):
        at = touched_rows(np.array([0, 1 + ranks.rank]), ranks)
        L = local_factor(csc_array(np.diag([4.0, 100.0])), at).completed()
        return L.least_pivot, L.shifted(3.0, np.zeros((1, 1))).least_pivot

    assert on_threads(3, work) == [pytest.approx((12**0.5, 48**0.5))] * 3


def test_a_rank_without_rows_takes_part_in_a_solve():
    """Rank 0 has A = diag(4, 9); rank 1 has no rows."""

    def work(ranks):
        k = 0 if ranks.rank else 2
        at = touched_rows(np.arange(k), ranks)
        A = csc_array(np.diag([4.0, 9.0])[:k, :k])
        L, t = local_factor(A, at).completed(), at.additive(np.array([2.0, 3.0])[:k])
        found = L.forward(t), L.backward(L.forward(t)), L(t)
        return [np.asarray(v).tolist() for v in found], np.linalg.norm(found[0])

    norm = pytest.approx(2**0.5)
    solved = pytest.approx([1 / 2, 1 / 3])
    (first, of_first), (second, of_second) = on_threads(2, work)
    assert first[0] == pytest.approx([1, 1])
    assert first[1] == first[2] == solved
    assert second == [[], [], []]
    assert of_first == of_second == norm


@pytest.mark.parametrize("changing", [False, True])
def test_dependent_rows_are_refused_on_ranks_that_share_none_with_them(changing):
    """Rank 1 has two equal rows, which rank 0 does not touch."""

    def work(ranks):
        p = ranks.rank
        at = touched_rows(2 * p + np.arange(2), ranks)
        A = csc_array(np.ones((2, 2)) if p else np.eye(2))
        with pytest.raises(DependentRowsError, match="linearly dependent"):
            local_factor(A, at, np.full(2, changing)).completed()
        return True

    assert on_threads(2, work) == [True, True]
