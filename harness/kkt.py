"""Optimality of a primal-dual point, measured by us and never by the solver.

Every residual is scale-free: multiplying the objective, a constraint row or the unit of
x by a constant changes none of them, so that one threshold means the same for every
problem. All four are zero exactly at a KKT point, which is a solution if P is positive
semidefinite; that is taken on trust.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from harness.qp import QP, Matrix, Vector
from harness.record import Record, Verdict
from harness.solution import Solution, Status

VERIFIED_FACTOR = 10.0  #: verified: every residual ≤ this times the tolerance asked for


class Residuals(NamedTuple):
    """Scale-free KKT residuals; NaN where the point holds NaN."""

    primal: float  #: worst violation of a row or bound
    dual: float  #: stationarity and multiplier signs
    complementarity: float  #: worst |multiplier·slack|
    gap: float  #: |primal − dual objective|

    @property
    def worst(self) -> float:
        """The largest of the four; NaN if any is NaN."""
        return float(np.max(self))


class _Scales(NamedTuple):
    """What residuals are compared with; built so that no answer can inflate them."""

    x: float  #: of variables
    gradient: float  #: of Px + q and what balances it
    energy: float


@np.errstate(over="ignore", invalid="ignore")  # a point may hold NaN, inf, or 1e300
def kkt_residuals(qp: QP, s: Solution) -> Residuals:
    """Measure how far `s` is from satisfying the KKT conditions of `qp`.

    With the scales X, S, E of x, of the gradient and of the energy (see `_scales`):

    * primal: violation of aᵢx = bᵢ, gᵢx ≤ hᵢ or a bound, relative to the larger of
      |aᵢ|·|x| + |bᵢ| and ‖aᵢ‖₁X
    * dual: ‖Px + q + Aᵀy + Gᵀz + z_box‖∞/S, and zᵢ⁻‖gᵢ‖∞/S for a multiplier of the
      wrong sign; one on an absent bound has the wrong sign
    * complementarity: max |zᵢ(h − Gx)ᵢ|/E over rows and bounds
    * gap: |xᵀPx + qᵀx + bᵀy + hᵀz + lbᵀz_box⁻ + ubᵀz_box⁺|/E

    An absolute residual hides the units, and primal, stationarity and gap alone accept
    a multiplier of the wrong sign: x = 0, z = −1 for min ½(x+1)², x ≤ 0.
    """
    lower, upper = np.isfinite(qp.lb), np.isfinite(qp.ub)
    z_lb, z_ub = np.maximum(-s.z_box, 0), np.maximum(s.z_box, 0)
    slack_lb, slack_ub = (s.x - qp.lb)[lower], (qp.ub - s.x)[upper]
    Px, slack = qp.P @ s.x, qp.h - qp.G @ s.x
    multipliers = qp.A.T @ s.y + qp.G.T @ s.z + s.z_box
    held = qp.b @ s.y + qp.h @ s.z
    held += qp.ub[upper] @ z_ub[upper] - qp.lb[lower] @ z_lb[lower]
    terms = np.array([s.x @ Px, qp.q @ s.x, held])
    X, S, E = _scales(qp, s.x, (Px, qp.q, multipliers), terms)

    primal = _largest(
        _ratio(qp.A @ s.x - qp.b, _row_scale(qp.A, s.x, qp.b, X)),
        _ratio(np.minimum(slack, 0), _row_scale(qp.G, s.x, qp.h, X)),
        _ratio(np.minimum(slack_lb, 0), np.maximum(X, np.abs(qp.lb[lower]))),
        _ratio(np.minimum(slack_ub, 0), np.maximum(X, np.abs(qp.ub[upper]))),
    )
    dual = _largest(
        _ratio(Px + qp.q + multipliers, S),
        _ratio(np.minimum(s.z, 0) * _row_maxima(qp.G), S),
        _ratio(z_lb[~lower], S),
        _ratio(z_ub[~upper], S),
    )
    complementarity = _largest(
        _ratio(s.z * slack, E),
        _ratio(z_lb[lower] * slack_lb, E),
        _ratio(z_ub[upper] * slack_ub, E),
    )
    return Residuals(primal, dual, complementarity, _ratio(terms.sum(keepdims=True), E))


def _scales(
    qp: QP, x: Vector, gradients: tuple[Vector, Vector, Vector], energies: Vector
) -> _Scales:
    """Scales of x, gradient and energy.

    S is the largest of ‖Px‖, ‖q‖ and ‖Aᵀy + Gᵀz + z_box‖, E the largest of |xᵀPx|,
    |qᵀx| and |bᵀy + hᵀz + box|: sums, since multipliers that cancel could make their
    parts as large as one likes. X is the largest size of x that a row (|aᵢ|·|x| + |bᵢ|
    over ‖aᵢ‖₁), a bound or the curvature of a variable knows of: a variable that
    nothing knows of could make ‖x‖ as large as one likes.

    Where the solution is zero (λ = 0 without contact), X and E would be rounding
    errors. They are at least a hundredth of the median of |qᵢ|/Pᵢᵢ and of qᵢ²/Pᵢᵢ, the
    minimisers and minima of single variables. (An operator P has no Pᵢᵢ: no floors.)
    """
    S = max(map(_sup, gradients), key=_nan_first)
    diagonal = np.asarray(qp.P.diagonal()) if qp.is_explicit else np.zeros(x.size)
    alone = (diagonal > 0) & (qp.q != 0)
    d, q = diagonal[alone], np.abs(qp.q[alone])
    floor_x = 0.01 * float(np.median(q / d)) if d.size else 0.0
    floor_E = 0.01 * float(np.median(q**2 / d)) if d.size else 0.0
    lower, upper = np.isfinite(qp.lb), np.isfinite(qp.ub)
    felt = diagonal * np.abs(x) > 1e-12 * S if qp.is_explicit else np.full(x.size, True)
    X = _largest(
        floor_x,
        _sup(x[felt]),
        _sup(np.abs(x[lower]) + np.abs(qp.lb[lower])),
        _sup(np.abs(x[upper]) + np.abs(qp.ub[upper])),
        *(
            _ratio((abs(M) @ np.abs(x) + np.abs(rhs))[told], sums[told])
            for M, rhs in ((qp.A, qp.b), (qp.G, qp.h))
            if (told := (sums := _row_sums(M)) > 0).any()  # 0ᵀx ≤ h tells nothing of x
        ),
    )
    return _Scales(X, S, max(_sup(energies), floor_E, key=_nan_first))


def allowed(tol: float, factor: float = VERIFIED_FACTOR) -> float:
    """Return the largest residual that verification allows: factor·tol, at most 0.1."""
    return min(factor * tol, 0.1)


def verdict(
    claimed: Status,
    residuals: Residuals,
    tol: float,
    factor: float = VERIFIED_FACTOR,
) -> Verdict:
    """Judge a point by its residuals; the claim decides only how a failure is called.

    Verified: every residual ≤ factor·tol, whatever was claimed. A refuted claim of
    success is `inaccurate` while at least half of the digits asked for are there (worst
    residual ≤ √(factor·tol)), and `wrong` beyond. A residual above 0.1 verifies
    nothing, whatever the tolerance.
    """
    most = allowed(tol, factor)
    if claimed is Status.DECLINED:
        return Verdict.DECLINED
    if residuals.worst <= most:
        return Verdict.VERIFIED
    match claimed:
        case Status.SOLVED:
            close = residuals.worst <= max(most, np.sqrt(most))
            return Verdict.INACCURATE if close else Verdict.WRONG
        case Status.INFEASIBLE:
            return Verdict.INFEASIBLE_CLAIM
        case _:
            return Verdict(claimed.value)


def rejudged(record: Record, factor: float) -> Verdict:
    """Judge a stored measurement anew, at factor·tol instead of 10·tol.

    Claim and residuals decide. Where they do not explain the stored status (a limit, a
    crash, a sequence that had ended before), it was decided by something else, and
    stands.
    """
    if record.claimed is None:
        return record.status
    stored = (getattr(record, name) for name in Residuals._fields)
    residuals = Residuals(*(np.inf if r is None else r for r in stored))
    tol = record.tol if record.accuracy is None else record.accuracy
    claimed = Status(record.claimed)
    if verdict(claimed, residuals, tol) is not record.status:
        return record.status
    return verdict(claimed, residuals, tol, factor)


def _sup(v: Vector) -> float:
    return float(np.abs(v).max(initial=0.0))


def _nan_first(value: float) -> float:
    """Order NaN above every number, so that it cannot hide behind one."""
    return np.inf if np.isnan(value) else value


def _largest(*values: float) -> float:
    return max(values, key=_nan_first)


def _ratio(error: Vector, scale: Vector | float) -> float:
    """Largest |error|/scale, where 0/0 = 0; a scale that overflowed tells nothing."""
    error = np.abs(error)
    scale = np.broadcast_to(scale, error.shape)
    safe = np.where(error == 0, 1.0, scale)
    with np.errstate(divide="ignore"):
        return float(np.where(np.isinf(safe), np.inf, error / safe).max(initial=0.0))


def _row_scale(M: Matrix, x: Vector, rhs: Vector, X: float) -> Vector:
    """Per row, the larger of |aᵢ|·|x| + |bᵢ| and ‖aᵢ‖₁X."""
    if not rhs.size:  # sparse matrices take long over nothing
        return rhs
    own = abs(M) @ np.abs(x) + np.abs(rhs)
    return np.asarray(np.maximum(own, _row_sums(M) * X))


def _row_sums(M: Matrix) -> Vector:
    return np.asarray(abs(M).sum(axis=1), dtype=float).ravel()


def _row_maxima(M: Matrix) -> Vector:
    if 0 in M.shape:
        return np.zeros(M.shape[0])
    largest = abs(M).max(axis=1)
    return np.asarray(
        largest.toarray() if hasattr(largest, "toarray") else largest
    ).ravel()
