"""Reference solutions of QPs, computed independently of the solvers under test.

If P = LLᵀ is dense and positive definite and x ≥ lb is the only constraint, the QP is
equivalent to the nonnegative least-squares problem min ½‖Lᵀy + L⁻¹(q + P lb)‖² over
y = x − lb ≥ 0. The active-set method of Lawson and Hanson ends after finitely many
steps with the exact active set. The free components are then recomputed by a direct
solve with one step of iterative refinement.

Every other QP is scaled (`equilibrate`) and solved by an interior-point method until
the active constraints can be identified (`interior`). The equations of the active set
are then solved with refinement in extended precision (`polish`). The result is the
point with the smallest KKT residual of the original QP. The residual is an argument,
so that the harness can choose among the points by its own rule.

If P is an operator with preconditioners and the QP is too large to assemble P, its
active sets are found with conjugate gradients on faces (`operators`).

If the sets are bounds and discs, a method that uses projections (`projection`) refines
the point of the interior-point method. QPs with other sets are solved by the projection
method alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular

from mortarbench.harness import QP, Discs, Solution, Status
from mortarbench.harness.operators import assembled
from mortarbench.harness.sets.blocks import Blocks
from mortarbench.solvers.common.stopping import relative_residual
from mortarbench.solvers.reference.equilibrate import equilibrate
from mortarbench.solvers.reference.interior import DELTA, interior_point
from mortarbench.solvers.reference.operators import reference_of_operator
from mortarbench.solvers.reference.polish import polish
from mortarbench.solvers.reference.projection import projection_iterates, refine

#: Largest KKT residual of a reliable starting point for refinement; if the residual is
#: larger, other starting points are tried. From an unreliable starting point, the
#: refinement of a QP with many solutions ended at a solution of size 1e10, whose
#: rounding errors hid errors of the optimal value.
MAX_START_RESIDUAL = 1e-3
#: KKT residual of a point, apart from rounding, that needs no further refinement
MAX_RESIDUAL = 1e-14
#: largest number of further rounds of `projection` that do not reduce a residual
#: between MAX_RESIDUAL and MAX_REFERENCE_RESIDUAL; the residual is then accepted
MAX_IDLE_ROUNDS = 1
MAX_REFERENCE_RESIDUAL = 1e-9  #: largest KKT residual of a reference solution
#: δ of the interior-point method if there are discs and P is singular; with a smaller
#: δ, steps along the kernel of P leave the discs so far that the linearisation fails
SINGULAR_DELTA = 1e-7
#: largest number of variables and rows of a QP whose operator P is assembled
MAX_ASSEMBLED = 800
#: data of a scaled QP count as outliers above this factor times their median
OUTLIER_FACTOR = 1e4

#: function that returns the KKT residual of a point
Residual = Callable[[QP, Solution], float]
_relative = partial(relative_residual, tol=MAX_REFERENCE_RESIDUAL)


def reference_solution(qp: QP, residual: Residual = _relative) -> Solution:
    """Return a solution of a convex QP, usually accurate to rounding.

    In this case, the remaining residual is caused by the rounding of x to double
    precision. It is about 1e-16·|P||x| relative to |Px|, which is a few times 1e-12 for
    the displacements of stiff bodies. The field `iterations` contains the number of
    interior-point steps, if that method ran. The function does not check that P is
    positive semidefinite.

    residual : KKT residual by which the best point is chosen; it is called with vectors
        in extended precision

    Raises
    ------
    ValueError
        If P is an operator without preconditioners and the QP is too large to assemble
        it, or if a matrix contains NaN or inf.
    ArithmeticError
        If no point with a KKT residual of at most 1e-9 is found, usually because the
        constraints contradict each other or the objective is unbounded below.

    Examples
    --------
    >>> import mortarbench as mb
    >>> qp = mb.QP.from_arrays([[2.0, 0.0], [0.0, 2.0]], [-2.0, 2.0], lb=[0.0, 0.0])
    >>> reference_solution(qp).x.tolist()
    [1.0, 0.0]

    """
    if not qp.is_explicit and qp.q.size + qp.b.size + qp.h.size <= MAX_ASSEMBLED:
        qp = replace(qp, P=assembled(qp.P))
    if not qp.is_explicit:
        return reference_of_operator(qp)
    if not all(np.isfinite(M.sum()) for M in (qp.P, qp.A, qp.G)):
        raise ValueError("the reference solve needs finite matrices; got NaN or inf")
    best, least = Solution.without_point(qp, Status.FAILED), np.inf
    attempts: tuple[Iterator[Solution], ...] = (
        _candidates(qp, residual),
        _candidates_without_outliers(qp),
        _less_regularised_candidates(qp),
    )
    if len(qp.sets) > 1:
        smooth = all(isinstance(one, Discs) for one in qp.sets[1:])
        shifts = (DELTA, SINGULAR_DELTA) if smooth else ()
        attempts = (
            *(_smooth_candidates(qp, delta) for delta in shifts),
            _projection_candidates(qp, residual),
        )
    for candidates in attempts:
        residuals = list[float]()
        for point in candidates:
            residuals.append(worst := _extended(residual, qp, point))
            if worst <= least:
                best, least = point, worst
        is_near = residuals[0] <= MAX_START_RESIDUAL
        if is_near and least <= MAX_REFERENCE_RESIDUAL:
            return best
    if least <= MAX_REFERENCE_RESIDUAL:
        return best
    raise ArithmeticError(
        "the reference solve found no optimal point (smallest KKT residual: "
        f"{least:.1e}); the QP may be infeasible or unbounded"
    )


def _extended(residual: Residual, qp: QP, s: Solution) -> float:
    """Return the KKT residual, evaluated in extended precision."""
    vectors = {k: getattr(s, k).astype(np.longdouble) for k in ("x", "y", "z", "z_box")}
    return residual(qp, replace(s, **vectors))


def _candidates(qp: QP, residual: Residual) -> Iterator[Solution]:
    """Yield points with usually decreasing errors."""
    if _is_nonnegative(qp):
        # LinAlgError if P is singular; RuntimeError if nnls reached its step limit
        with suppress(np.linalg.LinAlgError, RuntimeError):
            yield (point := _nonnegative(qp))
            if _extended(residual, qp, point) <= MAX_RESIDUAL:
                return
    scaled = equilibrate(qp)
    start = interior_point(scaled.qp)
    yield scaled.recover(start)
    yield from map(scaled.recover, polish(scaled.qp, start))


def _smooth_candidates(qp: QP, delta: float) -> Iterator[Solution]:
    """Yield the interior-point solution for bounds and discs, then its refinement."""
    scaled = equilibrate(qp)
    start = interior_point(scaled.qp, delta)
    yield scaled.recover(start)
    yield scaled.recover(refine(scaled.qp, start))


def _projection_candidates(qp: QP, residual: Residual) -> Iterator[Solution]:
    """Yield points of a QP over arbitrary sets until the residual is small.

    The QP is scaled if its sets consist of blocks: with a single penalty for all
    variables, the method does not converge if their curvatures differ by a factor of
    1e7.
    """
    has_blocks = all(isinstance(one, Blocks) for one in qp.sets[1:])
    scaled = equilibrate(qp) if has_blocks else None
    residuals = list[float]()
    for iterate in projection_iterates(scaled.qp if scaled else qp):
        yield (point := scaled.recover(iterate) if scaled else iterate)
        residuals.append(_extended(residual, qp, point))
        best = int(np.argmin(residuals))
        is_settled = best < len(residuals) - MAX_IDLE_ROUNDS
        if residuals[best] <= (MAX_REFERENCE_RESIDUAL if is_settled else MAX_RESIDUAL):
            return


def _candidates_without_outliers(qp: QP) -> Iterator[Solution]:
    """Yield points refined from a starting point that is computed without outliers."""
    scaled = equilibrate(qp)
    near = scaled.qp.h < _outlier_size(scaled.qp)
    tame = equilibrate(_without_outliers(scaled.qp, near))
    start = tame.recover(interior_point(tame.qp))
    z = np.zeros(near.size)
    z[near] = start.z
    start = replace(start, z=z)
    yield scaled.recover(start)
    yield from map(scaled.recover, polish(scaled.qp, start))


def _less_regularised_candidates(qp: QP) -> Iterator[Solution]:
    """Yield points that were refined with a smaller δ.

    If P has weak curvature or rows are nearly parallel, a smaller δ is necessary.
    """
    scaled = equilibrate(qp)
    start = interior_point(scaled.qp)
    for delta in (1e-13, 1e-16):
        yield from map(scaled.recover, polish(scaled.qp, start, delta))


def _outlier_size(qp: QP) -> float:
    """Return the absolute value above which data of a scaled QP count as outliers."""
    data = np.concatenate([qp.q, qp.b, qp.h, qp.lb, qp.ub])
    sizes = np.abs(data[np.isfinite(data) & (data != 0)])
    return OUTLIER_FACTOR * float(np.median(sizes)) if sizes.size else np.inf


def _without_outliers(qp: QP, near: NDArray[np.bool_]) -> QP:
    """Return a scaled QP without outliers, from which a starting point is computed.

    Bounds and rows with outliers are omitted, on the assumption that they are inactive.
    Outliers among the coefficients of the objective are clipped, on the assumption that
    their variables are at a bound. The residual of the original QP shows whether both
    assumptions are true.

    near : (p,) mask of the rows to keep
    """
    most = _outlier_size(qp)
    tamed = replace(qp, q=np.clip(qp.q, -most, most), G=qp.G[near], h=qp.h[near])
    return tamed.with_bounds(
        np.where(qp.lb < -most, -np.inf, qp.lb), np.where(qp.ub > most, np.inf, qp.ub)
    )


def _is_nonnegative(qp: QP) -> bool:
    """Return True if P is dense and the only constraints are x ≥ lb with finite lb.

    A QP without variables is excluded, because scipy's nnls (1.17.1) crashes for n = 0.
    """
    only = not qp.b.size and not qp.h.size and np.isinf(qp.ub).all()
    lower = qp.q.size > 0 and np.isfinite(qp.lb).all()
    return bool(isinstance(qp.P, np.ndarray) and only and lower)


def _nonnegative(qp: QP) -> Solution:
    """Minimise ½xᵀPx + qᵀx over x ≥ lb by nonnegative least squares."""
    # imported here because the import is slow and workers do not need nnls
    from scipy.optimize import nnls

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
        status=Status.SOLVED,
        x=qp.lb + np.maximum(y, 0),
        y=np.zeros(0),
        z=np.zeros(0),
        z_box=np.where(free, 0.0, -gradient),
    )
