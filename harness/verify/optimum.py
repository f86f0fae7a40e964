"""Proof of the optimal value of a small QP, for verdicts that residuals do not decide.

Residuals bound the error of the objective f only through two unknown quantities: the
distance from the solution, and the size of the true multipliers. A reference solver,
which is not under test, returns a point x̂ with multipliers λ̂ = (ŷ, ẑ, ẑ_box), ẑ ≥ 0.
This point is not trusted either. With r̂ = Px̂ + q + Aᵀŷ + Gᵀẑ + ẑ_box and the
Lagrangian L, convexity implies for the solution x* and the optimal value f* = f(x*)

    f* ≥ L(x̂, λ̂) − Σ|r̂ᵢ||x*ᵢ − x̂ᵢ|,

where L is evaluated in extended precision. Conversely, f* ≤ f(x̃) = L(x̃, λ̂) for a
point x̃ that satisfies the active rows exactly and differs from x̂ by rounding. The
difference L(x̃, λ̂) − L(x̂, λ̂) is r̂ᵀ(x̃ − x̂) plus a term quadratic in the rounding.
Hence L(x̂, λ̂) equals f* up to the sum in the inequality. Two assumptions are not
proven: |x*ᵢ − x̂ᵢ| and |x̃ᵢ − x̂ᵢ| do not exceed the bound given by `MAX_DISTANCE`.

If the terms of the objective cancel, the sum may leave f* too uncertain. In this case,
the KKT equations of the rows with a nonzero multiplier are solved in rational
arithmetic. If the result satisfies all KKT conditions exactly, its objective is f*,
without any assumption.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from math import copysign, inf, isinf
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array

from mortarbench.harness.operators import assembled
from mortarbench.harness.plugin import Reference
from mortarbench.harness.qp import QP, Vector
from mortarbench.harness.sets.box import Box
from mortarbench.harness.sets.convex import admissible
from mortarbench.harness.solution import Solution, Status
from mortarbench.harness.verify.kkt import (
    NEGLIGIBLE,
    ROUNDING,
    Residuals,
    allowed,
    energy_at,
    kkt_residuals,
    own_sizes,
    scales_at,
    tightened,
    violation,
)
from mortarbench.harness.verify.rational import rational, solutions
from mortarbench.harness.verify.scales import MAX_CANCELLATION, TERMS_FACTOR

#: Largest number of coupled variables and rows of a QP that is passed to the reference
#: solver, whose dense solve may take several times as long as the solve under test.
MAX_COUPLED = 400
#: Largest number of variables of a QP that is passed to the reference solver; an
#: uncoupled variable costs one division.
MAX_VARIABLES = 4000
#: Largest number of variables and rows of a QP whose operator P is assembled, which
#: takes one product per variable.
MAX_ASSEMBLED = 800
#: Largest number of unknowns of equations that are solved in rational arithmetic; the
#: cost grows faster than the cube of this number.
MAX_RATIONAL = 40
#: Assumed largest distance of x*ⱼ from x̂ⱼ, in units of the size Xⱼ (`scales_at`), at
#: least the length over which the energy changes by E. At a distance of √2 such lengths
#: from its minimum, the quadratic term alone has grown by E. With 0 and with infinity,
#: `test_multipliers_that_cancel_prove_nothing_in_any_unit_of_energy` fails.
MAX_DISTANCE = 2.0
EPS = float(np.finfo(float).eps)
#: Largest KKT residual, beyond rounding, with which a reference point is accepted. The
#: reference solver does not attain smaller residuals. With 1e-8,
#: `test_residuals_refute_no_point_between_nearly_parallel_rows` fails.
MAX_RESIDUAL = 1e-14


@dataclass(frozen=True, eq=False, kw_only=True)
class Optimum:
    """Optimal value of a QP, and the scales by which errors are divided."""

    qp: QP  #: QP that was solved, in which P is a matrix
    value: float  #: f*
    #: bound on the error of f*, plus the rounding of f at an exact solution
    doubt: float
    energy: float  #: scale of errors of the objective
    x: Vector  #: (n,) sizes of the variables
    own: Vector  #: (n,) sizes that do not depend on energies, see `own_sizes`


#: Function that returns the proven optimum of a QP, or None if the proof fails.
Proves = Callable[[QP], Optimum | None]


def decided(
    qp: QP,
    s: Solution,
    residuals: Residuals,
    tol: float,
    prove: Proves,
) -> float | None:
    """Return the error of a point relative to the optimum; None if residuals decide.

    Residuals decide if they exceed 10·tol even with the most generous scales, if the QP
    is large, or if no optimum could be proven.

    prove : returns the optimum; see `proves`

    Returns
    -------
    the larger of the error |f(x) − f*|, reduced by the doubt about f*, and the
    violation of the constraints, both relative to the scales of the optimum. Unless f*
    is zero up to rounding, the scale of the error is 10 times the smallest of 500·|f*|
    (more if f* is uncertain), max(|xᵀPx|, Σ|qᵢxᵢ|) at the optimum, and the generous
    scale of energy (`harness.verify.kkt.energy_at`)

    """
    if not is_small(qp):
        return None
    most = allowed(tol)
    if not qp.is_explicit:  # the rounding of products with P is unknown
        optimum = prove(qp)
        if optimum is None:
            return None
        qp = optimum.qp
        residuals = kkt_residuals(qp, s)
    if not (
        residuals.worst <= most or kkt_residuals(qp, s, generous=True).worst <= most
    ):
        return None
    optimum = prove(qp)
    return None if optimum is None else error_at(s, optimum)


def is_small(qp: QP) -> bool:
    """Return True if a reference solve, or the assembly of an operator P, is cheap."""
    n, rows = qp.q.size, qp.b.size + qp.h.size
    if not qp.is_explicit:
        return n + rows <= MAX_ASSEMBLED
    if n > MAX_VARIABLES:
        return False
    return n + rows <= MAX_COUPLED or int(coupled(qp).sum()) + rows <= MAX_COUPLED


def coupled(qp: QP) -> NDArray[np.bool_]:
    """Return a mask (n,) of the coupled variables.

    A variable is coupled if it occurs in an off-diagonal entry of P, in a row, or in a
    set other than bounds.
    """
    is_coupled = np.zeros(qp.q.size, dtype=bool)
    for one in qp.sets[1:]:
        is_coupled[one.block] = True
    P = coo_array(qp.P)
    for j in (P.row, P.col):
        is_coupled[j[(P.row != P.col) & (P.data != 0)]] = True
    for M in (qp.A, qp.G):
        rows = coo_array(M)
        is_coupled[rows.col[rows.data != 0]] = True
    return is_coupled


@np.errstate(all="ignore")
def error_at(s: Solution, optimum: Optimum) -> float:
    """Return the error of a point relative to an optimum; see `decided`."""
    qp, x = optimum.qp, s.x.astype(np.longdouble)
    off = abs(float(_objective(qp, x) - np.longdouble(optimum.value))) - optimum.doubt
    return max(
        max(off, 0.0) / optimum.energy,
        violation(qp, s.x, optimum.x, np.minimum(own_sizes(qp, s.x), optimum.own)),
    )


def proven_optimum(qp: QP, solve: Reference) -> Optimum | None:
    """Solve a QP with the reference solver and prove its optimum; None on failure.

    An operator P is assembled first; the result is None if the QP is not small.
    """
    if not qp.is_explicit:
        qp = replace(qp, P=assembled(qp.P))
    return _proven(qp, solve) if is_small(qp) else None


@np.errstate(all="ignore")  # a reference that overflows proves nothing
def _proven(qp: QP, solve: Reference) -> Optimum | None:
    s = _reference_point(qp, solve)
    if s is None:
        exact = exact_optimum_without_guess(qp)
        if exact is None:
            return None
        s = exact.solution
    f = _objective(qp, s.x)
    gaps = sum(
        gap.value.sum()
        for one in qp.sets
        for gap in one.support_gaps(s.x, s.z_box, one.limits(s.x))
    )
    value = f + s.y @ (qp.A @ s.x - qp.b) + s.z @ (qp.G @ s.x - qp.h) - gaps
    r = np.abs(qp.P @ s.x + qp.q + qp.A.T @ s.y + qp.G.T @ s.z + s.z_box)
    generous = energy_at(qp, s, generous=True)
    X = scales_at(qp, s.x.astype(float), generous).x
    lb, ub = tightened(qp)
    doubt = float(r @ np.minimum(np.maximum(ub - lb, 0), MAX_DISTANCE * X))
    size = _size(qp, s)
    if not EPS * size <= NEGLIGIBLE * abs(value):
        size = min(size, _size(qp, _least_multipliers(qp, s)))
    if not doubt + EPS * size <= NEGLIGIBLE * abs(value):
        exact = exact_optimum(qp, s)
        if exact is not None:
            value, doubt, s = np.longdouble(exact.value), 0.0, exact.solution
            size = min(size, _size(qp, s))
    # rounding of x changes f by EPS·size, which limits the accuracy of f*
    magnitude = max(abs(float(value)), (doubt + EPS * size) / NEGLIGIBLE)
    work = float(max(abs(s.x @ (qp.P @ s.x)), np.abs(qp.q) @ np.abs(s.x)))
    least = energy_at(qp, s)
    if abs(value) > ROUNDING * max(work, least) + doubt:
        # an error of 100·tol times this scale is half of the error that `kkt_residuals`
        # allows
        scale = min(generous, MAX_CANCELLATION / (2 * TERMS_FACTOR) * magnitude, work)
    elif work > NEGLIGIBLE * least:  # f* is zero up to rounding
        scale = magnitude = work
    else:  # x* is zero up to rounding
        scale = magnitude = generous
    rounding = min(ROUNDING * size, NEGLIGIBLE * magnitude)
    if not (
        scale > 0 and doubt <= NEGLIGIBLE * scale
    ):  # the scale is 0 if all terms vanish
        return None
    return Optimum(
        qp=qp,
        value=float(value),
        doubt=doubt + rounding,
        energy=TERMS_FACTOR * scale,
        x=scales_at(qp, s.x.astype(float), scale).x,
        own=own_sizes(qp, s.x.astype(float)),
    )


def _reference_point(qp: QP, solve: Reference) -> Solution | None:
    """Return the reference solution if it is optimal up to rounding, else None."""
    try:
        point = solve(qp)
    except (ArithmeticError, ValueError, np.linalg.LinAlgError):
        return None
    s = replace(
        point,
        x=point.x.astype(np.longdouble),
        y=point.y.astype(np.longdouble),
        z=np.maximum(point.z, 0).astype(np.longdouble),
        z_box=admissible(qp.sets, point.z_box).astype(np.longdouble),
    )
    return s if kkt_residuals(qp, s, generous=True).worst <= MAX_RESIDUAL else None


class ExactOptimum(NamedTuple):
    """Optimum computed in rational arithmetic."""

    value: Fraction  #: f*
    solution: Solution  #: solution, rounded to double precision


def exact_optimum(qp: QP, s: Solution) -> ExactOptimum | None:
    """Compute an optimum in rational arithmetic; return None if the proof fails.

    Sets other than bounds are not treated, since their optima are rarely rational.

    The rows and bounds with a nonzero multiplier in `s` become equations. Unknowns that
    the KKT equations leave undetermined are set to zero. If the result is not optimal,
    undetermined multipliers are set to the least multipliers
    (`_least_multipliers`). If this result is not optimal either, undetermined unknowns
    are set to the values of `s`. The result must satisfy the KKT conditions of all rows
    and bounds exactly.
    """
    if len(qp.sets) > 1:
        return None
    if qp.q.size > MAX_RATIONAL and not (is_coupled := coupled(qp)).all():
        return _with_others(qp, s, is_coupled)
    for point in _exact_points(qp, s):
        if not any(fault.any() for fault in _faults(qp, point)):
            return _exact(qp, s, point)
    return None


def exact_optimum_without_guess(qp: QP) -> ExactOptimum | None:
    """Compute an optimum in rational arithmetic by primal-dual active-set steps.

    Rows with multipliers of the wrong sign leave the active set, and violated rows
    enter it. The result is None if an active set recurs, since the iteration would
    cycle, if the equations of an active set have no solution or more than
    `MAX_RATIONAL` unknowns, or if the QP has sets other than bounds.
    """
    if len(qp.sets) > 1:
        return None
    s = Solution.without_point(qp, Status.FAILED)
    s = replace(s, x=0 * qp.q, y=0 * qp.b, z=0 * qp.h, z_box=0 * qp.q)
    visited = set[bytes]()
    while (state := np.append(s.z, s.z_box).tobytes()) not in visited:
        visited.add(state)
        point = next(_exact_points(qp, s), None)
        if point is None:
            return None
        over, under, above, pulling, wrong = _faults(qp, point)
        if not any(fault.any() for fault in (over, under, above, pulling, wrong)):
            return _exact(qp, s, point)
        z_box = np.where(wrong, 0.0, s.z_box)
        s = replace(
            s,
            z=np.where(over, 1.0, np.where(pulling, 0.0, s.z)),
            z_box=np.where(under, -1.0, np.where(above, 1.0, z_box)),
        )
    return None


class _ExactPoint(NamedTuple):
    """A primal-dual point in fractions."""

    x: Any  #: (n,) primal variables
    y: Any  #: (m,) multipliers of equality rows
    z: Any  #: (p,) multipliers of inequality rows
    z_box: Any  #: (n,) multipliers of bounds


def _exact_points(qp: QP, s: Solution) -> Iterator[_ExactPoint]:
    """Yield solutions of the KKT equations of rows with a nonzero multiplier.

    In three solutions, undetermined multipliers are zero, equal to the least
    multipliers, and equal to the multipliers of `s`; undetermined variables are zero,
    zero, and equal to x of `s`. Nothing is yielded if the equations have no solution or
    more than `MAX_RATIONAL` unknowns.
    """
    lower = (s.z_box < 0) & np.isfinite(qp.lb)
    upper = (s.z_box > 0) & np.isfinite(qp.ub)
    n, pressed, at_bound = qp.q.size, s.z > 0, lower | upper
    if n + qp.b.size + int(pressed.sum() + at_bound.sum()) > MAX_RATIONAL:
        return
    B = np.vstack([_dense(qp.A), _dense(qp.G)[pressed], np.eye(n)[at_bound]])
    bounds = np.where(lower, qp.lb, qp.ub)[at_bound]
    c = np.concatenate([qp.b, qp.h[pressed], bounds])
    equations = np.block([[_dense(qp.P), B.T], [B, np.zeros((len(B), len(B)))]])
    solve = solutions(rational(equations), rational(np.concatenate([-qp.q, c])))
    if solve is None:
        return
    least = _least_multipliers(qp, s)
    for x, multipliers in ((0 * s.x, None), (0 * s.x, least), (s.x, s)):
        guess = np.zeros(n + len(B))
        guess[:n] = x
        if multipliers is not None:
            guess[n:] = np.concatenate(
                [multipliers.y, multipliers.z[pressed], multipliers.z_box[at_bound]]
            )
        at = np.cumsum([n, qp.b.size, int(pressed.sum())])
        exact_x, y, z_pressed, z_bound = np.split(solve(rational(guess)), at)
        z, z_box = rational(0 * qp.h), rational(0 * qp.q)
        z[pressed], z_box[at_bound] = z_pressed, z_bound
        yield _ExactPoint(exact_x, y, z, z_box)


def _faults(qp: QP, point: _ExactPoint) -> tuple[NDArray[np.bool_], ...]:
    """Return masks of violated KKT conditions at a solution of the KKT equations.

    The masks are Gx > h (p,), x < lb (n,), x > ub (n,), z < 0 (p,), and z_box ≠ 0 (n,)
    at a bound that is absent or inactive.
    """
    below, above = np.isfinite(qp.lb), np.isfinite(qp.ub)
    under, over = np.zeros(qp.q.size, dtype=bool), np.zeros(qp.q.size, dtype=bool)
    at_lb, at_ub = under.copy(), under.copy()
    x, lb, ub = point.x, rational(qp.lb[below]), rational(qp.ub[above])
    under[below], at_lb[below] = x[below] < lb, x[below] == lb
    over[above], at_ub[above] = x[above] > ub, x[above] == ub
    wrong = ((point.z_box < 0) & ~at_lb) | ((point.z_box > 0) & ~at_ub)
    rows = np.asarray(rational(_dense(qp.G)) @ x > rational(qp.h), dtype=bool)
    return rows, under, over, np.asarray(point.z < 0, dtype=bool), wrong.astype(bool)


def _exact(qp: QP, s: Solution, point: _ExactPoint) -> ExactOptimum:
    P, q, x = rational(_dense(qp.P)), rational(qp.q), point.x
    rounded = replace(
        s,
        x=x.astype(float),
        y=point.y.astype(float),
        z=point.z.astype(float),
        z_box=point.z_box.astype(float),
    )
    return ExactOptimum(x @ (P @ x) / 2 + q @ x, rounded)


def _with_others(
    qp: QP, s: Solution, is_coupled: NDArray[np.bool_]
) -> ExactOptimum | None:
    """Return the exact optimum, minimising over each uncoupled variable separately."""
    P = csr_array(qp.P)
    part = replace(
        qp,
        P=P[is_coupled][:, is_coupled],
        q=qp.q[is_coupled],
        A=csr_array(qp.A)[:, is_coupled],
        G=csr_array(qp.G)[:, is_coupled],
        sets=(Box(qp.lb[is_coupled], qp.ub[is_coupled]),),
    )
    s = replace(s, x=s.x[is_coupled], z_box=s.z_box[is_coupled])
    exact = exact_optimum(part, s)
    if exact is None:
        return None
    value, x, z_box = exact.value, 0.0 * qp.q, 0.0 * qp.q
    x[is_coupled], z_box[is_coupled] = exact.solution.x, exact.solution.z_box
    curvature = P.diagonal()
    for j in np.flatnonzero(~is_coupled):
        d, q = Fraction(curvature[j]), Fraction(qp.q[j])
        free: Fraction | float = Fraction(0)
        if q != 0:
            free = -q / d if d > 0 else -copysign(inf, q)
        least = min(max(free, qp.lb[j]), qp.ub[j])
        if isinf(least):
            return None
        best = Fraction(least)
        value += d / 2 * best**2 + q * best
        x[j], z_box[j] = float(best), -float(d * best + q)
    return ExactOptimum(value, replace(exact.solution, x=x, z_box=z_box))


def _dense(M: Any) -> Any:
    return M.toarray() if hasattr(M, "toarray") else M


def proves(solve: Reference) -> Proves:
    """Return a function that proves optima of QPs and caches them by `id(qp)`."""
    optima: dict[int, tuple[QP, Optimum | None]] = {}

    def once(qp: QP) -> Optimum | None:
        # the cache also stores the QP, so that its id is not reused
        if id(qp) not in optima:
            optima[id(qp)] = qp, proven_optimum(qp, solve)
        return optima[id(qp)][1]

    return once


def _objective(qp: QP, x: Any) -> np.longdouble:
    return np.longdouble(x @ (qp.P @ x) / 2 + qp.q @ x)


def _least_multipliers(qp: QP, s: Solution) -> Solution:
    """Return `s` with the smallest multipliers that balance the gradient.

    Equality rows, fixed variables, and rows and bounds with a nonzero multiplier in `s`
    receive multipliers λᵢ. These minimise Σ(λᵢtᵢ)², where tᵢ is the sum of the absolute
    terms of row i. A row is omitted if its multiplier would change sign. `s` is
    returned unchanged if the remaining rows do not balance the gradient up to a
    negligible part, or if the QP has sets other than bounds.
    """
    if len(qp.sets) > 1:
        return s
    x, is_fixed = np.abs(s.x).astype(float), qp.lb == qp.ub
    pressed, at_bound = s.z > 0, (s.z_box != 0) | is_fixed
    B = np.vstack([_dense(qp.A), _dense(qp.G)[pressed], np.eye(x.size)[at_bound]])
    c = np.concatenate([qp.b, qp.h[pressed], x[at_bound]])
    sign = np.where(is_fixed, 0, np.sign(s.z_box.astype(float)))[at_bound]
    sign = np.concatenate([np.zeros(qp.b.size), np.ones(int(pressed.sum())), sign])
    weight = np.abs(B) @ x + np.abs(c)
    weight = np.where(weight > 0, weight, 1.0)
    gradient = (qp.P @ s.x + qp.q).astype(float)
    least, on = np.zeros(sign.size), np.ones(sign.size, dtype=bool)
    for _ in range(sign.size + 1):
        scaled = (B[on] / weight[on, None]).T
        least[:] = 0
        least[on] = np.linalg.lstsq(scaled, -gradient, rcond=None)[0] / weight[on]
        turned = on & (least * sign < 0)
        if not turned.any():
            break
        on &= ~turned
    left = np.abs(gradient + B.T @ least)
    size = np.abs(gradient) + np.abs(B).T @ np.abs(least)
    if not (left <= NEGLIGIBLE * size).all():
        return s
    y, z_pressed, z_bound = np.split(least, np.cumsum([qp.b.size, int(pressed.sum())]))
    z, z_box = np.zeros(s.z.size), np.zeros(s.z_box.size)
    z[pressed], z_box[at_bound] = z_pressed, z_bound
    return replace(s, y=y, z=z, z_box=z_box)


def _size(qp: QP, s: Solution) -> float:
    """Sum the absolute terms of f and of λᵀ(Bx − c), to bound the rounding of both."""
    x = np.abs(s.x)
    rows = ((qp.A, qp.b, s.y), (qp.G, qp.h, s.z))
    work = sum(np.abs(m) @ (abs(M) @ x + np.abs(c)) for M, c, m in rows if c.size)
    total = x @ np.abs(qp.P @ s.x) + np.abs(qp.q) @ x + work + np.abs(s.z_box) @ x
    return float(total + sum(one.support(s.z_box).terms for one in qp.sets))
