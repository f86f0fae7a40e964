"""Dualisation: transforms of a QP, each with its inverse (paper, Section 3).

The primal QP is  min ½uᵀKu − fᵀu  subject to  B_E u = c_E, B_I u ≤ c_I.  Each transform
returns a new problem together with a function that maps a solution of the new problem
to a solution (point and all multipliers) of the primal problem.

Friction with a prescribed bound g adds Σ g‖Tu − s‖ to the objective. The friction rows
T, s follow the contact rows in B and c, and the friction multipliers λ_t follow those
of contact in z of the primal solution. They satisfy ‖λ_t‖ ≤ g, a bound in 2D and a disc
in 3D.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array, vstack

from mortarbench.harness import QP, Friction, Solution, Structure, Vector, no_rows
from mortarbench.harness.mechanics import (
    NO_FRICTION,
    contact_rows,
    friction_discs,
    friction_multipliers,
    with_friction,
)
from mortarbench.harness.sets.box import Box
from mortarbench.harness.sets.convex import ConvexSet
from mortarbench.problems.fem.inverse import GeneralisedInverse


class Transformed(NamedTuple):
    """A transformed QP with its inverse map and the relation between the objectives."""

    qp: QP
    recover: Callable[[Solution], Solution]
    sign: float  #: primal objective = sign·new objective + constant, at the solutions
    constant: float
    #: function that returns a primal point (n,), which may be valid at the interface
    #: only; for undivided bodies, it is cheaper than `recover`
    interface_displacement: Callable[[Solution], Vector]


def primal_form(primal: QP, friction: Friction = NO_FRICTION) -> Transformed:
    """Return the primal problem as a QP, including the work of friction.

    The inverse map drops the auxiliary variables that
    `harness.mechanics.with_friction` introduces.
    """
    qp, n = with_friction(primal, friction), primal.q.size
    if not friction.bound.size:
        return Transformed(qp, lambda s: s, 1.0, 0.0, lambda s: s.x)

    def recover(s: Solution) -> Solution:
        y, normal, tangential = friction_multipliers(s, primal, friction)
        z = np.append(normal, tangential)
        return replace(s, x=s.x[:n], y=y, z=z, z_box=np.zeros(n))

    return Transformed(qp, recover, 1.0, 0.0, lambda s: s.x[:n])


def dualise(
    primal: QP,
    inverse: GeneralisedInverse,
    free: Vector | None = None,
    friction: Friction = NO_FRICTION,
) -> Transformed:
    """Return the dual of a primal QP, equations (2)-(5) of the paper.

    ::

        min ½λᵀFλ − dᵀλ   subject to   λ_I ≥ 0,  RᵀBᵀλ = Rᵀf
        F = BK⁺Bᵀ,  d = BK⁺f − c,  B = [B_E; B_I],  c = [c_E; c_I]

    The inverse map is (6),  u = K⁺(f − Bᵀλ) − Rα,  where α are the multipliers of
    RᵀBᵀλ = Rᵀf. (Equation (4) of the paper has Rᵀb instead of Rᵀf.) The multipliers of
    the bounds are Bu − c, and at the solutions  ½uᵀKu − fᵀu = −(½λᵀFλ − dᵀλ) − ½fᵀK⁺f.

    Parameters
    ----------
    primal : QP with P = K and no finite bounds
    inverse : K⁺ with an orthonormal basis R of ker K (no columns if K is nonsingular)
    free : K⁺f (n,); None if not computed yet
    friction : law with a prescribed bound; its rows follow the contact rows

    """
    return _dual(primal, inverse, free, friction, with_supports=True)


def dual_bounds(
    primal: QP,
    clamped: GeneralisedInverse,
    free: Vector | None = None,
    friction: Friction = NO_FRICTION,
) -> Transformed:
    """Return the dual with respect to the contact rows alone.

    ::

        min ½λᵀFλ − dᵀλ   subject to   λ ≥ 0,  RᵀB_Iᵀλ = Rᵀf
        F = B_I K⁺B_Iᵀ,  d = B_I u_0 − c_I,  u_0 = w + K⁺(f − Kw)

    where w contains the prescribed displacements and zeros. The equations state
    equilibrium with respect to the rigid motions R that the supports allow; if the
    supports exclude all rigid motions, there are no equations. The inverse map is
    u = w + K⁺(f − Kw − B_Iᵀλ) − Rα  as in `dualise`. The multipliers of the supports
    (reactions) follow from stationarity. At the solutions,
    ½uᵀKu − fᵀu = −(½λᵀFλ − dᵀλ) + ½wᵀ(Ku_0 − f) − ½fᵀu_0.

    Parameters
    ----------
    primal : QP whose equality rows are unit vectors
    clamped : K⁺ that is zero at the components these rows fix, with an orthonormal
        basis R of the rigid motions that are zero there
    free : u_0 (n,); None if not computed yet
    friction : law with a prescribed bound; its rows follow the contact rows

    """
    return _dual(primal, clamped, free, friction, with_supports=False)


def with_friction_bound(dual: QP, friction: Friction) -> QP:
    """Return `dual` with the bounds of `friction`; the same inverse map applies."""
    contact = dual.q.size - friction.bound.size
    free = int(np.isinf(dual.lb[:contact]).sum())
    sets = multiplier_sets(free, contact - free, friction.bound, friction.tangents)
    return replace(dual, sets=sets)


def multiplier_sets(
    free: int, normal: int, bound: Vector, tangents: int
) -> tuple[ConvexSet, ...]:
    """Return the sets of multipliers: λ_E free, λ_n ≥ 0, then ‖λ_t‖ ≤ g.

    Parameters
    ----------
    free : number of equality rows
    normal : number of contact rows
    bound : (k,) friction bound g of each friction row
    tangents : number of friction rows per node, 1 or 2

    """
    contact = free + normal
    upper = np.full(contact + bound.size, np.inf)
    lower = -upper
    lower[free:contact] = 0.0
    return Box(lower, upper), friction_discs(bound, tangents, contact)


def _without_motion(u: Vector, inverse: GeneralisedInverse, s: Solution) -> Vector:
    """Return u − Rα, where α are the multipliers y of the equations RᵀBᵀλ = Rᵀf."""
    R = inverse.kernel
    return u - R @ s.y if R.shape[1] else u


def _dual(
    primal: QP,
    inverse: GeneralisedInverse,
    free: Vector | None,
    friction: Friction,
    *,
    with_supports: bool,
) -> Transformed:
    """Return the dual with respect to the contact rows B, which support rows precede.

    ::

        min ½λᵀBK⁺Bᵀλ − (Bu_0 − c)ᵀλ,   RᵀBᵀλ = Rᵀf,   u_0 = w + K⁺(f − Kw)

    with_supports : True if the support rows are rows of B, so that w = 0
    """
    f, B, c = -primal.q, *contact_rows(primal, friction)
    m_E, fixed, lift = 0, np.unique(csr_array(primal.A).indices), primal.A.T @ primal.b
    if with_supports:
        B, c = csr_array(vstack([primal.A, B])), np.append(primal.b, c)
        m_E, fixed, lift = primal.b.size, fixed[:0], np.zeros_like(f)
    pushed, R = f - primal.P @ lift, inverse.kernel
    free = lift + inverse(pushed) if free is None else free
    structure = Structure(K=primal.P, B=B, fixed=fixed.astype(np.int64))
    moves = bool(R.shape[1])
    qp = QP(
        P=inverse.congruence(B),
        q=c - B @ free,
        A=np.ascontiguousarray((B @ R).T) if moves else no_rows(c.size),
        b=R.T @ f if moves else np.zeros(0),
        sets=multiplier_sets(m_E, primal.h.size, friction.bound, friction.tangents),
        structure=structure,
    )

    def recover(s: Solution) -> Solution:
        u = lift + _without_motion(inverse(pushed - B.T @ s.x), inverse, s)  # (6)
        y = s.x[:m_E]
        if not with_supports:
            y = -primal.A @ (primal.P @ u - f + B.T @ s.x)
        return replace(s, x=u, y=y, z=s.x[m_E:], z_box=np.zeros(u.size))

    def interface_displacement(s: Solution) -> Vector:
        return _without_motion(free - inverse.at_constraints(B.T @ s.x), inverse, s)

    constant = 0.5 * float(lift @ (primal.P @ free - f)) - 0.5 * float(f @ free)
    return Transformed(qp, recover, -1.0, constant, interface_displacement)
