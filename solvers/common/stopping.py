"""Stopping test of the in-house solvers: relative KKT residuals in scaled variables.

The test is of the kind that OSQP (Stellato et al., Math. Program. Comput. 12, 2020) and
SCS (O'Donoghue, SIAM J. Optim. 31, 2021) use, in the variables √D x with D = diag P.
With the scale of forces F = max(‖Px/√D‖∞, ‖q/√D‖∞) and the sizes of the variables
Xⱼ = max(‖√D x‖∞, tol·F)/√Dⱼ, a point solves a QP to the tolerance `tol` if

* |aᵢx − bᵢ| ≤ tol·(|bᵢ| + max(Σ|aᵢⱼxⱼ|, κᵢΣ|aᵢⱼ|Xⱼ)) for each equality row, where κᵢ is
  1e-3 if bᵢ ≠ 0, and 0.1 if bᵢ = 0, as in the rule of verdicts; likewise the violation
  of each inequality row and bound, and of each disc and cone
* ‖r/√D‖∞ ≤ tol·F with r = Px + q + Aᵀy + Gᵀz + z_box
* |xᵀPx + qᵀx + bᵀy + hᵀz + σ(z_box)| ≤ tol·max(|xᵀPx|, |qᵀx|, tol·F²), where σ is the
  support function of the sets, for bounds the product of bounds and multipliers

The terms tol·F and tol·F² replace an absolute tolerance: if the solution is x = 0, the
other scales vanish, and a residual r of size tol·F√D moves x by tol·F/√D. If Px and q
are negligible, F is ‖√D x‖∞, or 1 for P = 0. Rounding errors of r and of the gap
are subtracted, but at most `tol` times the scale. Multipliers with a wrong sign count
as zero. The file solvers/smalbe/stopping.pxi contains the same test for bounds and
equality rows.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mortarbench.harness import QP, Solution, Vector
from mortarbench.harness.sets.convex import admissible

#: rounding errors of Px/√D relative to ‖√D x‖∞, and of xᵀPx relative to xᵀDx, in units
#: of the precision of x
ROUNDING = 8
#: diagonal entries of P below this factor times their mean count as zero, and so do
#: forces (q/√D and Px/√D) below this factor times ‖√D x‖∞
NEGLIGIBLE = 1e-12
#: Least size of the terms of a row relative to those at X, if the right-hand side is
#: not 0, and if it is. The judge has the same constants. It refuted answers of tests
#: that measure rows relative to X, if the variables of a row are much smaller than X.
OWN_FLOOR, FLOOR = 1e-3, 0.1


def curvatures(qp: QP) -> Vector:
    """Return diag P (n,), with a typical curvature in place of negligible entries.

    The typical curvature is the mean of the positive entries, else ‖q‖∞, else 1.
    """
    d = _diagonal(qp)
    if not d.any():
        return d + (np.abs(qp.q).max(initial=0.0) or 1.0)
    usual = d.sum() / np.count_nonzero(d)
    return np.where(d > NEGLIGIBLE * usual, d, usual)


@np.errstate(all="ignore")  # a point of a failed solve may contain NaN, inf, or 1e300
def relative_residual(qp: QP, s: Solution, tol: float) -> float:
    """Return the largest error of a point, which solves a QP if the result is ≤ `tol`.

    The call takes one product with P. The result is inf or NaN if the point contains
    NaN or inf.

    tol : the tolerance, on which the scales depend if x is nearly zero
    """
    x, y, z, z_box = s.x, s.y, np.maximum(s.z, 0), admissible(qp.sets, s.z_box)
    Px, root, eps = qp.P @ x, np.sqrt(curvatures(qp)), ROUNDING * np.finfo(x.dtype).eps
    force, size = max(_sup(Px / root), _sup(qp.q / root)), _sup(root * x)
    is_curved = _diagonal(qp).any()
    if force <= NEGLIGIBLE * size:
        force = size if is_curved else 1.0
    least = tol * force if is_curved else 0.0
    X = max(size, least) / root
    r, errors = Px + qp.q + z_box, []
    if y.size:
        r = r + qp.A.T @ y
        sizes = abs(qp.A) @ abs(x), abs(qp.A) @ X
        errors.append(_relative(qp.A @ x - qp.b, qp.b, *sizes))
    if z.size:
        r = r + qp.G.T @ z
        sizes = abs(qp.G) @ abs(x), abs(qp.G) @ X
        errors.append(_relative(_over(qp.h - qp.G @ x), qp.h, *sizes))
    for limit in (limit for one in qp.sets for limit in one.limits(x)):
        sizes = limit.terms, X[limit.variable]
        errors.append(_relative(_over(limit.slack), limit.size, *sizes))
    energies, work = np.array([x @ Px, qp.q @ x]), qp.b @ y + qp.h @ z
    gap = energies.sum() + work + sum(one.support(z_box) for one in qp.sets)
    energy = max(_sup(energies), least * force) or force * size
    terms = (root * x) @ (root * x)
    for error, scale, rounding in (
        (_sup(r / root), force, eps * size),
        (gap, energy, eps * terms),
    ):
        error = np.maximum(abs(error) - np.minimum(rounding, tol * scale), 0)
        errors.append(_ratio(error, scale))
    return float(np.max(errors))


def _diagonal(qp: QP) -> Vector:
    """Return max(Pⱼⱼ, 0) (n,), zero if P is an operator without a known diagonal."""
    d = qp.diagonal()
    return 0 * qp.q if d is None else np.maximum(d, 0)


def _relative(error: Vector, rhs: Vector, terms: Vector, at_X: Vector) -> Any:
    """Return the largest error of rows relative to their right-hand sides and terms."""
    least = np.where(rhs != 0, OWN_FLOOR, FLOOR) * at_X
    return _ratio(error, abs(rhs) + np.maximum(terms, least))


def _over(slack: Vector) -> Vector:
    return np.maximum(-slack, 0)


def _ratio(error: Any, size: Any) -> Any:
    """Return the largest |error|/size, where 0/0 = 0."""
    return np.where(error == 0, 0, abs(error) / size).max(initial=0.0)


def _sup(v: Vector) -> Any:
    return abs(v).max(initial=0.0)
