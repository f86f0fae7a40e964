"""Errors of one answer against the reference solution.

Let u and λ be the displacement and the multipliers of the answer, and u* and λ* the
displacement and the multipliers of the solution. Let ‖·‖ be the energy norm, and u_λ
the displacement in equilibrium with the load and the contact forces −Bᵀλ. An answer is
verified at tolerance t if its KKT residuals are at most 10t. The residual of the
duality gap g is g/E with an energy E; here, E is taken to be ‖u*‖². By the identity of
Prager and Synge (`harness.verify.certificate`, (2)),

    ‖u − u*‖² + ‖u_λ − u*‖² ≤ 2g ≤ 20t‖u*‖²,

so that a verified answer has errors ‖u − u*‖ and ‖u_λ − u*‖ of at most √(20t)‖u*‖. The
error ‖u_λ − u*‖ equals the error ‖Bᵀ(λ − λ*)‖ of the contact forces in the dual norm.
It is used instead of the error of λ, since the multipliers need not be unique.

A contact row i with the estimated compliance Dᵢ counts as closed if λᵢDᵢ > gapᵢ. Errors
within this bound change λᵢDᵢ or gapᵢ by about sᵢ = √(20t Dᵢ)‖u*‖. A reference and an
answer with different states of row i therefore contradict each other only if
max(λᵢDᵢ, gapᵢ) > sᵢ for the reference and for the answer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from mortarbench.harness.crossval.references import ReferencePoint
from mortarbench.harness.mechanics import Exact, Extended, Mechanics, Real
from mortarbench.harness.qp import QP, Vector
from mortarbench.harness.solution import Solution
from mortarbench.harness.verify.active_set_refinement import equilibrium
from mortarbench.harness.verify.kkt import allowed


@dataclass(frozen=True, kw_only=True)
class Assessment:
    """Errors of one answer, in the notation of the docstring of this module.

    Energies are relative to ½‖u*‖², and energy norms are relative to ‖u*‖. For a QP
    without mechanics, fields that require the mechanics are None.
    """

    error: float  #: ‖u − u*‖, error of the displacement
    equilibrium_error: float | None  #: ‖u_λ − u*‖, error of the contact forces
    energy: float  #: J(u) − J(u*), where J is the potential energy
    #: max (Bu − c)₊ of all contact rows, divided by the mesh size
    penetration: float | None
    #: largest resultant force or moment on a body, relative to the forces on the body
    balance: float | None
    active: int | None  #: number of closed contact rows
    #: contact rows whose state contradicts the state in the reference
    rows: tuple[int, ...] = ()
    #: contact rows in tension, λᵢDᵢ < −sᵢ, and friction rows that exceed the friction
    #: bound by more than sᵢ/Dᵢ
    pulls: tuple[int, ...] = ()


def energy_allowed(tol: float) -> float:
    """Return √(20 tol), a bound on the relative error of answers verified at `tol`."""
    return float(np.sqrt(2 * allowed(tol)))


@np.errstate(all="ignore")  # components of a point may be as large as 1e300
def assess(
    mechanics: Mechanics, truth: ReferencePoint, s: Solution, tol: float
) -> tuple[Assessment, Vector]:
    """Compute the errors of an answer, and (u − u*)/‖u*‖ (n,).

    If ‖u*‖ = 0, errors are relative to the energy norm of the displacement under the
    load without contact.

    truth : reference point
    s : answer as a finite point, returned by ``mechanics.to_primal``
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
    return assessment, np.asarray(off / (length or 1.0), dtype=float)


@np.errstate(all="ignore")
def assess_point(qp: QP, truth: Solution, s: Solution) -> tuple[Assessment, Vector]:
    """Compute the errors of a finite point of a QP without mechanics, and x − x*.

    Errors are measured in the seminorm ‖·‖_P, relative to `point_norm`. The errors do
    not depend on the choice of the reference solution, since Px is equal for all
    solutions.
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
    return assessment, off


def point_norm(qp: QP, s: Solution) -> float:
    """Return √max(xᵀPx, |qᵀx|), the scale of errors in the seminorm ‖·‖_P."""
    return float(np.sqrt(max(s.x @ (qp.P @ s.x), abs(qp.q @ s.x))))


def _closed(
    exact: Exact, lam: Extended, gap: Extended, small: Extended
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return masks (m,) of the closed rows, and of the rows whose state is certain.

    lam : (m,) multipliers
    small : (m,) errors sᵢ that the tolerance permits
    """
    force = lam * exact.compliance
    return force > gap, np.maximum(force, gap) > small


def _balance(mechanics: Mechanics, s: Solution) -> float | None:
    """Return the largest relative resultant force or moment on a body, or None.

    Resultants are Rᵀ(f − B_Eᵀy − Bᵀλ), where R contains the rigid motions of the
    bodies, B_E the rows of the supports, and B the rows of contact and friction.
    Resultants are divided by the sum of the absolute forces on the body. The value is
    None if there are no rigid motions.
    """
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
    """Divide with 0/0 = 0; the result is inf instead of NaN after an overflow."""
    if value == 0:
        return 0.0
    ratio = value / scale if scale else np.inf
    return float(np.inf if np.isnan(ratio) else ratio)
