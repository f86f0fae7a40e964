"""Bounds of the optimal value, from a feasible point and multipliers.

*Below.* For any x, y and z ≥ 0, let z_box be the part of −(Px + q + Aᵀy + Gᵀz) that is
normal to the bounds and sets, and r = Px + q + Aᵀy + Gᵀz + z_box. For all feasible w,

    f(w) ≥ −½xᵀPx − bᵀy − hᵀz − σ(z_box) + rᵀw + ½(w − x)ᵀP(w − x).

With P ≥ λD², D = diag(2ᵉ), the last two terms are at least rᵀx − ‖D⁻¹r‖²/2λ. λ > 0 is
proven by a Cholesky factor L of D⁻¹PD⁻¹ − μI and the norm of its residual. On variables
with Pᵢᵢ = 0, the term is −|rᵢ|R instead, and the bound holds for |wᵢ − xᵢ| ≤ R = 1e6.

*Above.* x satisfies the equations up to rounding. A point that satisfies them exactly
is at a distance of at most δ = ‖Ax − b‖/σ, with the least singular value σ of A on the
variables that are not fixed. All inequalities have slacks of at least δ at x, so that
this point is feasible. Its objective differs from f(x) by at most δ(‖∇f‖ + δ‖P‖).

Sums are evaluated in extended precision, and bounds of their rounding errors widen the
interval. Norms and singular values are evaluated in double precision.
"""

from __future__ import annotations

from dataclasses import replace
from math import inf, nextafter
from typing import Any

import numpy as np
from scipy.linalg import svdvals
from scipy.sparse import csc_array, csr_array, diags_array, eye_array
from scipy.sparse.linalg import norm

from mortarbench.dataset.standard import curvature_exponents
from mortarbench.harness import QP
from mortarbench.harness.mechanics import Real
from mortarbench.harness.qp import Vector
from mortarbench.harness.sets.box import Box
from mortarbench.harness.sets.convex import admissible, hull
from mortarbench.harness.sets.discs import Discs

RADIUS = 1e6  #: R, distance from x in variables without curvature
#: Candidates for μ. The last is a quarter of what a shift adds (`standard.SHIFT`)
CURVATURES = tuple(2.0**-k for k in (4, 10, 16, 22, 28, 32))
#: Least ratio of singular values of A that counts as full rank.
MIN_RANK = 1e-8
_EPS = float(np.finfo(Real).eps)
MARGIN = 2.0**-42  #: distance of certified points from limits, for rounding errors


class UnprovenError(ArithmeticError):
    """Error for an optimal value that cannot be bounded; the message is a reason."""


def optimum_interval(qp: QP, x: Vector, y: Vector, z: Vector) -> tuple[float, float]:
    """Return bounds of the optimal value of an explicit QP.

    x, y, z : (n,), (m,), (p,) point and multipliers, of any accuracy

    Raises
    ------
    UnprovenError
        If no bound can be proven, for the reason in the message.

    """
    if not all(isinstance(one, Box | Discs) for one in qp.sets):
        raise UnprovenError("cones are not supported")
    size, z = np.abs(x), np.maximum(z, 0)
    P, A, G = (M.astype(Real) for M in (qp.P, qp.A, qp.G))
    Px, roundings = P @ x.astype(Real), 2 * _EPS * (x.size + y.size + z.size)
    objective = 0.5 * (x @ Px) + qp.q.astype(Real) @ x
    error = roundings * (0.5 * (size @ (abs(P) @ size)) + np.abs(qp.q) @ size)
    delta = _distance(qp, x)
    gradient = np.linalg.norm(qp.P @ x + qp.q)
    high = objective + error + delta * (gradient + delta * norm(csc_array(qp.P)))

    force = Px + qp.q + A.T @ y.astype(Real) + G.T @ z.astype(Real)
    sizes = abs(P) @ size + np.abs(qp.q) + abs(A).T @ np.abs(y) + abs(G).T @ z
    borne = admissible(qp.sets, -force.astype(float))
    support = sum(one.support(borne.astype(Real)) for one in qp.sets)
    reach = np.abs(np.nan_to_num(hull(qp.sets, x.size), posinf=0, neginf=0)).max(axis=0)
    r = force + borne
    low = r @ x - 0.5 * (x @ Px) - qp.b.astype(Real) @ y - qp.h.astype(Real) @ z
    error += roundings * (np.abs(qp.b) @ np.abs(y) + np.abs(qp.h) @ z + sizes @ size)
    error += roundings * (np.abs(borne) @ reach) + np.finfo(float).eps * abs(support)
    r = np.abs(r) + roundings * sizes
    curved = np.isfinite(e := curvature_exponents(qp.P))
    if curved.any():
        if not (curvature := least_curvature(qp.P)):
            raise UnprovenError("P is not provably positive semidefinite")
        error += ((r[curved] / np.exp2(e[curved])) ** 2).sum() / (2 * curvature)
    low -= support + error + RADIUS * r[~curved].sum()
    return nextafter(float(low), -inf), nextafter(float(high), inf)


def least_curvature(P: Any) -> float:
    """Return λ with P ≥ λD² on the variables with curvature; 0 if none is proven."""
    rest = csc_array(P)[np.isinf(curvature_exponents(P))]
    M = of_unit_diagonal(P)
    if not M.nnz or abs(rest).sum() > 1e-12 * abs(P).sum():
        return 0.0
    for mu in CURVATURES:
        residual = _cholesky_residual(M - mu * eye_array(M.shape[0]))
        if residual <= mu / 2:
            return mu - residual
    return 0.0


def of_unit_diagonal(P: Any) -> csc_array:
    """Return D⁻¹PD⁻¹ on the variables with curvature."""
    e = curvature_exponents(P)
    used = np.flatnonzero(np.isfinite(e))
    D = diags_array(np.exp2(-e[used]))
    return csc_array(D @ csc_array(P)[np.ix_(used, used)] @ D)


def _cholesky_residual(M: Any) -> float:
    """Return a bound of ‖M − LLᵀ‖, where L is a Cholesky factor; inf without one.

    The bound contains the rounding errors of LLᵀ, which |L||Lᵀ| bounds by entries.
    """
    from sksparse.cholmod import CholmodNotPositiveDefiniteError, cholesky

    try:
        factor = cholesky(M)
        L, order = csc_array(factor.L()), factor.P()
    except CholmodNotPositiveDefiniteError:
        return np.inf
    terms = int(np.diff(csr_array(L).indptr).max()) + 2
    rounding = terms * np.finfo(float).eps * norm(abs(L) @ abs(L).T)
    return float(norm(M[order][:, order] - L @ L.T) + rounding)


def _distance(qp: QP, x: Vector) -> float:
    """Return δ, the distance from x to a feasible point.

    Raises
    ------
    UnprovenError
        If there is no feasible point that near, or the equations are dependent.

    """
    lower, upper = hull(qp.sets, x.size)
    free, delta, eps = lower < upper, 0.0, x.size * _EPS
    if qp.b.size:
        values = svdvals(csc_array(qp.A)[:, np.flatnonzero(free)].toarray())
        if values.size < qp.b.size or values[-1] <= MIN_RANK * values[0]:
            raise UnprovenError("the equations are dependent")
        residual = np.abs(qp.A.astype(Real) @ x.astype(Real) - qp.b)
        rounding = eps * (abs(qp.A) @ np.abs(x) + np.abs(qp.b))
        delta = 1.001 * float(np.linalg.norm(residual + rounding)) / values[-1]
    slack = qp.h - qp.G.astype(Real) @ x.astype(Real)
    needed = eps * (abs(qp.G) @ np.abs(x) + np.abs(qp.h)) + delta * norm(
        csr_array(qp.G), axis=1
    )
    is_near = bool((slack >= needed).all())
    for one in qp.sets:
        for limit in one.limits(x):
            rounding = 1e-15 * limit.size * isinstance(one, Discs)
            needed = rounding + delta * free[limit.variable]
            is_near &= bool((limit.slack >= needed).all())
    if not is_near:
        raise UnprovenError("its point violates an inequality")
    return delta


def tightened(qp: QP) -> QP:
    """Return a QP whose approximate solutions satisfy the inequalities of `qp`.

    Limits are moved inwards by `MARGIN`, in the Euclidean norm, except those of
    variables that are fixed.
    """
    margin = MARGIN * (qp.lb < qp.ub)
    sets = [replace(one, radius=one.radius - MARGIN * (one.radius > 0))
            for one in qp.sets if isinstance(one, Discs)]  # fmt: skip
    return replace(
        qp,
        h=qp.h - MARGIN * norm(csr_array(qp.G), axis=1),
        sets=(Box(qp.lb + margin, qp.ub - margin), *sets),
    )
