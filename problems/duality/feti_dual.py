"""The dual of a contact problem on decomposed bodies, with its inverse map.

::

    min ½λᵀFλ − dᵀλ   subject to   λ_I ≥ 0,   RᵀBᵀλ = Rᵀf
    F = BK⁺Bᵀ,   d = BK⁺f − c,   K = diag(K_s),   R = diag(R_s)

This is the dual of `problems.duality.dualisation`, assembled from subdomains (Total
FETI; Dostál, Horák and Kučera 2006). F is an operator: a sum over subdomains
(`problems.feti.operators`). RᵀBᵀ is sparse.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from mortarbench.harness import QP, Case, Friction, Solution, Vector
from mortarbench.harness.digest import hex_digest
from mortarbench.harness.mechanics import NO_FRICTION, contact_rows
from mortarbench.harness.sets.convex import ConvexSet
from mortarbench.problems.duality.dualisation import Transformed, multiplier_sets
from mortarbench.problems.feti.operators import block_bytes, touched_components
from mortarbench.problems.feti.served import (
    OperatorOnRanks,
    Served,
    operator_of,
)
from mortarbench.problems.feti.subdomains import TornBodies


@dataclass(frozen=True, eq=False)
class TornDual:
    """The dual of torn bodies."""

    served: Served

    @property
    def torn(self) -> TornBodies:
        """The torn bodies."""
        return self.served.torn

    @property
    def sets(self) -> tuple[ConvexSet, ...]:
        """The sets of the multipliers: λ_n ≥ 0, ‖λ_t‖ ≤ g/scale."""
        contact = self.torn.problem.contact
        normals = contact.c.size - contact.bound.size
        bound = contact.bound / self.torn.problem.contact_scale[normals:]
        E = self.torn.rows.equalities
        return multiplier_sets(E, normals, bound, contact.tangents)

    @property
    def qp(self) -> QP:
        """The dual QP."""
        return self._qp_and_constant[0]

    @property
    def constant(self) -> float:
        """−½fᵀK⁺f, the negative objective of the dual minus that of the primal QP."""
        return self._qp_and_constant[1]

    @cached_property
    def _qp_and_constant(self) -> tuple[QP, float]:
        (B, c, _), R, f = self.torn.rows, self.torn.kernel(), self.torn.f
        free = self.torn.apply("inverse", f)  # displacement without multipliers
        qp = QP(
            P=operator_of(self.served),
            q=c - B @ free,
            A=csr_array((B @ R).T),
            b=R.T @ f,
            sets=self.sets,
        )
        return qp, -0.5 * float(f @ free)

    def displacement(self, s: Solution) -> Vector:
        """Return u = (TᵀT)⁻¹Tᵀv (n,), the average over the copies of each node.

        The torn displacement is v = K⁺(f − Bᵀλ) − Rα, where α are the multipliers of
        RᵀBᵀλ = Rᵀf. At the solution, all copies are equal.
        """
        B, T, f = self.torn.rows.B, self.torn.spread, self.torn.f
        v = self.torn.apply("inverse", f - B.T @ s.x) - self.torn.moved(s.y)
        copies = np.bincount(self.torn.component, minlength=T.shape[1])
        return np.asarray((T.T @ v) / copies)

    def multipliers(self, s: Solution) -> Vector:
        """Return the multipliers (m_I,) of the unscaled contact and friction rows."""
        rows, scale = self.torn.rows, self.torn.problem.contact_scale
        return np.asarray(scale * s.x[rows.equalities :])


def feti_dual(
    served: Served, primal: QP, friction: Friction = NO_FRICTION
) -> Transformed:
    """Return the dual of a contact problem on decomposed bodies.

    The multipliers of the supports (reactions) follow from stationarity.

    Parameters
    ----------
    served : decomposed bodies, whose contact rows are the contact rows of `primal`
        followed by the friction rows
    primal : QP of the undivided bodies
    friction : friction law with a prescribed bound

    """
    dual = TornDual(served)
    B_I = contact_rows(primal, friction)[0]

    def recover(s: Solution) -> Solution:
        u, z = dual.displacement(s), dual.multipliers(s)
        reactions = -primal.A @ (primal.P @ u + primal.q + B_I.T @ z)
        return replace(s, x=u, y=reactions, z=z, z_box=np.zeros(u.size))

    return Transformed(dual.qp, recover, -1.0, dual.constant, dual.displacement)


def digest_of(served: Served, torn: TornBodies, others: int = 0) -> str:
    """Return a digest of the dual that does not depend on the number of processes.

    The rounding of q depends on this number. Therefore the digest contains the
    classes of the subdomains, B, c, f and the friction bounds instead. If the dual
    follows from solutions of `others` previous problems, which have rounding errors
    too, it contains the data of the first of these problems and their number.

    torn : bodies of the first problem, in the subdomains of `served`
    """
    (B, c, _), bound = torn.rows, torn.problem.contact.bound
    arrays = (torn.domains.class_of, B.indptr, B.indices, B.data, c, torn.f, bound)
    data = (x.tobytes() for x in arrays)
    name_of = served.torn.of_classes("names")
    names = (name_of[k].encode() for k in sorted(name_of))
    return hex_digest((*names, *data, str(others).encode()), 16)


def with_decomposition(
    case: Case, served: Served, first: TornBodies, others: int = 0
) -> Case:
    """Return the case of a dual in subdomains with its digest, matrices and sizes.

    first, others : see `digest_of`
    """
    sizes = decomposition_quantities(served, case.qp)
    (B, c, _), q, matrices = served.torn.rows, case.qp.q, dict[str, Any]()
    if not isinstance(case.qp.P, OperatorOnRanks):  # which cannot be exported
        matrices = {"F": case.qp.P, "d": -q, "B": B, "c": c, "R": served.torn.kernel()}
    return replace(
        case,
        digest=digest_of(served, first, others),
        quantities=lambda s: {**case.quantities(s), **sizes},
        matrices=matrices,
    )


def decomposition_quantities(served: Served, dual: QP) -> dict[str, Any]:
    """Return the quantities that describe the size of a decomposition.

    * `subdomains`: number of subdomains
    * `kinds`: number of classes of congruent subdomains; each class has one factor
    * `torn_dofs`: number of displacement unknowns, including all copies
    * `multipliers`: number of rows of B
    * `coarse_unknowns`: number of rigid motions of all subdomains
    * `explicit_subdomains`: number of subdomains with explicit blocks (K⁺)_bb and S_bb;
      for all other subdomains, every product requires a solve
    * `explicit_mib`: memory for these blocks, MiB, stored once
    """
    domains, B = served.domains, served.torn.rows.B
    explicit = served.explicit
    sizes = np.array([part.size for part in touched_components(B, domains)])
    return {
        "subdomains": domains.class_of.size,
        "kinds": domains.sizes.size,
        "torn_dofs": int(domains.start[-1]),
        "multipliers": B.shape[0],
        "coarse_unknowns": dual.b.size,
        "explicit_subdomains": int(explicit[domains.class_of].sum()),
        "explicit_mib": float(block_bytes(sizes, domains)[explicit].sum() / 2**20),
    }
