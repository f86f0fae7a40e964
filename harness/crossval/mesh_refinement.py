"""From a mesh to the one with every cell halved, by what is next to what.

Positions would not do: on a curved side the new nodes lie beside the chord, by more
than a cell where cells are thin. So only the nodes that both meshes share are found by
position; a new node is the one neighbour that two others have in common.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, eye_array, vstack
from scipy.spatial import cKDTree

from mortarbench.harness.mechanics import Grid

Nodes = NDArray[np.int64]

SAME = 1e-9  #: distance of nodes that are one, in sizes of the body


def prolongation(coarse: Grid, fine: Grid) -> csr_array:
    """Interpolate from the nodes of `coarse` (N) to those of `fine` (M), (M, N).

    Linear on the edges and bilinear in the cells of `coarse`, which are segments or
    quadrilaterals; of these, the last two corners may be one. Such a triangle is cut
    into four triangles, or like a quadrilateral, about the middle between the one
    corner and the side across.

    Raises
    ------
    ValueError
        When `fine` is not `coarse` with every cell halved.

    """
    to, near = _shared(coarse, fine), _neighbours(fine)
    unit = eye_array(len(coarse.points), format="csr")
    corners = list(coarse.cells.T)
    middles = [
        _between(near, to[a], to[b])
        for a, b in zip(corners, _turned(corners), strict=True)
    ]
    rows = [
        (unit[a] + unit[b]) / 2 for a, b in zip(corners, _turned(corners), strict=True)
    ]
    places = [to, *middles]
    if len(corners) == 4:
        # in four triangles the middles of the sides next to the one corner are joined
        joined = np.asarray(near[middles[1], middles[3]]).ravel() > 0
        cut = ~(joined & (corners[2] == corners[3]))
        places.append(_between(near, middles[0][cut], middles[2][cut]))
        rows.append(csr_array(rows[0] + rows[2])[cut] / 2)
    found, first = np.unique(np.concatenate(places), return_index=True)
    if found.size != len(fine.points):
        raise _unfit()
    return csr_array(csr_array(vstack([unit, *rows]))[first])


def _turned(corners: list[Nodes]) -> list[Nodes]:
    return [*corners[1:], corners[0]]


def _shared(coarse: Grid, fine: Grid) -> Nodes:
    """Find every node of `coarse` in the same body of `fine`, (N,)."""
    to = np.zeros(len(coarse.points), dtype=np.int64)
    for body in np.unique(coarse.bodies):
        mine = np.unique(coarse.cells[coarse.bodies == body])
        theirs = np.unique(fine.cells[fine.bodies == body])
        if not theirs.size:
            raise _unfit()
        apart, which = cKDTree(fine.points[theirs]).query(coarse.points[mine])
        if apart.max() > SAME * np.ptp(coarse.points[mine], axis=0).max():
            raise _unfit()
        to[mine] = theirs[which]
    return to


def _neighbours(grid: Grid) -> csr_array:
    """Connect nodes that share an edge, (M, M); no node is its own neighbour."""
    corners = list(grid.cells.T)
    a, b = np.concatenate(corners), np.concatenate(_turned(corners))
    apart, n = a != b, len(grid.points)
    edges = coo_array((np.ones(apart.sum()), (a[apart], b[apart])), (n, n)).tocsr()
    both = csr_array(edges + edges.T)
    both.data[:] = 1
    return both


def _between(near: csr_array, a: Nodes, b: Nodes) -> Nodes:
    """Find the common neighbour of each pair (E,); of a node with itself, the node."""
    found, apart = a.copy(), a != b
    common = csr_array(near[a[apart]].multiply(near[b[apart]]))
    if (np.diff(common.indptr) != 1).any():
        raise _unfit()
    found[apart] = common.indices
    return found


def _unfit() -> ValueError:
    return ValueError("the refined mesh is not the mesh with every cell halved")
