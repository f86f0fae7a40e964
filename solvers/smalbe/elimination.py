"""Free variables, eliminated: a transform of a QP with its way back.

Where no bound holds x_E, stationarity in E and the equality rows that involve E,

    [P_EE G_Eᵀ] [x_E]   [−q_E − P_EI x_I]
    [G_E   0  ] [ y ] = [ e   − G_I x_I ]

give x_E and y as affine functions of the bounded x_I. What is left is a QP in x_I with
the bounds, those equality rows that E does not meet, and the Schur complement

    P_II − P_IE P_EE⁻¹ P_EI + Tᵀ(G_E P_EE⁻¹ G_Eᵀ)⁻¹T,   T = G_E P_EE⁻¹ P_EI − G_I,

which costs about as much to form as P_EE to factorise. On the duals of contact problems
E are the supports: P_EE = F_EE is the same in every load step.
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

from mortarbench.harness import QP, Matrix, Solution, Vector, no_rows
from mortarbench.solvers.smalbe.rows import orthonormal_rows

#: singular values of orthonormal rows, cut to E, are zero below and good above these;
#: rows that hardly meet E would make the reduced matrix as large as they are small
ZERO, GOOD = 1e-12, 1e-2

Array = NDArray[np.float64]


class FreeBlock(NamedTuple):
    """P_EE with its Cholesky factor."""

    matrix: Array  #: (k, k)
    factor: Array  #: R of P_EE = RᵀR, in the upper triangle


class Eliminated(NamedTuple):
    """A QP in the bounded variables, and its way back."""

    qp: QP  #: P is dense
    recover: Callable[[Solution], Solution]
    G: Array  #: (m, n) the equality rows as given
    block: FreeBlock  #: to use again where P_EE is the same
    columns: int  #: of P_EE that were factorised, 0 where the factor was known


@dataclass(frozen=True, eq=False)
class _Saddle:
    """Solves for x_E and y."""

    factor: Array  #: (k, k) of P_EE, in the upper triangle
    G_E: Array  #: (r, k) of full rank
    PG: Array  #: P_EE⁻¹G_Eᵀ (k, r)
    schur: Array  #: (r, r) Cholesky factor of G_E P_EE⁻¹ G_Eᵀ, likewise

    def __call__(self, top: Vector, bottom: Vector) -> tuple[Vector, Vector]:
        w = dpotrs(self.factor, top)[0]
        if not len(bottom):
            return w, bottom
        y = dpotrs(self.schur, self.G_E @ w - bottom)[0]
        return w - self.PG @ y, y

    def complement(self, P_EI: Array, P_II: Array, G_I: Array) -> Array:
        """Return the Schur complement (n − k, n − k) of the saddle point matrix."""
        W = dtrtrs(self.factor, P_EI, trans=1)[0]
        S: Array = P_II - W.T @ W
        if len(G_I):
            Z = dtrtrs(self.schur, self.PG.T @ P_EI - G_I, trans=1)[0]
            S += Z.T @ Z
        return S


def eliminate_free(qp: QP, known: FreeBlock | None = None) -> Eliminated | None:
    """Eliminate the variables without bounds; None where that cannot be done.

    It needs an explicit P with a positive definite P_EE, consistent equality rows that
    meet E clearly or not at all, no inequality rows, and variables of both kinds.

    known : from an earlier problem; used if its P_EE is this one's
    """
    free = np.isinf(qp.lb) & np.isinf(qp.ub)
    if free.all() or not free.any() or not qp.is_explicit or qp.h.size:
        return None
    rows = orthonormal_rows(qp.A, qp.b)
    block = _factorised(_block(qp.P, free, free), known)
    if block is None or not rows.consistent:
        return None
    C_E = rows.C[:, free]
    left, size, _ = np.linalg.svd(C_E, full_matrices=C_E.shape[0] > C_E.shape[1])
    if ((size > ZERO) & (size < GOOD)).any():
        return None
    rank = int((size >= GOOD).sum())
    meets, others = left[:, :rank], left[:, rank:]
    G, N, Cx = meets.T @ rows.C, others.T @ rows.C, rows.C @ rows.x_tilde
    try:
        solve = _saddle(block, G[:, free])
    except LinAlgError:  # rows that P_EE⁻¹ makes nearly parallel
        return None
    G_I, P_EI = G[:, ~free], _block(qp.P, free, ~free)
    x_0, y_0 = solve(-qp.q[free], meets.T @ Cx)
    reduced = QP(
        P=solve.complement(P_EI, _block(qp.P, ~free, ~free), G_I),
        q=qp.q[~free] + P_EI.T @ x_0 + G_I.T @ y_0,
        A=N[:, ~free], b=others.T @ Cx, G=no_rows(int((~free).sum())), h=np.zeros(0),
        lb=qp.lb[~free], ub=qp.ub[~free],
    )  # fmt: skip

    def recover(s: Solution) -> Solution:
        top = -qp.q[free] - P_EI @ s.x
        x_E, y_R = solve(top, meets.T @ Cx - G_I @ s.x)
        x, z_box = np.zeros(free.size), np.zeros(free.size)
        x[free], x[~free], z_box[~free] = x_E, s.x, s.z_box
        y = rows.multipliers(meets @ y_R + others @ s.y)
        return replace(s, x=x, y=y, z_box=z_box)

    columns = 0 if known is block else int(free.sum())
    return Eliminated(reduced, recover, rows.G, block, columns)


def _factorised(P_EE: Array, known: FreeBlock | None) -> FreeBlock | None:
    if known is not None and np.array_equal(known.matrix, P_EE):
        return known
    try:
        return FreeBlock(P_EE, _cholesky(P_EE))
    except LinAlgError:  # singular: stationarity does not determine x_E
        return None


def _cholesky(M: Array) -> Array:
    """Return R of M = RᵀR (k, k) in the upper triangle; below is what was there."""
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
    """Return that block of a symmetric P, which looks at P where that is dense."""
    if not isinstance(P, np.ndarray):
        return np.asarray(csr_array(P)[rows][:, columns].toarray(), dtype=float)
    at, of = _as_slice(columns), _as_slice(rows)
    if isinstance(at, slice) and isinstance(of, slice):
        return P[at, of].astype(float, copy=False).T  # as LAPACK stores it
    return P[np.ix_(columns, rows)].astype(float, copy=False).T


def _as_slice(chosen: NDArray[np.bool_]) -> slice | NDArray[np.bool_]:
    """Give components without a gap as a slice."""
    at = np.flatnonzero(chosen)
    whole = at.size and at[-1] - at[0] == at.size - 1
    return slice(int(at[0]), int(at[-1]) + 1) if whole else chosen
