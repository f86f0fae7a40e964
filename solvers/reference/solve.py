"""The reference solve: what is true of a QP, told by none of the solvers under test.

With lower bounds only and a dense positive definite P = LLᵀ, min ½xᵀPx + qᵀx over
x ≥ lb is the nonnegative least-squares problem min ½‖Lᵀy + L⁻¹(q + P lb)‖² over
y = x − lb ≥ 0. Lawson and Hanson's active-set method ends after finitely many
steps with the exact active set; the free components are then solved for once more,
directly, with one step of iterative refinement.

Any other QP is scaled (`equilibrate`), solved by an interior-point
method as far as tells the active constraints from the others
(`interior`), and the equations of the active set are refined in
extended precision (`polish`). What is handed back is the point with
the least KKT residuals, as the harness measures them on the QP as given.

A QP with sets other than bounds is solved by the projections on them (`projection`).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular

from mortarbench.harness import QP, Solution, Status, kkt_residuals
from mortarbench.harness.operators import assembled
from mortarbench.harness.verify.optimum import MAX_RESIDUAL, is_small
from mortarbench.solvers.reference.equilibrate import equilibrated
from mortarbench.solvers.reference.interior import interior_point
from mortarbench.solvers.reference.polish import polished
from mortarbench.solvers.reference.projection import projected

NEAR = 1e-3  #: KKT residual of a start: from farther off refinement ends, where the
#: solutions are many, at one that is far off, and other starts are tried
ACCEPTED = 1e-9  #: KKT residual of what is called a solution
FAR = 1e4  #: times the median datum of a scaled QP: what is larger is left out at first


def reference_solution(qp: QP) -> Solution:
    """Solve a convex QP to about the rounding of x and its multipliers.

    Told are the iterations of the interior-point method, where it was needed. What
    remains of the residuals comes of rounding x to double precision: up to some
    1e-16·|P||x| against |Px|, a few 1e-12 for stiff bodies in their displacements.

    Raises
    ------
    ValueError
        When P is an operator that is not small, or a matrix holds NaN or inf.
    ArithmeticError
        When no point with KKT residuals up to 1e-9 is found: constraints contradict
        each other, or the cost is unbounded. (That P is positive semidefinite is taken
        on trust.)

    """
    if not qp.is_explicit and is_small(qp):
        qp = replace(qp, P=assembled(qp.P))
    if not qp.is_explicit:
        raise ValueError("the reference solve needs P as a matrix, got an operator")
    if not all(np.isfinite(M.sum()) for M in (qp.P, qp.A, qp.G)):
        raise ValueError("the reference solve needs finite matrices, got NaN or inf")
    best, least = Solution.without_point(qp, Status.FAILED), np.inf
    ways = (_candidates(qp), _tamed_candidates(qp), _weak_candidates(qp))
    for candidates in (_projected_candidates(qp),) if len(qp.sets) > 1 else ways:
        residuals = list[float]()
        for point in candidates:
            residuals.append(worst := _residual(qp, point))
            if worst <= least:
                best, least = point, worst
        is_near = residuals[0] <= NEAR
        if is_near and least <= (MAX_RESIDUAL if is_small(qp) else ACCEPTED):
            return best
    if least <= ACCEPTED:
        return best
    raise ArithmeticError(
        "the reference solve found no optimal point, the least KKT residual is "
        f"{least:.1e}: the QP may be infeasible or unbounded"
    )


def _residual(qp: QP, s: Solution) -> float:
    """Give the worst KKT residual, without the rounding of its own evaluation."""
    vectors = {k: getattr(s, k).astype(np.longdouble) for k in ("x", "y", "z", "z_box")}
    return kkt_residuals(qp, replace(s, **vectors)).worst


def _candidates(qp: QP) -> Iterator[Solution]:
    """Give points, each expected to be better than the ones before."""
    if _is_nonnegative(qp):
        with suppress(np.linalg.LinAlgError, RuntimeError):  # singular; steps ran out
            yield (point := _nonnegative(qp))
            if _residual(qp, point) <= MAX_RESIDUAL:
                return
    scaled = equilibrated(qp)
    start = interior_point(scaled.qp)
    yield scaled.recover(start)
    yield from map(scaled.recover, polished(scaled.qp, start))


def _projected_candidates(qp: QP) -> Iterator[Solution]:
    """Give points over sets of any kind, until rounding is all that is left."""
    for point in projected(qp):
        yield point
        if _residual(qp, point) <= MAX_RESIDUAL:
            return


def _tamed_candidates(qp: QP) -> Iterator[Solution]:
    """Do so once more, where the interior-point method may have begun too far off."""
    scaled = equilibrated(qp)
    near = scaled.qp.h < _most(scaled.qp)
    tame = equilibrated(_tamed(scaled.qp, near))
    start = tame.recover(interior_point(tame.qp))
    z = np.zeros(near.size)
    z[near] = start.z
    start = replace(start, z=z)
    yield scaled.recover(start)
    yield from map(scaled.recover, polished(scaled.qp, start))


def _weak_candidates(qp: QP) -> Iterator[Solution]:
    """Do so with less regularisation, for weak curvature and nearly parallel rows."""
    scaled = equilibrated(qp)
    start = interior_point(scaled.qp)
    for delta in (1e-13, 1e-16):
        yield from map(scaled.recover, polished(scaled.qp, start, delta))


def _most(qp: QP) -> float:
    data = np.concatenate([qp.q, qp.b, qp.h, qp.lb, qp.ub])
    told = np.abs(data[np.isfinite(data) & (data != 0)])
    return FAR * float(np.median(told)) if told.size else np.inf


def _tamed(qp: QP, near: NDArray[np.bool_]) -> QP:
    """Leave out what dwarfs all other data of a scaled QP: where to look first.

    Bounds and rows so far away do not bind, and a cost so large holds its variable at a
    bound already when it is smaller. Whether that is true, the QP as given will tell.

    near : (p,) rows to keep
    """
    most = _most(qp)
    tamed = replace(qp, q=np.clip(qp.q, -most, most), G=qp.G[near], h=qp.h[near])
    return tamed.with_bounds(
        np.where(qp.lb < -most, -np.inf, qp.lb), np.where(qp.ub > most, np.inf, qp.ub)
    )


def _is_nonnegative(qp: QP) -> bool:
    """Whether P is dense, and there are lower bounds only, on all variables.

    Without variables it is not: scipy's nnls (1.17.1) would crash Python.
    """
    only = not qp.b.size and not qp.h.size and np.isinf(qp.ub).all()
    lower = qp.q.size > 0 and np.isfinite(qp.lb).all()
    return bool(isinstance(qp.P, np.ndarray) and only and lower)


def _nonnegative(qp: QP) -> Solution:
    """Solve  min ½xᵀPx + qᵀx, x ≥ lb, by nonnegative least squares."""
    from scipy.optimize import nnls  # late: it takes long, and workers need none

    P, gradient_at_lb = qp.P, qp.q + qp.P @ qp.lb
    L = cholesky(P, lower=True)
    y, _ = nnls(L.T, -solve_triangular(L, gradient_at_lb, lower=True))

    free = y > 0
    y[free] = 0
    if free.any():
        factor = cho_factor(P[np.ix_(free, free)])
        for _ in range(2):
            y[free] -= cho_solve(factor, (P @ y + gradient_at_lb)[free])
    gradient = P @ y + gradient_at_lb
    return Solution(
        status=Status.SOLVED, x=qp.lb + np.maximum(y, 0), y=np.zeros(0), z=np.zeros(0),
        z_box=np.where(free, 0.0, -gradient),
    )  # fmt: skip
