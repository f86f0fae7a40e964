"""The dual of a contact problem on torn bodies, with its way back (Total FETI).

::

    min ½λᵀFλ − dᵀλ   subject to   λ_I ≥ 0,   RᵀBᵀλ = Rᵀf
    F = BK⁺Bᵀ,   d = BK⁺f − c,   K = diag(K_s),   R = diag(R_s)

as in `problems.duality.dualisation`, but that everything is a sum over subdomains: F is
an operator of plain arrays (`problems.feti.operators`), and RᵀBᵀ is sparse.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from mortarbench.harness import QP, Friction, Solution, Vector, no_rows
from mortarbench.harness.mechanics import NO_FRICTION, contact_rows
from mortarbench.problems.duality.dualisation import Transformed
from mortarbench.problems.feti.operator_arrays import dual_operator
from mortarbench.problems.feti.operators import block_bytes, touched_components
from mortarbench.problems.feti.subdomain_classes import DecomposedBodies


def feti_dual(
    torn: DecomposedBodies, primal: QP, friction: Friction = NO_FRICTION
) -> Transformed:
    """Turn a contact problem on torn bodies into its dual.

    The way back takes  v = K⁺(f − Bᵀλ) − Rα  with α the multipliers of RᵀBᵀλ = Rᵀf,
    and averages the copies of a node, which are the same at the solution:
    u = (TᵀT)⁻¹Tᵀv. Multipliers of the supports are the reactions, from stationarity.

    Parameters
    ----------
    torn : its last rows are the contact rows of `primal`, then those of the friction
    primal : the problem of the whole
    friction : with a given bound

    """
    domains, R, T = torn.domains, torn.domains.kernel, torn.spread
    B, f, m_E, scale = torn.B, torn.f, torn.equalities, torn.scale
    free = domains.inverse(f)
    m_I = primal.h.size
    bound = friction.bound / scale[m_I:]
    qp = QP(
        P=dual_operator(B, domains, m_E), q=torn.c - B @ free,
        A=csr_array((B @ R).T), b=R.T @ f,
        G=no_rows(torn.c.size), h=np.zeros(0),
        lb=np.concatenate([np.full(m_E, -np.inf), np.zeros(m_I), -bound]),
        ub=np.concatenate([np.full(m_E + m_I, np.inf), bound]),
    )  # fmt: skip
    copies = np.asarray(T.multiply(T).sum(axis=0)).ravel()
    copies[copies == 0] = 1  # eliminated components are zero
    B_I = contact_rows(primal, friction)[0]

    def displacement(s: Solution) -> Vector:
        v = domains.inverse(f - B.T @ s.x) - R @ s.y
        return np.asarray((T.T @ v) / copies)

    def recover(s: Solution) -> Solution:
        u, z = displacement(s), scale * s.x[m_E:]
        reactions = -primal.A @ (primal.P @ u + primal.q + B_I.T @ z)
        return replace(s, x=u, y=reactions, z=z, z_box=np.zeros(u.size))

    return Transformed(qp, recover, -1.0, -0.5 * float(f @ free), displacement)


def feti_matrices(torn: DecomposedBodies, dual: QP) -> dict[str, Any]:
    """Name the matrices of the dual as the paper does: F, d, B, c and R."""
    R = torn.domains.kernel
    return {"F": dual.P, "d": -dual.q, "B": torn.B, "c": torn.c, "R": R}


def decomposition_quantities(torn: DecomposedBodies, dual: QP) -> dict[str, Any]:
    """Report how bodies are torn, and how F is multiplied with.

    kinds: of subdomains, each with one factor. torn_dofs: all copies counted.
    multipliers: rows of B. explicit_subdomains: whose blocks (K⁺)_bb and S_bb are
    formed, the others solve in every product. explicit_mib: what they take, MiB.
    """
    explicit = dual.P.arrays["explicit"]
    sizes = np.array([part.size for part in touched_components(torn.B, torn.domains)])
    taken = block_bytes(sizes, torn.domains)
    return {
        "subdomains": torn.class_of.size,
        "kinds": len(torn.classes),
        "torn_dofs": torn.f.size,
        "multipliers": torn.c.size,
        "explicit_subdomains": int(explicit[torn.class_of].sum()),
        "explicit_mib": float(taken[explicit].sum() / 2**20),
    }
