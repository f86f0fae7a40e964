"""Meshes with named boundaries (paper, Section 2 and Figure 1).

The dimension and the number of corners determine the element. Plane meshes may mix
quadrilaterals and triangles. A triangle is a degenerate quadrilateral whose last two
corners coincide. The bilinear map then covers the triangle, and N₁, N₂, N₃ + N₄ are its
barycentric coordinates,

    Σ N_a x_a = x,   Σ N_a = 1   ⟹   N₁, N₂, N₃ + N₄ are linear in x,

so that the bilinear element *is* the linear triangle (P1). The 2×2 Gauss rule
integrates its constant BᵀDB exactly, since the Jacobian determinant is linear in ξ.

Meshes in 3D consist of tetrahedra, wedges or hexahedra. In mixed meshes, all cells
are stored as hexahedra, which are degenerate in the same way: a tetrahedron is
(a, b, c, c, d, d, d, d), a wedge (a, b, c, c, d, e, f, f). The stiffness of such a cell
is that of the tetrahedral or wedge element.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Vector
from mortarbench.harness.mechanics import (
    CellBlock,
    boundary_facets,
    cell_blocks,
    cell_facets,
)
from mortarbench.problems.fem.elements import ELEMENTS, HEXAHEDRON, QUAD, Element

Nodes = NDArray[np.int64]

#: corners of a tetrahedron or wedge (by kind of cell) that form the eight corners of a
#: degenerate hexahedron
REPEATED = {"tetra": [0, 1, 2, 2, 3, 3, 3, 3], "wedge": [0, 1, 2, 2, 3, 4, 5, 5]}


@dataclass(frozen=True, eq=False)
class Mesh:
    """Nodes, cells and named boundaries; lengths in m.

    In 2D, a boundary is a chain of nodes with the body on its left: with the
    unit tangent t, the outward normal is (t_y, −t_x). In 3D, a boundary is an array
    (k, 4) of faces whose corners are anticlockwise as seen from outside; triangular
    faces repeat their last corner.

    >>> mesh = rectangle((0.0, 0.0), (2.0, 1.0), (2, 1))
    >>> len(mesh.points), len(mesh.cells), mesh.boundaries["bottom"].tolist()
    (6, 2, [0, 1, 2])
    """

    points: NDArray[np.float64]  #: (N, dim) positions of the nodes
    #: (E, c) nodes of each cell, counter-clockwise in 2D; in mixed meshes, cells
    #: with fewer corners repeat nodes
    cells: Nodes
    #: mapping from the name of a boundary to its chain or faces
    boundaries: Mapping[str, Nodes]
    #: numbers of cells of a structured mesh along its directions, of which the first
    #: varies fastest in the numbers of nodes and cells; empty for other meshes
    divisions: tuple[int, ...] = ()

    @property
    def dim(self) -> int:
        """Dimension of space, the number of displacement components per node."""
        return int(self.points.shape[1])

    @property
    def dofs(self) -> int:
        """Number of displacement components, see `dofs_of`."""
        return self.points.size

    @property
    def element(self) -> Element:
        """Element of all cells, which may be degenerate in mixed meshes."""
        return ELEMENTS[self.dim, self.cells.shape[1]]

    @property
    def blocks(self) -> tuple[CellBlock, ...]:
        """Cells grouped by kind, with meshio's names."""
        return cell_blocks(self.cells, self.dim)

    @property
    def grid(self) -> NDArray[np.float64]:
        """Points (…, dim) of a structured mesh, one axis per direction, fastest last.

        The centre of a half disc is repeated for every angle.
        """
        counts = [n + 1 for n in reversed(self.divisions)]
        node = np.minimum(np.arange(np.prod(counts)), len(self.points) - 1)
        return self.points[node].reshape(*counts, self.dim)


def cells_of_block(columns: int, rows: int) -> Nodes:
    """Return the cells (E, 4) of a grid of columns × rows nodes, row by row."""
    i = np.arange(rows * columns, dtype=np.int64).reshape(rows, columns)
    corners = i[:-1, :-1], i[:-1, 1:], i[1:, 1:], i[1:, :-1]
    return np.stack(corners, axis=-1).reshape(-1, 4)


def structured(points: NDArray[np.float64], names: Sequence[str]) -> Mesh:
    """Mesh a plane grid of nodes (l, k, 2), row by row, with quadrilaterals.

    names : names of the sides, anticlockwise from row 0
    """
    rows, columns, _ = points.shape
    across, up = np.arange(columns), columns * np.arange(rows)
    chains = across, up + columns - 1, (up[-1] + across)[::-1], up[::-1]
    return Mesh(
        points.reshape(-1, 2),
        cells_of_block(columns, rows),
        dict(zip(names, chains, strict=True)),
        (columns - 1, rows - 1),
    )


def box(
    corner: tuple[float, ...], size: tuple[float, ...], divisions: tuple[int, ...]
) -> Mesh:
    """Mesh a box with nx × ny × nz equal hexahedra.

    Numbers of nodes and cells vary fastest along x. The names of boundaries are those
    of `box_grid`. Lengths are in m.

    >>> mesh = box((0.0, 0.0, 0.0), (1.0, 1.0, 2.0), (1, 1, 2))
    >>> len(mesh.points), len(mesh.cells), mesh.boundaries["top"].tolist()
    (12, 2, [[8, 9, 11, 10]])
    """
    x, y, z = (
        first + length * np.arange(n + 1) / n
        for first, length, n in zip(corner, size, divisions, strict=True)
    )
    return box_grid(x, y, z)


def box_grid(x: Vector, y: Vector, z: Vector) -> Mesh:
    """Mesh a box with hexahedra whose faces lie at the given increasing coordinates.

    Numbers of nodes and cells vary fastest along x. The boundaries are left and right
    (smallest and largest x), front and back (y), bottom and top (z).
    """
    axes = x, y, z
    counts = [axis.size for axis in axes]
    number = np.arange(np.prod(counts)).reshape(counts[::-1])
    ends = (slice(None, -1), slice(1, None))
    corners = [number[ends[k], ends[j], ends[i]] for i, j, k in HEXAHEDRON.vertices]
    cells = np.stack([corner.ravel() for corner in corners], axis=-1)
    grid = np.meshgrid(*axes[::-1], indexing="ij")
    points = np.stack([coordinate.ravel() for coordinate in grid[::-1]], axis=-1)
    facets = boundary_facets(cells, 3)
    centre = points[facets].mean(axis=1)
    names = ("left", "right", "front", "back", "bottom", "top")
    planes = [(k, axes[k][end]) for k in range(3) for end in (0, -1)]
    return Mesh(
        points,
        cells,
        {
            name: facets[centre[:, k] == place]
            for name, (k, place) in zip(names, planes, strict=True)
        },
        (x.size - 1, y.size - 1, z.size - 1),
    )


def extruded(mesh: Mesh, layers: int, thickness: float) -> Mesh:
    """Extrude a plane mesh of quadrilaterals along z, from 0 to `thickness`.

    The mesh consists of `layers` layers of hexahedra. Nodes and cells are numbered
    layer by layer. Each boundary, a chain of nodes, becomes a set of faces of the same
    name. The end faces have no name.
    """
    N = len(mesh.points)
    step = N * np.arange(layers + 1)
    z = np.repeat(thickness * np.arange(layers + 1) / layers, N)
    points = np.column_stack([np.tile(mesh.points, (layers + 1, 1)), z])
    ends = step[:-1, None, None], step[1:, None, None]
    cells = np.concatenate([mesh.cells + at for at in ends], axis=2)
    # the body is on the left of the chain, so (a, b, b', a') is anticlockwise from
    # outside
    facets = {
        name: np.stack([chain[:-1], chain[1:], chain[1:] + N, chain[:-1] + N], axis=-1)
        for name, chain in mesh.boundaries.items()
    }
    boundaries = {
        name: (table + ends[0]).reshape(-1, 4) for name, table in facets.items()
    }
    divisions = (*mesh.divisions, layers) if mesh.divisions else ()
    return Mesh(points, cells.reshape(-1, 8), boundaries, divisions)


def distorted(mesh: Mesh, share: float, seed: int = 0) -> Mesh:
    """Shift the nodes of a `box` at random; the nodes of a side remain in its plane.

    share : largest shift along an axis, relative to the mean cell size along this axis
    """
    points = mesh.points
    low, high = points.min(axis=0), points.max(axis=0)
    size = (high - low) / [len(np.unique(points[:, k])) - 1 for k in range(3)]
    move = np.random.default_rng(seed).uniform(-share, share, points.shape) * size
    move[(points == low) | (points == high)] = 0
    return replace(mesh, points=points + move)


def rectangle(
    corner: tuple[float, float], size: tuple[float, float], divisions: tuple[int, int]
) -> Mesh:
    """Mesh a rectangle with nx × ny equal cells.

    The boundaries are bottom, right, top and left. Lengths are in m.

    >>> rectangle((0.0, 0.5), (2.0, 0.25), (8, 1)).points[-1].tolist()
    [2.0, 0.75]
    """
    nx, ny = divisions
    x = corner[0] + size[0] * np.arange(nx + 1) / nx
    y = corner[1] + size[1] * np.arange(ny + 1) / ny
    points = np.stack(np.meshgrid(x, y), axis=-1)
    return structured(points, ("bottom", "right", "top", "left"))


def half_ring(
    centre: tuple[float, float], radii: tuple[float, float], divisions: tuple[int, int]
) -> Mesh:
    """Mesh the upper half of a ring with cells of equal angle and equal thickness.

    The boundaries are outer (from angle 0 to π), left_foot, inner and right_foot.

    radii : inner and outer radius, m
    divisions : numbers of cells along the arc and across the ring
    """
    angles, layers = divisions
    theta = np.pi * np.arange(angles + 1) / angles
    r = radii[1] + (radii[0] - radii[1]) * np.arange(layers + 1) / layers
    direction = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    points = np.asarray(centre) + r[:, None, None] * direction
    return structured(points, ("outer", "left_foot", "inner", "right_foot"))


def half_disc(centre: tuple[float, float], angles: Vector, radii: Vector) -> Mesh:
    """Mesh half a disc with rings of cells; the innermost ring consists of triangles.

    The boundaries are arc (anticlockwise) and flat (through the centre).

    Parameters
    ----------
    angles : angles of the nodes, increasing by π from the first to the last
    radii : radii of the rings of nodes, positive and decreasing from the radius of the
        arc

    """
    a, r = angles.size, radii.size
    direction = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    rings = np.asarray(centre) + radii[:, None, None] * direction
    inner, first = np.arange(a * (r - 1), a * r), a * np.arange(r)
    triangles = [inner[:-1], inner[1:], *np.full((2, a - 1), a * r)]
    return Mesh(
        np.append(rings.reshape(-1, 2), [centre], axis=0),
        np.concatenate([cells_of_block(a, r), np.stack(triangles, axis=-1)]),
        {
            "arc": np.arange(a),
            "flat": np.concatenate([first + a - 1, [a * r], first[::-1]]),
        },
        (a - 1, r),
    )


def join(meshes: tuple[Mesh, ...]) -> tuple[Mesh, Nodes]:
    """Join the meshes of bodies without merging nodes; return the mesh and `body` (E,).

    Names of boundaries should be distinct (see `prefixed`): if several boundaries have
    the same name, only that of the last body is kept.

    >>> block = rectangle((0.0, 0.0), (1.0, 1.0), (1, 1))
    >>> mesh, body = join((prefixed(block, "a_"), prefixed(block, "b_")))
    >>> mesh.boundaries["b_top"].tolist(), body.tolist()
    ([7, 6], [0, 1])
    """
    starts = np.cumsum([0] + [len(m.points) for m in meshes])
    boundaries = {
        name: nodes + start
        for m, start in zip(meshes, starts, strict=False)
        for name, nodes in m.boundaries.items()
    }
    cells = [m.cells + start for m, start in zip(meshes, starts, strict=False)]
    body = np.repeat(np.arange(len(meshes)), [len(m.cells) for m in meshes])
    points = np.concatenate([m.points for m in meshes])
    return Mesh(points, np.concatenate(cells), boundaries), body


def prefixed(mesh: Mesh, prefix: str) -> Mesh:
    """Return the mesh with `prefix` added to the name of each boundary, see `join`."""
    return replace(
        mesh, boundaries={prefix + name: b for name, b in mesh.boundaries.items()}
    )


def is_triangle(cells: Nodes) -> NDArray[np.bool_]:
    """Return a mask (E,) of the triangles among cells (E, 4)."""
    return np.asarray(cells[:, 2] == cells[:, 3])


def adjacent_cells(cells: Nodes, dim: int) -> tuple[Nodes, Nodes, Nodes]:
    """Return pairs of cells (k,) and (k,) with a common facet, and the facets (k, m).

    Pairs are sorted by facet.

    >>> adjacent_cells(rectangle((0, 0), (2, 1), (2, 1)).cells, 2)
    (array([0]), array([1]), array([[1, 4]]))
    """
    facets, names, cell = cell_facets(cells, dim)
    order = np.lexsort(names.T)
    shared = np.flatnonzero((np.diff(names[order], axis=0) == 0).all(axis=1))
    one, other = order[shared], order[shared + 1]
    return cell[one], cell[other], facets[one]


def nodal_lengths(chain: NDArray[np.float64]) -> Vector:
    """Return ∫N_j ds (v,) of the linear shape functions on a polyline (v, dim), m.

    >>> nodal_lengths(np.array([[0.0, 0.0], [1.0, 0.0], [3.0, 0.0]])).tolist()
    [0.5, 1.5, 1.0]
    """
    edge = chain[1:] - chain[:-1]
    half = np.sqrt(np.einsum("ex,ex->e", edge, edge)) / 2
    return np.asarray(np.append(half, 0) + np.append(0, half))


def facet_quadrature(
    points: NDArray[np.float64], facets: Nodes
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return shape functions (q, m) and area vectors (q, k, dim) at Gauss points.

    The area vector is the outward normal, multiplied by the weight of the point and by
    the measure of the facet: a length in m in 2D, and an area in m² in 3D.

    facets : (k, m) edges (m = 2) or faces (m = 4) of a boundary
    """
    if points.shape[1] == 2:
        xi = np.array([-1.0, 1.0]) / np.sqrt(3)
        x, y = np.diff(points[facets], axis=1)[:, 0].T
        normals = np.stack([y, -x], axis=1) / 2
        return np.stack([1 - xi, 1 + xi], axis=1) / 2, np.stack([normals] * 2)
    areas = [
        weight * np.cross(*np.einsum("ar,fax->rfx", QUAD.gradients(xi), points[facets]))
        for xi, weight in zip(QUAD.points, QUAD.weights, strict=True)
    ]
    return np.stack([QUAD.shapes(xi) for xi in QUAD.points]), np.stack(areas)


def nodal_areas(points: NDArray[np.float64], faces: Nodes) -> tuple[Nodes, Vector]:
    """Return the nodes of `faces` (k, 4), ascending, and their areas ∫N_j dA, m².

    >>> unit = box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (1, 1, 1))
    >>> nodes, areas = nodal_areas(unit.points, unit.boundaries["top"])
    >>> nodes.tolist(), areas.round(12).tolist()
    ([4, 5, 6, 7], [0.25, 0.25, 0.25, 0.25])
    """
    nodes, place = np.unique(faces, return_inverse=True)
    shapes, areas = facet_quadrature(points, faces)
    shares = np.einsum("qm,qk->km", shapes, np.linalg.norm(areas, axis=2))
    total = np.zeros(nodes.size)
    np.add.at(total, place.reshape(faces.shape), shares)
    return nodes, total


def nodal_sizes(points: NDArray[np.float64], side: Nodes) -> tuple[Nodes, Vector]:
    """Return the nodes of a chain or of faces, with their lengths, m, or areas, m²."""
    if side.ndim > 1:
        return nodal_areas(points, side)
    return side, nodal_lengths(points[side])


def nodes_of_side(side: Nodes) -> Nodes:
    """Return the nodes of a chain in order, or of faces in ascending order."""
    return side if side.ndim == 1 else np.unique(side)


def dofs_of(nodes: Nodes, dim: int, axis: int | None = None) -> Nodes:
    """Return the displacement components of nodes: dim·i, dim·i + 1, … for node i.

    axis : 0, 1, … selects the components along one axis; None selects all

    Examples
    --------
    >>> dofs_of(np.array([0, 3]), 2).tolist(), dofs_of(np.array([0, 3]), 2, 1).tolist()
    ([0, 1, 6, 7], [1, 7])
    """
    if axis is not None:
        return np.asarray(dim * nodes + axis)
    return np.stack([dim * nodes + k for k in range(dim)], axis=-1).ravel()


def as_vectors(u: Vector, dim: int) -> NDArray[np.float64]:
    """Return a view (N, dim), one row per node, of a dof vector (dim·N,)."""
    return u.reshape(-1, dim)
