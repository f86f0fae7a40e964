"""QPs with two-sided rows, as test sets distribute them, turned into ours."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array, vstack

from mortarbench.harness import QP, InputError, Vector
from mortarbench.harness.qp import check_symmetric

INFINITE = 1e20  #: bounds of at least this size mean that there is none


class TwoSidedQP(NamedTuple):
    """Minimise ½xᵀPx + qᵀx + r subject to l ≤ Ax ≤ u, lb ≤ x ≤ ub."""

    P: Any  #: (n, n) sparse, whole
    q: Vector  #: (n,)
    r: float
    A: Any  #: (m, n) sparse
    l: Vector  #: (m,) ≤ −1e20: none
    u: Vector  #: (m,) ≥ 1e20: none
    lb: Vector  #: (n,) as l
    ub: Vector  #: (n,) as u


def one_sided(given: TwoSidedQP) -> QP:
    """Split the rows: those with l = u are equalities, others up to two inequalities.

    First all upper sides  Ax ≤ u, then all lower ones  −Ax ≤ −l; free rows vanish.

    Raises
    ------
    InputError
        When P is not symmetric, or sides cross.

    """
    P, A = csc_array(given.P, dtype=float), csr_array(given.A, dtype=float)
    try:
        check_symmetric(P)
    except ValueError as e:
        raise InputError(str(e)) from None
    l, u = _limits("row", given.l, given.u)
    lb, ub = _limits("variable", given.lb, given.ub)
    equal = l == u
    upper, lower = np.isfinite(u) & ~equal, np.isfinite(l) & ~equal
    return QP(
        P=P, q=given.q, A=A[equal], b=u[equal],
        G=csr_array(vstack([A[upper], -A[lower]])), h=np.append(u[upper], -l[lower]),
        lb=lb, ub=ub,
    )  # fmt: skip


def _limits(what: str, low: Vector, high: Vector) -> tuple[Vector, Vector]:
    """Make absent sides infinite; refuse those that cross or leave nothing."""
    low = np.where(low <= -INFINITE, -np.inf, low)
    high = np.where(high >= INFINITE, np.inf, high)
    bad: NDArray[np.bool_] = ~(low <= high) | (low >= INFINITE) | (high <= -INFINITE)
    if bad.any():
        i = int(bad.argmax())
        raise InputError(
            f"the limits of {what} {i} (from 0) cross: [{low[i]:g}, {high[i]:g}]"
        )
    return low, high
