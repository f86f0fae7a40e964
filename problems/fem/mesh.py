"""Meshes with named boundaries (paper, Section 2 and Figure 1).

The dimension and the number of corners say which element the cells are. In the plane
they are quadrilaterals or triangles, in any mixture. A triangle is a quadrilateral
whose last two corners are one: with N₃ + N₄ for that corner, the bilinear map is onto
the triangle, and N₁, N₂, N₃ + N₄ are its barycentric coordinates,

    Σ N_a x_a = x,   Σ N_a = 1   ⟹   N₁, N₂, N₃ + N₄ are linear in x,

so that the bilinear element *is* the linear triangle (P1); 2×2 Gauss points integrate
its constant BᵀDB exactly, as the Jacobian determinant is linear.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Vector
from mortarbench.harness.mechanics import CellBlock, cell_blocks
from mortarbench.problems.fem.elements import ELEMENTS, Element

Nodes = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Nodes and cells; lengths in m.

    A boundary in the plane is the chain of its nodes, ordered so that the body lies on
    its left: with the unit tangent t the outward normal is (t_y, −t_x).
    """

    points: NDArray[np.float64]  #: (N, dim)
    #: (E, c) nodes of each cell, in the plane counter-clockwise; where kinds are mixed,
    #: a cell of fewer corners repeats its last node
    cells: Nodes
    boundaries: Mapping[str, Nodes]

    @property
    def dim(self) -> int:
        """Number of coordinates of a node, and of components of its displacement."""
        return int(self.points.shape[1])

    @property
    def dofs(self) -> int:
        """Number of displacement components, see `dofs_of`."""
        return self.points.size

    @property
    def element(self) -> Element:
        """Element that all cells are integrated with."""
        return ELEMENTS[self.dim, self.cells.shape[1]]

    @property
    def blocks(self) -> tuple[CellBlock, ...]:
        """Cells by their kinds, in the vocabulary of meshio."""
        return cell_blocks(self.cells, self.dim)


@dataclass(frozen=True, eq=False)
class StructuredGrid:
    """Rows and columns of nodes, of which any block can be had without the others.

    Node (row j, column i) has the number  j·(columns) + i;  cells are numbered alike.
    """

    columns: Vector  #: (nx + 1,) parameter of each column of nodes
    rows: Vector  #: (ny + 1,) parameter of each row of nodes
    #: parameters of some columns (k,) and rows (l,) → points (l, k, 2)
    place: Callable[[Vector, Vector], NDArray[np.float64]]
    names: tuple[str, str, str, str]  #: of the sides, anticlockwise from row 0

    @property
    def divisions(self) -> tuple[int, int]:
        """Cells along rows and along columns, nx and ny."""
        return self.columns.size - 1, self.rows.size - 1

    @property
    def nodes(self) -> int:
        """How many nodes there are."""
        return self.columns.size * self.rows.size

    @property
    def sides(self) -> Mapping[str, Nodes]:
        """Nodes of the four sides, as chains of a mesh."""
        nx, ny = self.divisions
        across, up = np.arange(nx + 1), (nx + 1) * np.arange(ny + 1)
        chains = across, up + nx, (up[-1] + across)[::-1], up[::-1]
        return dict(zip(self.names, chains, strict=True))

    def block(self, columns: slice, rows: slice) -> NDArray[np.float64]:
        """Return the points (l·k, 2) of some rows and columns of nodes, row by row."""
        points = self.place(self.columns[columns], self.rows[rows])
        return np.asarray(np.ascontiguousarray(points.reshape(-1, 2)))

    def side(self, name: str) -> NDArray[np.float64]:
        """Return the points of a side in the order of its chain, (k, 2)."""
        at, all_, last = self.names.index(name), slice(None), slice(-1, None)
        if at in (0, 2):
            points = self.block(all_, last if at else slice(1))
        else:
            points = self.block(last if at == 1 else slice(1), all_)
        return np.asarray(points if at < 2 else points[::-1])

    def position(self, node: Nodes) -> NDArray[np.float64]:
        """Return the points of some nodes (k, 2), as `block` does."""
        row, column = np.divmod(node, self.columns.size)
        found = np.empty((node.size, 2))
        by_rows = np.unique(row).size <= np.unique(column).size
        for line in np.unique(row if by_rows else column):
            of = np.flatnonzero((row if by_rows else column) == line)
            places = (
                (self.columns[column[of]], self.rows[[line]]) if by_rows
                else (self.columns[[line]], self.rows[row[of]])
            )  # fmt: skip
            found[of] = self.place(*places).reshape(-1, 2)
        return found

    def prefixed(self, prefix: str) -> StructuredGrid:
        """Put `prefix` before the names of the sides."""
        first, second, third, fourth = (prefix + name for name in self.names)
        return replace(self, names=(first, second, third, fourth))

    def mesh(self) -> Mesh:
        """Connect all points."""
        cells = cells_of_block(self.columns.size, self.rows.size)
        return Mesh(self.block(slice(None), slice(None)), cells, self.sides)


@dataclass(frozen=True, eq=False)
class HalfDisc:
    """Rings of cells that end in triangles at the centre of half a disc.

    Of a angles and r radii, node (ring j, angle i) has the number  j·a + i,  and the
    centre is the last one. Cells are numbered ring by ring, the triangles last.
    """

    centre: tuple[float, float]
    angles: Vector  #: (a,) increasing, over half a turn; the arc is between the ends
    radii: Vector  #: (r,) decreasing, all positive: those of the arc and within
    names: tuple[str, str] = ("arc", "flat")  #: of the sides

    @property
    def divisions(self) -> tuple[int, int]:
        """Cells along a ring, and rings of cells, triangles being one."""
        return self.angles.size - 1, self.radii.size

    @property
    def nodes(self) -> int:
        """How many nodes there are."""
        return self.angles.size * self.radii.size + 1

    @property
    def sides(self) -> Mapping[str, Nodes]:
        """Nodes of the arc, anticlockwise, and of the flat side through the centre."""
        a, r = self.angles.size, self.radii.size
        rings = a * np.arange(r)
        flat = np.concatenate([rings + a - 1, [a * r], rings[::-1]])
        return dict(zip(self.names, (np.arange(a), flat), strict=True))

    @cached_property
    def _direction(self) -> NDArray[np.float64]:
        return np.stack([np.cos(self.angles), np.sin(self.angles)], axis=-1)

    def position(self, node: Nodes) -> NDArray[np.float64]:
        """Return the points of some nodes (k, 2)."""
        ring, angle = np.divmod(node, self.angles.size)
        radius = np.append(self.radii, 0.0)[ring][:, None]
        return np.asarray(np.asarray(self.centre) + radius * self._direction[angle])

    def block(self, angles: slice, rings: slice) -> tuple[Nodes, Nodes]:
        """List the nodes (k,) of some cells, and these cells (E, 4), as `mesh` does.

        angles, rings : of cells; corners of cells are places in the list of nodes
        """
        a, r = self.angles.size, self.radii.size
        has_centre = rings.stop == r
        i = np.arange(angles.start, angles.stop + 1)
        j = np.arange(rings.start, rings.stop + (not has_centre))
        nodes = (j[:, None] * a + i).ravel()
        cells = cells_of_block(i.size, j.size)
        if has_centre:
            inner, last = np.arange(nodes.size - i.size, nodes.size), nodes.size
            ends = [inner[:-1], inner[1:], *np.full((2, i.size - 1), last)]
            nodes = np.append(nodes, a * r)
            cells = np.concatenate([cells, np.stack(ends, axis=-1)])
        return nodes, cells

    def lengths(self) -> tuple[tuple[Vector, Vector], tuple[Vector, Vector]]:
        """Return the mean sides of cells, along radii and along arcs.

        Each as two factors, one of each ring of cells and one of each angle.
        """
        half, r = np.diff(self.angles) / 2, np.append(self.radii, 0.0)
        return (-np.diff(r), np.cos(half)), ((r[1:] + r[:-1]) / 2, 2 * np.sin(half))

    def prefixed(self, prefix: str) -> HalfDisc:
        """Put `prefix` before the names of the sides."""
        arc, flat = (prefix + name for name in self.names)
        return replace(self, names=(arc, flat))

    def mesh(self) -> Mesh:
        """Connect all points."""
        (a, r), all_ = self.divisions, np.arange(self.nodes)
        return Mesh(
            self.position(all_), self.block(slice(0, a), slice(0, r))[1], self.sides
        )


def cells_of_block(columns: int, rows: int) -> Nodes:
    """List the cells (E, 4) of so many columns and rows of nodes, row by row."""
    i = np.arange(rows * columns, dtype=np.int64).reshape(rows, columns)
    corners = i[:-1, :-1], i[:-1, 1:], i[1:, 1:], i[1:, :-1]
    return np.stack(corners, axis=-1).reshape(-1, 4)


def rectangle_grid(corner: tuple[float, float], size: tuple[float, float],
                   divisions: tuple[int, int]) -> StructuredGrid:  # fmt: skip
    """Divide a rectangle into nx × ny equal cells; sides bottom, right, top, left."""
    nx, ny = divisions
    return StructuredGrid(
        columns=corner[0] + size[0] * np.arange(nx + 1) / nx,
        rows=corner[1] + size[1] * np.arange(ny + 1) / ny,
        place=lambda x, y: np.stack(np.meshgrid(x, y, indexing="xy"), axis=-1),
        names=("bottom", "right", "top", "left"),
    )


def half_ring_grid(centre: tuple[float, float], radii: tuple[float, float],
                   divisions: tuple[int, int]) -> StructuredGrid:  # fmt: skip
    """Divide the upper half of a ring by equal angles × equal layers.

    Sides: outer (from angle 0 to π), left_foot, inner, right_foot.
    """
    angles, layers = divisions

    def place(theta: Vector, r: Vector) -> NDArray[np.float64]:
        direction = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
        return np.asarray(np.asarray(centre) + r[:, None, None] * direction)

    return StructuredGrid(
        columns=np.pi * np.arange(angles + 1) / angles,
        rows=radii[1] + (radii[0] - radii[1]) * np.arange(layers + 1) / layers,
        place=place, names=("outer", "left_foot", "inner", "right_foot"),
    )  # fmt: skip


def rectangle(corner: tuple[float, float], size: tuple[float, float],
              divisions: tuple[int, int]) -> Mesh:  # fmt: skip
    """Mesh a rectangle by nx × ny equal cells; boundaries bottom, right, top, left."""
    return rectangle_grid(corner, size, divisions).mesh()


def half_ring(centre: tuple[float, float], radii: tuple[float, float],
              divisions: tuple[int, int]) -> Mesh:  # fmt: skip
    """Mesh the upper half of a ring by equal angles × equal layers.

    Boundaries: outer (from angle 0 to π), left_foot, inner, right_foot.
    """
    return half_ring_grid(centre, radii, divisions).mesh()


def half_disc(centre: tuple[float, float], angles: Vector, radii: Vector) -> Mesh:
    """Mesh half a disc by rings of cells that end in triangles at its centre.

    Boundaries: arc (anticlockwise) and flat (through the centre).

    Parameters
    ----------
    angles : increasing, over half a turn; the arc lies between the first and the last
    radii : decreasing, all positive: those of the arc and of the rings of nodes within

    """
    return HalfDisc(centre, angles, radii).mesh()


def join(meshes: tuple[Mesh, ...]) -> tuple[Mesh, Nodes]:
    """Put bodies into one mesh that shares no node; also return each cell's body.

    Boundaries keep their names where these differ between the bodies.
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


def joined_sides(bodies: Sequence[StructuredGrid | HalfDisc]) -> Mapping[str, Nodes]:
    """Return the sides of bodies with the numbers that `join` gives their nodes."""
    starts = np.cumsum([0] + [body.nodes for body in bodies])
    return {
        name: nodes + start
        for body, start in zip(bodies, starts, strict=False)
        for name, nodes in body.sides.items()
    }


def prefixed(mesh: Mesh, prefix: str) -> Mesh:
    """Put `prefix` before the name of each boundary, so that equal shapes can join."""
    return replace(
        mesh, boundaries={prefix + name: b for name, b in mesh.boundaries.items()}
    )


def is_triangle(cells: Nodes) -> NDArray[np.bool_]:
    """Say which cells (E, 4) are triangles, (E,)."""
    return np.asarray(cells[:, 2] == cells[:, 3])


def boundary_facets(cells: Nodes, dim: int) -> Nodes:
    """List the facets (k, m) of exactly one cell (E, c), the body on their left.

    Edges in the plane, ordered by their lower node, then by the other; facets that
    repeated corners collapse are left out.
    """
    element = ELEMENTS[dim, cells.shape[1]]
    facets = cells[:, element.facets].reshape(-1, element.facets.shape[1])
    nodes = np.sort(facets, axis=1)
    is_facet = (nodes[:, 1:] != nodes[:, :-1]).all(axis=1)
    facets, nodes = facets[is_facet], nodes[is_facet]
    name, count = np.zeros(len(nodes), dtype=np.int64), nodes.max(initial=0) + 1
    for k in range(dim):  # so many nodes tell facets apart
        name = name * count + nodes[:, k]
    _, first, times = np.unique(name, return_index=True, return_counts=True)
    return np.asarray(facets[first[times == 1]])


def nodal_lengths(chain: NDArray[np.float64]) -> Vector:
    """Return ∫N_j ds (v,) of the linear shape functions on a polyline (v, d)."""
    edge = chain[1:] - chain[:-1]
    half = np.sqrt(np.einsum("ex,ex->e", edge, edge)) / 2
    return np.asarray(np.append(half, 0) + np.append(0, half))


def dofs_of(nodes: Nodes, dim: int, axis: int | None = None) -> Nodes:
    """List the displacement components of nodes: dim·i, dim·i + 1, … of node i.

    axis : 0, 1, …: the components along this axis alone
    """
    if axis is not None:
        return np.asarray(dim * nodes + axis)
    return np.stack([dim * nodes + k for k in range(dim)], axis=-1).ravel()


def as_vectors(u: Vector, dim: int) -> NDArray[np.float64]:
    """See a dof vector (dim·N,) as one vector per node (N, dim)."""
    return u.reshape(-1, dim)
