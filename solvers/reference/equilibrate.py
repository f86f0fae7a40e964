"""Equilibration: scaling of variables and rows that is independent of units.

Rows and columns of [P Aᵀ Gᵀ; A 0 0; G 0 0] are divided by the square roots of their
largest entries until every largest entry is about one (Ruiz 2001, RAL-TR-2001-034).
One common factor remains free: the scale of x relative to y and z. This factor is
chosen such that the largest entry of P is about one, independently of the unit of the
objective. All factors are powers of two, so the scaling and its inverse cause no
rounding errors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, diags_array

from mortarbench.harness import QP, Box, Matrix, Solution, Vector
from mortarbench.harness.sets.blocks import Blocks

#: largest number of scaling rounds; fewer rounds suffice if units of entries differ by
#: factors between 1e-12 and 1e12
ROUNDS = 20
Exponents = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class ScaledQP:
    """Scaled QP with the factors D, E, H of x, y, z: x = D x̂, y = E ŷ, z = H ẑ."""

    qp: QP
    D: Vector  #: (n,)
    E: Vector  #: (m,)
    H: Vector  #: (p,)

    def recover(self, s: Solution) -> Solution:
        """Return the point of the original QP that corresponds to a scaled point."""
        return replace(
            s, x=s.x * self.D, y=s.y * self.E, z=s.z * self.H, z_box=s.z_box / self.D
        )


def equilibrate(qp: QP) -> ScaledQP:
    """Scale a QP with an explicit P.

    The scaled P, A and G are dense if P is dense, and sparse otherwise. Sets other than
    bounds must consist of blocks of variables; all variables of a block are scaled by
    the same factor.
    """
    store = _dense if isinstance(qp.P, np.ndarray) else _sparse
    P, A, G = (store(M) for M in (qp.P, qp.A, qp.G))
    blocks = [one for one in qp.sets[1:] if isinstance(one, Blocks)]
    d, e, h = (np.zeros(v.size, dtype=np.int64) for v in (qp.q, qp.b, qp.h))
    for _ in range(ROUNDS):
        P_, A_, G_ = _times(d, P, d), _times(e, A, d), _times(h, G, d)
        columns = np.maximum.reduce([_largest(M, 0) for M in (P_, A_, G_)])
        for one in blocks:  # one factor for all variables of a block
            columns[one.index] = columns[one.index].max(axis=1, keepdims=True)
        changes = [_root(v) for v in (columns, _largest(A_, 1), _largest(G_, 1))]
        if not any(c.any() for c in changes):
            break
        d, e, h = d + changes[0], e + changes[1], h + changes[2]
    common = _root(_largest(_times(d, P, d), 0).max(initial=0.0, keepdims=True))
    d, e, h = d + common, e - common, h - common
    D, E, H = (np.ldexp(1.0, k) for k in (d, e, h))
    scaled = QP(
        P=_times(d, P, d),
        q=D * qp.q,
        A=_times(e, A, d),
        b=E * qp.b,
        G=_times(h, G, d),
        h=H * qp.h,
        sets=(
            Box(qp.lb / D, qp.ub / D),
            *(one.substituted(diags_array(D), 0 * D) for one in qp.sets[1:]),
        ),
    )
    return ScaledQP(scaled, D, E, H)


def _dense(M: Matrix) -> Matrix:
    return M if isinstance(M, np.ndarray) else M.toarray()


def _sparse(M: Matrix) -> csc_array:
    """Return a CSC array without duplicate entries."""
    stored = csc_array(M)
    if not stored.has_canonical_format:
        stored = stored.copy()
        stored.sum_duplicates()
    return stored


def _times(left: Exponents, M: Matrix, right: Exponents) -> Matrix:
    """Return diag(2^left) M diag(2^right)."""
    rows, columns = np.ldexp(1.0, left), np.ldexp(1.0, right)
    if isinstance(M, np.ndarray):
        return rows[:, None] * M * columns
    data = rows[M.indices] * M.data * columns[_columns(M)]
    return csc_array((data, M.indices, M.indptr), shape=M.shape)


def _columns(M: csc_array) -> NDArray[np.int64]:
    """Return the column index of each stored entry."""
    return np.repeat(np.arange(M.shape[1]), np.diff(M.indptr))


def _largest(M: Matrix, axis: int) -> Vector:
    """Return the largest |entry| of each column (axis 0) or row (axis 1)."""
    if isinstance(M, np.ndarray):
        return np.asarray(abs(M).max(axis=axis, initial=0.0))
    largest = np.zeros(M.shape[1 - axis])
    np.maximum.at(largest, M.indices if axis else _columns(M), abs(M.data))
    return largest


def _root(largest: Vector) -> Exponents:
    """Return log₂(1/√largest) rounded to an integer, and 0 for zero, inf and NaN."""
    filled = np.where((largest > 0) & np.isfinite(largest), largest, 1.0)
    return np.rint(-0.5 * np.log2(filled)).astype(np.int64)
