"""Errors of one answer against the reference solution.

An answer may deviate from the reference by an error that follows from its claim. At
tolerance t it is verified if its KKT residuals are at most 10t; the residual of the gap
is g/E with the energy
E = ‖u*‖². With the identity of Prager and Synge (`harness.verify.certificate`, (2)),

    ‖u − u*‖² + ‖u_λ − u*‖² ≤ 2g ≤ 20t‖u*‖²,

so that the errors of the displacement and of the equilibrium u_λ under the contact
forces are at most √(20t)‖u*‖. The second error is that of the contact forces in the
dual norm, ‖Bᵀ(λ − λ*)‖; the multipliers themselves need not be unique.

A row with compliance Dᵢ counts as closed if λᵢDᵢ > gapᵢ. An error of that energy
changes λᵢDᵢ or gapᵢ by at most sᵢ = √(20t Dᵢ)‖u*‖. Reference and answer therefore
contradict each other on a row only if max(λᵢDᵢ, gapᵢ) > sᵢ in both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from mortarbench.harness.mechanics import Exact, Extended, Mechanics, Real
from mortarbench.harness.qp import QP, Matrix, Vector
from mortarbench.harness.solution import Solution
from mortarbench.harness.verify.active_set_refinement import equilibrium
from mortarbench.harness.verify.kkt import allowed
from mortarbench.harness.verify.references import ReferencePoint


@dataclass(frozen=True, kw_only=True)
class Assessment:
    """Errors of one answer; None if a quantity does not exist for the problem.

    Energies are relative to ½‖u*‖². Lengths in the energy norm are relative to ‖u*‖.
    """

    error: float  #: ‖u − u*‖
    equilibrium_error: float | None  #: ‖u_λ − u*‖
    energy: float  #: J(u) − J(u*)
    penetration: float | None  #: max (Bu − c)₊ over the mesh size
    balance: float | None  #: largest unbalanced relative force or moment on a body
    active: int | None  #: number of closed contact rows
    rows: tuple[int, ...] = ()  #: rows whose state contradicts that of the reference
    #: rows with a tensile multiplier, λᵢDᵢ < −sᵢ, or one above the friction bound by sᵢ
    pulls: tuple[int, ...] = ()


class Deviation(NamedTuple):
    """Difference of an answer from the reference, divided by ‖u*‖; see `distances`."""

    u: Vector  #: (n,)
    equilibrium: Vector | None  #: (n,) difference of u_λ; None without mechanics


def energy_allowed(tol: float) -> float:
    """Return √(20 tol), the relative error that a verified answer may have."""
    return float(np.sqrt(2 * allowed(tol)))


@np.errstate(all="ignore")  # a point may hold 1e300
def assess(
    mechanics: Mechanics, truth: ReferencePoint, s: Solution, tol: float
) -> tuple[Assessment, Deviation]:
    """Measure `s`, a finite point from ``mechanics.to_primal``, against the solution.

    If the solution is zero, errors are relative to the displacement under the load
    without contact.
    """
    exact = mechanics.exact
    u, lam = s.x.astype(Real), mechanics.multipliers(s).astype(Real)
    gap, contact = -exact.motion(u), exact.contact
    at_rest, _ = equilibrium(mechanics, exact.f - exact.B.T @ lam)
    off, off_rest = u - truth.u, at_rest - truth.equilibrium
    K = mechanics.stiffness
    slope = K @ truth.u - exact.f
    rubbed = exact.friction_work(u) - exact.friction_work(truth.u)
    energy = float(slope @ off + 0.5 * (off @ (K @ off)) + rubbed.sum())
    length = truth.norm or mechanics.norm(equilibrium(mechanics, exact.f)[0])
    small: Extended = Real(energy_allowed(tol) * length) * np.sqrt(exact.compliance)
    closed, strict = _closed(exact, lam, gap, small)
    true_gap = -exact.motion(truth.u)
    true_closed, true_strict = _closed(exact, truth.multipliers, true_gap, small)
    contradicted = (closed != true_closed) & strict & true_strict & contact
    beyond = -exact.forces.interior(lam) * exact.compliance
    assessment = Assessment(
        error=_over(mechanics.norm(off), length),
        equilibrium_error=_over(mechanics.norm(off_rest), length),
        energy=_over(energy, 0.5 * length**2),
        penetration=float((-gap[contact]).max(initial=Real(0)) / mechanics.mesh_size),
        balance=_balance(mechanics, s),
        active=int(closed[contact].sum()),
        rows=_numbers(contradicted),
        pulls=_numbers(beyond > small),
    )
    scale = length or 1.0
    return assessment, Deviation(
        np.asarray(off / scale, dtype=float), np.asarray(off_rest / scale, dtype=float)
    )


@np.errstate(all="ignore")
def assess_point(qp: QP, truth: Solution, s: Solution) -> tuple[Assessment, Deviation]:
    """Measure a finite point of a QP without mechanics, in the seminorm ‖·‖_P.

    Errors are relative to `point_norm`. All solutions have the same Px, and the same x
    if P is positive definite.
    """
    norm = point_norm(qp, truth)
    off = s.x - truth.x
    P_off = qp.P @ off
    energy = float((qp.P @ truth.x + qp.q) @ off + 0.5 * (off @ P_off))
    assessment = Assessment(
        error=_over(float(np.sqrt(max(off @ P_off, 0.0))), norm),
        equilibrium_error=None,
        energy=_over(energy, 0.5 * norm**2),
        penetration=None,
        balance=None,
        active=None,
    )
    return assessment, Deviation(off / (norm or 1.0), None)


def point_norm(qp: QP, s: Solution) -> float:
    """Return √max(xᵀPx, |qᵀx|), the scale of relative errors of x."""
    return float(np.sqrt(max(s.x @ (qp.P @ s.x), abs(qp.q @ s.x))))


@np.errstate(all="ignore")
def distances(
    P: Matrix, kernel: NDArray[np.float64], points: Sequence[Vector]
) -> NDArray[np.float64]:
    """Return ‖v_i − v_j‖_P of all pairs (k, k), inf if one of them is not finite.

    Cancellation in the Gram matrix hides distances below 1e-8 of the norm of the longer
    vector. The points must therefore be deviations from a common reference.
    common reference.

    kernel : (n, r) orthonormal rigid motions, which are projected out
    """
    V = np.stack(points, axis=1)
    V = V - kernel @ (kernel.T @ V)
    gram = V.T @ np.asarray(P @ V)
    norms = np.diag(gram)  # squared
    squares = np.maximum(norms[:, None] + norms[None, :] - 2 * gram, 0)
    lengths = np.sqrt(np.where(np.isfinite(squares), squares, np.inf))
    np.fill_diagonal(lengths, 0)  # inf − inf would be NaN
    return np.asarray(lengths)


def _closed(
    exact: Exact, lam: Extended, gap: Extended, small: Extended
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return masks (m,) of closed rows, and of rows that are clearly closed or open."""
    force = lam * exact.compliance
    return force > gap, np.maximum(force, gap) > small


def _balance(mechanics: Mechanics, s: Solution) -> float | None:
    """Return the largest |Rᵀ(f − B_Eᵀy − B_Iᵀz)| of a body, relative to its forces."""
    R, primal = mechanics.rigid, mechanics.primal
    if not R.shape[1]:
        return None
    pressing = mechanics.rows.T @ mechanics.multipliers(s)
    forces = (-primal.q, -(primal.A.T @ s.y), -pressing)
    left = np.abs(R.T @ np.sum(forces, axis=0))
    acting = np.abs(R).T @ np.sum(np.abs(forces), axis=0)
    overlap = csr_array(np.abs(R).T @ np.abs(R))
    _, body = connected_components(overlap, directed=False)
    per_body = [
        _over(float(left[body == b].max()), float(acting[body == b].max()))
        for b in range(body.max() + 1)
    ]
    return max(per_body)


def _numbers(rows: NDArray[np.bool_]) -> tuple[int, ...]:
    return tuple(np.flatnonzero(rows).tolist())


def _over(value: float, scale: float) -> float:
    """Divide with 0/0 = 0; NaN, which results from overflow, becomes inf."""
    if value == 0:
        return 0.0
    ratio = value / scale if scale else np.inf
    return float(np.inf if np.isnan(ratio) else ratio)
