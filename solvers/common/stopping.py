"""Stopping test of the in-house solvers: relative KKT residuals in scaled variables.

The test is of the kind that OSQP (Stellato et al., Math. Program. Comput. 12, 2020) and
SCS (O'Donoghue, SIAM J. Optim. 31, 2021) use, in the variables √D x with D = diag P.
With Xⱼ = ‖√D x‖∞/√Dⱼ, the size of variable j, a point solves a QP to `tol` if

* |aᵢx − bᵢ| ≤ tol·(|bᵢ| + Σ|aᵢⱼ|Xⱼ) for each equality row; likewise the violation of
  each inequality row, bound, disc and cone
* ‖r/√D‖∞ ≤ tol·max(‖Px/√D‖∞, ‖q/√D‖∞), r = Px + q + Aᵀy + Gᵀz + z_box
* |xᵀPx + qᵀx + bᵀy + hᵀz + σ(z_box)| ≤ tol·max(|xᵀPx|, |qᵀx|), where σ is the support
  function of the sets, for bounds the product of bounds and multipliers

Multipliers with a wrong sign count as zero. `solvers.smalbe.compiled` contains the same
test for bounds and equality rows.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mortarbench.harness import QP, Solution, Vector
from mortarbench.harness.sets.convex import admissible

#: Rounding error of a sum relative to its terms, in units of the precision of x. Instead
#: of an absolute tolerance, the rounding errors of r and of the gap are subtracted: if
#: q = 0 and Px = 0, both scales are zero up to rounding.
ROUNDING = 8
#: diagonal entries of P below this factor times their mean count as zero
NO_CURVATURE = 1e-12


def curvatures(qp: QP) -> Vector:
    """Return diag P (n,), with a typical curvature in place of negligible entries.

    The typical curvature is the mean of the positive entries, else ‖q‖∞, else 1.
    """
    d = _diagonal(qp)
    if not d.any():
        return d + (np.abs(qp.q).max(initial=0.0) or 1.0)
    usual = d.sum() / np.count_nonzero(d)
    return np.where(d > NO_CURVATURE * usual, d, usual)


@np.errstate(all="ignore")  # a point of a failed solve may contain NaN, inf, or 1e300
def relative_residual(qp: QP, s: Solution) -> float:
    """Return the least `tol` to which a point solves a QP; takes one product with P.

    The result is inf or NaN if the point contains NaN or inf.
    """
    x, y, z, z_box = s.x, s.y, np.maximum(s.z, 0), admissible(qp.sets, s.z_box)
    Px, root, eps = qp.P @ x, np.sqrt(curvatures(qp)), np.finfo(x.dtype).eps
    X = _sup(root * x) / root
    r, errors = Px + qp.q + z_box, []
    if y.size:
        r = r + qp.A.T @ y
        errors.append(_ratio(qp.A @ x - qp.b, abs(qp.b) + abs(qp.A) @ X))
    if z.size:
        r = r + qp.G.T @ z
        errors.append(_ratio(_over(qp.h - qp.G @ x), abs(qp.h) + abs(qp.G) @ X))
    for limit in (limit for one in qp.sets for limit in one.limits(x)):
        errors.append(_ratio(_over(limit.slack), limit.size + limit.sized(X)))
    supports = [one.support(z_box) for one in qp.sets]
    energies = np.array([x @ Px, qp.q @ x])
    gap = energies.sum() + qp.b @ y + qp.h @ z + sum(one.value for one in supports)
    curved = _diagonal(qp) * abs(x)
    terms = (curved + abs(qp.q)) @ abs(x) + abs(qp.b) @ abs(y) + abs(qp.h) @ z
    terms += sum(one.terms for one in supports)
    force, rounding = max(_sup(Px / root), _sup(qp.q / root)), ROUNDING * eps
    errors.append(_ratio(_sup(r / root), force, rounding * _sup(curved / root)))
    errors.append(_ratio(gap, _sup(energies), rounding * terms))
    return float(np.max(errors))


def _diagonal(qp: QP) -> Vector:
    """Return max(Pⱼⱼ, 0) (n,), zero if P is an operator without a known diagonal."""
    d = qp.diagonal()
    return 0 * qp.q if d is None else np.maximum(d, 0)


def _over(slack: Vector) -> Vector:
    return np.maximum(-slack, 0)


def _ratio(error: Any, size: Any, rounding: Any = 0.0) -> Any:
    """Return the largest (|error| − rounding)⁺/size, where 0/0 = 0."""
    error = np.maximum(abs(error) - rounding, 0)
    return np.where(error == 0, 0, error / size).max(initial=0.0)


def _sup(v: Vector) -> Any:
    return abs(v).max(initial=0.0)
