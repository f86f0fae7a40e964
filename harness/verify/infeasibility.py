"""Certificates of infeasible and of unbounded QPs, evaluated with margins.

Infeasible: multipliers y and z ≥ 0 of the rows Ax = b and Gx ≤ h, with
c = Aᵀy + Gᵀz, prove that no point of the box with ‖x̂‖∞ ≤ T satisfies the rows if

    g = −bᵀy − hᵀz + Σ min(cⱼxⱼ over the box and |x̂ⱼ| ≤ T) > 0,

since cᵀx ≤ bᵀy + hᵀz for every x that satisfies the rows (Farkas' lemma). The radius
T = L/tol, where L is the largest length in the data, is so large that a point beyond
it is of no use at the tolerance; for T = ∞, rounding errors of c without a bound
would make every proof impossible. c is evaluated in extended precision, and a bound of
its rounding error, which T multiplies, is subtracted.

Unbounded: a ray r with qᵀr < 0, Pr = 0 in the recession cone of the feasible set, and a
feasible point. A ray alone proves only that the dual QP is infeasible.

All conditions are checked in the scaled QP of `harness.verify.kkt`, in which x̂ = x/D.
Multipliers and rays of the solver are tried first, then those of two linear programs.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array, hstack, vstack

from mortarbench.harness.mechanics import Real
from mortarbench.harness.qp import QP, Vector
from mortarbench.harness.sets.cones import Cones
from mortarbench.harness.sets.convex import hull
from mortarbench.harness.solution import Solution, Status
from mortarbench.harness.verify.kkt import (
    allowed,
    kkt_residuals,
    lengths,
    scaling_of,
)

#: Smallest g of a proof, as a fraction of the sum of its absolute terms. Redundant rows
#: that are consistent before rounding may contradict one another by a smaller margin if
#: their right-hand sides are rounded sums of thousands of terms.
MIN_MARGIN = 1e-12
#: Largest deviation of a ray from the recession cone and from Pr = 0. It is that of the
#: linear program, and independent of the tolerance: a ray with larger deviations may
#: belong to a bounded QP whose solution is long.
RAY_ACCURACY = 1e-10
MAX_ENTRIES = 10**6  #: largest number of entries of the linear programs
LP_SECONDS = 20.0  #: time limit of each linear program
NO_POINT = "a ray of descent, but no feasible point: only the dual QP is infeasible"


@np.errstate(all="ignore")  # entries may be as large as 1e300
def certificate_of(qp: QP, s: Solution, tol: float) -> tuple[bool, str]:
    """Return True if a claim of infeasibility or unboundedness holds, and the reason.

    Sets other than bounds are relaxed to their smallest enclosing box in a proof of
    infeasibility; if the relaxation is infeasible, the QP is infeasible.
    """
    if s.status is Status.INFEASIBLE:
        for y, z in _farkas_candidates(qp, s):
            if (margin := farkas_margin(qp, y, z, tol)) > MIN_MARGIN:
                return True, f"Farkas certificate with a margin of {margin:.1e}"
        return False, "no certificate of infeasibility was found"
    if not any(is_ray(qp, r) for r in _rays(qp, s)):
        return False, "no ray of unbounded descent was found"
    if not any(_is_feasible(qp, x, tol) for x in _points(qp, s)):
        return False, NO_POINT
    return True, "a ray of descent and a feasible point hold"


def farkas_margin(qp: QP, y: Vector, z: Vector, tol: float) -> float:
    """Return g divided by the sum of its absolute terms, or −1 for invalid z.

    A positive margin proves that no point with ‖x̂‖∞ ≤ L/tol is feasible.
    """
    if (z < 0).any() or not (np.isfinite(y).all() and np.isfinite(z).all()):
        return -1.0
    lower, upper = hull(qp.sets, qp.q.size)
    reach = scaling_of(qp).D * _longest(qp) / tol
    ends = np.maximum(lower, -reach), np.minimum(upper, reach)
    if (ends[0] > ends[1]).any():  # a bound is beyond the radius
        return -1.0
    c, error = _combined(qp, np.concatenate([y, z]))
    work = np.minimum(c * ends[0], c * ends[1])
    rounding = error @ np.maximum(np.abs(ends[0]), np.abs(ends[1]))
    g = -(qp.b @ y) - qp.h @ z + work.sum() - rounding
    terms = np.abs(qp.b) @ np.abs(y) + np.abs(qp.h) @ z + np.abs(work).sum()
    return float(g / terms) if terms > 0 else -1.0


def _combined(qp: QP, w: Vector) -> tuple[Any, Any]:
    """Return [A; G]ᵀw (n,) in extended precision, and bounds (n,) of its rounding."""
    K = coo_array(vstack([csr_array(qp.A), csr_array(qp.G)]))
    terms = K.data.astype(Real) * w[K.row]
    c, sizes = np.zeros((2, qp.q.size), dtype=Real)
    np.add.at(c, K.col, terms)
    np.add.at(sizes, K.col, np.abs(terms))
    count = 1 + np.bincount(K.col, minlength=c.size)  # roundings of each sum
    return c, count * np.finfo(Real).eps * sizes


def _longest(qp: QP) -> float:
    """Return L, the largest length in the data; 1 if there is none."""
    return float(lengths(qp).max(initial=0.0)) or 1.0


def is_ray(qp: QP, r: Vector) -> bool:
    """Return True if the objective decreases without bound along r (n,).

    With ‖r̂‖∞ = 1 and the slope σ = −q̂ᵀr̂ > 0, r may leave the recession cone by at most
    ε·min(1, σ/‖q̂‖∞) in each scaled row, bound or set, with ε = `RAY_ACCURACY`, and
    ‖P̂r̂‖∞ ≤ εσ/R with R = max(L, ‖q̂‖∞/max P̂ⱼⱼ). The objective is then linear along r
    up to a distance R/ε, where R is the largest length that the data define.
    """
    by = scaling_of(qp)
    size = float(np.abs(r / by.D).max())
    if not 0 < size < np.inf:
        return False
    r = r / size
    slope, (lower, upper) = -float(qp.q @ r), hull(qp.sets, r.size)
    if not slope > MIN_MARGIN * (np.abs(qp.q) @ np.abs(r)):
        return False
    leaving = [
        by.E * np.abs(qp.A @ r),
        by.F * (qp.G @ r),
        np.where(np.isfinite(lower), -r / by.D, 0),
        np.where(np.isfinite(upper), r / by.D, 0),
    ]
    for one in qp.sets[1:]:
        if isinstance(one, Cones):
            leaving += [-c.slack / by.D[c.variable] for c in one.limits(r)]
    largest = max(float(v.max(initial=0.0)) for v in leaving)
    bend = float(np.abs(by.D * (qp.P @ r)).max())
    steepest = float(np.abs(by.D * qp.q).max())
    stiffest = float((by.D**2 * by.curvature).max())
    if largest > RAY_ACCURACY * min(1.0, slope / steepest):
        return False
    reach = max(_longest(qp), steepest / stiffest if stiffest else 0.0) / RAY_ACCURACY
    return bend * reach <= slope


def _is_feasible(qp: QP, x: Vector, tol: float) -> bool:
    none = Solution.without_point(qp, Status.UNBOUNDED)
    point = replace(none, x=x, y=0 * qp.b, z=0 * qp.h, z_box=0 * qp.q)
    return kkt_residuals(qp, point).primal <= allowed(tol)


def _farkas_candidates(qp: QP, s: Solution) -> Iterator[tuple[Vector, Vector]]:
    yield s.y, np.maximum(s.z, 0)
    if (least := least_violation(qp)) is not None:
        yield least[1], least[2]


def _points(qp: QP, s: Solution) -> Iterator[Vector]:
    yield s.x
    if (least := least_violation(qp)) is not None:
        x = least[0]
        for one in qp.sets:
            x = one.project(x)
        yield x


def least_violation(qp: QP) -> tuple[Vector, Vector, Vector] | None:
    """Return the point in the box that violates scaled rows least, and multipliers.

    The linear program minimises t subject to −t ≤ E(Ax − b)/L ≤ t and F(Gx − h)/L ≤ t.
    If the least t is positive, the multipliers y, z of the rows are those of a Farkas
    certificate with g = tL.
    """
    by, n, (lower, upper) = scaling_of(qp), qp.q.size, hull(qp.sets, qp.q.size)
    D = by.D * _longest(qp)
    A, G = (csr_array(diags_array(e) @ csr_array(M) @ diags_array(by.D))
            for e, M in ((by.E, qp.A), (by.F, qp.G)))  # fmt: skip
    K = vstack([A, -A, G])
    bounds = np.stack([np.append(lower / D, 0), np.append(upper / D, np.inf)])
    solved = _linear_program(
        np.append(np.zeros(n), 1.0),
        csr_array(hstack([K, np.full((K.shape[0], 1), -1.0)])),
        np.concatenate([by.E * qp.b, -by.E * qp.b, by.F * qp.h]) / _longest(qp),
        None,
        bounds,
    )
    if solved is None:
        return None
    w, m = -solved.ineqlin.marginals, qp.b.size
    y, z = by.E * (w[:m] - w[m : 2 * m]), by.F * np.maximum(w[2 * m :], 0)
    return D * solved.x[:n], y, z


def _rays(qp: QP, s: Solution) -> Iterator[Vector]:
    """Yield x of the solver, then the ray of steepest descent."""
    if np.isfinite(s.x).all():
        yield s.x
    yield from steepest_ray(qp)


def steepest_ray(qp: QP) -> Iterator[Vector]:
    """Yield the ray of steepest descent with ‖r̂‖∞ ≤ 1, if it is found.

    Cones are relaxed to their smallest enclosing box.
    """
    if not qp.is_explicit:
        return
    by, (lower, upper) = scaling_of(qp), hull(qp.sets, qp.q.size)
    low, high = -1.0 * np.isinf(lower), 1.0 * np.isinf(upper)
    D = diags_array(by.D)
    G = csr_array(diags_array(by.F) @ csr_array(qp.G) @ D)
    A = vstack([diags_array(by.E) @ csr_array(qp.A) @ D, D @ csr_array(qp.P) @ D])
    solved = _linear_program(
        by.D * qp.q, G, np.zeros(G.shape[0]), csr_array(A), np.stack([low, high])
    )
    if solved is not None:
        yield by.D * solved.x


def _linear_program(cost: Vector, G: Any, h: Vector, A: Any, bounds: Any) -> Any | None:
    """Minimise costᵀx subject to Gx ≤ h, Ax = 0 and bounds (2, n); None on failure."""
    # imported here, since scipy.optimize loads slowly
    from scipy.optimize import linprog

    entries = G.nnz + (0 if A is None else A.nnz)
    if entries > MAX_ENTRIES or not np.isfinite(G.data).all():
        return None
    solved = linprog(
        cost,
        A_ub=G if G.shape[0] else None,
        b_ub=h if G.shape[0] else None,
        A_eq=A,
        b_eq=None if A is None else np.zeros(A.shape[0]),
        bounds=bounds.T,
        options=dict(
            time_limit=LP_SECONDS,
            primal_feasibility_tolerance=1e-10,
            dual_feasibility_tolerance=1e-10,
        ),
    )
    return None if solved.x is None else solved
