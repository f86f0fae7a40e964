"""Optimality of a primal-dual point, measured by us and never by the solver.

Every residual is scale-free: multiplying the objective, a constraint row or the unit of
x by a constant changes none of them, so that one threshold means the same for every
problem. All four are zero exactly at a solution.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from harness.qp import QP, Matrix, Vector
from harness.record import Verdict
from harness.solution import Solution, Status

VERIFIED_FACTOR = 10.0  #: verified: every residual ≤ this times the tolerance asked for


class Residuals(NamedTuple):
    """Scale-free KKT residuals; NaN where the point holds NaN."""

    primal: float  #: worst violation of a row or bound, relative to |aᵢ|₁‖x‖∞ + |bᵢ|
    dual: float  #: stationarity and multiplier signs, relative to the largest term
    complementarity: float  #: worst |multiplier·slack|, relative to the energy
    gap: float  #: |primal − dual objective|, relative to the energy

    @property
    def worst(self) -> float:
        """The largest of the four; NaN if any is NaN."""
        return float(np.max(self))


def kkt_residuals(qp: QP, s: Solution) -> Residuals:
    """Measure how far `s` is from satisfying the KKT conditions of `qp`.

    With S the largest of ‖Px‖, ‖q‖, ‖Aᵀy‖, ‖Gᵀz‖, ‖z_box‖ (max norms) and E the largest
    of |xᵀPx|, |qᵀx|, |bᵀy|, |hᵀz|, |lbᵀz_box⁻ + ubᵀz_box⁺|:

    * primal: (aᵢx − bᵢ)/(‖aᵢ‖₁‖x‖∞ + |bᵢ|), likewise for G x ≤ h and the bounds
    * dual: ‖Px + q + Aᵀy + Gᵀz + z_box‖∞/S, and zᵢ⁻‖gᵢ‖∞/S for a multiplier of the
      wrong sign; one on an absent bound has the wrong sign
    * complementarity: max |zᵢ(h − Gx)ᵢ|/E over rows and bounds
    * gap: |xᵀPx + qᵀx + bᵀy + hᵀz + lbᵀz_box⁻ + ubᵀz_box⁺|/E

    An absolute residual hides the units, and primal, stationarity and gap alone accept
    a multiplier of the wrong sign: x = 0, z = −1 for min ½(x+1)², x ≤ 0.
    """
    Px, Ay, Gz = qp.P @ s.x, qp.A.T @ s.y, qp.G.T @ s.z
    lower, upper = np.isfinite(qp.lb), np.isfinite(qp.ub)
    z_lb, z_ub = np.maximum(-s.z_box, 0), np.maximum(s.z_box, 0)
    slack_lb, slack_ub = (s.x - qp.lb)[lower], (qp.ub - s.x)[upper]
    slack = qp.h - qp.G @ s.x

    x_size = _sup(s.x)
    primal = max(
        _ratio(qp.A @ s.x - qp.b, _row_sums(qp.A) * x_size + np.abs(qp.b)),
        _ratio(np.minimum(slack, 0), _row_sums(qp.G) * x_size + np.abs(qp.h)),
        _ratio(np.minimum(slack_lb, 0), x_size + np.abs(qp.lb[lower])),
        _ratio(np.minimum(slack_ub, 0), x_size + np.abs(qp.ub[upper])),
        key=_nan_first,
    )

    S = max(map(_sup, (Px, qp.q, Ay, Gz, s.z_box)), key=_nan_first)
    dual = max(
        _ratio(Px + qp.q + Ay + Gz + s.z_box, S),
        _ratio(np.minimum(s.z, 0) * _row_maxima(qp.G), S),
        _ratio(z_lb[~lower], S),
        _ratio(z_ub[~upper], S),
        key=_nan_first,
    )

    box = -qp.lb[lower] @ z_lb[lower] + qp.ub[upper] @ z_ub[upper]
    energies = np.array([s.x @ Px, qp.q @ s.x, qp.b @ s.y, qp.h @ s.z, box])
    E = _sup(energies)
    products = (s.z * slack, z_lb[lower] * slack_lb, z_ub[upper] * slack_ub)
    complementarity = max((_ratio(p, E) for p in products), key=_nan_first)
    return Residuals(
        primal, dual, complementarity, _ratio(energies.sum(keepdims=True), E)
    )


def verdict(claimed: Status, residuals: Residuals, tol: float) -> Verdict:
    """Judge a point by its residuals; the claim decides only how a failure is called.

    Verified: every residual ≤ 10·tol, whatever was claimed. A refuted claim of success
    is `inaccurate` while at least half of the digits asked for are there (worst
    residual ≤ √(10·tol)), and `wrong` beyond.
    """
    allowed = VERIFIED_FACTOR * tol
    if claimed is Status.DECLINED:
        return Verdict.DECLINED
    if residuals.worst <= allowed:
        return Verdict.VERIFIED
    match claimed:
        case Status.SOLVED:
            close = residuals.worst <= max(allowed, np.sqrt(allowed))
            return Verdict.INACCURATE if close else Verdict.WRONG
        case Status.INFEASIBLE:
            return Verdict.INFEASIBLE_CLAIM
        case _:
            return Verdict(claimed.value)


def _sup(v: Vector) -> float:
    return float(np.abs(v).max(initial=0.0))


def _nan_first(value: float) -> float:
    """Order NaN above every number, so that it cannot hide behind one."""
    return np.inf if np.isnan(value) else value


def _ratio(error: Vector, scale: Vector | float) -> float:
    """Largest |error|/scale, where 0/0 = 0."""
    error = np.abs(error)
    scale = np.broadcast_to(scale, error.shape)
    safe = np.where(error == 0, 1.0, scale)
    with np.errstate(divide="ignore"):
        return float((error / safe).max(initial=0.0))


def _row_sums(M: Matrix) -> Vector:
    return np.asarray(abs(M).sum(axis=1), dtype=float).ravel()


def _row_maxima(M: Matrix) -> Vector:
    if 0 in M.shape:
        return np.zeros(M.shape[0])
    largest = abs(M).max(axis=1)
    return np.asarray(
        largest.toarray() if hasattr(largest, "toarray") else largest
    ).ravel()
