"""Structured grids cut into blocks, and scaling of their rows for the shape of cells.

The stiffest mode of an interface is a saw tooth along the interface, that is,
alternating tension and compression. The stiffness of this mode depends on the shape of
the cells. Between half planes of cells with sides hₜ along the interface and hₙ across
it, the stiffness is

    s(r) = √((C₆₆ + C₁₁r²) / (C₆₆ + C₁₁)),    r = hₙ/hₜ

relative to square cells, with the entries C₁₁ and C₆₆ of the elasticity matrix.
Derivation: the energy of a saw tooth along rows of cells is a quadratic form in its
amplitudes on successive rows of nodes. The matrix of this form is 4C₁₁/hₜ times the
mass matrix plus hₜC₆₆/3 times the stiffness matrix of linear elements on a half line; s
is the Schur complement of this matrix on the interface. If rows of B are scaled by √s,
the smallest eigenvalue of the dual is that for square cells (`shape_factors`).
"""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Vector
from mortarbench.problems.fem.mesh import Mesh, Nodes
from mortarbench.problems.feti.subdivision import Shaping, Subdivision
from mortarbench.problems.feti.tearing import blocks, compact_blocks, joined_labels


def blocks_of_meshes(
    parts: tuple[Mesh, ...], most: int, joined: tuple[Mesh, Nodes]
) -> Subdivision:
    """Cut structured meshes into blocks of at most `most` cells per side.

    Plane grids are cut evenly, half discs and boxes of hexahedra by `compact_blocks`.

    joined : mesh of all bodies and body (E,) of each cell, see `join`
    """
    mesh, body = joined
    if mesh.dim == 3 or any(part.grid.size > part.points.size for part in parts):
        label = joined_labels([compact_blocks(part.grid, most) for part in parts])
        return Subdivision(mesh, label, body)
    label = joined_labels([blocks(part.divisions, most) for part in parts])
    return Subdivision(mesh, label, body, partial(_shaping, parts, most))


def _shaping(parts: tuple[Mesh, ...], most: int, share: Vector) -> Shaping:
    """Return `shape_factors` as a function of nodes.

    share : (parts,) C₁₁/(C₁₁ + C₆₆) of each body
    """
    first = np.cumsum([0, *(len(part.points) for part in parts)])

    def factors(node: Nodes, supports: bool) -> Vector:
        result = np.empty(node.size)
        of_node = np.searchsorted(first, node, side="right") - 1
        for k, part in enumerate(parts):
            selected = of_node == k
            at = np.divmod(node[selected] - first[k], part.grid.shape[1])
            marks = lines(part.divisions, most, at, ends=supports)
            sides = spacings(part.grid, at)
            result[selected] = shape_factors(sides, marks, share[k])
        return result

    return factors


def lines(
    divisions: tuple[int, ...], most: int, at: tuple[Nodes, Nodes], *, ends: bool
) -> NDArray[np.bool_]:
    """Return masks (k, 2) of the nodes whose row, or column, separates blocks.

    at : rows (k,) and columns (k,) of the nodes
    ends : also mark the sides of the grid, as required for rows of supports
    """
    columns, rows = (np.full(cells + 1, ends) for cells in divisions)
    for line in (columns, rows):
        line[1:-1] = np.diff(blocks((line.size - 1,), most)) != 0
    return np.stack([rows[at[0]], columns[at[1]]], axis=-1)


def spacings(
    points: NDArray[np.float64], at: tuple[Nodes, Nodes]
) -> NDArray[np.float64]:
    """Return the mean lengths (k, 2) of the edges at nodes along rows and columns.

    Parameters
    ----------
    points : (l, m, 2) points of l rows and m columns of nodes
    at : rows (k,) and columns (k,) of the nodes

    """
    row, column = at
    last_row, last_column = (count - 2 for count in points.shape[:2])
    lengths = np.zeros((row.size, 2))
    for i in (np.maximum(row - 1, 0), np.minimum(row, last_row)):
        edges = points[i + 1, column] - points[i, column]
        lengths[:, 1] += np.linalg.norm(edges, axis=1)
    for j in (np.maximum(column - 1, 0), np.minimum(column, last_column)):
        edges = points[row, j + 1] - points[row, j]
        lengths[:, 0] += np.linalg.norm(edges, axis=1)
    return lengths / 2


def shape_factors(
    spacing: NDArray[np.float64], lines: NDArray[np.bool_], share: Vector | float
) -> Vector:
    """Return s(r) at each node (k,); the mean of s if two interfaces meet there.

    Parameters
    ----------
    spacing : (k, 2) result of `spacings`
    lines : (k, 2) result of `lines`; the factor is 1 at nodes off all interfaces
    share : C₁₁ / (C₁₁ + C₆₆) of the material, (k,) or a scalar

    """
    squares = (spacing[:, ::-1] / spacing) ** 2  # r² of the row, and of the column
    share = np.reshape(share, (-1, 1))
    s = np.where(lines, np.sqrt(1 - share + share * squares), 0.0).sum(axis=1)
    count = lines.sum(axis=1)
    return np.asarray(np.where(count > 0, s / np.maximum(count, 1), 1.0))
