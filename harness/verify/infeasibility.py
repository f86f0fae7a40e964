"""Certificates of infeasibility by Farkas' lemma, evaluated without rounding.

Multipliers y and z ≥ 0 of the rows Ax = b and Gx ≤ h, with c = Aᵀy + Gᵀz, prove that
no x satisfies both the rows and lb ≤ x ≤ ub if

    V = bᵀy + hᵀz − Σ min(cⱼlbⱼ, cⱼubⱼ) < 0,

since cᵀx ≤ bᵀy + hᵀz at every x that satisfies the rows. Such multipliers are called a
ray here, since their positive multiples are equivalent. In the convention of
`harness.qp`, z_box = −c. If cⱼ > 0 and lbⱼ is absent, or cⱼ < 0 and ubⱼ is absent, V is
infinite, however small cⱼ is. An approximate ray is therefore first corrected such that
cⱼ = 0 holds exactly for these j. The correction is computed in rational arithmetic, or
an enclosure is computed that provably contains an exact ray. V is then evaluated in
rational arithmetic from the doubles of the QP.

The margin of a ray is the ratio of −V to the sum of the absolute terms of V. The margin
does not depend on the units of rows and variables. Since right-hand sides are rounded
numbers, the margin of a proof must exceed `MIN_MARGIN`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array, eye_array, hstack, vstack

from mortarbench.harness.qp import QP, Vector
from mortarbench.harness.sets.box import Box
from mortarbench.harness.sets.convex import hull
from mortarbench.harness.solution import Solution
from mortarbench.harness.verify.rational import (
    nonnegative_solution,
    rational,
    rational_product,
    solutions,
)

#: Smallest margin of a proof. Redundant rows that are consistent before rounding may
#: contradict one another by a smaller margin if their right-hand sides are rounded sums
#: of thousands of terms.
MIN_MARGIN = 1e-12
#: Multipliers of scaled rows that are at most this fraction of the largest multiplier
#: are set to zero; the fractions are tried in turn. Iterative solvers return small
#: multipliers for rows that do not contribute to the proof.
CUTS = (0.0, 1e-9, 1e-6, 1e-3)
#: Largest |cⱼ| that counts as an approximation of 0, relative to the sum of its
#: absolute terms.
MAX_CANCELLED = 1e-3
#: Largest number of entries of A and G; for larger QPs no proof is attempted.
MAX_ENTRIES = 10**6
#: Largest number of pivots of an elimination in rational arithmetic (about 1 s).
MAX_PIVOTS = 40
#: Largest number of entries of a linear program in rational arithmetic; a program of
#: this size takes seconds.
MAX_TABLEAU = 1500
MAX_ENCLOSURE = 1500  #: largest number of rows and columns of an enclosure
#: Bounds larger than this multiple of the largest right-hand side (of the smallest
#: nonzero bound if all right-hand sides are zero) are omitted in the first search,
#: because the accuracy of the linear program does not suffice for costs of such
#: different magnitudes.
MAX_BOUND_RATIO = 1e6
LP_SECONDS = 20.0  #: time limit of each linear program in the search for a ray
EPS, TINY = float(np.finfo(float).eps), float(np.finfo(float).tiny)


class Ray(NamedTuple):
    """Multipliers of the rows [A; G] that may prove infeasibility."""

    rows: NDArray[np.int64]  #: (k,) indices of the rows with a nonzero multiplier
    centre: Any  #: (k,) approximate multipliers, as fractions
    radius: Any  #: (k,) bounds on |multipliers − centre|, as fractions
    #: (n,) mask of variables for which cⱼ = 0 holds exactly, by construction
    vanish: NDArray[np.bool_]


#: Cached margins from `_searched`, which do not depend on an answer; None if the
#: search found no proof.
_MARGINS: WeakKeyDictionary[QP, float | None] = WeakKeyDictionary()


@np.errstate(all="ignore")  # entries of 1e±300 overflow when rows are scaled
def infeasibility_margin(qp: QP, s: Solution) -> float | None:
    """Return the margin of a proof that `qp` is infeasible; None if none is found.

    The multipliers of `s`, which claims infeasibility, are tried first. If these
    multipliers do not yield a proof, a ray is searched for, once per QP object. Sets
    other than bounds are relaxed to their smallest enclosing box; if the relaxation is
    infeasible, the QP is infeasible.

    Returns
    -------
    the ratio of −V to the sum of the absolute terms of V if it exceeds `MIN_MARGIN`

    """
    claimed = np.concatenate([s.y, s.z])
    if not qp.b.size + qp.h.size:
        return None
    M = csr_array(vstack([csr_array(qp.A), csr_array(qp.G)]), dtype=float)
    if M.nnz > MAX_ENTRIES or not np.isfinite(M.data).all():
        return None
    M.eliminate_zeros()
    row, column = _equilibrated(M)
    boxed = replace(qp, sets=(Box(*hull(qp.sets, qp.q.size)),))
    margin = None
    if np.isfinite(claimed).all() and claimed.any():
        margin = _margin_near(boxed, M, column, claimed)
    if margin is None:
        if qp not in _MARGINS:
            _MARGINS[qp] = _searched(boxed, M, row, column)
        margin = _MARGINS[qp]
    return margin


def _searched(qp: QP, M: csr_array, row: Vector, column: Vector) -> float | None:
    """Search for a ray that proves infeasibility; return its margin, or None."""
    for w in _rays(qp, M, row, column):
        margin = _margin_near(qp, M, column, w)
        if margin is not None:
            return margin
    ray = _exact_ray(qp, M)
    return None if ray is None else _margin(qp, M, ray)


def _margin_near(qp: QP, M: csr_array, column: Vector, w: Vector) -> float | None:
    """Prove infeasibility by a ray near w (k,); return its margin, or None."""
    w = w.copy()
    w[qp.b.size :] = np.maximum(w[qp.b.size :], 0)
    sizes = abs(M) @ diags_array(column)
    largest = np.asarray(sizes.max(axis=1).toarray()).ravel()
    size = np.abs(w) * np.where(
        largest > 0, largest, 1.0
    )  # a row 0·x ≤ −1 has no entries
    if not 0 < size.max() < np.inf:
        return None
    w = w * 2.0 ** -np.floor(np.log2(size.max()))
    tried = set[int]()
    for cut in CUTS:
        rows = np.flatnonzero(size > cut * size.max())
        if rows.size in tried:
            continue
        tried.add(rows.size)
        for ray in _corrected(qp, M[rows], rows, w[rows]):
            margin = _margin(qp, M[rows], ray)
            if margin is not None:
                return margin
    return None


def _corrected(
    qp: QP, M: csr_array, rows: NDArray[np.int64], w: Vector
) -> Iterator[Ray]:
    """Yield rays near w that satisfy cⱼ = 0 exactly where required.

    cⱼ = 0 is required for variables without bounds. It is also required for variables
    with a single bound if cⱼ is small and has the sign for which V is infinite. The
    first ray is w itself. It is followed by rays with cⱼ = 0 wherever cⱼ is small, and
    by rays with cⱼ = 0 only where required, each as an enclosure and, for few pivots,
    also as an exact solution.

    M, w : rows with a nonzero multiplier, and their multipliers
    """
    exact = rational(w)
    zero = 0 * exact
    c = rational_product(M, exact)
    terms = abs(M).T @ np.abs(w)
    vanishes = np.array([not value for value in c])
    yield Ray(rows, exact, zero, vanishes)
    rounded = np.array([float(value) for value in c])
    free = np.isinf(qp.lb) & np.isinf(qp.ub)
    small = np.abs(rounded) <= MAX_CANCELLED * terms
    wrong = ((rounded > 0) & np.isinf(qp.lb)) | ((rounded < 0) & np.isinf(qp.ub))
    for vanish in (small | free, small & (wrong | vanishes) | free):
        vanish = vanish & (terms > 0)
        if not vanish.any():
            continue
        part = csr_array(M[:, vanish])
        radius = _enclosure(part, w, rounded[vanish], terms[vanish])
        if radius is not None:
            yield Ray(rows, exact, rational(radius), vanish)
        if min(part.shape) <= MAX_PIVOTS and max(part.shape) <= MAX_ENCLOSURE:
            # order of the pivots: equations, then inequalities, each by decreasing |w|
            order = np.lexsort([-np.abs(w), rows >= qp.b.size])
            solve = solutions(
                rational(part.toarray().T[:, order]), rational(np.zeros(part.shape[1]))
            )
            assert solve is not None  # w = 0 is a solution
            corrected = exact.copy()
            corrected[order] = solve(exact[order])
            yield Ray(rows, corrected, zero, vanish)


def _enclosure(M: csr_array, w: Vector, c: Vector, terms: Vector) -> Vector | None:
    """Bound a change of w (k,) after which Mᵀw = 0 holds exactly; None if unproven.

    Columns are scaled by their terms and rows by w. Let X be an approximate right
    inverse of Mᵀ, and α < 1 a bound on ‖I − MᵀX‖∞ that includes rounding. Then MᵀX is
    nonsingular, δ = −X(MᵀX)⁻¹c solves Mᵀ(w + δ) = 0, and |δᵢ| ≤ Σⱼ|Xᵢⱼ|·‖c‖∞/(1 − α).

    M : (k, n) columns of the variables with cⱼ = 0
    c : (n,) Mᵀw
    """
    k, n = M.shape
    if n > k or k > MAX_ENCLOSURE:
        return None
    # scale by powers of two, which is exact
    unit, weight = (2.0 ** np.floor(np.log2(v)) for v in (terms, np.abs(w)))
    ratio = weight / unit[:, None]
    B = M.toarray().T * ratio
    if not ((ratio > 0).all() and np.isfinite(B).all()):
        return None
    X = np.linalg.pinv(B)
    rounding = 2 * (k + 2) * EPS * (np.abs(B) @ np.abs(X) + 1)
    alpha = float((np.abs(np.eye(n) - B @ X) + rounding).sum(axis=1).max())
    if not alpha < 0.5:
        return None
    largest = float((np.maximum(np.abs(c), TINY) / unit).max()) / (1 - alpha)
    radius: Vector = 1.001 * np.abs(X).sum(axis=1) * largest * weight
    return radius + TINY


def _margin(qp: QP, M: csr_array, ray: Ray) -> float | None:
    """Bound the margin from below over an enclosure of rays.

    Return None if the bound does not exceed `MIN_MARGIN`, or if the enclosure contains
    a negative multiplier of an inequality, or a ray with infinite V.
    """
    m = qp.b.size
    if (ray.centre < ray.radius)[ray.rows >= m].any():
        return None
    rhs = rational(np.concatenate([qp.b, qp.h])[ray.rows])
    value = ray.centre @ rhs + ray.radius @ abs(rhs)
    terms = (abs(ray.centre) + ray.radius) @ abs(rhs)
    left = np.flatnonzero(~ray.vanish)
    part = M[:, left]
    c, spread = (
        rational_product(part, ray.centre),
        rational_product(abs(part), ray.radius),
    )
    for lb, ub, c_j, by in zip(qp.lb[left], qp.ub[left], c, spread, strict=True):
        products = []
        for end in (c_j - by, c_j + by):
            bound = float(lb if end > 0 else ub) if end else 0.0
            if np.isinf(bound):
                return None
            products.append(-end * Fraction(bound))
        value += max(products)  # the term is convex in cⱼ, so its maximum is at an end
        terms += max(map(abs, products))
    return float(-value / terms) if -value > Fraction(MIN_MARGIN) * terms else None


def _rays(qp: QP, M: csr_array, row: Vector, column: Vector) -> Iterator[Vector]:
    """Yield multipliers w of the rows of M that maximise the margin.

    A linear program minimises V under the condition that the sum of its absolute terms
    is at most one. The first program omits large bounds (`MAX_BOUND_RATIO`).

    row, column : scaling factors from `_equilibrated`
    """
    rhs = row * np.concatenate([qp.b, qp.h])
    lb, ub = qp.lb / column, qp.ub / column
    bounds = np.abs(np.concatenate([lb, ub]))
    bounds = bounds[np.isfinite(bounds) & (bounds > 0)]
    size = np.abs(rhs).max() or bounds.min(initial=np.inf)
    rhs, lb, ub, bounds = (v / size for v in (rhs, lb, ub, bounds))
    scaled = csr_array(diags_array(row) @ M @ diags_array(column))
    reaches = {MAX_BOUND_RATIO}
    if (bounds > MAX_BOUND_RATIO).any():
        reaches.add(bounds.max())
    for reach in sorted(reaches):
        w = _solved(scaled, qp.b.size, rhs, lb, ub, reach)
        if w is not None:
            yield w * row


def _solved(
    M: csr_array, m: int, rhs: Vector, lb: Vector, ub: Vector, reach: float
) -> Vector | None:
    """Solve the linear program of `_rays`.

    Return None if no solution with a negative value is found.

    M, rhs, lb, ub : scaled rows, right-hand sides of at most 1, and bounds; the first m
        rows are equations
    reach : bounds of larger absolute value are omitted
    """
    # imported here, since scipy.optimize loads slowly
    from scipy.optimize import linprog

    n, k = M.shape[1], M.shape[0]
    lower, upper = (np.flatnonzero(np.abs(v) <= reach) for v in (lb, ub))
    eye = csr_array(eye_array(n))
    cost = np.concatenate([rhs, -rhs[:m], ub[upper], -lb[lower]])
    # the unknowns are multiplied by their costs, so that the program is well scaled
    unit = np.maximum(np.abs(cost), 1 / MAX_BOUND_RATIO)
    balance = hstack([M.T, -M[:m].T, eye[:, upper], -eye[:, lower]])
    balance = csr_array(balance @ diags_array(1 / unit))
    largest = np.asarray(abs(balance).max(axis=1).toarray()).ravel()
    balance = csr_array(diags_array(1 / np.where(largest > 0, largest, 1.0)) @ balance)
    cost = cost / unit
    if not (np.isfinite(balance.data).all() and np.isfinite(cost).all()):
        return None
    solution = linprog(
        cost,
        A_ub=csr_array(np.abs(cost)[None]),
        b_ub=[1.0],
        A_eq=balance,
        b_eq=np.zeros(n),
        options=dict(
            time_limit=LP_SECONDS,
            primal_feasibility_tolerance=1e-10,
            dual_feasibility_tolerance=1e-10,
        ),
    )
    if solution.x is None or not solution.fun < 0:
        return None
    terms = solution.x / unit
    w: Vector = terms[:k]
    w[:m] -= terms[k : k + m]
    return w


def _exact_ray(qp: QP, M: csr_array) -> Ray | None:
    """Return a ray with a margin above `MIN_MARGIN` in rational arithmetic, or None.

    For a small QP, the search is complete. By Farkas' lemma, such a ray exists if and
    only if the QP remains infeasible when all right-hand sides and bounds are relaxed
    by `MIN_MARGIN` times their absolute value. For larger QPs (`MAX_TABLEAU`), the
    result is None.
    """
    m, k, n = qp.b.size, M.shape[0], M.shape[1]
    lower, upper = (np.flatnonzero(np.isfinite(v)) for v in (qp.lb, qp.ub))
    unknowns = k + m + lower.size + upper.size
    if (n + 1) * unknowns > MAX_TABLEAU:
        return None
    rows, eye = M.toarray(), np.eye(n)
    columns = np.hstack([rows.T, -rows[:m].T, eye[:, upper], -eye[:, lower]])
    rhs = rational(np.concatenate([qp.b, qp.h, -qp.b, qp.ub[upper], -qp.lb[lower]]))
    rhs = rhs + Fraction(MIN_MARGIN) * abs(rhs)
    w = nonnegative_solution(
        np.vstack([rational(columns), rhs]), rational(np.append(np.zeros(n), -1.0))
    )
    if w is None:
        return None
    ray = w[:k].copy()
    ray[:m] -= w[k : k + m]
    return Ray(np.arange(k), ray, 0 * ray, np.zeros(n, dtype=bool))


def _equilibrated(M: csr_array) -> tuple[Vector, Vector]:
    """Return powers of two that scale rows and columns to entries of about one.

    As in the method of Ruiz (2001), rows and columns are repeatedly divided by the
    square root of their largest entry.
    """
    row, column = np.ones(M.shape[0]), np.ones(M.shape[1])
    size = abs(M)
    for _ in range(20):
        scaled = diags_array(row) @ size @ diags_array(column)
        for factor, axis in ((row, 1), (column, 0)):
            largest = np.asarray(scaled.max(axis=axis).toarray()).ravel()
            factor /= np.sqrt(np.where(largest > 0, largest, 1.0))
    return np.exp2(np.round(np.log2(row))), np.exp2(np.round(np.log2(column)))
