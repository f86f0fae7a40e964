"""Equivalent formulations of a QP.

Equivalent problems must have equal answers. A change may concern the units, the order
of unknowns or rows, the origin or the sign of unknowns, or the scaling or duplication
of rows. Such relations are called metamorphic (T. Y. Chen et al., ACM Computing Surveys
51 (2018) 4). Each change is a substitution of one of two types:

* of unknowns,  x = T x' + a,  where T has one nonzero in each row and column; the
  objective is multiplied by t:

      P' = t TᵀPT,  q' = t Tᵀ(Pa + q),  A' = AT,  b' = b − Aa,  G' = GT,  h' = h − Ga

* of rows,  A' = MA, b' = Mb  or  G' = NG, h' = Nh.  M and N have one nonzero in each
  row and at least one in each column; the nonzeros of N are positive.

If all factors are powers of two, the data of every changed QP except a shifted one are
exact in floating-point arithmetic. Substitutions of unknowns require P as a matrix and
raise ValueError if P is an operator.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array, eye_array

from mortarbench.harness.qp import QP, Matrix, Vector

Order = NDArray[Any]  #: array of indices or mask that selects unknowns or rows


def change_units(qp: QP, *, unknown: float, objective: float) -> QP:
    """Change the units of x and of the objective.

    ::

        x = s x',  objective' = t·objective
        P' = ts²P,  q' = ts q,  A' = A,  b' = b/s,  G' = G,  h' = h/s,  lb' = lb/s

    Since the entries of contact rows are dimensionless, A and G do not change, and
    right-hand sides have the unit of x. If x is a displacement, multipliers are forces.

    unknown : s, the new unit of x in multiples of the old unit
    objective : t, the old unit of the objective in multiples of the new unit
    """
    T = diags_array(np.full(qp.q.size, unknown))
    A, G = (diags_array(np.full(v.size, 1 / unknown)) for v in (qp.b, qp.h))
    return _rows(_unknowns(qp, T, objective=objective), A, G)


def permute_unknowns(qp: QP, order: Order) -> QP:
    """Permute the unknowns: x' = x[order]."""
    return _unknowns(qp, csr_array(eye_array(qp.q.size, format="csr")[order].T))


def permute_rows(qp: QP, equalities: Order, inequalities: Order) -> QP:
    """Permute the rows; repeated indices repeat rows."""
    M, N = (eye_array(v.size, format="csr") for v in (qp.b, qp.h))
    return _rows(qp, M[equalities], N[inequalities])


def scale_rows(qp: QP, equalities: Vector, inequalities: Vector) -> QP:
    """Multiply each row by a positive factor, which divides the row's multiplier."""
    return _rows(qp, diags_array(equalities), diags_array(inequalities))


def shift_unknowns(qp: QP, origin: Vector) -> QP:
    """Shift the origin of the unknowns to a = `origin` (n,): x = x' + a."""
    return _unknowns(qp, eye_array(qp.q.size, format="csr"), origin)


def mirror(qp: QP, flipped: Order) -> QP:
    """Reverse the sign of selected unknowns: xᵢ' = −xᵢ, lbᵢ' = −ubᵢ, ubᵢ' = −lbᵢ.

    flipped : indices or mask of the selected unknowns
    """
    sign = np.ones(qp.q.size)
    sign[flipped] = -1
    return _unknowns(qp, diags_array(sign))


def _unknowns(
    qp: QP, T: Matrix, origin: Vector | None = None, objective: float = 1.0
) -> QP:
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
    a = np.zeros(qp.q.size) if origin is None else origin
    return QP(
        P=T.T @ qp.P @ T * t,
        q=T.T @ (qp.P @ a + qp.q) * t,
        A=qp.A @ T,
        b=qp.b - qp.A @ a,
        G=qp.G @ T,
        h=qp.h - qp.G @ a,
        sets=[one.substituted(T, a) for one in qp.sets],
    )


def _rows(qp: QP, M: Matrix, N: Matrix) -> QP:
    """Multiply the equality rows by M and the inequality rows by N."""
    M, N = csr_array(M), csr_array(N)
    return replace(qp, A=M @ qp.A, b=M @ qp.b, G=N @ qp.G, h=N @ qp.h)


def _order(count: int) -> Order:
    return np.random.default_rng(141421).permutation(count)


def _rows_scaled(qp: QP) -> QP:
    """Scale each row by a random power of two between 2⁻¹⁰ and 2¹⁰."""
    exponents = np.random.default_rng(173205).integers(-10, 11, qp.b.size + qp.h.size)
    return scale_rows(qp, *np.split(2.0**exponents, [qp.b.size]))


#: Units of displacements and of the objective: load (10⁸ N/m) and length (2 m) of
#: beam-ring in each system of units, rounded to powers of two.
UNITS: Mapping[str, tuple[float, float]] = {
    "N, m": (2.0**27, 2.0**1),
    "N, mm": (2.0**17, 2.0**11),
    "GN, m": (2.0**-3, 2.0**1),
}

#: Changes by name. The first word of a change of rows names the rows that it needs.
CHANGES: Mapping[str, Callable[[QP], QP]] = {
    **{
        f"units {name}": partial(
            change_units, unknown=1 / length, objective=force * length
        )
        for name, (force, length) in UNITS.items()
    },
    "unknowns permuted": lambda qp: permute_unknowns(qp, _order(qp.q.size)),
    "rows permuted": lambda qp: permute_rows(
        qp, _order(qp.b.size)[::-1], _order(qp.h.size)
    ),
    "rows scaled": _rows_scaled,
    "equality rows twice": lambda qp: permute_rows(
        qp, np.tile(np.arange(qp.b.size), 2), np.arange(qp.h.size)
    ),
    "inequality rows twice": lambda qp: permute_rows(
        qp, np.arange(qp.b.size), np.tile(np.arange(qp.h.size), 2)
    ),
    "unknowns shifted": lambda qp: shift_unknowns(qp, np.full(qp.q.size, 0.5)),
    # reverse the signs of all unknowns: the load acts upwards, and x ≥ 0 becomes x ≤ 0
    "mirrored": lambda qp: mirror(qp, np.arange(qp.q.size)),
}
