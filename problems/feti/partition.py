"""Bodies of any mesh cut into connected parts, by a partition of the graph of cells.

Two cells are neighbours if they share a facet: an edge in the plane, a face in space.
METIS (Karypis and Kumar 1998, SIAM J. Sci. Comput. 20) parts the graph of each body so
that parts are about equal and the facets between them are small, measured by the cells
around: so parts are compact where cells are long and thin, as those of graded meshes
are. Cells that hang together in a node (or, in space, an edge) only would turn against
each other: a part must be connected by facets, or it has more motions than a rigid
body.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from mortarbench.harness import InputError
from mortarbench.problems.fem.elements import ELEMENTS
from mortarbench.problems.fem.mesh import Nodes

Labels = NDArray[np.int64]

UNIT_WEIGHT = 100  #: weight of the facet between two squares, or two cubes
MAX_WEIGHT = 10_000  #: weight; METIS adds them up as integers of 32 bits
MAX_IMBALANCE = (
    300  #: in thousandths: the less, the more pieces are apart from their part
)


def graph_partition(
    points: NDArray[np.float64], cells: Nodes, body: Labels, parts: int
) -> Labels:
    """Label the cells of bodies by parts, each connected and of one body.

    Every body has a number of parts in proportion to its cells, one at least.

    Parameters
    ----------
    points : (N, dim) of the nodes
    cells : (E, c) corners; a triangle repeats its last one
    body : (E,) of each cell, 0, 1, …
    parts : of all bodies together

    Returns
    -------
    (E,) part of each cell, 0 … parts − 1, those of one body after those of another

    Raises
    ------
    InputError
        When there are more bodies than parts, less than two cells for each part, or a
        body is not connected.

    """
    counts = np.bincount(body)
    if not counts.size <= parts <= max(counts.size, len(cells) // 2):
        raise InputError(
            f"parts={parts} of {counts.size} bodies with {len(cells)} cells; expected "
            f"{counts.size} to {len(cells) // 2}, or 0 for one piece per body"
        )
    label, first = np.empty(len(cells), dtype=np.int64), 0
    for b, of_body in enumerate(_shares(counts, parts)):
        own = np.flatnonzero(body == b)
        label[own] = first + _parted(neighbours(points, cells[own]), int(of_body))
        first += int(of_body)
    return label


def _shares(counts: Labels, parts: int) -> Labels:
    """Share out the parts in proportion to the cells of each body, one at least."""
    shares = np.ones_like(counts)
    for _ in range(parts - counts.size):
        shares[np.argmax(counts / shares)] += 1
    return shares


def neighbours(points: NDArray[np.float64], cells: Nodes) -> csr_array:
    """Return the graph of cells (E, E), with an integer weight for each shared facet.

    The weight is `UNIT_WEIGHT` times √(L/d) for an edge of length L between cell
    centres at the distance d, and times (L/d)^⅔ for a face of area L². Where the two
    cells have the area (volume) 1, this is the length of the edge (area of the face).
    """
    dim = points.shape[1]
    element = ELEMENTS[dim, cells.shape[1]]
    corners = element.facets.shape[1]
    facets = cells[:, element.facets].reshape(-1, corners)
    cell = np.repeat(np.arange(len(cells)), len(element.facets))
    names = np.sort(facets, axis=1)
    is_facet = (names[:, 1:] != names[:, :-1]).all(axis=1)
    facets, names, cell = facets[is_facet], names[is_facet], cell[is_facet]
    order = np.lexsort(names.T)
    shared = np.flatnonzero((np.diff(names[order], axis=0) == 0).all(axis=1))
    one, other = cell[order[shared]], cell[order[shared + 1]]
    ends, centre = points[facets[order[shared]]], points[cells].mean(axis=1)
    ratio = _side(ends) / np.linalg.norm(centre[one] - centre[other], axis=1)
    size = ratio ** ((dim - 1) / dim)
    weight = np.clip(np.rint(UNIT_WEIGHT * size), 1, MAX_WEIGHT).astype(np.int64)
    shape = (len(cells), len(cells))
    half = csr_array((weight, (one, other)), shape=shape)
    return csr_array(half + half.T)


def _side(facets: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the length of edges (k, 2, 2), or the root of the area of faces (k, 4, 3).

    Of corners that are not in one plane, the area of their projection that is largest.
    """
    if facets.shape[2] == 2:
        return np.asarray(np.linalg.norm(facets[:, 0] - facets[:, 1], axis=1))
    one, other = facets[:, 2] - facets[:, 0], facets[:, 3] - facets[:, 1]
    area = np.linalg.norm(np.cross(one, other), axis=1) / 2
    return np.asarray(np.sqrt(area))


def _parted(graph: csr_array, parts: int) -> Labels:
    """SubdomainMesh the cells of one body."""
    if connected_components(graph)[0] > 1:
        raise InputError(
            "the cells of a body do not all hang together by edges (faces in space); "
            "expected a body for each of its pieces"
        )
    if parts == 1:
        return np.zeros(graph.shape[0], dtype=np.int64)
    from pymetis import CSRAdjacency, Options, part_graph  # here: few cases are parted

    adjacency, weights = CSRAdjacency(graph.indptr, graph.indices), graph.data
    # k-way parts are better, but some may be empty where parts have few cells
    for recursive in (False, True):
        options = Options(ufactor=MAX_IMBALANCE, contig=int(not recursive))
        _, found = part_graph(
            parts, adjacency, eweights=weights, recursive=recursive, options=options
        )
        label = _connected(graph, np.array(found, dtype=np.int64))
        if np.unique(label).size == parts:
            return label
    raise InputError(
        f"METIS finds no {parts} connected parts in a body of {label.size} cells; "
        "expected fewer parts"
    )


def _connected(graph: csr_array, label: Labels) -> Labels:
    """Give the smaller pieces of a part to the neighbours that they touch most."""
    cell, other = graph.nonzero()
    while True:
        same = label[cell] == label[other]
        inside = csr_array((same.astype(np.int8), (cell, other)), shape=graph.shape)
        inside.eliminate_zeros()
        count, piece = connected_components(inside)
        if count == np.unique(label).size:
            return label
        sizes, of_part = np.bincount(piece), np.empty(count, dtype=np.int64)
        of_part[piece] = label
        order = np.lexsort((sizes, of_part))
        largest = np.append(of_part[order][1:] != of_part[order][:-1], True)
        loose = order[~largest][0]
        touched = label[other[(piece[cell] == loose) & ~same]]
        label = np.where(piece == loose, np.bincount(touched).argmax(), label)
