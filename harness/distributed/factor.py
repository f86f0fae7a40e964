"""Cholesky factor of a sum of matrices over ranks, A = Σ_p A_p = LLᵀ.

Rank p stores a symmetric, positive semidefinite A_p on a set of rows, which the rank is
said to *touch*. A row that only one rank touches is an *inner* row of this rank. Rows
that several ranks touch are *shared*. No entry couples inner rows of different ranks,
so each rank eliminates its inner rows independently. The Schur complements on the
shared rows are summed over the ranks, and every rank factorises the sum. This method is
known as substructuring (Smith, Bjørstad and Gropp, Domain Decomposition, 1996, Chapter
4). A solve needs one reduction of shared rows; all other work is local.

A vector with an entry for each row of A is stored as a `DistributedVector` in one of
three representations:

* additive: the vector is the sum of the contributions of all ranks
* consistent: each rank stores the entries of the rows that it touches
* orthonormal: in the row order of L, each rank stores the entries of its inner rows and
  all shared entries divided by √P, where P is the number of ranks

The inner product of two vectors is the sum over ranks of local inner products if one
vector is additive and the other is consistent, or if both vectors are orthonormal.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, lapack
from scipy.sparse import csc_array, csc_matrix, diags_array
from sksparse.cholmod import CholmodNotPositiveDefiniteError, analyze

from mortarbench.harness.distributed.sparse import BorderedFactor, factor_above
from mortarbench.harness.distributed.vectors import (
    DistributedVector,
    Ranks,
    distributed,
)
from mortarbench.harness.qp import Matrix

Rows = NDArray[np.int64]
Dense = NDArray[np.float64]
#: Largest pivot that counts as zero; rows are scaled to length one.
DEPENDENCE_TOLERANCE = 1e-13
#: Number added to a unit diagonal, since the factorisation would fail at a zero pivot.
PIVOT_SHIFT = 1e-15
#: Largest number of entries of the dense factor of the shared rows, per row of A.
MAX_FILL = 8
#: Largest number of rows of a matrix that compiled code factorises as a dense array.
#: For 500 rows, the dense factorisation already takes longer than the overhead of
#: calling a sparse library.
MAX_ARRAY_ROWS = 256


@dataclass(frozen=True, eq=False)
class Touched:
    """Rows of A that this rank touches, and all rows that several ranks touch."""

    ranks: Ranks
    rows: Rows  #: (k,) numbers of the rows that this rank touches, ascending
    touching: Rows  #: (k,) number of ranks that touch each of these rows
    shared: Rows  #: (s,) numbers of all shared rows, equal on all ranks

    @cached_property
    def is_shared(self) -> NDArray[np.bool_]:
        """Mask (k,) of the local rows that are shared."""
        return self.touching > 1

    @cached_property
    def place(self) -> Rows:
        """Positions in `shared` of the shared rows of this rank, ascending."""
        return np.searchsorted(self.shared, self.rows[self.is_shared])

    @property
    def few_shared(self) -> bool:
        """True if the dense factor of the shared rows is small (`MAX_FILL`)."""
        inner = self.ranks.total(np.array([float(np.count_nonzero(~self.is_shared))]))
        s = self.shared.size
        return s**2 <= MAX_FILL * (s + float(inner[0]))

    def additive(self, t: Dense) -> DistributedVector:
        """Convert a consistent vector (k,) to an additive vector."""
        return distributed(t / self.touching, self.ranks)


def touched_rows(rows: Rows, ranks: Ranks) -> Touched:
    """Gather the numbers of the rows that the ranks touch, and find the shared rows.

    rows : (k,) rows that this rank touches, ascending
    """
    every, count = np.unique(
        np.concatenate(ranks.comm.allgather(rows)), return_counts=True
    )
    touching = count[np.searchsorted(every, rows)]
    return Touched(ranks, rows, touching, every[count > 1])


class DependentRowsError(ValueError):
    """Error for a singular A, raised on all ranks."""


@dataclass(frozen=True, eq=False)
class LocalFactor:
    """The matrix A_p after elimination of the inner rows that do not change.

    The remaining rows form the *border*. They are the inner rows that may change,
    followed by the shared rows. In formulas, a denotes the eliminated rows and b the
    border.
    """

    at: Touched
    #: number of inner rows that may change, which are the first rows of the border
    changing: int
    #: factor of A_p with 1 added to the diagonal of shared rows. Unchanging rows are
    #: first, then changing rows, then shared rows
    factor: BorderedFactor

    @property
    def border(self) -> Rows:
        """Positions (b,) of the border among the local rows."""
        return self.factor.border_rows

    @cached_property
    def complement(self) -> Dense:
        """Schur complement (b, b) of A_p on the border."""
        T = self.factor.complement
        # subtract the 1 added to the diagonal of shared rows
        T[np.arange(self.changing, len(T)), np.arange(self.changing, len(T))] -= 1
        return T

    def reduced(self, t: Dense) -> tuple[Dense, Dense]:
        """Return L_aa⁻¹t_a and t_b − L_ba L_aa⁻¹t_a for an additive vector t (k,)."""
        u = self.factor.reduced(t)
        first = u.size - len(self.complement)
        return u[:first], u[first:]

    def extended(self, u: Dense, x_b: Dense) -> Dense:
        """Return x (k,) with  L_aaᵀx_a + L_baᵀx_b = u  for given x_b (b,) and u."""
        return self.factor.extended(np.concatenate([u, x_b]))

    def completed(self) -> SummedFactor:
        """Factorise A, the sum over ranks; called by all ranks.

        Raises
        ------
        DependentRowsError
            If A is not positive definite.

        """
        ranks, c = self.at.ranks, self.changing
        fails, L_cc = 0.0, self.complement[:c, :c]
        try:
            L_cc = _cholesky(L_cc)
        except np.linalg.LinAlgError:
            fails = 1.0
        if ranks.extreme(fails, np.max):  # raise on all ranks if any rank failed
            raise DependentRowsError("the rows are linearly dependent")
        L_sc, S = self._onto_shared(self.complement, L_cc)
        try:
            return SummedFactor(self, 1.0, L_cc, L_sc, _cholesky(S))
        except np.linalg.LinAlgError:
            raise DependentRowsError("the rows are linearly dependent") from None

    def _onto_shared(self, T: Dense, L_cc: Dense) -> tuple[Dense, Dense]:
        """Eliminate the changing rows of T (b, b), and sum the results over ranks.

        Returns the block L_sc of this rank, and the sum S (s, s) of Schur complements
        on the shared rows.

        T : Schur complement on the border of this rank
        L_cc : (c, c) factor of the block of changing rows of T
        """
        c, s, place = self.changing, self.at.shared.size, self.at.place
        L_sc = blas.dtrsm(1.0, L_cc, T[:c, c:], lower=1).T if c else T[c:, :0]
        S = np.zeros((s, s))
        S[place[:, None], place] = T[c:, c:] - L_sc @ L_sc.T
        return L_sc, self.at.ranks.total(S.ravel()).reshape(s, s) if s else S


@dataclass(frozen=True, eq=False)
class SummedFactor:
    """Factor L of A, or of the matrix in `shifted`, distributed over ranks."""

    local: LocalFactor
    root: float  #: √(1 + shift), by which L_aa is multiplied
    L_cc: Dense  #: (c, c) block of the changing rows of this rank
    L_sc: Dense  #: (s_p, c) block of the shared rows of this rank
    L_ss: Dense  #: (s, s) block of all shared rows, replicated

    @property
    def least_pivot(self) -> float:
        """Smallest diagonal entry of L on all ranks; inf if A has no rows."""
        inner = self.root * self.local.factor.least_inner_pivot
        pivots = np.concatenate([[inner], np.diag(self.L_cc), np.diag(self.L_ss)])
        return self.local.at.ranks.extreme(float(pivots.min(initial=np.inf)), np.min)

    def shifted(self, shift: float, less: Dense) -> SummedFactor:
        """Factorise (1 + shift)A − Σ_p `less`_p, where L is the factor of A.

        less : (b, b) matrix of this rank on its border, such that Σ_p `less`_p ≤ A as
            quadratic forms. The factorised matrix is then at least shift·A. Since Schur
            complements are monotone, its Schur complements are at least `shift` times
            the Schur complements of A, whose factors are L_cc and L_ss.
        """
        local, c, scale = self.local, self.local.changing, 1 + shift
        T = scale * local.complement - less
        L_cc = factor_above(T[:c, :c], shift, self.L_cc)
        L_sc, S = local._onto_shared(T, L_cc)
        L_ss = factor_above(S, shift, self.L_ss)
        return SummedFactor(local, float(np.sqrt(scale)), L_cc, L_sc, L_ss)

    def forward(self, t: Dense) -> DistributedVector:
        """Return L⁻¹t in orthonormal representation for an additive vector t (k,).

        The result has k − s_p + s components, where s_p is the number of shared rows
        that this rank touches.
        """
        ranks = self.local.at.ranks
        with ranks.clocked("coarse"):
            u, r = self.local.reduced(np.asarray(t))
            z_c, r_s = self._changing(r)
            z_s = _solved(self.L_ss, self._gathered(r_s))
            z_s /= np.sqrt(ranks.size)
            return distributed(np.concatenate([u / self.root, z_c, z_s]), ranks)

    def backward(self, a: Dense) -> DistributedVector:
        """Return the consistent L⁻ᵀa (k,) for a in orthonormal representation."""
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
        """Return the consistent solution y (k,) of A y = t for an additive t (k,)."""
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
        """Eliminate the changing rows from a vector r (c + s_p,) on the border.

        Returns L_cc⁻¹r_c and r_s − L_sc L_cc⁻¹r_c.
        """
        c = len(self.L_cc)
        z_c = _solved(self.L_cc, r[:c])
        return z_c, r[c:] - self.L_sc @ z_c

    def _gathered(self, r: Dense) -> Dense:
        """Sum the entries (s_p,) in shared rows over all ranks; return the sum (s,)."""
        shared = np.zeros(len(self.L_ss))
        shared[self.local.at.place] = r
        return self.local.at.ranks.total(shared) if shared.size else shared


def local_factor(
    A: csc_array, at: Touched, changing: NDArray[np.bool_] | None = None
) -> LocalFactor:
    """Eliminate the inner rows of A_p (k, k) that do not change; called by all ranks.

    A : A_p, scaled such that the diagonal entries of the sum A are about one
    changing : (k,) mask of the rows that may change, in which shared rows are ignored;
        None if no row may change

    Raises
    ------
    DependentRowsError
        If the inner rows of any rank are linearly dependent.

    """
    changes = np.zeros(at.rows.size, bool) if changing is None else changing
    changing_rows = np.flatnonzero(changes & ~at.is_shared)
    border = np.concatenate([changing_rows, np.flatnonzero(at.is_shared)])
    # A_p may be singular on shared rows, since other ranks contribute to them
    raised = np.where(at.is_shared, 1.0, 0.0)
    factor, fails = None, 0.0
    try:
        factor = bordered_factor(csc_array(A) + diags_array(raised), border)
    except DependentRowsError:
        fails = 1.0
    if at.ranks.extreme(fails, np.max) or factor is None:
        raise DependentRowsError("the rows are linearly dependent")
    return LocalFactor(at, changing_rows.size, factor)


def bordered_factor(A: Matrix, border: Rows) -> BorderedFactor:
    """Factorise a symmetric, positive definite A (n, n), with the border last.

    The rows before the border are ordered such that the factor has few nonzeros.

    border : (b,) rows whose diagonal block may change later

    Raises
    ------
    DependentRowsError
        If A is not positive definite.

    """
    if A.shape[0] <= MAX_ARRAY_ROWS:
        entries = A if isinstance(A, np.ndarray) else A.toarray()
        try:
            return BorderedFactor.of_array(entries, border)
        except np.linalg.LinAlgError:
            raise DependentRowsError("the rows are linearly dependent") from None
    inner = np.setdiff1d(np.arange(A.shape[0]), border)
    A = csc_array(A)
    if inner.size:
        inner = inner[analyze(with_int32(A[inner][:, inner]), use_long=False).P()]
    order = np.concatenate([inner, border])
    ordered = with_int32(A[order][:, order])
    factor = analyze(ordered, ordering_method="natural", use_long=False)
    try:
        factor.cholesky_inplace(ordered)
        L = csc_array(factor.L())
    except CholmodNotPositiveDefiniteError:
        raise DependentRowsError("the rows are linearly dependent") from None
    L.sort_indices()
    corner = L[inner.size :, inner.size :].toarray()
    return BorderedFactor(order, L[:, : inner.size], corner)


def independent_rows(gram: Matrix) -> Rows:
    """Return a maximal set of linearly independent rows of a matrix G.

    The pivot of a row is the square of its distance from the span of the previous rows.
    A row is dependent if its pivot is at most `DEPENDENCE_TOLERANCE` times its squared
    length. The pivots after a dependent row consist of rounding errors. Therefore, only
    the first dependent row is removed before the pivots are computed again.

    gram : (r, r) matrix GGᵀ

    Returns
    -------
    (k,) indices of the rows, ascending

    """
    size = np.sqrt(gram.diagonal())
    kept = np.flatnonzero(size > 0)
    while kept.size:
        inverse = diags_array(1 / size[kept])
        unit = inverse @ csc_array(gram)[kept][:, kept] @ inverse
        shifted = with_int32(unit + diags_array(np.full(kept.size, PIVOT_SHIFT)))
        factor = analyze(shifted, mode="simplicial", use_long=False)
        factor.cholesky_inplace(shifted)
        dependent = np.flatnonzero(factor.D() <= DEPENDENCE_TOLERANCE)
        if not dependent.size:
            break
        kept = np.delete(kept, factor.P()[dependent[0]])
    return kept


def _cholesky(M: Dense) -> Dense:
    """Return L with LLᵀ = M; the upper triangle of the result is not meaningful."""
    if not len(M):
        return np.zeros((0, 0), order="F")
    L, failed = lapack.dpotrf(M, lower=1, clean=0)
    if failed:
        raise np.linalg.LinAlgError
    return np.asarray(L)


def _solved(L: Dense, x: Dense, *, transposed: bool = False) -> Dense:
    """Return L⁻¹x, or L⁻ᵀx if `transposed`."""
    if not x.size:
        return x
    return np.asarray(blas.dtrsv(L, x, lower=1, trans=int(transposed)))


def with_int32(M: Matrix) -> csc_matrix:
    """Return a copy of a sparse matrix with 32-bit indices, as CHOLMOD requires."""
    M = csc_matrix(M)
    M.indices, M.indptr = M.indices.astype(np.int32), M.indptr.astype(np.int32)
    return M
