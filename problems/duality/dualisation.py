"""Dualisation: transforms of a QP, each with its way back (paper, Section 3).

The primal QP is  min ½uᵀKu − fᵀu  subject to  B_E u = c_E, B_I u ≤ c_I.  Each transform
returns the new problem together with a function that takes a solution of the new
problem to a solution (point and all multipliers) of the old one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array, vstack

from harness import QP, Solution, Structure, Vector, no_rows
from problems.fem.inverse import GeneralisedInverse


class Transformed(NamedTuple):
    """A transformed QP, its way back, and the relation between the objectives."""

    qp: QP
    recover: Callable[[Solution], Solution]
    sign: float  #: old objective = sign·new objective + constant, at the solutions
    constant: float
    #: old point (n,), right where constraints can touch it; cheaper than `recover`
    touched: Callable[[Solution], Vector]


def dualise(
    primal: QP, inverse: GeneralisedInverse, free: Vector | None = None
) -> Transformed:
    """Turn the primal QP into its dual, equations (2)-(5) of the paper.

    ::

        min ½λᵀFλ − dᵀλ   subject to   λ_I ≥ 0,  RᵀBᵀλ = Rᵀf
        F = BK⁺Bᵀ,  d = BK⁺f − c,  B = [B_E; B_I],  c = [c_E; c_I]

    The way back is (6):  u = K⁺(f − Bᵀλ) − Rα  with α the multipliers of RᵀBᵀλ = Rᵀf.
    (The paper's (4) has Rᵀb for Rᵀf.) The multipliers of the bounds are Bu − c, and at
    the solutions  ½uᵀKu − fᵀu = −(½λᵀFλ − dᵀλ) − ½fᵀK⁺f.

    Parameters
    ----------
    primal : P = K; no finite bounds
    inverse : K⁺ with an orthonormal basis R of ker K (no columns for a regular K)
    free : K⁺f (n,), where it is known already

    """
    f, m_E = -primal.q, primal.b.size
    B, c = csr_array(vstack([primal.A, primal.G])), np.append(primal.b, primal.h)
    R = inverse.kernel
    free = inverse(f) if free is None else free
    structure = Structure(K=primal.P, B=B, fixed=np.zeros(0, dtype=np.int64))
    lb = np.where(np.arange(c.size) < m_E, -np.inf, 0.0)
    qp = _dual(structure, c, inverse, free, lb)
    if R.shape[1]:
        qp = replace(qp, A=np.ascontiguousarray((B @ R).T), b=R.T @ f)

    def recover(s: Solution) -> Solution:
        u = inverse(f - B.T @ s.x)
        if R.shape[1]:
            u = u - R @ s.y
        return replace(s, x=u, y=s.x[:m_E], z=s.x[m_E:], z_box=np.zeros(u.size))

    def touched(s: Solution) -> Vector:
        u = free - inverse.at_constraints(B.T @ s.x)
        return u - R @ s.y if R.shape[1] else u

    return Transformed(qp, recover, -1.0, -0.5 * float(f @ free), touched)


def dual_bounds(
    primal: QP, clamped: GeneralisedInverse, free: Vector | None = None
) -> Transformed:
    """Dualise the contact rows alone: λ ≥ 0 is the only constraint.

    ::

        min ½λᵀFλ − dᵀλ   subject to   λ ≥ 0,    F = B_I K⁺B_Iᵀ,  d = B_I K⁺f − c_I

    The way back is  u = K⁺(f − B_Iᵀλ);  the multipliers of the supports are the
    reactions, from stationarity.

    Parameters
    ----------
    primal : its equality rows hold single components at zero, by unit entries
    clamped : K⁺ that is zero on these components
    free : K⁺f (n,), where it is known already

    """
    f, B = -primal.q, csr_array(primal.G)
    free = clamped(f) if free is None else free
    held = np.unique(csr_array(primal.A).indices).astype(np.int64)
    structure = Structure(K=primal.P, B=B, fixed=held)
    qp = _dual(structure, primal.h, clamped, free, np.zeros(primal.h.size))

    def recover(s: Solution) -> Solution:
        u = clamped(f - B.T @ s.x)
        reactions = -primal.A @ (primal.P @ u - f + B.T @ s.x)
        return replace(s, x=u, y=reactions, z=s.x, z_box=np.zeros(u.size))

    def touched(s: Solution) -> Vector:
        return free - clamped.at_constraints(B.T @ s.x)

    return Transformed(qp, recover, -1.0, -0.5 * float(f @ free), touched)


def _dual(
    structure: Structure,
    c: Vector,
    inverse: GeneralisedInverse,
    free: Vector,
    lb: Vector,
) -> QP:
    """Emit  min ½λᵀBK⁺Bᵀλ − (BK⁺f − c)ᵀλ,  λ ≥ lb."""
    m, B = c.size, structure.B
    return QP(
        P=inverse.congruence(B), q=c - B @ free,
        A=no_rows(m), b=np.zeros(0), G=no_rows(m), h=np.zeros(0),
        lb=lb, ub=np.full(m, np.inf), structure=structure,
    )  # fmt: skip
