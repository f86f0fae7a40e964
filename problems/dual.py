"""Dualisation and elimination: transforms of a QP, each with its way back (Section 3).

The primal QP is  min ½uᵀKu − fᵀu  subject to  B_E u = c_E, B_I u ≤ c_I.  Each transform
returns the new problem together with a function that takes a solution of the new
problem to a solution (point and all multipliers) of the old one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_array, csr_array, vstack

from harness import QP, Solution, Vector, no_rows
from problems.inverse import GeneralisedInverse


class Transformed(NamedTuple):
    """A transformed QP, its way back, and the relation between the objectives."""

    qp: QP
    recover: Callable[[Solution], Solution]
    sign: float  #: old objective = sign·new objective + constant, at the solutions
    constant: float


def dualise(primal: QP, inverse: GeneralisedInverse) -> Transformed:
    """Turn the primal QP into its dual, equations (2)-(5) of the paper.

    ::

        min ½λᵀFλ − dᵀλ   subject to   λ_I ≥ 0,  RᵀBᵀλ = Rᵀf
        F = BK⁺Bᵀ,  d = BK⁺f − c,  B = [B_E; B_I],  c = [c_E; c_I]

    The way back is (6):  u = K⁺(f − Bᵀλ) − Rα  with α the multipliers of RᵀBᵀλ = Rᵀf.
    (The paper's (4) has Rᵀb for Rᵀf.) The multipliers of the bounds are Bu − c, and at
    the solutions  ½uᵀKu − fᵀu = −(½λᵀFλ − dᵀλ) − ½fᵀK⁺f.

    Parameters
    ----------
    primal : sparse P = K; no finite bounds
    inverse : K⁺ with an orthonormal basis R of ker K (no columns for a regular K)

    """
    f, m_E = -primal.q, primal.b.size
    B, c = csr_array(vstack([primal.A, primal.G])), np.append(primal.b, primal.h)
    R, m = inverse.kernel, c.size
    W = inverse.half(B)
    w = inverse.half(f[None])[:, 0]
    F, BR = W.T @ W, B @ R
    F = (F + F.T) / 2
    qp = QP(
        P=F, q=c - W.T @ w,
        A=BR.T if R.shape[1] else no_rows(m), b=R.T @ f,
        G=no_rows(m), h=np.zeros(0),
        lb=np.append(np.full(m_E, -np.inf), np.zeros(m - m_E)), ub=np.full(m, np.inf),
    )  # fmt: skip

    def recover(s: Solution) -> Solution:
        u = inverse(f - B.T @ s.x) - R @ s.y
        return _like(s, u, s.x[:m_E], s.x[m_E:])

    return Transformed(qp, recover, -1.0, -0.5 * float(w @ w))


def eliminate(primal: QP) -> Transformed:
    """Take out the unknowns that single-entry equality rows prescribe.

    ::

        u = [u_f; u_D],  u_D given:  min ½u_fᵀK_ff u_f − (f_f − K_fD u_D)ᵀu_f

    The multipliers of the rows taken out are the reactions, from stationarity.

    Raises
    ------
    ValueError
        When an equality row has more than one entry.

    """
    rows = csr_array(primal.A)
    if (np.diff(rows.indptr) != 1).any():
        raise ValueError("elimination needs equality rows with exactly one entry each")
    fixed, n = rows.indices, primal.q.size
    free = np.setdiff1d(np.arange(n), fixed)
    u0 = np.zeros(n)
    u0[fixed] = primal.b / rows.data
    K, G, Ku0 = csc_array(primal.P), csc_array(primal.G), primal.P @ u0
    reduced = QP(
        P=K[free][:, free], q=(primal.q + Ku0)[free],
        A=no_rows(free.size), b=np.zeros(0),
        G=csr_array(G[:, free]), h=primal.h - primal.G @ u0,
        lb=np.full(free.size, -np.inf), ub=np.full(free.size, np.inf),
    )  # fmt: skip

    def recover(s: Solution) -> Solution:
        u = u0.copy()
        u[free] = s.x
        gradient = primal.P @ u + primal.q + primal.G.T @ s.z
        return _like(s, u, -gradient[fixed] / rows.data, s.z)

    constant = float(0.5 * u0 @ Ku0 + primal.q @ u0)
    return Transformed(reduced, recover, 1.0, constant)


def _like(s: Solution, u: Vector, y: Vector, z: Vector) -> Solution:
    return Solution(status=s.status, x=u, y=y, z=z, z_box=np.zeros(u.size),
                    iterations=s.iterations, counts=s.counts,
                    message=s.message)  # fmt: skip
