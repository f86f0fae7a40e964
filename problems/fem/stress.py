"""Stresses from displacements: at cell centres, Gauss points, recovered at nodes.

Superconvergent patch recovery after Zienkiewicz and Zhu (1992): bilinear quadrilaterals
have their superconvergent stresses at the cell centres; a linear polynomial is fitted
to those around each interior node. A boundary node takes the mean of the polynomials
of the interior nodes that it shares a cell with. Bodies share no nodes, so nothing is
averaged across bodies.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from harness import Vector
from problems.fem.elasticity import (
    GAUSS,
    Plane,
    cell_dofs,
    shape_gradients,
    strain_matrix,
)
from problems.fem.mesh import Mesh


def centre_stress(mesh: Mesh, D: NDArray[np.float64], u: Vector) -> NDArray[np.float64]:
    """Return σ = DBu (E, 3) at the cell centres, Pa; u in m, D (3, 3) or (E, 3, 3)."""
    return _stress_at(np.zeros(2), mesh, D, u)


def gauss_stress(mesh: Mesh, D: NDArray[np.float64], u: Vector) -> NDArray[np.float64]:
    """Return σ = DBu (E, 4, 3) at the 2×2 Gauss points, Pa; else as `centre_stress`."""
    return np.stack([_stress_at(point, mesh, D, u) for point in GAUSS], axis=1)


def _stress_at(
    point: Vector, mesh: Mesh, D: NDArray[np.float64], u: Vector
) -> NDArray[np.float64]:
    gradients, _ = shape_gradients(mesh.points[mesh.cells], point)
    DB = D @ strain_matrix(gradients)
    stress: NDArray[np.float64] = np.einsum("esd,ed->es", DB, u[cell_dofs(mesh)])
    return stress


def recover(mesh: Mesh, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Recover nodal values (N, k) from cell-centre values (E, k) by patch recovery."""
    nodes, cells = mesh.cells.ravel(), np.repeat(np.arange(len(mesh.cells)), 4)
    N, k = len(mesh.points), values.shape[1]
    size = np.ptp(mesh.points, axis=0).max()
    offset = (mesh.points[mesh.cells].mean(axis=1)[cells] - mesh.points[nodes]) / size
    basis = np.column_stack([np.ones(len(nodes)), offset])  # 1, x, y about the node
    normal, right = np.zeros((N, 3, 3)), np.zeros((N, 3, k))
    np.add.at(normal, nodes, basis[:, :, None] * basis[:, None, :])
    np.add.at(right, nodes, basis[:, :, None] * values[cells][:, None, :])

    interior = ~_on_boundary(mesh)
    polynomial = np.zeros((N, 3, k))
    polynomial[interior] = np.linalg.solve(normal[interior], right[interior])
    result = polynomial[:, 0]

    b, i = _neighbours(mesh, ~interior, interior)
    shift = np.column_stack([np.ones(len(b)), (mesh.points[b] - mesh.points[i]) / size])
    count = np.bincount(b, minlength=N)
    np.add.at(result, b, np.einsum("pt,ptk->pk", shift, polynomial[i]))
    result[count > 0] /= count[count > 0, None]
    lonely = ~interior & (count == 0)  # one layer of cells: no interior node nearby
    result[lonely] = right[lonely, 0] / normal[lonely, 0, 0, None]
    return result


def von_mises(stress: NDArray[np.float64], nu: Vector | float, plane: Plane) -> Vector:
    """Return σ_vM of (…, 3) stresses; plane strain has σ_z = ν(σ_x + σ_y)."""
    x, y, shear = np.moveaxis(stress, -1, 0)
    z = nu * (x + y) if plane == "strain" else np.zeros_like(x)
    squares = ((x - y) ** 2 + (y - z) ** 2 + (z - x) ** 2) / 2 + 3 * shear**2
    return np.asarray(np.sqrt(squares))


def _on_boundary(mesh: Mesh) -> NDArray[np.bool_]:
    """Mark nodes on an edge that belongs to one cell only."""
    edges = np.sort(
        np.stack([mesh.cells, np.roll(mesh.cells, -1, axis=1)], axis=-1).reshape(-1, 2)
    )
    edge, times = np.unique(edges, axis=0, return_counts=True)
    mark = np.zeros(len(mesh.points), dtype=bool)
    mark[edge[times == 1]] = True
    return mark


def _neighbours(
    mesh: Mesh, first: NDArray[np.bool_], second: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pair each node of `first` with those of `second` that share a cell with it."""
    a, b = np.repeat(mesh.cells, 4, axis=1).ravel(), np.tile(mesh.cells, 4).ravel()
    keep = first[a] & second[b]
    pairs = np.unique(np.stack([a[keep], b[keep]]), axis=1)
    return pairs[0], pairs[1]
