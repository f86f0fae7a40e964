"""A Cholesky factor of a sum of matrices over ranks, A = Σ_p A_p = LLᵀ.

Every rank p has a symmetric, positive semidefinite A_p on the rows that it *touches*.
No entry couples rows that one rank alone touches, its *inner* ones, with those of
another: each rank eliminates its own. The Schur complements on the *shared* rows are
summed over the ranks, and that sum is factorised by all of them alike (substructuring;
Smith, Bjørstad and Gropp, Domain Decomposition, 1996, Chapter 4). A solve is one
reduction of shared rows; all else is work of each rank on its own rows.

A vector of rows is held in one of three ways, each of them a `DistributedVector`:

* additive: the sum over ranks is meant, as of G_p v with the columns G_p of a rank
* consistent: each rank has the entries of the rows that it touches
* orthonormal: in the order of L, inner rows on their rank; of each shared entry all P
  ranks hold 1/√P

An additive times a consistent one, and two orthonormal ones, give the inner product of
the whole.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, eigh, lapack, qr
from scipy.sparse import csc_array, csc_matrix, diags_array
from sksparse.cholmod import CholmodNotPositiveDefiniteError, Factor, analyze

from mortarbench.harness.distributed.vectors import (
    DistributedVector,
    Ranks,
    distributed,
)
from mortarbench.harness.qp import Matrix

Rows = NDArray[np.int64]
Dense = NDArray[np.float64]
DEPENDENT = 1e-13  #: pivots of rows of length one below this are rounding
UNSTUCK = 1e-15  #: added to the diagonal so that no pivot of dependent rows is zero
PIVOT = 1e-3  #: by which a pivot may miss its least value, for the rounding of both
FILL = 8  #: entries for each row of A that the dense factor of the shared rows may have


@dataclass(frozen=True, eq=False)
class Touched:
    """The rows of A that a rank touches."""

    ranks: Ranks
    rows: Rows  #: (k,) ascending
    touching: Rows  #: (k,) how many ranks touch each
    shared: Rows  #: (s,) rows that several ranks touch, the same on all of them

    @cached_property
    def is_shared(self) -> NDArray[np.bool_]:
        """Which of its rows are."""
        return self.touching > 1

    @cached_property
    def place(self) -> Rows:
        """Places in `shared` of its shared rows, ascending."""
        return np.searchsorted(self.shared, self.rows[self.is_shared])

    @property
    def few_shared(self) -> bool:
        """Whether so few are shared that their dense factor is the lesser work."""
        inner = self.ranks.total(np.array([float(np.count_nonzero(~self.is_shared))]))
        s = self.shared.size
        return s**2 <= FILL * (s + float(inner[0]))

    def additive(self, t: Dense) -> DistributedVector:
        """Make what every rank has of its rows (k,) a vector that is summed."""
        return distributed(t / self.touching, self.ranks)


def touched_rows(rows: Rows, ranks: Ranks) -> Touched:
    """Tell the others which rows this rank touches, and learn which are shared."""
    every, count = np.unique(
        np.concatenate(ranks.comm.allgather(rows)), return_counts=True
    )
    touching = count[np.searchsorted(every, rows)]
    return Touched(ranks, rows, touching, every[count > 1])


class DependentRowsError(ValueError):
    """A is singular; raised on all ranks alike."""


@dataclass(frozen=True, eq=False)
class LocalFactor:
    """A_p with its unchanging inner rows eliminated, once.

    Rows that may change, and shared ones, are its *border*.
    """

    at: Touched
    order: Rows  #: (k,) of its rows: unchanging, changing, shared
    changing: int  #: how many of these may change
    #: of A_p in that order, with 1 added to the diagonal of shared rows; None without
    #: rows
    factor: Factor | None
    L_bb: Dense  #: (b, b) its last block, of the border

    @property
    def border(self) -> Rows:
        """Its border, as places in its rows, (b,)."""
        return self.order[self.order.size - len(self.L_bb) :]

    @cached_property
    def complement(self) -> Dense:
        """The Schur complement of A_p on the border, (b, b)."""
        T = self.L_bb @ self.L_bb.T
        T[np.arange(self.changing, len(T)), np.arange(self.changing, len(T))] -= 1
        return T

    def reduced(self, t: Dense) -> tuple[Dense, Dense]:
        """Eliminate in an additive t (k,): L_aa⁻¹t_a, and what is left of t_b."""
        if self.factor is None:
            return np.zeros(0), np.zeros(0)
        u = self.factor.solve_L(t[self.order], use_LDLt_decomposition=False)
        first = u.size - len(self.L_bb)
        return u[:first], self.L_bb @ u[first:]

    def extended(self, u: Dense, x_b: Dense) -> Dense:
        """Return the x (k,) with  L_aaᵀx_a + L_baᵀx_b = u  and x_b on the border."""
        y = np.empty(self.order.size)
        if self.factor is not None:
            u = np.concatenate([u, self.L_bb.T @ x_b])
            y[self.order] = self.factor.solve_Lt(u, use_LDLt_decomposition=False)
        return y

    def completed(self) -> SummedFactor:
        """Factorise A.

        Raises
        ------
        DependentRowsError
            Where that is not positive definite.

        """
        ranks, c = self.at.ranks, self.changing
        fails, L_cc = 0.0, self.complement[:c, :c]
        try:
            L_cc = _cholesky(L_cc)
        except np.linalg.LinAlgError:
            fails = 1.0
        if ranks.extreme(fails, np.max):  # raised by all ranks alike
            raise DependentRowsError("the rows depend on each other")
        L_sc, S = self._onto_shared(self.complement, L_cc)
        try:
            return SummedFactor(self, 1.0, L_cc, L_sc, _cholesky(S))
        except np.linalg.LinAlgError:
            raise DependentRowsError("the rows depend on each other") from None

    def _onto_shared(self, T: Dense, L_cc: Dense) -> tuple[Dense, Dense]:
        """Eliminate changing rows of T (b, b): L_sc, and the sum over ranks (s, s)."""
        c, s, place = self.changing, self.at.shared.size, self.at.place
        L_sc = blas.dtrsm(1.0, L_cc, T[:c, c:], lower=1).T if c else T[c:, :0]
        S = np.zeros((s, s))
        S[place[:, None], place] = T[c:, c:] - L_sc @ L_sc.T
        return L_sc, self.at.ranks.total(S.ravel()).reshape(s, s) if s else S


@dataclass(frozen=True, eq=False)
class SummedFactor:
    """LLᵀ = A, or (1 + κ)A − Σ_p less_p, over ranks."""

    local: LocalFactor
    root: float  #: √(1 + κ)
    L_cc: Dense  #: (c, c) of the changing rows of this rank
    L_sc: Dense  #: (s_p, c) of its shared rows
    L_ss: Dense  #: (s, s) of the shared rows of all, the same on all ranks

    @property
    def least_pivot(self) -> float:
        """The least diagonal entry of L, of all ranks; inf where there are no rows."""
        factor, inner = self.local.factor, self.local.order.size - len(self.local.L_bb)
        of_inner = np.zeros(0) if factor is None else factor.L().diagonal()[:inner]
        own = np.concatenate([
            self.root * of_inner, np.diag(self.L_cc), np.diag(self.L_ss),
        ])  # fmt: skip
        return self.local.at.ranks.extreme(float(own.min(initial=np.inf)), np.min)

    def shifted(self, shift: float, less: Dense) -> SummedFactor:
        """Factorise (1 + shift)A − Σ_p `less`_p with the factor of A.

        less : (b, b) on the border, with Σ_p `less`_p ≤ A. Schur complements grow with
            their matrix, so that those met here are at least `shift` times those of A,
            which L_cc and L_ss are factors of.
        """
        local, c, scale = self.local, self.local.changing, 1 + shift
        T = scale * local.complement - less
        L_cc = factor_above(T[:c, :c], shift, self.L_cc)
        L_sc, S = local._onto_shared(T, L_cc)
        L_ss = factor_above(S, shift, self.L_ss)
        return SummedFactor(local, float(np.sqrt(scale)), L_cc, L_sc, L_ss)

    def forward(self, t: Dense) -> DistributedVector:
        """Take an additive t (k,) to L⁻¹t (k - s_p + s,), orthonormal."""
        ranks = self.local.at.ranks
        with ranks.clocked("coarse"):
            u, r = self.local.reduced(np.asarray(t))
            z_c, r_s = self._changing(r)
            z_s = _solved(self.L_ss, self._gathered(r_s))
            z_s /= np.sqrt(ranks.size)
            return distributed(np.concatenate([u / self.root, z_c, z_s]), ranks)

    def backward(self, a: Dense) -> DistributedVector:
        """Take an orthonormal a (k - s_p + s,) to L⁻ᵀa (k,), consistent."""
        ranks, a = self.local.at.ranks, np.asarray(a)
        with ranks.clocked("coarse"):
            c, s = len(self.L_cc), len(self.L_ss)
            u, z_c, z_s = np.split(a, [a.size - c - s, a.size - s])
            x_s = _solved(self.L_ss, np.sqrt(ranks.size) * z_s, transposed=True)
            x_s = x_s[self.local.at.place]
            x_c = _solved(self.L_cc, z_c - self.L_sc.T @ x_s, transposed=True)
            y = self.local.extended(u / self.root, np.concatenate([x_c, x_s]))
            return distributed(y, ranks)

    def __call__(self, t: Dense) -> DistributedVector:
        """Solve for the consistent y (k,) of an additive t (k,)."""
        local = self.local
        with local.at.ranks.clocked("coarse"):
            u, r = local.reduced(np.asarray(t))
            z_c, r_s = self._changing(r)
            z_s = _solved(self.L_ss, self._gathered(r_s))
            x_s = _solved(self.L_ss, z_s, transposed=True)[local.at.place]
            x_c = _solved(self.L_cc, z_c - x_s @ self.L_sc, transposed=True)
            y = local.extended(u / self.root**2, np.concatenate([x_c, x_s]))
            return distributed(y, local.at.ranks)

    def _changing(self, r: Dense) -> tuple[Dense, Dense]:
        """Eliminate changing rows of a border (c + s_p,); and what the others keep."""
        c = len(self.L_cc)
        z_c = _solved(self.L_cc, r[:c])
        return z_c, r[c:] - self.L_sc @ z_c

    def _gathered(self, r: Dense) -> Dense:
        """Add what all ranks have for shared rows (s_p,): (s,)."""
        shared = np.zeros(len(self.L_ss))
        shared[self.local.at.place] = r
        return self.local.at.ranks.total(shared) if shared.size else shared


def local_factor(
    A: csc_array, at: Touched, changing: NDArray[np.bool_] | None = None
) -> LocalFactor:
    """Eliminate the unchanging inner rows of this rank's A_p (k, k).

    A : of rows whose diagonal entries, summed over the ranks, are about one
    changing : (k,) inner rows that may change; none unless given

    Raises
    ------
    DependentRowsError
        Where the inner rows of any rank depend on each other.

    """
    changes = np.zeros(at.rows.size, bool) if changing is None else changing
    first = np.flatnonzero(~changes & ~at.is_shared)
    second = np.flatnonzero(changes & ~at.is_shared)
    if first.size:
        first = first[analyze(with_int32(A[first][:, first]), use_long=False).P()]
    order = np.concatenate([first, second, np.flatnonzero(at.is_shared)])
    factor, L_bb, fails = None, np.zeros((0, 0)), 0.0
    if order.size:
        raised = np.where(at.is_shared[order], 1.0, 0.0)  # A_p may be singular there
        M = with_int32(csc_array(A[order][:, order]) + diags_array(raised))
        factor = analyze(M, ordering_method="natural", use_long=False)
        try:
            factor.cholesky_inplace(M)
            L_bb = factor.L()[first.size :, first.size :].toarray()
        except CholmodNotPositiveDefiniteError:
            fails = 1.0
    if at.ranks.extreme(fails, np.max):
        raise DependentRowsError("the rows depend on each other")
    return LocalFactor(at, order, second.size, factor, np.asarray(L_bb))


def independent_rows(gram: Matrix) -> Rows:
    """Return rows G of a matrix that are independent and span all, from GGᵀ (r, r).

    A row counts as dependent where its pivot, the square of its distance from the span
    of the rows before it, is at most `DEPENDENT` of the square of its length. The first
    such row is left out, then all pivots are computed anew: those behind are rounding.

    Returns
    -------
    (k,) their numbers, ascending

    """
    size = np.sqrt(gram.diagonal())
    kept = np.flatnonzero(size > 0)
    while kept.size:
        inverse = diags_array(1 / size[kept])
        unit = inverse @ csc_array(gram)[kept][:, kept] @ inverse
        shifted = with_int32(unit + diags_array(np.full(kept.size, UNSTUCK)))
        factor = analyze(shifted, mode="simplicial", use_long=False)
        factor.cholesky_inplace(shifted)
        dependent = np.flatnonzero(factor.D() <= DEPENDENT)
        if not dependent.size:
            break
        kept = np.delete(kept, factor.P()[dependent[0]])
    return kept


def factor_above(M: Dense, share: float, L_0: Dense) -> Dense:
    """Return L with LLᵀ = M, for an M that exact arithmetic has at least share·L₀L₀ᵀ.

    M is a difference of matrices as large as L₀L₀ᵀ. Where the share is less than what
    they cancel to, its eigenvalues are rounding, of either sign. The pivots of M are no
    less than those of share·L₀L₀ᵀ; where they are, the matrix L₀⁻¹ML₀⁻ᵀ ≥ share·I is
    decomposed instead, its eigenvalues λ are raised to the share, and

        LLᵀ = L₀ Q λ Qᵀ L₀ᵀ   from a QR factorisation of √λ QᵀL₀ᵀ,

    which forms no difference, and has that floor whatever was cancelled.

    M : (k, k) symmetric
    L_0 : (k, k) lower triangular
    """
    try:
        L = _cholesky(M)
        if (np.diag(L) ** 2 >= (1 - PIVOT) * share * np.diag(L_0) ** 2).all():
            return L
    except np.linalg.LinAlgError:
        pass
    inner = blas.dtrsm(1.0, L_0, blas.dtrsm(1.0, L_0, M, lower=1).T, lower=1)
    size, Q = eigh((inner + inner.T) / 2)
    root = np.sqrt(np.maximum(size, share))
    half = blas.dtrmm(1.0, L_0, Q * root, lower=1)
    (R,) = qr(half.T, mode="r", overwrite_a=True)
    L = np.asfortranarray(R.T)
    return L * np.where(np.diag(L) < 0, -1.0, 1.0)


def _cholesky(M: Dense) -> Dense:
    """Return L with LLᵀ = M, its upper triangle not to be read."""
    if not len(M):
        return np.zeros((0, 0), order="F")
    L, failed = lapack.dpotrf(M, lower=1, clean=0)
    if failed:
        raise np.linalg.LinAlgError
    return np.asarray(L)


def _solved(L: Dense, x: Dense, *, transposed: bool = False) -> Dense:
    """Return L⁻¹x or L⁻ᵀx."""
    if not x.size:
        return x
    return np.asarray(blas.dtrsv(L, x, lower=1, trans=int(transposed)))


def with_int32(M: Matrix) -> csc_matrix:
    """Have the entries of a sparse M (k, l) numbered as `Factor` does: 32 bits."""
    M = csc_matrix(M)
    M.indices, M.indptr = M.indices.astype(np.int32), M.indptr.astype(np.int32)
    return M
