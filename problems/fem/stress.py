"""Stresses from displacements at cell centres and Gauss points, and recovery at nodes.

Nodal stresses follow from superconvergent patch recovery (Zienkiewicz and Zhu 1992).
Stresses are superconvergent at the centres of multilinear cells, and most accurate at
the centroids of linear triangles and tetrahedra. Around each interior node, a linear
polynomial is fitted to these values. At a boundary node, the polynomials of all
interior nodes that share a cell with the node are averaged. At a boundary node that
shares no cell with an interior node (the corner of a single triangle), the averages at
the boundary nodes of its cells are averaged; if there are none (in a single layer of
cells), the stresses of its cells are averaged. Bodies have no common nodes, so that no
average extends over several bodies.
"""

from __future__ import annotations

from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from mortarbench.harness import Vector
from mortarbench.harness.mechanics import boundary_facets
from mortarbench.problems.fem.elasticity import (
    Plane,
    mean_dilatation,
    shape_gradients,
    strain_matrix,
)
from mortarbench.problems.fem.mesh import Mesh, dofs_of

#: numbers of cells and of nodes that are evaluated at a time to limit the memory
STRIP_CELLS = STRIP_NODES = 2**14


def centre_stress(mesh: Mesh, D: NDArray[np.float64], u: Vector) -> NDArray[np.float64]:
    """Return σ = DBu (E, v) at the cell centres, Pa; u in m, D (v, v) or (E, v, v)."""
    stress = np.empty((len(mesh.cells), D.shape[-1]))
    if mesh.dim == 2:
        stress = _stress_at(mesh.element.centre, mesh, D, u)
    # the centre of a degenerate hexahedron is not that of the wedge or tetrahedron
    for block in mesh.blocks if mesh.dim > 2 else ():
        part = Mesh(mesh.points, block.nodes, {})
        of_cells = D if D.ndim == 2 else D[block.cells]
        stress[block.cells] = _stress_at(part.element.centre, part, of_cells, u)
    each = D.reshape(-1, *D.shape[-2:])
    material = (
        np.arange(len(mesh.cells)) if D.ndim > 2 else np.zeros_like(mesh.cells[:, 0])
    )
    for nearly in mean_dilatation(mesh, each, material):
        off = np.einsum("em,em->e", nearly.mean - nearly.centre, u[nearly.dofs])
        stress[nearly.cells, : mesh.dim] += (nearly.kappa * off)[:, None]
    return stress


def gauss_stress(mesh: Mesh, D: NDArray[np.float64], u: Vector) -> NDArray[np.float64]:
    """Return σ = DBu (E, q, v) at the Gauss points, Pa; see `centre_stress`."""
    stresses = [_stress_at(point, mesh, D, u) for point in mesh.element.points]
    return np.stack(stresses, axis=1)


def _stress_at(
    point: Vector, mesh: Mesh, D: NDArray[np.float64], u: Vector
) -> NDArray[np.float64]:
    stress = np.empty((len(mesh.cells), D.shape[-1]))
    for first in range(0, len(stress), STRIP_CELLS):
        strip = slice(first, first + STRIP_CELLS)
        cells = mesh.cells[strip]
        gradients, _ = shape_gradients(mesh.points[cells], point)
        u_e = u[dofs_of(cells, mesh.dim)].reshape(len(cells), -1, 1)
        strain = strain_matrix(gradients) @ u_e
        stress[strip] = ((D if D.ndim == 2 else D[strip]) @ strain)[..., 0]
    return stress


def recover(mesh: Mesh, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Recover nodal values (N, k) from cell-centre values (E, k) by patch recovery."""
    corner = np.ones(mesh.cells.shape, dtype=bool)
    corner[:, 1:] = mesh.cells[:, 1:] != mesh.cells[:, :-1]
    N, dim = mesh.points.shape
    interior = np.ones(N, dtype=bool)
    interior[boundary_facets(mesh.cells, dim)] = False
    k, terms = values.shape[1], dim + 1
    size = np.ptp(mesh.points, axis=0).max()
    cells = np.repeat(np.arange(len(corner)), corner.sum(axis=1))
    where, shape = (mesh.cells[corner], cells), (N, len(corner))
    of_node = csr_array((np.ones(cells.size), where), shape=shape)
    centre = of_node.T @ mesh.points / corner.sum(axis=1)[:, None]
    # basis 1, x, … relative to the node, in units of the extent of the mesh
    nodes = np.repeat(np.arange(N), np.diff(of_node.indptr))
    offset = (centre[of_node.indices] - mesh.points[nodes]) / size
    basis = [of_node.data, *offset.T]
    normal, right = np.zeros((N, terms, terms)), np.zeros((N, terms, k))
    for p, q in combinations_with_replacement(range(terms), 2):
        normal[:, p, q] = normal[:, q, p] = np.bincount(nodes, basis[p] * basis[q], N)
    for p, weights in enumerate(basis):
        data = weights, of_node.indices, of_node.indptr
        right[:, p] = csr_array(data, shape=shape) @ values

    polynomial = np.zeros((N, terms, k))
    for first in range(0, N, STRIP_NODES):
        strip = first + np.flatnonzero(interior[first : first + STRIP_NODES])
        polynomial[strip] = np.linalg.solve(normal[strip], right[strip])
    has_value = interior
    for _ in range(2):  # average over interior nodes, then over boundary nodes
        b, i = _neighbours(mesh, ~has_value, has_value)
        moved = polynomial[i]  # expanded about node b
        offset = (mesh.points[b] - mesh.points[i]) / size
        moved[:, 0] += np.einsum("px,pxk->pk", offset, moved[:, 1:])
        np.add.at(polynomial, b, moved)
        count = np.bincount(b, minlength=N)
        polynomial[count > 0] /= count[count > 0, None, None]
        has_value = has_value | (count > 0)
    # each polynomial is expanded about its node: its constant term is the nodal value
    result = polynomial[:, 0]
    # nodes of a single layer of cells: average over adjacent cells
    isolated = ~has_value
    result[isolated] = right[isolated, 0] / normal[isolated, 0, 0, None]
    return result


def von_mises(
    stress: NDArray[np.float64], nu: Vector | float, plane: Plane | None
) -> Vector:
    """Return the von Mises stress (…) of stresses in Voigt's notation.

    Stresses are (…, 3) in 2D, and (…, 6) if `plane` is None.

    In plane strain, σ_z = ν(σ_x + σ_y).
    """
    if plane is None:
        x, y, z, *shears = np.moveaxis(stress, -1, 0)
        shear = np.sqrt(sum(s**2 for s in shears))
        return von_mises_of(np.stack([x, y, shear, z], axis=-1))
    x, y, shear = np.moveaxis(stress, -1, 0)
    z = nu * (x + y) if plane == "strain" else np.zeros_like(x)
    return von_mises_of(np.stack([x, y, shear, z], axis=-1))


def von_mises_of(stress: NDArray[np.float64]) -> Vector:
    """Return the von Mises stress (…) of stresses (…, 4): σ_x, σ_y, τ_xy, σ_z."""
    x, y, shear, z = np.moveaxis(stress, -1, 0)
    squares = ((x - y) ** 2 + (y - z) ** 2 + (z - x) ** 2) / 2 + 3 * shear**2
    return np.asarray(np.sqrt(squares))


def _neighbours(
    mesh: Mesh, first: NDArray[np.bool_], second: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return all pairs (a, b) of nodes in a common cell with first[a] and second[b]."""
    cells = mesh.cells[first[mesh.cells].any(axis=1)]
    corners = cells.shape[1]
    a, b = np.repeat(cells, corners, axis=1).ravel(), np.tile(cells, corners).ravel()
    keep = first[a] & second[b]
    from_first, to_second = np.divmod(
        np.unique(a[keep] * first.size + b[keep]), first.size
    )
    return from_first, to_second
