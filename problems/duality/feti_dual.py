"""The dual of a contact problem on decomposed bodies, with its inverse map.

::

    min ½λᵀFλ − dᵀλ   subject to   λ_I ≥ 0,   RᵀBᵀλ = Rᵀf
    F = BK⁺Bᵀ,   d = BK⁺f − c,   K = diag(K_s),   R = diag(R_s)

This is the dual of `problems.duality.dualisation`, assembled from subdomains (Total
FETI; Dostál, Horák and Kučera 2006). F is an operator: a sum over subdomains, which is
stored as plain arrays (`problems.feti.operators`). RᵀBᵀ is sparse.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from mortarbench.harness import QP, Friction, Solution, Vector, no_rows
from mortarbench.harness.mechanics import NO_FRICTION, contact_rows
from mortarbench.problems.duality.dualisation import Transformed, multiplier_sets
from mortarbench.problems.feti.operator_arrays import dual_operator
from mortarbench.problems.feti.operators import block_bytes, touched_components
from mortarbench.problems.feti.subdomain_classes import DecomposedBodies


def feti_dual(
    bodies: DecomposedBodies, primal: QP, friction: Friction = NO_FRICTION
) -> Transformed:
    """Return the dual of a contact problem on decomposed bodies.

    The inverse map computes  v = K⁺(f − Bᵀλ) − Rα,  where α are the multipliers of
    RᵀBᵀλ = Rᵀf, and averages over the copies of each node, u = (TᵀT)⁻¹Tᵀv. At the
    solution, all copies are equal. The multipliers of the supports (reactions) follow
    from stationarity.

    Parameters
    ----------
    bodies : decomposed bodies, whose last constraint rows are the contact rows of
        `primal` followed by the friction rows
    primal : QP of the undivided bodies
    friction : friction law with a prescribed bound

    """
    domains, R, T = bodies.domains, bodies.domains.kernel, bodies.spread
    B, f, m_E, scale = bodies.B, bodies.f, bodies.equalities, bodies.scale
    free = domains.inverse(f)
    m_I = primal.h.size
    bound = friction.bound / scale[m_I:]
    qp = QP(
        P=dual_operator(B, domains, m_E, bodies.redundant),
        q=bodies.c - B @ free,
        A=csr_array((B @ R).T),
        b=R.T @ f,
        G=no_rows(bodies.c.size),
        h=np.zeros(0),
        sets=multiplier_sets(m_E, m_I, bound, friction.tangents),
    )
    copies = np.asarray(T.multiply(T).sum(axis=0)).ravel()
    copies[copies == 0] = 1  # eliminated components have no copy, and u = 0 there
    B_I = contact_rows(primal, friction)[0]

    def displacement(s: Solution) -> Vector:
        v = domains.inverse(f - B.T @ s.x) - R @ s.y
        return np.asarray((T.T @ v) / copies)

    def recover(s: Solution) -> Solution:
        u, z = displacement(s), scale * s.x[m_E:]
        reactions = -primal.A @ (primal.P @ u + primal.q + B_I.T @ z)
        return replace(s, x=u, y=reactions, z=z, z_box=np.zeros(u.size))

    return Transformed(qp, recover, -1.0, -0.5 * float(f @ free), displacement)


def feti_matrices(bodies: DecomposedBodies, dual: QP) -> dict[str, Any]:
    """Return F, d, B, c and R of the dual, keyed by their names in the paper."""
    R = bodies.domains.kernel
    return {"F": dual.P, "d": -dual.q, "B": bodies.B, "c": bodies.c, "R": R}


def decomposition_quantities(bodies: DecomposedBodies, dual: QP) -> dict[str, Any]:
    """Return the quantities that describe the size of a decomposition.

    * `subdomains`: number of subdomains
    * `kinds`: number of classes of congruent subdomains; each class has one factor
    * `torn_dofs`: number of displacement unknowns, including all copies
    * `multipliers`: number of rows of B
    * `coarse_unknowns`: number of rigid motions of all subdomains
    * `explicit_subdomains`: number of subdomains with explicit blocks (K⁺)_bb and S_bb;
      for all other subdomains, every product requires a solve
    * `explicit_mib`: memory for these blocks, MiB
    """
    explicit = dual.P.arrays["explicit"]
    sizes = np.array(
        [part.size for part in touched_components(bodies.B, bodies.domains)]
    )
    taken = block_bytes(sizes, bodies.domains)
    return {
        "subdomains": bodies.class_of.size,
        "kinds": len(bodies.classes),
        "torn_dofs": bodies.f.size,
        "multipliers": bodies.c.size,
        "coarse_unknowns": dual.b.size,
        "explicit_subdomains": int(explicit[bodies.class_of].sum()),
        "explicit_mib": float(taken[explicit].sum() / 2**20),
    }
