"""Sparse Cholesky factors with a border, and independent rows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csc_matrix, diags_array
from sksparse.cholmod import CholmodNotPositiveDefiniteError, analyze

from mortarbench.harness.distributed.sparse import BorderedFactor
from mortarbench.harness.qp import Matrix

Rows = NDArray[np.int64]
#: Largest pivot that counts as zero; rows are scaled to length one.
DEPENDENCE_TOLERANCE = 1e-13
#: Number added to a unit diagonal, since the factorisation would fail at a zero pivot.
PIVOT_SHIFT = 1e-15
#: Largest number of rows of a matrix that is factorised as a dense array. Dense
#: factors of more rows take more memory and time per solve than sparse ones.
MAX_ARRAY_ROWS = 256


class DependentRowsError(ValueError):
    """Error for a singular matrix."""


def bordered_factor(A: Matrix, border: Rows) -> BorderedFactor:
    """Factorise a symmetric, positive definite A (n, n), with the border last.

    The rows before the border are ordered such that the factor has few nonzeros.

    border : (b,) rows whose diagonal block may change later

    Raises
    ------
    DependentRowsError
        If A is not positive definite.

    """
    n = A.shape[0]
    if n <= MAX_ARRAY_ROWS:  # all rows form the border
        try:
            L = np.linalg.cholesky(A.toarray())
        except np.linalg.LinAlgError:
            raise DependentRowsError("the rows are linearly dependent") from None
        return BorderedFactor(np.arange(n), csc_array((n, 0)), L)
    inner = np.setdiff1d(np.arange(n), border)
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


def with_int32(M: Matrix) -> csc_matrix:
    """Return a copy of a sparse matrix with 32-bit indices, as CHOLMOD requires."""
    M = csc_matrix(M)
    M.indices, M.indptr = M.indices.astype(np.int32), M.indptr.astype(np.int32)
    return M
