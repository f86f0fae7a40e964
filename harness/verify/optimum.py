"""The proven optimum of a small QP, which decides where residuals cannot.

Residuals bound the error of the objective only through quantities that they do not
know: how far the solution is, and how large the true multipliers are. A reference solve
that is none of the solvers under test gives a point x̂ with multipliers λ̂ ≥ 0; it is
believed no more than they are. With r̂ = Px̂ + q + Aᵀŷ + Gᵀẑ + ẑ_box and the Lagrangian
L, convexity gives for the solution x*

    f(x*) ≥ L(x̂, λ̂) − Σ|r̂ᵢ||x*ᵢ − x̂ᵢ|,

evaluated in extended precision. From above, f* is at most f(x̃) = L(x̃, λ̂) for the
point x̃ that meets the active rows exactly, off x̂ by rounding; L(x̃, λ̂) − L(x̂, λ̂) is
r̂ᵀ(x̃ − x̂) and a square of rounding. So L(x̂, λ̂) is f* up to the sum above. What is
taken on trust: the bound of |x*ᵢ − x̂ᵢ| (`FAR`), and that x̃ is as near as that.

Where the sum tells too little, since the objective cancels, the KKT equations of the
rows that carry a multiplier are solved in rational arithmetic. If that point satisfies
all KKT conditions, without any rounding, its value is f*, and nothing is on trust.
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
from mortarbench.harness.sets import Box
from mortarbench.harness.solution import Solution, Status
from mortarbench.harness.verify.kkt import (
    EXCUSED,
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

LARGEST = 400  #: coupled variables, and rows, of a QP that is cheap to solve once more
MOST_APART = 4000  #: variables, the others coupled to none
MULTIPLIED = 800  #: variables and rows of a QP whose operator P is multiplied out
CLOSE = 1e-14  #: KKT residual, beyond rounding, of a point that may be an optimum
FAR = 2.0  #: lengths over which the energy changes by all of it: x*ⱼ is no further
EPS = float(np.finfo(float).eps)
SPARED = 10.0  #: the objective adds up what residuals say of single rows
MOST = 0.5  #: of the terms of f*: a larger error is not verified at any tolerance
SMALLEST = 500.0  #: terms may exceed f* by so much before f* counts alone
NEEDLESS = 1e4  #: an optimum whose terms exceed another's by so much tells no rounding
STEPS = 20  #: of active sets, to find an optimum that no reference finds
RATIONAL = 40  #: unknowns of equations that are solved in rational arithmetic


@dataclass(frozen=True, eq=False, kw_only=True)
class Optimum:
    """The optimal value of a QP, and what errors against it are compared with."""

    qp: QP  #: what it is the optimum of, with P as a matrix
    value: float  #: f*
    doubt: float  #: by how much f* may be off, with the rounding of a right answer
    energy: float  #: scale of errors of the objective
    terms: float  #: of f* itself, and what the least variable alone is worth
    x: Vector  #: (n,) sizes of the variables
    own: Vector  #: (n,) the same without any energy, see `own_sizes`


Proves = Callable[[QP], Optimum | None]


def decided(
    qp: QP,
    s: Solution,
    residuals: Residuals,
    tol: float,
    prove: Proves,
) -> float | None:
    """Measure a point against the proven optimum; None where residuals decide.

    They do where they exceed 10·tol even against the most generous scales, where the QP
    is large or its P an operator, or where nothing could be proven.

    prove : finds the optimum, see `proves`

    Returns
    -------
    the larger of |f(x) − f*| and of the violation, relative to the scales of the
    optimum; the first to 10 times the smaller of its terms and 500·|f*|. Where it
    exceeds half of the terms that f* itself is the sum of, relative to these

    """
    if not is_small(qp):
        return None
    most = allowed(tol)
    if not qp.is_explicit:  # which knows no rounding of its products
        found = prove(qp)
        if found is None:
            return None
        qp = found.qp
        residuals = kkt_residuals(qp, s)
    if not (
        residuals.worst <= most or kkt_residuals(qp, s, generous=True).worst <= most
    ):
        return None
    found = prove(qp)
    return None if found is None else error_at(s, found)


def is_small(qp: QP) -> bool:
    """Return True if a QP is cheap to solve once more, or its P to multiply out."""
    n, rows = qp.q.size, qp.b.size + qp.h.size
    if not qp.is_explicit:
        return n + rows <= MULTIPLIED
    if n > MOST_APART:
        return False
    return n + rows <= LARGEST or int(coupled(qp).sum()) + rows <= LARGEST


def coupled(qp: QP) -> NDArray[np.bool_]:
    """Mark the variables (n,) that P, a matrix, couples to others, or a row holds."""
    found = np.zeros(qp.q.size, dtype=bool)
    P = coo_array(qp.P)
    for j in (P.row, P.col):
        found[j[(P.row != P.col) & (P.data != 0)]] = True
    for M in (qp.A, qp.G):
        rows = coo_array(M)
        found[rows.col[rows.data != 0]] = True
    return found


@np.errstate(all="ignore")
def error_at(s: Solution, optimum: Optimum) -> float:
    """Compare a point with the optimum; see `decided`."""
    qp, x = optimum.qp, s.x.astype(np.longdouble)
    off = abs(float(_objective(qp, x) - np.longdouble(optimum.value))) - optimum.doubt
    scale = optimum.energy if off <= MOST * optimum.terms else optimum.terms
    return max(
        max(off, 0.0) / scale,
        violation(qp, s.x, optimum.x, np.minimum(own_sizes(qp, s.x), optimum.own)),
    )


def proven_optimum(qp: QP, solve: Reference) -> Optimum | None:
    """Solve a QP by the reference, and prove its optimal value; None if that fails.

    And where it turns out, once an operator P is multiplied out, that it is not small.
    """
    if not qp.is_explicit:
        qp = replace(qp, P=assembled(qp.P))
    return _proven(qp, solve) if is_small(qp) else None


@np.errstate(all="ignore")  # a reference may overflow: it proves nothing then
def _proven(qp: QP, solve: Reference) -> Optimum | None:
    s = _reference_point(qp, solve)
    if s is None:
        anew = exact_optimum_anew(qp)
        if anew is None:
            return None
        s = anew.solution
    f = _objective(qp, s.x)
    bound = np.where(s.z_box < 0, qp.lb, qp.ub)
    pulls = s.z_box[s.z_box != 0] * (s.x - bound)[s.z_box != 0]
    value = f + s.y @ (qp.A @ s.x - qp.b) + s.z @ (qp.G @ s.x - qp.h) + pulls.sum()
    r = np.abs(qp.P @ s.x + qp.q + qp.A.T @ s.y + qp.G.T @ s.z + s.z_box)
    terms = energy_at(qp, s, generous=True)
    X = scales_at(qp, s.x.astype(float), terms).x
    lb, ub = tightened(qp)
    doubt = float(r @ np.minimum(np.maximum(ub - lb, 0), FAR * X))
    size = _size(qp, s)
    if not EPS * size <= EXCUSED * abs(value):
        size = min(size, _size(qp, _least_multipliers(qp, s)))
    if not doubt + EPS * size <= EXCUSED * abs(value):
        exact = exact_optimum(qp, s)
        if exact is not None:
            value, doubt = np.longdouble(exact.value), 0.0
            shorter = _size(qp, exact.solution)
            if shorter < size / NEEDLESS:
                s, size = exact.solution, shorter
    # f* cannot be told more accurately than rounding x moves f
    told = max(abs(float(value)), (doubt + EPS * size) / EXCUSED)
    work = float(max(abs(s.x @ (qp.P @ s.x)), np.abs(qp.q) @ np.abs(s.x)))
    if abs(value) > ROUNDING * terms + doubt:
        known = min(terms, SMALLEST * told, work)
    else:
        known = told = terms
    rounding = min(ROUNDING * size, EXCUSED * told)
    if not (known > 0 and doubt <= EXCUSED * known):  # f* = 0 of nothing has no scale
        return None
    return Optimum(
        qp=qp, value=float(value), doubt=doubt + rounding, energy=SPARED * known,
        terms=max(energy_at(qp, s), work),
        x=scales_at(qp, s.x.astype(float), known).x,
        own=own_sizes(qp, s.x.astype(float)),
    )  # fmt: skip


def _reference_point(qp: QP, solve: Reference) -> Solution | None:
    """Solve by the reference; None where that is no optimum to the last digits."""
    try:
        found = solve(qp)
    except (ArithmeticError, ValueError, np.linalg.LinAlgError):
        return None
    s = replace(
        found,
        x=found.x.astype(np.longdouble), y=found.y.astype(np.longdouble),
        z=np.maximum(found.z, 0).astype(np.longdouble),
        z_box=np.where(found.z_box < 0, np.where(np.isfinite(qp.lb), found.z_box, 0),
                       np.where(np.isfinite(qp.ub), found.z_box, 0)
                       ).astype(np.longdouble),
    )  # fmt: skip
    return s if kkt_residuals(qp, s, generous=True).worst <= CLOSE else None


class ExactOptimum(NamedTuple):
    """An optimum known without rounding."""

    value: Fraction  #: f*
    solution: Solution  #: rounded to double precision


def exact_optimum(qp: QP, s: Solution) -> ExactOptimum | None:
    """Find an optimum in rational arithmetic; None where none is proven.

    The rows that carry a multiplier in `s` are taken as equations. What these leave
    open is zero; where that is no optimum, multipliers are near the least ones
    (`_least_multipliers`), and where that is none, all is as in `s`. The point that
    solves them has to satisfy the KKT conditions of all rows exactly.
    """
    if qp.q.size > RATIONAL and not (held := coupled(qp)).all():
        return _with_others(qp, s, held)
    for point in _exact_points(qp, s):
        if not any(fault.any() for fault in _faults(qp, point)):
            return _exact(qp, s, point)
    return None


def exact_optimum_anew(qp: QP) -> ExactOptimum | None:
    """Find an optimum in rational arithmetic without any guess; None where it is not.

    By primal-dual active-set steps: rows with multipliers of the wrong sign are left
    out, violated ones are taken in, `STEPS` times at most.
    """
    s = Solution.without_point(qp, Status.FAILED)
    s = replace(s, x=0 * qp.q, y=0 * qp.b, z=0 * qp.h, z_box=0 * qp.q)
    for _ in range(STEPS):
        point = next(_exact_points(qp, s), None)
        if point is None:
            return None
        over, under, above, pulling, wrong = _faults(qp, point)
        if not any(fault.any() for fault in (over, under, above, pulling, wrong)):
            return _exact(qp, s, point)
        z_box = np.where(wrong, 0, s.z_box)
        s = replace(
            s, z=np.where(over, 1, np.where(pulling, 0, s.z)),
            z_box=np.where(under, -1, np.where(above, 1, z_box)),
        )  # fmt: skip
    return None


class _ExactPoint(NamedTuple):
    """A point in fractions."""

    x: Any  #: (n,)
    y: Any  #: (m,)
    z: Any  #: (p,)
    z_box: Any  #: (n,)


def _exact_points(qp: QP, s: Solution) -> Iterator[_ExactPoint]:
    """Solve the KKT equations of the rows that carry a multiplier, from three guesses.

    Of what they leave open: zero; the least multipliers; all as in `s`.
    """
    lower = (s.z_box < 0) & np.isfinite(qp.lb)
    upper = (s.z_box > 0) & np.isfinite(qp.ub)
    n, pressed, held = qp.q.size, s.z > 0, lower | upper
    B = np.vstack([_dense(qp.A), _dense(qp.G)[pressed], np.eye(n)[held]])
    if n + len(B) > RATIONAL:
        return
    c = np.concatenate([qp.b, qp.h[pressed], np.where(lower, qp.lb, qp.ub)[held]])
    equations = np.block([[_dense(qp.P), B.T], [B, np.zeros((len(B), len(B)))]])
    solve = solutions(rational(equations), rational(np.concatenate([-qp.q, c])))
    if solve is None:
        return
    least = _least_multipliers(qp, s)
    for x, multipliers in ((0 * s.x, None), (0 * s.x, least), (s.x, s)):
        guess = np.zeros(n + len(B))
        guess[:n] = x
        if multipliers is not None:
            guess[n:] = np.concatenate([
                multipliers.y, multipliers.z[pressed], multipliers.z_box[held]
            ])  # fmt: skip
        at = np.cumsum([n, qp.b.size, int(pressed.sum())])
        found, y, z_pressed, z_held = np.split(solve(rational(guess)), at)
        z, z_box = rational(0 * qp.h), rational(0 * qp.q)
        z[pressed], z_box[held] = z_pressed, z_held
        yield _ExactPoint(found, y, z, z_box)


def _faults(qp: QP, point: _ExactPoint) -> tuple[NDArray[np.bool_], ...]:
    """Mark where a point breaks the KKT conditions that its equations leave open.

    Gx > h (p,), x < lb (n,), x > ub (n,), z < 0 (p,), and z_box (n,) that pushes where
    no bound is, or at the other one.
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
        s, x=x.astype(float), y=point.y.astype(float), z=point.z.astype(float),
        z_box=point.z_box.astype(float),
    )  # fmt: skip
    return ExactOptimum(x @ (P @ x) / 2 + q @ x, rounded)


def _with_others(qp: QP, s: Solution, held: NDArray[np.bool_]) -> ExactOptimum | None:
    """Find the exact optimum of the coupled variables, and of each other one alone."""
    P = csr_array(qp.P)
    part = replace(
        qp, P=P[held][:, held], q=qp.q[held], A=csr_array(qp.A)[:, held],
        G=csr_array(qp.G)[:, held], sets=(Box(qp.lb[held], qp.ub[held]),),
    )  # fmt: skip
    found = exact_optimum(part, replace(s, x=s.x[held], z_box=s.z_box[held]))
    if found is None:
        return None
    value, x, z_box = found.value, 0.0 * qp.q, 0.0 * qp.q
    x[held], z_box[held] = found.solution.x, found.solution.z_box
    bends = P.diagonal()
    for j in np.flatnonzero(~held):
        d, q = Fraction(bends[j]), Fraction(qp.q[j])
        free: Fraction | float = Fraction(0)
        if q != 0:
            free = -q / d if d > 0 else -copysign(inf, q)
        least = min(max(free, qp.lb[j]), qp.ub[j])
        if isinf(least):
            return None
        best = Fraction(least)
        value += d / 2 * best**2 + q * best
        x[j], z_box[j] = float(best), -float(d * best + q)
    return ExactOptimum(value, replace(found.solution, x=x, z_box=z_box))


def _dense(M: Any) -> Any:
    return M.toarray() if hasattr(M, "toarray") else M


def proves(solve: Reference) -> Proves:
    """Prove the optimum of every QP, told by identity, only once."""
    known: dict[int, tuple[QP, Optimum | None]] = {}

    def once(qp: QP) -> Optimum | None:
        if id(qp) not in known:  # the QP is kept, or another could get its id
            known[id(qp)] = qp, proven_optimum(qp, solve)
        return known[id(qp)][1]

    return once


def _objective(qp: QP, x: Any) -> np.longdouble:
    return np.longdouble(x @ (qp.P @ x) / 2 + qp.q @ x)


def _least_multipliers(qp: QP, s: Solution) -> Solution:
    """Give the multipliers that do the least work, where several balance the gradient.

    Those of rows that carry one in `s`, with the least sum of squares of λᵢ times the
    terms of row i; rows whose sign that would turn carry none. As they were, where
    nothing is left that balances.
    """
    x, is_fixed = np.abs(s.x).astype(float), qp.lb == qp.ub
    pressed, held = s.z > 0, (s.z_box != 0) | is_fixed
    B = np.vstack([_dense(qp.A), _dense(qp.G)[pressed], np.eye(x.size)[held]])
    c = np.concatenate([qp.b, qp.h[pressed], x[held]])
    sign = np.where(is_fixed, 0, np.sign(s.z_box.astype(float)))[held]
    sign = np.concatenate([np.zeros(qp.b.size), np.ones(int(pressed.sum())), sign])
    weight = np.abs(B) @ x + np.abs(c)
    weight = np.where(weight > 0, weight, 1.0)
    gradient = (qp.P @ s.x + qp.q).astype(float)
    found, on = np.zeros(sign.size), np.ones(sign.size, dtype=bool)
    for _ in range(sign.size + 1):
        scaled = (B[on] / weight[on, None]).T
        found[:] = 0
        found[on] = np.linalg.lstsq(scaled, -gradient, rcond=1e-12)[0] / weight[on]
        turned = on & (found * sign < 0)
        if not turned.any():
            break
        on &= ~turned
    left = np.abs(gradient + B.T @ found)
    if not (left <= 1e-6 * (np.abs(gradient) + np.abs(B).T @ np.abs(found))).all():
        return s
    y, z_pressed, z_held = np.split(found, np.cumsum([qp.b.size, int(pressed.sum())]))
    z, z_box = np.zeros(s.z.size), np.zeros(s.z_box.size)
    z[pressed], z_box[held] = z_pressed, z_held
    return replace(s, y=y, z=z, z_box=z_box)


def _size(qp: QP, s: Solution) -> float:
    """Add up what rounding of x to double precision moves: f itself, and λᵀ(Bx − c)."""
    x = np.abs(s.x)
    rows = ((qp.A, qp.b, s.y), (qp.G, qp.h, s.z))
    held = sum(np.abs(m) @ (abs(M) @ x + np.abs(c)) for M, c, m in rows if c.size)
    total = x @ np.abs(qp.P @ s.x) + np.abs(qp.q) @ x + held + 2 * np.abs(s.z_box) @ x
    return float(total)
