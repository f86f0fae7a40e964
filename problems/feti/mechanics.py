"""Elastic contact problems of torn bodies, for certificates."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, null_space
from scipy.sparse import block_diag as sparse_diag
from scipy.sparse import coo_array, csc_array, csr_array

from mortarbench.harness.distributed.comm import Lead
from mortarbench.harness.mechanics import (
    DecomposedMechanics,
    Real,
    contact_data,
    friction_discs,
)
from mortarbench.problems.fem.mesh import Nodes, dofs_of
from mortarbench.problems.feti.served import Served, parts_of
from mortarbench.problems.feti.subdivision import Points
from mortarbench.problems.feti.subdomains import DecomposedProblem, TornBodies


def torn_mechanics(
    served: Served, lead: Lead, K: csc_array | None = None
) -> Callable[[], DecomposedMechanics]:
    """Return a function that returns the data for certificates on rank 0.

    K : (n, n) stiffness matrix of the undivided bodies, if it is assembled
    """

    def mechanics() -> DecomposedMechanics:
        torn, parts = served.torn.floating, parts_of(served, lead)
        problem, contact = torn.problem, torn.problem.contact
        n = problem.components * problem.layout.nodes
        # all contact rows, and friction rows with bounds > 0
        slides = contact.bound > 0
        normals = contact.c.size - slides.size
        active = np.flatnonzero(np.append(np.ones(normals, dtype=bool), slides))
        B, bound = csr_array(contact.rows[active]), contact.bound[slides]
        at, diagonal = np.unique(B.indices).astype(np.int64), np.zeros(n)
        diagonal[at] = parts.diagonal(at)
        rigid, allowed, names = _rigid_motions(torn)
        return DecomposedMechanics(
            parts=parts,
            exact=contact_data(
                problem.load(np.arange(n)).astype(Real),
                (B, contact.c[active]),
                friction_discs(bound, contact.tangents, normals),
                np.unique(problem.fixed),
                diagonal,
            ),
            kernel=csr_array(rigid @ allowed),
            rigid=rigid,
            names=names,
            stored=None if K is None else csr_array(K),
        )

    return cache(mechanics)


def floating_bodies(problem: DecomposedProblem) -> list[int]:
    """Return the indices of the pieces that the supports allow to move rigidly."""
    layout, d = problem.layout, problem.components
    node, axis = np.divmod(problem.fixed, d)
    body = problem.piece_of[layout.holder(node)]

    def is_supported(b: int) -> bool:
        fixed = body == b
        if not fixed.any():
            return False
        points = layout.position(node[fixed])
        size = np.ptp(points, axis=0).max() or 1.0
        motions = _motions((points - points[0]) / size, axis[fixed], d)
        return bool(np.linalg.matrix_rank(motions) == motions.shape[1])

    return [b for b in range(int(problem.piece_of.max()) + 1) if not is_supported(b)]


def _motions(points: Points, axis: Nodes, d: int) -> NDArray[np.float64]:
    """Return the r = d (d + 1) / 2 rigid motions (k, r) at k displacement components.

    The modes are those of `problems.fem.elasticity.rigid_motions`, with rotations about
    the origin.

    points : (k, dim) point of each component
    axis : (k,) axis of each component, 0 … d − 1
    d : number of components per node
    """
    columns = [np.where(axis == k, 1.0, 0.0) for k in range(d)]
    for k, l in combinations(range(d), 2):
        column = np.where(axis == l, points[:, k], 0.0)
        columns.append(np.where(axis == k, -points[:, l], column))
    return np.stack(columns, axis=1)


def _rigid_motions(
    torn: TornBodies,
) -> tuple[csr_array, NDArray[np.float64], tuple[str, ...]]:
    """Return the rigid motions of the pieces that the supports do not fix.

    The results are the orthonormal motions (n, k), regardless of supports, orthonormal
    combinations (k, r) of them that the supports allow, and the names of the pieces.
    """
    problem, layout, d = torn.problem, torn.problem.layout, torn.problem.components
    n, numbers = d * layout.nodes, floating_bodies(problem)
    if not numbers:
        return csr_array((n, 0)), np.zeros((0, 0)), ()
    piece = np.empty(layout.nodes, dtype=np.int64)
    piece[torn.nodes.number] = problem.piece_of[torn.nodes.subdomain]
    rows, modes, allowed = list[Nodes](), list[NDArray[np.float64]](), list[Points]()
    for b in numbers:
        nodes = np.flatnonzero(piece == b)
        points = layout.position(nodes)
        points = points - points.mean(axis=0)
        axis = np.tile(np.arange(d), nodes.size)
        motions = _motions(np.repeat(points, d, axis=0), axis, d)
        modes.append(np.linalg.qr(motions)[0])
        rows.append(dofs_of(nodes, d))
        at_fixed = modes[-1][np.isin(rows[-1], problem.fixed)]
        free = null_space(at_fixed) if at_fixed.size else np.eye(motions.shape[1])
        allowed.append(free)
    entries = coo_array(sparse_diag(modes, format="coo"))
    place = np.concatenate(rows)[entries.row], entries.col
    rigid = csr_array((entries.data, place), shape=(n, entries.shape[1]))
    names = tuple(problem.names[b] for b in numbers)
    return rigid, block_diag(*allowed), names
