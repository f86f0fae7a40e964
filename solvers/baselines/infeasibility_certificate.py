"""Certificates that a QP has no solution, checked on its own data.

Differences of successive proximal iterates tend to them where there is one (Banjac et
al., Infeasibility detection in the alternating direction method of multipliers for
convex optimization, JOTA 183, 2019, for a method of the same family).
"""

from __future__ import annotations

import numpy as np

from mortarbench.harness import QP, Matrix, Vector

ROUNDING = 1e-10  #: of a sum, relative to the largest term that it could have


@np.errstate(over="ignore", invalid="ignore")  # iterates of such problems run away
def contradicts(qp: QP, y: Vector, z: Vector) -> bool:
    """Whether Ax = b and Gx ≤ h, weighted with y and z ≥ 0, exclude all of the box.

    With v = Aᵀy + Gᵀz every feasible x has vᵀx ≤ bᵀy + hᵀz, while over the box
    vᵀx is at least Σ vᵢ·(lbᵢ where vᵢ > 0, ubᵢ where vᵢ < 0) (the lemma of Farkas).
    """
    z = np.maximum(z, 0)
    v = _times(qp.A.T, y) + _times(qp.G.T, z)
    v[np.abs(v) <= ROUNDING * (_sizes(qp.A.T, y) + _sizes(qp.G.T, z))] = 0
    bound = np.where(v > 0, qp.lb, qp.ub)
    terms = np.zeros(v.size)
    np.multiply(v, bound, out=terms, where=v != 0)
    most = qp.b @ y + qp.h @ z
    size = np.abs(qp.b) @ np.abs(y) + np.abs(qp.h) @ z + np.abs(terms).sum()
    return bool(np.isfinite(size) and terms.sum() - most > 1e-6 * size)


@np.errstate(over="ignore", invalid="ignore")
def descends(qp: QP, v: Vector) -> bool:
    """Whether the cost falls without end along v, which leaves no constraint.

    Pv = 0, qᵀv < 0, Av = 0, Gv ≤ 0, and v leads towards no bound. It says nothing of
    whether there is a feasible point to start from.
    """
    if not v.any() or not np.isfinite(v).all():
        return False
    v = v / np.abs(v).max()
    v = np.where(np.abs(v) <= ROUNDING, 0.0, v)
    flat = np.abs(_times(qp.P, v)).max() <= ROUNDING * np.abs(qp.P.diagonal()).max()
    held = np.abs(_times(qp.A, v)) <= ROUNDING * _sizes(qp.A, np.ones(v.size))
    inside = _times(qp.G, v) <= ROUNDING * _sizes(qp.G, np.ones(v.size))
    off = (v >= 0) | np.isinf(qp.lb), (v <= 0) | np.isinf(qp.ub)
    slope = float(qp.q @ v)
    falls = slope < -1e-6 * float(np.abs(qp.q) @ np.abs(v))
    return bool(flat and held.all() and inside.all() and np.all(off) and falls)


def _times(M: Matrix, v: Vector) -> Vector:
    return np.asarray(M @ v)


def _sizes(M: Matrix, v: Vector) -> Vector:
    return np.asarray(abs(M) @ np.abs(v))
