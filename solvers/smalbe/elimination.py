"""Free variables, eliminated: a transform of a QP with its way back.

Where no bound holds x_E, stationarity in E and the equality rows that involve E,

    [P_EE G_Eᵀ] [x_E]   [−q_E − P_EI x_I]
    [G_E   0  ] [ y ] = [ e   − G_I x_I ]

give x_E and y as affine functions of the bounded x_I. What is left is a QP in x_I with
the bounds and those equality rows that E does not meet. On the duals of contact
problems E are the supports: P_EE = F_EE is the same in every load step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.sparse import csr_array

from harness import QP, Matrix, Solution, Vector, no_rows
from solvers.smalbe.rows import orthonormal_rows

#: singular values of orthonormal rows, cut to E, are zero below and good above these;
#: rows that hardly meet E would make the reduced matrix as large as they are small
ZERO, GOOD = 1e-12, 1e-2

Array = NDArray[np.float64]


class FreeBlock(NamedTuple):
    """P_EE with its Cholesky factor."""

    matrix: Array  #: (k, k)
    factor: Any


class Eliminated(NamedTuple):
    """A QP in the bounded variables, and its way back."""

    qp: QP  #: P is an operator; one product costs what one with the whole P does
    recover: Callable[[Solution], Solution]
    block: FreeBlock  #: to use again where P_EE is the same
    columns: int  #: of P_EE that were factorised, 0 where the factor was known


@dataclass(frozen=True, eq=False)
class _Saddle:
    """Solves for x_E and y."""

    factor: Any
    G_E: Array  #: (r, k) of full rank
    PG: Array  #: P_EE⁻¹G_Eᵀ (k, r)
    schur: Any  #: Cholesky factor of G_E P_EE⁻¹ G_Eᵀ

    def __call__(self, top: Vector, bottom: Vector) -> tuple[Vector, Vector]:
        w = cho_solve(self.factor, top, check_finite=False)
        if not len(bottom):
            return w, bottom
        y = cho_solve(self.schur, self.G_E @ w - bottom, check_finite=False)
        return w - self.PG @ y, y


@dataclass(frozen=True, eq=False)
class _Reduced:
    """The matrix of the reduced problem, as an operator."""

    solve: _Saddle
    P_EI: Array
    P_II: Array
    G_I: Array

    @property
    def shape(self) -> tuple[int, int]:
        return self.P_II.shape[0], self.P_II.shape[0]

    def __matmul__(self, v: Vector) -> Vector:
        x_E, y = self.solve(-(self.P_EI @ v), -(self.G_I @ v))
        return np.asarray(self.P_II @ v + self.P_EI.T @ x_E + self.G_I.T @ y)


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
    left, size, _ = np.linalg.svd(rows.C[:, free])
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
        P=_Reduced(solve, P_EI, _block(qp.P, ~free, ~free), G_I),
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
    return Eliminated(reduced, recover, block, columns)


def _factorised(P_EE: Array, known: FreeBlock | None) -> FreeBlock | None:
    if known is not None and np.array_equal(known.matrix, P_EE):
        return known
    try:
        return FreeBlock(P_EE, cho_factor(P_EE))
    except LinAlgError:  # singular: stationarity does not determine x_E
        return None


def _saddle(block: FreeBlock, G_E: Array) -> _Saddle:
    PG = cho_solve(block.factor, G_E.T)
    return _Saddle(block.factor, G_E, PG, cho_factor(G_E @ PG) if len(G_E) else None)


def _block(P: Matrix, rows: NDArray[np.bool_], columns: NDArray[np.bool_]) -> Array:
    if isinstance(P, np.ndarray):
        return P[np.ix_(rows, columns)].astype(float)
    return np.asarray(csr_array(P)[rows][:, columns].toarray(), dtype=float)
