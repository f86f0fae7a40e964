"""Equivalent formulations of a QP, each with its way back.

What is physically the same must get the same answer: a change of units, another order
of unknowns and rows, a row times a positive number or written twice, unknowns counted
from elsewhere, a mirror (metamorphic relations: T. Y. Chen et al., ACM Computing
Surveys 51 (2018) 4). All are one of two substitutions:

* of unknowns,  x = T x' + a  with one entry in each row and column of T, and the
  objective times t:

      P' = t TᵀPT,  q' = t Tᵀ(Pa + q),  A' = AT,  b' = b − Aa,  G' = GT,  h' = h − Ga;
      y = y'/t,  z = z'/t,  z_box = T⁻ᵀz_box'/t,  objective = objective'/t + aᵀ(½Pa + q)

* of rows,  A' = MA, b' = Mb  or  G' = NG, h' = Nh,  with one entry in each row of M
  and N, positive in N, and at least one in each column:

      y = Mᵀy',  z = Nᵀz'

With powers of two for factors all but a shift lose no bit. A structure is carried: with
P = BK⁺Bᵀ, it is P' = B'K'⁺B'ᵀ for B' = TᵀB and K' = K/t. What changes unknowns needs P
as a matrix, and raises ValueError for an operator.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array, eye_array

from mortarbench.harness.qp import QP, Matrix, Structure, Vector
from mortarbench.harness.solution import Solution

Order = NDArray[Any]  #: of indices, or a mask


class Equivalent(NamedTuple):
    """A QP with the same solutions as an old one, and the way back."""

    qp: QP
    recover: Callable[[Solution], Solution]  #: point of the new QP → of the old one
    scale: float = 1.0  #: old objective = scale·new objective + constant,
    constant: float = 0.0  #: at every point

    def followed_by(self, change: Callable[[QP], Equivalent]) -> Equivalent:
        """Change the new QP once more."""
        new = change(self.qp)
        return Equivalent(
            new.qp,
            lambda s: self.recover(new.recover(s)),
            self.scale * new.scale,
            self.scale * new.constant + self.constant,
        )


def change_units(qp: QP, *, unknown: float, objective: float) -> Equivalent:
    """Measure x in another unit, and the objective.

    ::

        x = s x',  objective' = t·objective
        P' = ts²P,  q' = ts q,  A' = A,  b' = b/s,  G' = G,  h' = h/s,  lb' = lb/s
        y = y'/(ts),  z = z'/(ts),  z_box = z_box'/(ts)

    The rows keep their entries, which of contact rows are numbers, and their right-hand
    sides the unit of x; with displacements the multipliers are forces.

    unknown : s, how many of the old unit of x are one of the new
    objective : t, how many of the new unit of the objective are one of the old
    """
    s = unknown
    T = diags_array(np.full(qp.q.size, s))
    A, G = (diags_array(np.full(v.size, 1 / s)) for v in (qp.b, qp.h))
    return _unknowns(qp, T, objective=objective).followed_by(
        lambda new: _rows(new, A, G)
    )


def permute_unknowns(qp: QP, order: Order) -> Equivalent:
    """Put unknowns in another order: x' = x[order], and z_box with them."""
    return _unknowns(qp, csr_array(eye_array(qp.q.size, format="csr")[order].T))


def permute_rows(qp: QP, equalities: Order, inequalities: Order) -> Equivalent:
    """Put rows in another order: y' = y[equalities], z' = z[inequalities]."""
    return _rows(qp, *_chosen(qp, equalities, inequalities))


def scale_rows(qp: QP, equalities: Vector, inequalities: Vector) -> Equivalent:
    """Multiply each row by a positive factor, by which its multiplier is divided."""
    return _rows(qp, diags_array(equalities), diags_array(inequalities))


def duplicate_rows(qp: QP, equalities: Order, inequalities: Order) -> Equivalent:
    """Write the chosen rows a second time, below the others.

    The multiplier of a row is the sum of those of its copies, which are not unique.
    """
    every = [np.arange(v.size) for v in (qp.b, qp.h)]
    twice = [
        np.append(rows, rows[chosen])
        for rows, chosen in zip(every, (equalities, inequalities), strict=True)
    ]
    return _rows(qp, *_chosen(qp, *twice))


def shift_unknowns(qp: QP, origin: Vector) -> Equivalent:
    """Count unknowns from `origin` (n,): x = x' + a; the multipliers stay."""
    return _unknowns(qp, eye_array(qp.q.size, format="csr"), origin)


def mirror(qp: QP, flipped: Order) -> Equivalent:
    """Turn chosen unknowns round: xᵢ = −xᵢ', lbᵢ' = −ubᵢ, ubᵢ' = −lbᵢ.

    z_boxᵢ = −z_boxᵢ', while y and z stay.
    """
    sign = np.ones(qp.q.size)
    sign[flipped] = -1
    return _unknowns(qp, diags_array(sign))


def _unknowns(
    qp: QP, T: Matrix, origin: Vector | None = None, objective: float = 1.0
) -> Equivalent:
    """Substitute x = T x' + a, and multiply the objective by t."""
    if not qp.is_explicit:
        raise ValueError(f"QP.P is a {type(qp.P).__name__}, expected a matrix")
    T, t = csr_array(T), objective
    U = T.copy()  # T⁻ᵀ: one entry in each row and column
    U.data = 1 / T.data
    a = np.zeros(qp.q.size) if origin is None else origin
    Pa = qp.P @ a
    new = replace(
        qp, P=_sorted(T.T @ qp.P @ T * t), q=T.T @ (Pa + qp.q) * t,
        A=_sorted(qp.A @ T), b=qp.b - qp.A @ a,
        G=_sorted(qp.G @ T), h=qp.h - qp.G @ a,
        sets=tuple(one.substituted(T, a) for one in qp.sets),
        structure=_structure(qp.structure, T, t),
    )  # fmt: skip

    def recover(s: Solution) -> Solution:
        z_box = U @ s.z_box / t
        return replace(s, x=T @ s.x + a, y=s.y / t, z=s.z / t, z_box=z_box)

    return Equivalent(new, recover, 1 / t, float(a @ (0.5 * Pa + qp.q)))


def _structure(old: Structure | None, T: Matrix, t: float) -> Structure | None:
    if old is None:
        return None
    return Structure(K=old.K * (1 / t), B=_sorted(T.T @ old.B), fixed=old.fixed)


def _rows(qp: QP, M: Matrix, N: Matrix) -> Equivalent:
    """Multiply the equality rows by M and the inequality rows by N."""
    M, N = csr_array(M), csr_array(N)
    new = replace(
        qp, A=_sorted(M @ qp.A), b=M @ qp.b, G=_sorted(N @ qp.G), h=N @ qp.h
    )  # fmt: skip
    return Equivalent(new, lambda s: replace(s, y=M.T @ s.y, z=N.T @ s.z))


def _chosen(qp: QP, equalities: Order, inequalities: Order) -> tuple[Matrix, Matrix]:
    """Make the matrices that take these rows, in this order."""
    M, N = (eye_array(v.size, format="csr") for v in (qp.b, qp.h))
    return M[equalities], N[inequalities]


def _sorted(M: Matrix) -> Matrix:
    """Order the entries of sparse rows, which products leave as they come."""
    if hasattr(M, "sort_indices"):
        M.sort_indices()
    return M
