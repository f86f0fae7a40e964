"""Elimination of the free variables from a QP, and recovery of their values.

A variable is free if it has no bounds and belongs to no disc. Let E be the free
variables and I the other variables. The equality rows are orthonormalised and combined
such that as few of them as possible involve E. The stationarity conditions of E and the
rows that involve E,

    [P_EE G_Eᵀ] [x_E]   [−q_E − P_EI x_I]
    [G_E   0  ] [ y ] = [ e   − G_I x_I ]

determine x_E and the multipliers y of these rows as affine functions of x_I. The
reduced problem is a QP in x_I with the bounds and discs, the equality rows that do not
involve E, and the Schur complement

    P_II − P_IE P_EE⁻¹ P_EI + Tᵀ(G_E P_EE⁻¹ G_Eᵀ)⁻¹T,   T = G_E P_EE⁻¹ P_EI − G_I.

For k variables in E and b other variables, the factorisation of P_EE costs O(k³)
operations, and the assembly of the Schur complement O(k²b + kb²). In duals of contact
problems, E contains the support forces, and P_EE = F_EE is the same in every load step
if the bodies are linearly elastic.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError
from scipy.linalg.lapack import dpotrf, dpotrs, dtrtrs
from scipy.sparse import csr_array

from mortarbench.harness import QP, Box, Discs, Matrix, Solution, Vector, no_rows
from mortarbench.solvers.smalbe.rows import orthonormal_rows

#: Thresholds for the singular values of the orthonormal rows restricted to E. Values of
#: at most RANK_ZERO count as zero, and values of at least RANK_GOOD are accepted. If a
#: value is between these thresholds, nothing is eliminated, because the reciprocal of
#: this value would cause rounding errors above the tolerance in the reduced matrix.
RANK_ZERO, RANK_GOOD = 1e-12, 1e-2

Array = NDArray[np.float64]


class FreeBlock(NamedTuple):
    """The block P_EE with its Cholesky factor."""

    matrix: Array  #: (k, k)
    #: upper triangular R (k, k) with P_EE = RᵀR; the lower triangle is arbitrary
    factor: Array


class Eliminated(NamedTuple):
    """A QP without the free variables, with the recovery of their values."""

    qp: QP  #: reduced QP, with a dense P
    recover: Callable[[Solution], Solution]
    G: Array  #: (m, n) equality rows of the original QP
    block: FreeBlock  #: block with the factor, for later QPs with the same P_EE
    columns: int  #: number of factorised columns of P_EE; 0 if a stored factor was used


@dataclass(frozen=True, eq=False)
class _Saddle:
    """Solution operator of the saddle-point system for x_E and y."""

    factor: Array  #: (k, k) Cholesky factor of P_EE, in the upper triangle
    G_E: Array  #: (r, k) rows of full rank
    PG: Array  #: P_EE⁻¹G_Eᵀ (k, r)
    schur: Array  #: (r, r) Cholesky factor of G_E P_EE⁻¹ G_Eᵀ, in the upper triangle

    def __call__(self, top: Vector, bottom: Vector) -> tuple[Vector, Vector]:
        w = dpotrs(self.factor, top)[0]
        if not len(bottom):
            return w, bottom
        y = dpotrs(self.schur, self.G_E @ w - bottom)[0]
        return w - self.PG @ y, y

    def complement(self, P_EI: Array, P_II: Array, G_I: Array) -> Array:
        """Return the Schur complement (n − k, n − k) of the saddle-point matrix."""
        W = dtrtrs(self.factor, P_EI, trans=1)[0]
        S: Array = P_II - W.T @ W
        if len(G_I):
            Z = dtrtrs(self.schur, self.PG.T @ P_EI - G_I, trans=1)[0]
            S += Z.T @ Z
        return S


def eliminate_free(qp: QP, previous: FreeBlock | None = None) -> Eliminated | None:
    """Eliminate the free variables; return None if this is not possible.

    Elimination requires an explicit P with positive definite P_EE, both free and other
    variables, and consistent equality rows. After orthonormalisation, each
    singular value of these rows restricted to E must be either zero up to rounding or
    far above rounding. A QP with inequality rows is not reduced.

    previous : block of an earlier problem, used if P_EE has not changed
    """
    free = np.ones(qp.q.size, dtype=bool)
    for one in qp.sets:
        free[one.block] = False
    if free.all() or not free.any() or not qp.is_explicit or qp.h.size:
        return None
    rows = orthonormal_rows(qp.A, qp.b)
    block = _factorised(_block(qp.P, free, free), previous)
    if block is None or not rows.consistent:
        return None
    C_E = rows.C[:, free]
    left, size, _ = np.linalg.svd(C_E, full_matrices=C_E.shape[0] > C_E.shape[1])
    if ((size > RANK_ZERO) & (size < RANK_GOOD)).any():
        return None
    rank = int((size >= RANK_GOOD).sum())
    meets, others = left[:, :rank], left[:, rank:]
    G, N, Cx = meets.T @ rows.C, others.T @ rows.C, rows.C @ rows.x_tilde
    try:
        solve = _saddle(block, G[:, free])
    except LinAlgError:  # G_E P_EE⁻¹ G_Eᵀ is singular to rounding
        return None
    G_I, P_EI = G[:, ~free], _block(qp.P, free, ~free)
    number = np.cumsum(~free) - 1  # indices in x_I
    x_0, y_0 = solve(-qp.q[free], meets.T @ Cx)
    reduced = QP(
        P=solve.complement(P_EI, _block(qp.P, ~free, ~free), G_I),
        q=qp.q[~free] + P_EI.T @ x_0 + G_I.T @ y_0,
        A=N[:, ~free],
        b=others.T @ Cx,
        G=no_rows(int((~free).sum())),
        h=np.zeros(0),
        sets=(
            Box(qp.lb[~free], qp.ub[~free]),
            *(
                replace(one, index=number[one.index])
                for one in qp.sets
                if isinstance(one, Discs)
            ),
        ),
    )

    def recover(s: Solution) -> Solution:
        top = -qp.q[free] - P_EI @ s.x
        x_E, y_R = solve(top, meets.T @ Cx - G_I @ s.x)
        x, z_box = np.zeros(free.size), np.zeros(free.size)
        x[free], x[~free], z_box[~free] = x_E, s.x, s.z_box
        y = rows.multipliers(meets @ y_R + others @ s.y)
        return replace(s, x=x, y=y, z_box=z_box)

    columns = 0 if previous is block else int(free.sum())
    return Eliminated(reduced, recover, rows.G, block, columns)


def _factorised(P_EE: Array, previous: FreeBlock | None) -> FreeBlock | None:
    if previous is not None and np.array_equal(previous.matrix, P_EE):
        return previous
    try:
        return FreeBlock(P_EE, _cholesky(P_EE))
    except LinAlgError:  # singular: stationarity does not determine x_E
        return None


def _cholesky(M: Array) -> Array:
    """Return R with M = RᵀR in the upper triangle of an array."""
    factor, info = dpotrf(M.T, clean=False)
    if info:
        raise LinAlgError("not positive definite")
    return np.asarray(factor)


def _saddle(block: FreeBlock, G_E: Array) -> _Saddle:
    if not len(G_E):
        return _Saddle(block.factor, G_E, G_E.T, np.zeros((0, 0)))
    PG = dpotrs(block.factor, G_E.T)[0]
    return _Saddle(block.factor, G_E, PG, _cholesky(G_E @ PG))


def _block(P: Matrix, rows: NDArray[np.bool_], columns: NDArray[np.bool_]) -> Array:
    """Return the block P[rows, columns] of a symmetric P, as a view if possible."""
    if not isinstance(P, np.ndarray):
        return np.asarray(csr_array(P)[rows][:, columns].toarray(), dtype=float)
    at, of = _as_slice(columns), _as_slice(rows)
    if isinstance(at, slice) and isinstance(of, slice):
        # in column-major order, for LAPACK
        return P[at, of].astype(float, copy=False).T
    return P[np.ix_(columns, rows)].astype(float, copy=False).T


def _as_slice(chosen: NDArray[np.bool_]) -> slice | NDArray[np.bool_]:
    """Convert a mask to a slice if its true components are consecutive."""
    at = np.flatnonzero(chosen)
    whole = at.size and at[-1] - at[0] == at.size - 1
    return slice(int(at[0]), int(at[-1]) + 1) if whole else chosen
