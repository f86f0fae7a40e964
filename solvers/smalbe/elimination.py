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
problems, E contains the support forces.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError
from scipy.linalg.lapack import dpotrf, dpotrs, dtrtrs

from mortarbench.harness import QP, Box, Discs, Solution, Vector, no_rows
from mortarbench.solvers.smalbe.rows import orthonormal_rows

#: Thresholds for the singular values of the orthonormal rows restricted to E. Values of
#: at most RANK_ZERO count as zero, and values of at least RANK_GOOD are accepted. If a
#: value is between these thresholds, nothing is eliminated, because the reciprocal of
#: this value would cause rounding errors above the tolerance in the reduced matrix.
RANK_ZERO, RANK_GOOD = 1e-12, 1e-2
#: smaller entries of D are replaced by this factor times the largest one
SMALLEST_DIAGONAL = 1e-10

Array = NDArray[np.float64]


class Eliminated(NamedTuple):
    """A QP without the free variables, with the recovery of their values."""

    qp: QP  #: reduced QP, with a dense P
    recover: Callable[[Solution], Solution]
    columns: int  #: number of factorised columns of P_EE


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


def eliminate_free(qp: QP) -> Eliminated | None:
    """Eliminate the free variables; return None if this is not possible.

    Elimination requires a dense P with positive definite P_EE, both free and other
    variables, and consistent equality rows. After orthonormalisation, each
    singular value of these rows restricted to E must be either zero up to rounding or
    far above rounding.
    """
    free = np.ones(qp.q.size, dtype=bool)
    for one in qp.sets:
        free[one.block] = False
    if free.all() or not free.any() or not isinstance(qp.P, np.ndarray):
        return None
    rows = orthonormal_rows(qp.A, qp.b)
    if not rows.consistent:
        return None
    C_E = rows.C[:, free]
    left, size, _ = np.linalg.svd(C_E, full_matrices=C_E.shape[0] > C_E.shape[1])
    if ((size > RANK_ZERO) & (size < RANK_GOOD)).any():
        return None
    rank = int((size >= RANK_GOOD).sum())
    meets, others = left[:, :rank], left[:, rank:]
    G, N, Cx = meets.T @ rows.C, others.T @ rows.C, rows.C @ rows.x_tilde
    try:
        solve = _saddle(_cholesky(_block(qp.P, free, free)), G[:, free])
    except LinAlgError:  # P_EE or G_E P_EE⁻¹ G_Eᵀ is singular to rounding
        return None
    G_I, P_EI = G[:, ~free], _block(qp.P, free, ~free)
    number = np.cumsum(~free) - 1  # indices in x_I
    x_0, y_0 = solve(-qp.q[free], meets.T @ Cx)
    reduced, root = _scaled(
        QP(
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
    )

    def recover(s: Solution) -> Solution:
        x_I = s.x / root
        x_E, y_R = solve(-qp.q[free] - P_EI @ x_I, meets.T @ Cx - G_I @ x_I)
        x, z_box = np.zeros(free.size), np.zeros(free.size)
        x[free], x[~free], z_box[~free] = x_E, x_I, s.z_box * root
        y = rows.multipliers(meets @ y_R + others @ s.y)
        return replace(s, x=x, y=y, z_box=z_box)

    return Eliminated(reduced, recover, int(free.sum()))


def _scaled(qp: QP) -> tuple[QP, Vector]:
    """Return a QP over discs in y = D¹ᐟ²x, and D¹ᐟ² (n,), with D = diag(P).

    If the rows of P have at most k nonzero entries, the condition number of
    D⁻¹ᐟ²PD⁻¹ᐟ² is at most k times the smallest that a diagonal scaling can reach (van
    der Sluis, Numer. Math. 14, 1969, 14-23). On a disc, D is the mean over its
    variables, so that a disc of x becomes a disc of y. Powers of two cause no rounding
    errors.
    """
    P = np.asarray(qp.P)
    D, discs = P.diagonal().copy(), [d for d in qp.sets if isinstance(d, Discs)]
    for one in discs:
        D[one.index] = D[one.index].mean(axis=1, keepdims=True)
    # along redundant rows, D is zero or a rounding error
    D = np.maximum(D, SMALLEST_DIAGONAL * D.max(initial=0.0) or 1.0)
    root = np.exp2(np.round(np.log2(D) / 2))
    scaled = replace(
        qp,
        P=P / root[:, None] / root,
        q=qp.q / root,
        A=qp.A / root,
        sets=(
            Box(qp.lb * root, qp.ub * root),
            *(replace(d, radius=d.radius * root[d.index[:, 0]]) for d in discs),
        ),
    )
    return scaled, root


def _cholesky(M: Array) -> Array:
    """Return R with M = RᵀR in the upper triangle of an array."""
    factor, info = dpotrf(M.T, clean=False)
    if info:
        raise LinAlgError("not positive definite")
    return np.asarray(factor)


def _saddle(factor: Array, G_E: Array) -> _Saddle:
    if not len(G_E):
        return _Saddle(factor, G_E, G_E.T, np.zeros((0, 0)))
    PG = dpotrs(factor, G_E.T)[0]
    return _Saddle(factor, G_E, PG, _cholesky(G_E @ PG))


def _block(P: Array, rows: NDArray[np.bool_], columns: NDArray[np.bool_]) -> Array:
    """Return the block P[rows, columns] of a symmetric P, in column-major order."""
    return np.asarray(P[np.ix_(columns, rows)], dtype=float).T
