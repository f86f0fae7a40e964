"""Interpolation from a mesh to its refinement with half the cell size.

A node of the coarse mesh is located in the refined mesh by its position. Positions
cannot be used for new nodes: on a curved side, a new node does not lie on the chord,
and its distance from the chord may exceed the size of a thin cell. Instead, a new node
is identified as the only node that is connected by edges to two given nodes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, eye_array, vstack
from scipy.spatial import cKDTree

from mortarbench.harness.mechanics import Grid

Nodes = NDArray[np.int64]

#: Largest distance between a coarse node and the same node in the refined mesh,
#: relative to the extent of the body.
MAX_NODE_DISTANCE = 1e-9
#: Corners of the edges of a hexahedron. In the refined mesh, edges connect the centre
#: of a face with the midpoints of two opposite edges of the face, and the centre of the
#: cell with the centres of two opposite faces.
EDGES = (
    (0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5),
    (2, 6), (3, 7),
)  # fmt: skip
#: Two opposite edges of each face, as indices in `EDGES`; the first two faces are
#: opposite to each other.
FACES = ((0, 2), (4, 6), (0, 4), (1, 5), (2, 6), (3, 7))


class NonNestedMeshError(ValueError):
    """Error for a mesh that is not the refinement of the coarse mesh."""

    def __init__(self) -> None:
        super().__init__("the refined mesh is not the mesh with every cell halved")


def prolongation(coarse: Grid, fine: Grid) -> csr_array:
    """Return the matrix (M, N) that interpolates from `coarse` to the nodes of `fine`.

    The cells of `coarse` are segments, quadrilaterals or hexahedra, in which the
    interpolation is linear or multilinear. A quadrilateral whose last two corners
    coincide is a triangle. A triangle may be refined into four triangles, or like a
    quadrilateral, with a new node between the double corner and the opposite side.

    Raises
    ------
    NonNestedMeshError
        If `fine` is not the refinement of `coarse` with half the cell size.

    """
    to, near = _shared(coarse, fine), _neighbours(fine)
    unit = eye_array(len(coarse.points), format="csr")
    corners = list(coarse.cells.T)
    ends = _edges(corners)
    middles = [_between(near, to[a], to[b]) for a, b in ends]
    rows = [csr_array((unit[a] + unit[b]) / 2) for a, b in ends]
    places = [to, *middles]
    if len(corners) == 8:
        centres = [_between(near, middles[a], middles[b]) for a, b in FACES]
        of_faces = [csr_array((rows[a] + rows[b]) / 2) for a, b in FACES]
        places += [*centres, _between(near, *centres[:2])]
        rows += [*of_faces, csr_array((of_faces[0] + of_faces[1]) / 2)]
    if len(corners) == 4:
        # a triangle was refined into four triangles if an edge connects the midpoints
        # of the two sides at the double corner
        joined = np.asarray(near[middles[1], middles[3]]).ravel() > 0
        cut = ~(joined & (corners[2] == corners[3]))
        places.append(_between(near, middles[0][cut], middles[2][cut]))
        rows.append(csr_array(rows[0] + rows[2])[cut] / 2)
    nodes, first = np.unique(np.concatenate(places), return_index=True)
    if nodes.size != len(fine.points):
        raise NonNestedMeshError
    return csr_array(csr_array(vstack([unit, *rows]))[first])


def _edges(corners: list[Nodes]) -> list[tuple[Nodes, Nodes]]:
    """Return, for each edge of a cell, its two end nodes in all cells."""
    if len(corners) == 8:
        return [(corners[a], corners[b]) for a, b in EDGES]
    return list(zip(corners, [*corners[1:], corners[0]], strict=True))


def _shared(coarse: Grid, fine: Grid) -> Nodes:
    """Return the nodes (N,) of `fine` at the positions of the nodes of `coarse`.

    Each body is searched separately, since nodes of two bodies may coincide.
    """
    to = np.zeros(len(coarse.points), dtype=np.int64)
    for body in np.unique(coarse.bodies):
        mine = np.unique(coarse.cells[coarse.bodies == body])
        theirs = np.unique(fine.cells[fine.bodies == body])
        if not theirs.size:
            raise NonNestedMeshError
        distance, nearest = cKDTree(fine.points[theirs]).query(coarse.points[mine])
        if (
            distance.max()
            > MAX_NODE_DISTANCE * np.ptp(coarse.points[mine], axis=0).max()
        ):
            raise NonNestedMeshError
        to[mine] = theirs[nearest]
    return to


def _neighbours(grid: Grid) -> csr_array:
    """Return the adjacency matrix (M, M) of the nodes, with entry 1 for each edge."""
    a, b = map(np.concatenate, zip(*_edges(list(grid.cells.T)), strict=True))
    # exclude the degenerate edge between the repeated corners of a triangle
    differs, n = a != b, len(grid.points)
    ends = a[differs], b[differs]
    edges = coo_array((np.ones(differs.sum()), ends), (n, n)).tocsr()
    both = csr_array(edges + edges.T)
    both.data[:] = 1
    return both


def _between(near: csr_array, a: Nodes, b: Nodes) -> Nodes:
    """Return the only node adjacent to both nodes of each pair (E,); a if a = b."""
    middle, differs = a.copy(), a != b
    common = csr_array(near[a[differs]].multiply(near[b[differs]]))
    if (np.diff(common.indptr) != 1).any():
        raise NonNestedMeshError
    middle[differs] = common.indices
    return middle
