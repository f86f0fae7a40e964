"""QPs with two-sided rows, as in test sets, and their conversion to `QP`."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array, vstack

from mortarbench.harness import QP, InputError, Vector
from mortarbench.harness.qp import check_symmetric

MIN_INFINITE = 1e20  #: bounds of at least this magnitude count as infinite


class TwoSidedQP(NamedTuple):
    """The problem  min ½xᵀPx + qᵀx + r  subject to  l ≤ Ax ≤ u, lb ≤ x ≤ ub."""

    P: Any  #: (n, n) sparse Hessian, with both triangles
    q: Vector  #: (n,) linear term
    r: float
    A: Any  #: (m, n) sparse constraint matrix
    l: Vector  #: (m,) lower limits; a value ≤ −1e20 means no limit
    u: Vector  #: (m,) upper limits; a value ≥ 1e20 means no limit
    lb: Vector  #: (n,) lower bounds; a value ≤ −1e20 means no bound
    ub: Vector  #: (n,) upper bounds; a value ≥ 1e20 means no bound


def one_sided(qp: TwoSidedQP) -> QP:
    """Return the QP with rows l = u as equalities and all others as inequalities.

    Upper limits  Ax ≤ u  precede lower limits  −Ax ≤ −l; rows without limits are
    dropped.

    Raises
    ------
    InputError
        If P is not symmetric, or the limits of a row or variable exclude every value.

    """
    P, A = csc_array(qp.P, dtype=float), csr_array(qp.A, dtype=float)
    try:
        check_symmetric(P)
    except ValueError as e:
        raise InputError(str(e)) from None
    l, u = _limits("row", qp.l, qp.u)
    lb, ub = _limits("variable", qp.lb, qp.ub)
    equal = l == u
    upper, lower = np.isfinite(u) & ~equal, np.isfinite(l) & ~equal
    return QP(
        P=P,
        q=qp.q,
        A=A[equal],
        b=u[equal],
        G=csr_array(vstack([A[upper], -A[lower]])),
        h=np.append(u[upper], -l[lower]),
        lb=lb,
        ub=ub,
    )


def _limits(what: str, low: Vector, high: Vector) -> tuple[Vector, Vector]:
    """Replace absent limits by ±inf; raise InputError if they exclude every value."""
    low = np.where(low <= -MIN_INFINITE, -np.inf, low)
    high = np.where(high >= MIN_INFINITE, np.inf, high)
    bad: NDArray[np.bool_] = (
        ~(low <= high) | (low >= MIN_INFINITE) | (high <= -MIN_INFINITE)
    )
    if bad.any():
        i = int(bad.argmax())
        raise InputError(
            f"the limits of {what} {i} (from 0) cross: [{low[i]:g}, {high[i]:g}]"
        )
    return low, high
