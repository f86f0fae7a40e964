"""Verdicts on primal-dual points: four relative residuals in a scaled QP.

The QP min ½xᵀPx + qᵀx, Ax = b, Gx ≤ h, x in sets, is scaled once: x̂ = x/D, rows
K̂ = EKD with K = [A; G], q̂ = Dq. The scaling is that of Curtis and Reid (1972),
followed by steps of Ruiz (2001). A point with multipliers is verified at a tolerance
tol if each of four residuals is at most τ = 10·tol; docs/verdicts.md states the rule on
half a page. Up to rounding, all residuals vanish if and only if the point is a KKT
point, which is a solution if P is positive semidefinite.

The rule is independent of the solvers: none of them imports this module.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, vstack

from mortarbench.harness.qp import QP, Vector
from mortarbench.harness.record import VERIFIED_FACTOR, Record, Verdict
from mortarbench.harness.sets.blocks import Blocks
from mortarbench.harness.sets.convex import admissible
from mortarbench.harness.solution import Solution, Status

#: Size of a row with a right-hand side of 0, as a fraction of ‖x̂‖∞, and scale of forces
#: that vanish, as a fraction of max P̂ⱼⱼ‖x̂‖∞. Neither has a unit of its own. With
#: 0.1 = 1/10, an error τ times this scale is tol·‖x̂‖∞, which the solver was asked for.
FLOOR = 0.1
#: Size of a row with a right-hand side ≠ 0, as a fraction of ‖x̂‖∞. The row has its own
#: unit; this limit prevents a right-hand side of rounding size from becoming a unit.
OWN_FLOOR = 1e-3
#: Numbers of alternations of Curtis and Reid, and of steps of Ruiz. With these, the
#: largest residual changes by 0.1 decades if rows are scaled by 1e±6.
CURTIS_REID, RUIZ = 20, 4
#: Number of power iterations for the largest eigenvalue of P. The estimate is typically
#: a few percent too small, which changes residuals by a similar percentage.
POWER_STEPS = 20


class Residuals(NamedTuple):
    """Relative KKT residuals; at least one is NaN if the point contains NaN."""

    primal: float  #: largest violation of a row, bound or other set
    dual: float  #: largest error of stationarity or of the sign of a multiplier
    complementarity: float  #: largest |multiplier·slack|, or support gap of a set
    gap: float  #: |primal − dual objective|

    @property
    def worst(self) -> float:
        """The largest of the four residuals; NaN if any of them is NaN."""
        return float(np.max(self))


@dataclass(frozen=True, eq=False)
class Scaling:
    """Factors of the scaled QP in which residuals are relative."""

    D: Vector  #: (n,) units of the variables, x = D·x̂; equal within a disc or cone
    E: Vector  #: (m,) factors of the rows of A
    F: Vector  #: (p,) factors of the rows of G
    curvature: Vector  #: (n,) Pⱼⱼ; the largest eigenvalue of P if P has no diagonal
    used: NDArray[np.bool_]  #: (n,) mask of variables with an entry in P, A or G
    is_approximate: bool  #: True if P has no diagonal


class _Errors(NamedTuple):
    """Relative errors of one kind, such as the violations of the rows of A."""

    residual: str  #: name of the residual, a field of `Residuals`
    reason: str  #: format of a sentence with the number and the ratio of an error
    ratios: Vector  #: (k,) errors divided by their sizes
    #: (k,) number of the row or variable of each error; None for 0, 1, …
    number: NDArray[np.int64] | None = None


_SCALINGS: WeakKeyDictionary[QP, Scaling] = WeakKeyDictionary()


def scaling_of(qp: QP) -> Scaling:
    """Return the scaling of a QP, which is computed once per object."""
    if qp not in _SCALINGS:
        _SCALINGS[qp] = _scaled(qp)
    return _SCALINGS[qp]


def _scaled(qp: QP) -> Scaling:
    """Scale [diag(P) Kᵀ; K 0], K = [A; G], to entries of order one.

    For positive semidefinite P, |Pᵢⱼ| ≤ √(PᵢᵢPⱼⱼ), so that its diagonal suffices.
    First, 20 alternations minimise Σ wⱼ(log|kᵢⱼ| + ρᵢ + δⱼ)² + Σ (γ + log Pⱼⱼ + 2δⱼ)²
    over ρ, γ and δ, where wⱼ is the reciprocal of the number of entries in column j of
    K, so that these together weigh as much as Pⱼⱼ. Then the largest entry of each row
    becomes 1, and four steps of Ruiz divide rows and columns by the roots of their
    largest entries. D = exp(δ), E = exp(ρ).
    """
    diagonal = qp.diagonal()
    p = np.full(qp.q.size, largest_eigenvalue(qp)) if diagonal is None else diagonal
    p, m, n = np.maximum(p, 0), qp.b.size, qp.q.size
    K = coo_array(vstack([csr_array(qp.A), csr_array(qp.G)]))
    K.eliminate_zeros()
    (i, j), curved, blocks = K.coords, p > 0, _blocks(qp)
    a, t = np.log(np.abs(K.data)), np.log(np.where(curved, p, 1))
    count = np.bincount(j, minlength=n)
    w = 1 / np.maximum(count, 1)[j]
    W, Wa = (csr_array((v, (i, j)), shape=K.shape) for v in (w, w * a))
    rows = _nonzero(W.sum(axis=1))
    columns = _nonzero(W.sum(axis=0) + 4 * curved)
    of_rows, of_columns = Wa.sum(axis=1), Wa.sum(axis=0)
    d, r, c = np.zeros(n), np.zeros(K.shape[0]), 0.0
    for _ in range(CURTIS_REID):
        r = -(of_rows + W @ d) / rows
        c = -float(np.mean((2 * d + t)[curved])) if curved.any() else 0.0
        d = -(of_columns + W.T @ r + 2 * (c + t) * curved) / columns
        _tie(d, blocks)
    for step in range(1 + RUIZ):
        row = np.full(r.size, -np.inf)
        column = np.where(curved, c + t + 2 * d, -np.inf)
        np.maximum.at(row, i, a + r[i] + d[j])
        np.maximum.at(column, j, a + r[i] + d[j])
        row, column = (np.where(np.isfinite(v), v, 0) for v in (row, column))
        if step == 0:
            r = r - row
        else:
            r, d = r - row / 2, d - column / 2
            _tie(d, blocks)
    R = np.exp(r)
    used = (count > 0) | curved
    return Scaling(np.exp(d), R[:m], R[m:], p, used, diagonal is None)


def _blocks(qp: QP) -> list[Blocks]:
    return [one for one in qp.sets[1:] if isinstance(one, Blocks)]


def _tie(d: Vector, blocks: list[Blocks]) -> None:
    """Replace d (n,) by its mean over each disc or cone, which is not a box."""
    for one in blocks:
        d[one.index] = d[one.index].mean(axis=1, keepdims=True)


def _nonzero(weights: NDArray[Any]) -> Vector:
    return np.where(weights > 0, weights, 1)


@np.errstate(all="ignore")  # a point may contain NaN, inf, or 1e300
def kkt_residuals(qp: QP, s: Solution) -> Residuals:
    """Return the relative residuals of the KKT conditions of `qp` at `s`.

    Let r = Px + q + Aᵀy + Gᵀz⁺ + z_box without inadmissible multipliers, ℓ the least
    nonzero |b̂|, |ĥ|, finite bound or radius (without any, ‖q̂‖∞/max P̂ⱼⱼ or 1),
    X = max(‖x̂‖∞, ℓ) and X̄ = max(‖x̂‖₂/√n, ℓ). L is the largest of these lengths, and
    of ‖q̂‖∞/max P̂ⱼⱼ (∞ if all vanish), so that a part of x that no datum determines,
    such as a rigid motion, sets no unit of forces. The residuals are the largest of

    * primal: v̂ᵢ/max(|b̂ᵢ| + Σ|k̂ᵢⱼ||x̂ⱼ|, κᵢX), where v̂ᵢ is the violation of a row,
      bound or other set, and κᵢ is `OWN_FLOOR` if bᵢ ≠ 0 and `FLOOR` if bᵢ = 0
    * dual: φ/F, where φ is an entry of Dr, a multiplier z⁻ of the wrong sign or an
      inadmissible part of z_box, and F = max(‖P̂x̂‖∞, ‖q̂‖∞); or
      max(φ/`FLOOR`, F)/(max P̂ⱼⱼ·min(X, L)) if smaller, as near q = 0, Px = 0
    * complementarity: |zᵢ(h − Gx)ᵢ|/ℰ, and the support gaps of bounds and sets
    * gap: |xᵀPx + qᵀx + bᵀy + hᵀz + σ(z_box)|/ℰ

    with ℰ = max(|xᵀPx|, |qᵀx|); or, if this is smaller, the largest of the error and
    all energies, divided by 𝒩 = X̄·max(‖q̂‖₂/√n, max P̂ⱼⱼ·X̄), as near f* = 0.

    Examples
    --------
    >>> import numpy as np
    >>> from mortarbench import QP, Solution, Status
    >>> from mortarbench.harness.verify.kkt import kkt_residuals
    >>> qp = QP.from_arrays(np.eye(2), [-1, -1], lb=0)
    >>> s = Solution(
    ...     status=Status.SOLVED, x=np.array([1.0, 1.0 + 1e-6]), y=np.zeros(0),
    ...     z=np.zeros(0), z_box=np.zeros(2),
    ... )
    >>> kkt_residuals(qp, s).worst <= 1e-5  # verified at tolerance 1e-6
    True
    >>> kkt_residuals(qp, s).worst <= 1e-7  # but not at 1e-8
    False

    """
    worst = dict.fromkeys(Residuals._fields, 0.0)
    for errors in _errors(qp, s):
        largest = float(np.max(errors.ratios, initial=0.0))  # NaN remains NaN
        worst[errors.residual] = float(np.maximum(worst[errors.residual], largest))
    return Residuals(**worst)


class _Sizes(NamedTuple):
    """Units of errors at a point; each follows from x and the data alone."""

    length: float  #: X
    force: float  #: F
    natural_force: float  #: unit of forces if they vanish
    energy: float  #: ℰ
    natural_energy: float  #: 𝒩


def _sizes_at(qp: QP, x: Vector, Px: Vector) -> _Sizes:
    by = scaling_of(qp)
    pmax, size = _sup(by.D**2 * by.curvature), (x / by.D)[by.used]
    loads = by.D * qp.q
    least, most = _length_units(qp)
    X, mean = max(_sup(size), least), max(_rms(size), least)
    F = max(_sup(by.D * Px), _sup(loads))
    return _Sizes(
        length=X,
        force=F,
        natural_force=FLOOR * pmax * min(X, most) or (0.0 if F else 1.0),
        energy=max(abs(float(x @ Px)), abs(float(qp.q @ x))),
        natural_energy=mean * (max(_rms(loads), pmax * mean) or 1.0),
    )


def lengths(qp: QP) -> Vector:
    """Return the nonzero |b̂|, |ĥ|, finite bounds and radii of a QP, in no order."""
    by, origin = scaling_of(qp), np.zeros(qp.q.size)
    limits = (c for one in qp.sets for c in one.limits(origin))
    data = [by.E * np.abs(qp.b), by.F * np.abs(qp.h)]
    found = np.concatenate([*data, *(c.size / by.D[c.variable] for c in limits)])
    return found[found > 0]


def _length_units(qp: QP) -> tuple[float, float]:
    """Return ℓ and L of `kkt_residuals`, the least and largest length in the data."""
    by, found = scaling_of(qp), lengths(qp)
    pmax = _sup(by.D**2 * by.curvature)
    loaded = _sup(by.D * qp.q) / pmax if pmax else 0.0
    least = float(found.min()) if found.size else loaded or 1.0
    return least, max(float(found.max(initial=0)), loaded) or np.inf


def units_at(qp: QP, x: Vector) -> tuple[Vector, float]:
    """Return weights (n,) of stationarity residuals and the unit of energies at x (n,).

    Both units are those of a point that vanishes if they are larger, so that they are
    never zero.
    """
    sizes = _sizes_at(qp, x, qp.P @ x)
    force = sizes.force or sizes.natural_force
    return scaling_of(qp).D / force, sizes.energy or sizes.natural_energy


def _errors(qp: QP, s: Solution) -> Iterator[_Errors]:
    """Yield the relative errors of a point; see `kkt_residuals`."""
    by, Px, x = scaling_of(qp), qp.P @ s.x, np.abs(s.x)
    limits = [one.limits(s.x) for one in qp.sets]
    every = [limit for of_set in limits for limit in of_set]
    sizes = _sizes_at(qp, s.x, Px)

    def violations(error: Vector, terms: Vector, rhs: Vector, scale: Vector) -> Vector:
        size = np.where(rhs != 0, OWN_FLOOR, FLOOR) * sizes.length
        return scale * error / np.maximum(scale * (terms + np.abs(rhs)), size)

    left, slack = np.abs(qp.A @ s.x - qp.b), qp.h - qp.G @ s.x
    violated = "{} {{}} is violated by {{}} of its terms".format
    ratios = violations(left, abs(qp.A) @ x, qp.b, by.E)
    yield _Errors("primal", violated("row"), ratios)
    over = np.maximum(-slack, 0)
    ratios = violations(over, abs(qp.G) @ x, qp.h, by.F)
    yield _Errors("primal", violated("inequality row"), ratios)
    for c in every:
        over, scale = np.maximum(-c.slack, 0), 1 / by.D[c.variable]
        ratios = violations(over, c.terms, c.size, scale)
        yield _Errors("primal", violated(c.name), ratios, c.variable)

    borne = admissible(qp.sets, s.z_box)
    r = Px + qp.q + qp.A.T @ s.y + qp.G.T @ np.maximum(s.z, 0) + borne
    sign = "the sign of {}[{{}}] is wrong by {{}}".format
    for place, error in (
        ("component {} of Px + q + Aᵀy + Gᵀz + z_box is {}", np.abs(by.D * r)),
        (sign("z"), np.maximum(-s.z, 0) / by.F),
        (sign("z_box"), np.abs(by.D * (s.z_box - borne))),
    ):
        forces = np.maximum(error, FLOOR * sizes.force)
        near_zero = _over(forces, sizes.natural_force)
        ratios = np.minimum(_over(error, sizes.force), near_zero)
        yield _Errors("dual", f"{place} of the largest force", ratios)

    work = qp.b @ s.y + qp.h @ s.z + sum(one.support(s.z_box) for one in qp.sets)
    energies = np.array([s.x @ Px, qp.q @ s.x, work])

    def relative(error: Vector) -> Vector:
        near_zero = np.maximum(np.abs(error), _sup(energies)) / sizes.natural_energy
        return np.minimum(_over(np.abs(error), sizes.energy), near_zero)

    product = "multiplier times slack of {} {{}} is {{}} of the energy".format
    ratios = relative(s.z * slack)
    yield _Errors("complementarity", product("inequality row"), ratios)
    for one, of_set in zip(qp.sets, limits, strict=True):
        for c, gap in zip(of_set, one.support_gaps(s.x, s.z_box, of_set), strict=False):
            ratios = relative(gap)
            yield _Errors("complementarity", product(c.name), ratios, c.variable)
    reason = "primal and dual objective differ by {1} of the energy"
    yield _Errors("gap", reason, relative(energies.sum(keepdims=True)))


def largest_eigenvalue(qp: QP) -> float:
    """Estimate the largest eigenvalue of P from below by power iteration."""
    v = np.random.default_rng(0).standard_normal(qp.q.size)
    for _ in range(POWER_STEPS):
        v = qp.P @ (v / np.linalg.norm(v))
        if not v.any():
            return 0.0
    return float(np.linalg.norm(v))


def allowed(tol: float, factor: float = VERIFIED_FACTOR) -> float:
    """Return the largest residual that verification allows: factor·tol, at most 0.1."""
    return min(factor * tol, 0.1)


def verdict(
    claimed: Status,
    residuals: Residuals,
    tol: float,
    factor: float = VERIFIED_FACTOR,
) -> Verdict:
    """Return the verdict on a point, given its residuals.

    A point is verified if every residual is at most `allowed(tol, factor)`, even if the
    solver claims no success, unless the solver declined the QP. Otherwise, the claim
    determines the type of failure. A refuted claim of success is `inaccurate` if the
    point has at least half of the requested digits (worst residual ≤ √allowed), and
    `wrong` otherwise. Claims of infeasible and of unbounded QPs are verified by
    certificates, see `harness.verify.infeasibility`.
    """
    most, worst = allowed(tol, factor), residuals.worst
    if claimed is Status.DECLINED:
        return Verdict.DECLINED
    if worst <= most:
        return Verdict.VERIFIED
    match claimed:
        case Status.SOLVED:
            return Verdict.INACCURATE if worst <= np.sqrt(most) else Verdict.WRONG
        case Status.INFEASIBLE:
            return Verdict.INFEASIBLE_CLAIM
        case Status.UNBOUNDED:
            return Verdict.UNBOUNDED_CLAIM
        case _:
            return Verdict(claimed.value)


def rejudged(record: Record, factor: float) -> Verdict:
    """Recompute a stored verdict with the tolerance factor·tol instead of 10·tol.

    The verdict follows from the stored claim and residuals. Verdicts that do not follow
    from these numbers are returned unchanged: verdicts on limits, on crashes and on
    steps after the end of a sequence, and verdicts by certificates, which do not depend
    on this factor.
    """
    if record.claimed is None:
        return record.status
    stored = (getattr(record, name) for name in Residuals._fields)
    residuals = Residuals(*(np.inf if r is None else r for r in stored))
    claimed, tol = Status(record.claimed), record.judged_at
    if verdict(claimed, residuals, tol) is not record.status:
        return record.status
    return verdict(claimed, residuals, tol, factor)


@np.errstate(all="ignore")  # a point may contain NaN, inf, or 1e300
def diagnosis(qp: QP, s: Solution, tol: float) -> str:
    """Return the reason why a point is not verified, in one line; empty if it is.

    The reason is a vector with NaN or inf, a multiplier of the opposite sign, or else
    the largest relative error and its place.
    """
    for name in ("x", "y", "z", "z_box"):
        bad = np.flatnonzero(~np.isfinite(getattr(s, name)))
        if bad.size:
            value = getattr(s, name)[bad[0]]
            return f"{name} contains {'NaN' if np.isnan(value) else 'inf'}"
    if kkt_residuals(qp, s).worst <= (most := allowed(tol)):
        return ""
    duals = [name for name in ("y", "z", "z_box") if getattr(s, name).any()]
    for names in (c for k in (1, 2, 3) for c in combinations(duals, k)):
        flipped = replace(s, **{name: -getattr(s, name) for name in names})
        if kkt_residuals(qp, flipped).worst <= most:
            signs = " and ".join(f"−{name}" for name in names)
            return (
                f"with {signs} all residuals vanish: check the sign of "
                f"{' and '.join(names)}"
            )
    one = max(  # NaN is the largest: terms of a finite point may overflow
        _errors(qp, s),
        key=lambda one: float(np.nan_to_num(one.ratios.max(initial=0.0), nan=np.inf)),
    )
    at, ratio = int(one.ratios.argmax()), f"{one.ratios.max():.1e}"
    number = at if one.number is None else int(one.number[at])
    return one.reason.format(number, ratio)


def _sup(v: Vector) -> float:
    return float(np.abs(v).max(initial=0.0))


def _rms(v: Vector) -> float:
    return float(np.linalg.norm(v)) / float(np.sqrt(max(v.size, 1)))


def _over(error: Vector, size: float) -> Vector:
    """Return error/size (k,), where 0/0 is 0."""
    return np.where(error == 0, 0.0, error / size)
