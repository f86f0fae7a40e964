"""Tests of certificates which prove that a QP has no solution.

If a certificate exists, the differences of successive proximal iterates converge to a
certificate. Banjac et al. prove this for ADMM, a related method (Infeasibility
detection in the alternating direction method of multipliers for convex optimization,
JOTA 183, 2019).
"""

from __future__ import annotations

import numpy as np

from mortarbench.harness import QP, Matrix, Vector

#: a sum counts as zero if it is below this factor times the sum of the absolute values
#: of its terms
ROUNDING = 1e-10


# overflow is possible, because iterates of QPs without a solution diverge
@np.errstate(over="ignore", invalid="ignore")
def proves_infeasible(qp: QP, y: Vector, z: Vector) -> bool:
    """Return True if y and z ≥ 0 are a Farkas certificate of infeasibility.

    With v = Aᵀy + Gᵀz, every feasible x satisfies vᵀx ≤ bᵀy + hᵀz. On the box, vᵀx is
    at least the sum of vᵢ·lbᵢ over vᵢ > 0 and of vᵢ·ubᵢ over vᵢ < 0. The QP is
    infeasible if this sum exceeds bᵀy + hᵀz (Farkas' lemma).
    """
    z = np.maximum(z, 0)
    v = _times(qp.A.T, y) + _times(qp.G.T, z)
    v[np.abs(v) <= ROUNDING * (_sizes(qp.A.T, y) + _sizes(qp.G.T, z))] = 0
    bound = np.where(v > 0, qp.lb, qp.ub)
    terms = np.zeros(v.size)
    np.multiply(v, bound, out=terms, where=v != 0)
    most = qp.b @ y + qp.h @ z
    size = np.abs(qp.b) @ np.abs(y) + np.abs(qp.h) @ z + np.abs(terms).sum()
    # a term is infinite if the bound is absent; vᵀx then has no lower bound
    return bool(np.isfinite(size) and terms.sum() - most > 1e-6 * size)


@np.errstate(over="ignore", invalid="ignore")
def proves_unbounded(qp: QP, v: Vector) -> bool:
    """Return True if the objective is unbounded below along the feasible direction v.

    The conditions are Pv = 0, qᵀv < 0, Av = 0 and Gv ≤ 0, with vᵢ ≥ 0 if lbᵢ is finite
    and vᵢ ≤ 0 if ubᵢ is finite. These conditions do not imply that a feasible point
    exists. An operator P without a known diagonal has no size with which Pv could be
    compared; the result is then False.
    """
    diagonal = qp.diagonal()
    if diagonal is None or not v.any() or not np.isfinite(v).all():
        return False
    v = v / np.abs(v).max()
    v = np.where(np.abs(v) <= ROUNDING, 0.0, v)
    is_flat = np.abs(_times(qp.P, v)).max() <= ROUNDING * np.abs(diagonal).max()
    equalities_hold = np.abs(_times(qp.A, v)) <= ROUNDING * _sizes(
        qp.A, np.ones(v.size)
    )
    inequalities_hold = _times(qp.G, v) <= ROUNDING * _sizes(qp.G, np.ones(v.size))
    bounds_allow = (v >= 0) | np.isinf(qp.lb), (v <= 0) | np.isinf(qp.ub)
    slope = float(qp.q @ v)
    falls = slope < -1e-6 * float(np.abs(qp.q) @ np.abs(v))
    return bool(
        is_flat
        and equalities_hold.all()
        and inequalities_hold.all()
        and np.all(bounds_allow)
        and falls
    )


def _times(M: Matrix, v: Vector) -> Vector:
    return np.asarray(M @ v)


def _sizes(M: Matrix, v: Vector) -> Vector:
    return np.asarray(abs(M) @ np.abs(v))
