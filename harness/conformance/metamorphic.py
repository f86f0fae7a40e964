"""Equivalent formulations of a QP, and maps of their solutions to the original QP.

Equivalent problems must have equal answers. A change may concern the units, the order
of unknowns or rows, the origin or the sign of unknowns, or the scaling or duplication
of rows. Such relations are called metamorphic (T. Y. Chen et al., ACM Computing Surveys
51 (2018) 4). Each change is a substitution of one of two types:

* of unknowns,  x = T x' + a,  where T has one nonzero in each row and column; the
  objective is multiplied by t:

      P' = t TᵀPT,  q' = t Tᵀ(Pa + q),  A' = AT,  b' = b − Aa,  G' = GT,  h' = h − Ga;
      y = y'/t,  z = z'/t,  z_box = T⁻ᵀz_box'/t,  objective = objective'/t + aᵀ(½Pa + q)

* of rows,  A' = MA, b' = Mb  or  G' = NG, h' = Nh.  M and N have one nonzero in each
  row and at least one in each column; the nonzeros of N are positive:

      y = Mᵀy',  z = Nᵀz'

If all factors are powers of two, the data of every changed QP except a shifted one are
exact in floating-point arithmetic. The structure of the QP is also transformed: P =
BK⁺Bᵀ becomes P' = B'K'⁺B'ᵀ with B' = TᵀB and K' = K/t. Substitutions of unknowns
require P as a matrix and raise ValueError if P is an operator.
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

Order = NDArray[Any]  #: array of indices or mask that selects unknowns or rows


class Equivalent(NamedTuple):
    """A transformed QP, and the map of its points to points of the original QP."""

    qp: QP
    #: maps a point of the transformed QP to a point of the original QP
    recover: Callable[[Solution], Solution]
    #: factor s in: original objective = s·(transformed objective) + constant
    scale: float = 1.0
    constant: float = 0.0

    def followed_by(self, change: Callable[[QP], Equivalent]) -> Equivalent:
        """Return the composition with a further change of the transformed QP."""
        new = change(self.qp)
        return Equivalent(
            new.qp,
            lambda s: self.recover(new.recover(s)),
            self.scale * new.scale,
            self.scale * new.constant + self.constant,
        )


def change_units(qp: QP, *, unknown: float, objective: float) -> Equivalent:
    """Change the units of x and of the objective.

    ::

        x = s x',  objective' = t·objective
        P' = ts²P,  q' = ts q,  A' = A,  b' = b/s,  G' = G,  h' = h/s,  lb' = lb/s
        y = y'/(ts),  z = z'/(ts),  z_box = z_box'/(ts)

    Since the entries of contact rows are dimensionless, A and G do not change, and
    right-hand sides have the unit of x. If x is a displacement, multipliers are forces.

    unknown : s, the new unit of x in multiples of the old unit
    objective : t, the old unit of the objective in multiples of the new unit
    """
    s = unknown
    T = diags_array(np.full(qp.q.size, s))
    A, G = (diags_array(np.full(v.size, 1 / s)) for v in (qp.b, qp.h))
    return _unknowns(qp, T, objective=objective).followed_by(
        lambda new: _rows(new, A, G)
    )


def permute_unknowns(qp: QP, order: Order) -> Equivalent:
    """Permute the unknowns: x' = x[order], z_box' = z_box[order]."""
    return _unknowns(qp, csr_array(eye_array(qp.q.size, format="csr")[order].T))


def permute_rows(qp: QP, equalities: Order, inequalities: Order) -> Equivalent:
    """Permute the rows: y' = y[equalities], z' = z[inequalities]."""
    return _rows(qp, *_selections(qp, equalities, inequalities))


def scale_rows(qp: QP, equalities: Vector, inequalities: Vector) -> Equivalent:
    """Multiply each row by a positive factor, which divides the row's multiplier."""
    return _rows(qp, diags_array(equalities), diags_array(inequalities))


def duplicate_rows(qp: QP, equalities: Order, inequalities: Order) -> Equivalent:
    """Append copies of the selected rows.

    The multiplier of an original row is the sum of the multipliers of its copies. The
    multipliers of the copies are not unique.
    """
    every = [np.arange(v.size) for v in (qp.b, qp.h)]
    twice = [
        np.append(rows, rows[selected])
        for rows, selected in zip(every, (equalities, inequalities), strict=True)
    ]
    return _rows(qp, *_selections(qp, *twice))


def shift_unknowns(qp: QP, origin: Vector) -> Equivalent:
    """Shift the origin of the unknowns to a = `origin` (n,): x = x' + a.

    The multipliers do not change.
    """
    return _unknowns(qp, eye_array(qp.q.size, format="csr"), origin)


def mirror(qp: QP, flipped: Order) -> Equivalent:
    """Reverse the sign of selected unknowns: xᵢ' = −xᵢ, lbᵢ' = −ubᵢ, ubᵢ' = −lbᵢ.

    The multipliers z_boxᵢ of selected unknowns also change sign; y and z do not change.

    flipped : indices or mask of the selected unknowns
    """
    sign = np.ones(qp.q.size)
    sign[flipped] = -1
    return _unknowns(qp, diags_array(sign))


def _unknowns(
    qp: QP, T: Matrix, origin: Vector | None = None, objective: float = 1.0
) -> Equivalent:
    """Substitute x = T x' + a, and multiply the objective by a factor.

    origin : a; None for zero
    objective : factor t of the objective

    Raises
    ------
    ValueError
        If P is an operator.

    """
    if not qp.is_explicit:
        raise ValueError(f"QP.P is a {type(qp.P).__name__}, expected a matrix")
    T, t = csr_array(T), objective
    # T⁻ᵀ has the sparsity pattern of T, since T has one nonzero in each row and column
    U = T.copy()
    U.data = 1 / T.data
    a = np.zeros(qp.q.size) if origin is None else origin
    Pa = qp.P @ a
    new = replace(
        qp,
        P=_sorted(T.T @ qp.P @ T * t),
        q=T.T @ (Pa + qp.q) * t,
        A=_sorted(qp.A @ T),
        b=qp.b - qp.A @ a,
        G=_sorted(qp.G @ T),
        h=qp.h - qp.G @ a,
        sets=tuple(one.substituted(T, a) for one in qp.sets),
        structure=_structure(qp.structure, T, t),
    )

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
    new = replace(qp, A=_sorted(M @ qp.A), b=M @ qp.b, G=_sorted(N @ qp.G), h=N @ qp.h)
    return Equivalent(new, lambda s: replace(s, y=M.T @ s.y, z=N.T @ s.z))


def _selections(
    qp: QP, equalities: Order, inequalities: Order
) -> tuple[Matrix, Matrix]:
    """Return the matrices that select the given equality and inequality rows."""
    M, N = (eye_array(v.size, format="csr") for v in (qp.b, qp.h))
    return M[equalities], N[inequalities]


def _sorted(M: Matrix) -> Matrix:
    """Sort the indices of a sparse matrix in place; a product may not sort them."""
    if hasattr(M, "sort_indices"):
        M.sort_indices()
    return M
