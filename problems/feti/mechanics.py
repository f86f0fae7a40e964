"""Elastic contact problems of torn bodies, for certificates."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from scipy.linalg import null_space
from scipy.sparse import csc_array, csr_array, hstack

from mortarbench.harness.mechanics import (
    DecomposedMechanics,
    Real,
    contact_data,
    friction_discs,
)
from mortarbench.problems.fem.elasticity import gram_schmidt, rigid_motions
from mortarbench.problems.fem.mesh import dofs_of
from mortarbench.problems.feti.served import Served
from mortarbench.problems.feti.subdomains import DecomposedProblem

EPS = float(np.finfo(float).eps)


def torn_mechanics(
    served: Served, K: csc_array | None = None
) -> Callable[[], DecomposedMechanics]:
    """Return a function that returns the torn bodies on rank 0, for certificates.

    K : (n, n) stiffness matrix of the undivided bodies; None if it is not assembled
    """

    @cache
    def bodies() -> DecomposedMechanics:
        problem, parts = served.torn.problem, served.local_problems
        contact, bound = problem.contact, problem.contact.bound
        n, m = problem.components * problem.layout.nodes, contact.c.size
        acts = np.append(np.ones(m - bound.size), bound) > 0
        rows, diagonal = csr_array(contact.rows[acts]), np.zeros(n)
        at = np.unique(rows.indices)
        diagonal[at] = parts.diagonal(at)
        return DecomposedMechanics(
            parts=parts,
            exact=contact_data(
                problem.load.astype(Real),
                (rows, contact.c[acts]),
                friction_discs(bound[bound > 0], contact.tangents, m - bound.size),
                np.unique(problem.fixed),
                diagonal,
            ),
            stored=None if K is None else csr_array(K),
            **_rigid_motions(problem),
        )

    return bodies


def _rigid_motions(problem: DecomposedProblem) -> dict[str, Any]:
    """Return the fields of `DecomposedMechanics` that describe rigid motions."""
    layout, d, names = problem.layout, problem.components, list[str]()
    node, axis = np.divmod(problem.fixed, d)
    body = problem.piece_of[layout.holder(node)]
    none = csr_array((d * layout.nodes, 0))
    kernel, rigid = [none], [none]
    for b, name in enumerate(problem.names):
        fixed, axes = node[body == b], axis[body == b]
        is_inside = np.zeros(layout.nodes, dtype=bool)
        is_inside[layout.mesh.cells[problem.piece_of[layout.label] == b]] = True
        of_body = np.flatnonzero(is_inside)
        points, dofs = layout.mesh.points[of_body], dofs_of(of_body, d)
        R = np.ones((len(points), 1))
        if d > 1:
            R = rigid_motions(points / np.ptp(points, axis=0).max())
        at = d * np.searchsorted(of_body, fixed) + axes
        # the R factor has the same kernel; an SVD of R[at] would form a square matrix
        rows = np.linalg.qr(R[at], mode="r")
        allowed = null_space(rows, rcond=EPS * max(R[at].shape))
        if not allowed.shape[1]:  # the supports prevent all motions
            continue
        allowed = gram_schmidt(R @ allowed)
        allowed[at] = 0
        embedding = csr_array(
            (np.ones(dofs.size), (dofs, np.arange(dofs.size))),
            shape=(d * layout.nodes, dofs.size),
        )
        rigid.append(embedding @ csr_array(gram_schmidt(R)))
        kernel.append(embedding @ csr_array(allowed))
        names.append(name)
    return {
        "kernel": csr_array(hstack(kernel)),
        "rigid": csr_array(hstack(rigid)),
        "names": tuple(names),
    }
