"""Partition of unstructured bodies into connected subdomains, by the graph of cells.

In this graph, two cells are neighbours if they share a facet: an edge in 2D, a
face in 3D. METIS (Karypis and Kumar 1998, SIAM J. Sci. Comput. 20) partitions the
graph of each body into parts of about equal size, and approximately minimises the total
weight of the facets between parts. The weight of a facet is its size relative to the
adjacent cells, so that parts are compact even where the cells of graded meshes are long
and thin. The cells of a part must be connected through facets: cells that share only a
node (or, in 3D, an edge) can rotate relative to each other, so that the kernel of the
stiffness matrix would contain more than the rigid motions of the part.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from mortarbench.harness import InputError
from mortarbench.problems.fem.mesh import Nodes, adjacent_cells, facet_quadrature

Labels = NDArray[np.int64]

UNIT_WEIGHT = 100  #: weight of the facet between two squares, or two cubes
MAX_WEIGHT = 10_000  #: largest weight of a facet; METIS adds weights in 32-bit integers
#: largest imbalance of the parts that METIS may return, in thousandths; with smaller
#: values, parts consist of several disconnected pieces more often
MAX_IMBALANCE = 300


def graph_partition(
    points: NDArray[np.float64], cells: Nodes, body: Labels, parts: int
) -> Labels:
    """Partition bodies into connected parts; return the part of each cell.

    Each part belongs to one body. Each body has at least one part, and larger bodies
    have more parts, in proportion to their numbers of cells.

    Parameters
    ----------
    points : (N, dim) points of the nodes
    cells : (E, c) corners; a triangle repeats its last corner
    body : (E,) number of the body of each cell, from 0
    parts : total number of parts

    Returns
    -------
    (E,) part of each cell, 0 … parts − 1, numbered body by body

    Raises
    ------
    InputError
        If there are fewer parts than bodies, or more parts than bodies and on average
        fewer than two cells per part; if the cells of a body are not connected through
        facets; or if METIS finds no partition into connected parts.

    """
    counts = np.bincount(body)
    if not counts.size <= parts <= max(counts.size, len(cells) // 2):
        raise InputError(
            f"parts={parts} for {counts.size} bodies with {len(cells)} cells; expected "
            f"{counts.size} to {len(cells) // 2}, or 0 for undivided bodies"
        )
    label, first = np.empty(len(cells), dtype=np.int64), 0
    for b, of_body in enumerate(_parts_by_body(counts, parts)):
        cells_of_body = np.flatnonzero(body == b)
        label[cells_of_body] = first + _partition_body(
            neighbours(points, cells[cells_of_body]), int(of_body)
        )
        first += int(of_body)
    return label


def _parts_by_body(counts: Labels, parts: int) -> Labels:
    """Return the number of parts of each body, in proportion to its cells."""
    shares = np.ones_like(counts)
    for _ in range(parts - counts.size):
        shares[np.argmax(counts / shares)] += 1
    return shares


def neighbours(points: NDArray[np.float64], cells: Nodes) -> csr_array:
    """Return the graph of cells (E, E), with an integer weight for each shared facet.

    Let d be the distance between the centres of the two cells. The weight is
    `UNIT_WEIGHT` times √(L/d) for an edge of length L, or `UNIT_WEIGHT` times (L/d)^⅔
    for a face of area L². The second factor is the length of the edge if the cells are
    rectangles of unit area, and the area of the face if they are boxes of unit volume.
    """
    dim = points.shape[1]
    one, other, facets = adjacent_cells(cells, dim)
    centre = points[cells].mean(axis=1)
    area = np.linalg.norm(facet_quadrature(points, facets)[1].sum(axis=0), axis=1)
    distance = np.linalg.norm(centre[one] - centre[other], axis=1)
    size = (area ** (1 / (dim - 1)) / distance) ** ((dim - 1) / dim)
    weight = np.clip(np.rint(UNIT_WEIGHT * size), 1, MAX_WEIGHT).astype(np.int64)
    shape = (len(cells), len(cells))
    half = csr_array((weight, (one, other)), shape=shape)
    return csr_array(half + half.T)


def _partition_body(graph: csr_array, parts: int) -> Labels:
    """Return the parts (E,) of the cells of one body."""
    if connected_components(graph)[0] > 1:
        raise InputError(
            "the cells of a body are not all connected by edges (faces in 3D); "
            "expected a separate body for each connected piece"
        )
    if parts == 1:
        return np.zeros(graph.shape[0], dtype=np.int64)
    # rarely needed, hence local
    from pymetis import CSRAdjacency, Options, part_graph

    adjacency, weights = CSRAdjacency(graph.indptr, graph.indices), graph.data
    # k-way partitions are better, but may have empty parts if there are few cells per
    # part; recursive bisection is the fallback
    for recursive in (False, True):
        options = Options(ufactor=MAX_IMBALANCE, contig=int(not recursive))
        _, found = part_graph(
            parts, adjacency, eweights=weights, recursive=recursive, options=options
        )
        label = _reconnect(graph, np.array(found, dtype=np.int64))
        if np.unique(label).size == parts:
            return label
    raise InputError(
        f"METIS found no partition of a body of {label.size} cells into {parts} "
        "connected parts; expected fewer parts"
    )


def _reconnect(graph: csr_array, label: Labels) -> Labels:
    """Merge all but the largest piece of each part into adjacent parts.

    A piece is a connected component of a part. It is merged into the part with which it
    shares the most facets.
    """
    cell, other = graph.nonzero()
    while True:
        same = label[cell] == label[other]
        within_parts = csr_array(
            (same.astype(np.int8), (cell, other)), shape=graph.shape
        )
        within_parts.eliminate_zeros()
        count, piece = connected_components(within_parts)
        if count == np.unique(label).size:
            return label
        sizes, of_part = np.bincount(piece), np.empty(count, dtype=np.int64)
        of_part[piece] = label
        order = np.lexsort((sizes, of_part))
        largest = np.append(of_part[order][1:] != of_part[order][:-1], True)
        loose = order[~largest][0]
        touched = label[other[(piece[cell] == loose) & ~same]]
        label = np.where(piece == loose, np.bincount(touched).argmax(), label)
