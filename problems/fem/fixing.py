"""Fixing nodes of a floating body: if they are fixed, no rigid motion is possible.

The farther apart the fixing nodes are, the better K is conditioned without their rows
and columns. Fixing two neighbouring corners costs three digits of accuracy; fixing the
central nodes of four parts of the body costs hardly any accuracy. In 3D the fixing
nodes must not be collinear, because the body could rotate about their line.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import laplacian
from scipy.sparse.linalg import eigsh

from mortarbench.harness import Matrix
from mortarbench.problems.fem.mesh import Nodes

#: number of fixing nodes per body; fewer nodes worsen the conditioning, more nodes
#: increase the fill-in
PARTS = 4
#: fixing nodes in 3D count as collinear if their largest distance from the line of
#: best fit is below this multiple of the largest distance of a node of the last part.
#: This ratio is at least 0.35 for blocks, and may be 0 for bars that are one cell wide
MIN_DISTANCE = 0.25
TIE = 1e-6  #: relative difference between lengths that count as equal


def fixing_nodes(points: NDArray[np.float64], parts: int = PARTS) -> Nodes:
    """Select `parts` (a power of two) fixing nodes of one body by their positions.

    The nodes at `points` (N, dim) are bisected recursively across their longest
    principal axis, until there are `parts` parts or a part is a single node. The node
    nearest to the centroid of each part is selected. In 3D, if the selected nodes
    are nearly collinear, the last one is replaced by a node away from their line.
    """
    groups = [np.arange(len(points))]
    while len(groups) < parts and all(group.size > 1 for group in groups):
        groups = [half for group in groups for half in _halves(points, group)]
    chosen = []
    for group in groups:
        offset = points[group] - points[group].mean(axis=0)
        distance = np.linalg.norm(offset, axis=1)
        chosen.append(group[_without_ties(distance).argmin()])
    fixing = np.array(chosen, dtype=np.int64)
    if points.shape[1] > 2:
        offset = points - points[fixing].mean(axis=0)
        axis = np.linalg.svd(offset[fixing], full_matrices=False)[2][0]
        distance = np.linalg.norm(offset - np.outer(offset @ axis, axis), axis=1)
        farthest = groups[-1][distance[groups[-1]].argmax()]
        if distance[fixing].max() < MIN_DISTANCE * distance[farthest]:
            fixing[-1] = farthest
    return fixing


def spectral_fixing_nodes(cells: Nodes, nodes: int, parts: int = PARTS) -> Nodes:
    """Select fixing nodes by spectral bisection of the mesh graph (paper, ref. [8]).

    The nodes are bisected recursively at the median of the Fiedler vector (the second
    eigenvector of the graph Laplacian). In each part, the node with the largest entry
    in the Perron vector of the adjacency matrix, the most central node, is selected.

    Parameters
    ----------
    cells : (E, 4) node numbers of one body, 0 … nodes − 1

    """
    graph = _graph(cells, nodes)
    groups = [np.arange(nodes)]
    while len(groups) < parts:
        groups = [half for group in groups for half in _bisected(graph, group)]
    return np.array([_central(graph, group) for group in groups], dtype=np.int64)


def _graph(cells: Nodes, nodes: int) -> csr_array:
    """Return the adjacency matrix (N, N): 1 for two nodes that share an edge."""
    a, b = cells.ravel(), np.roll(cells, -1, axis=1).ravel()
    ones = np.ones(2 * a.size)
    ends = (np.concatenate([a, b]), np.concatenate([b, a]))
    graph = csr_array(coo_array((ones, ends), shape=(nodes, nodes)))
    graph.data[:] = 1.0
    return graph


def _bisected(graph: Matrix, group: Nodes) -> tuple[Nodes, Nodes]:
    part = laplacian(graph[group][:, group]).tocsc()
    shift = -1e-3 / group.size  # σ just below the zero eigenvalue: L − σI is definite
    # fixed start, because the default of eigsh is random
    start = np.linspace(-1, 1, group.size)
    values, vectors = eigsh(part, k=2, sigma=shift, which="LM", v0=start)
    order = group[np.argsort(vectors[:, values.argmax()], kind="stable")]
    return order[: len(order) // 2], order[len(order) // 2 :]


def _central(graph: Matrix, group: Nodes) -> int:
    if group.size < 3:
        return int(group[0])
    _, vector = eigsh(graph[group][:, group], k=1, which="LA", v0=np.ones(group.size))
    return int(group[np.abs(vector[:, 0]).argmax()])


def _halves(points: NDArray[np.float64], group: Nodes) -> tuple[Nodes, Nodes]:
    offset = points[group] - points[group].mean(axis=0)
    weights = np.linspace(1, 1 - TIE, offset.shape[1])  # of equal principal axes
    axis = np.linalg.svd(offset * weights, full_matrices=False)[2][0]
    axis *= np.copysign(1, axis @ np.exp(-np.arange(axis.size)))
    order = group[_without_ties(offset @ axis).argsort()]
    return order[: len(order) // 2], order[len(order) // 2 :]


def _without_ties(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return values increased slightly, so that the first of equal ones is the least.

    Rounding errors, which depend on the kernel of BLAS, would otherwise decide.
    """
    largest: float = np.abs(values).max(initial=0.0)
    return values + np.linspace(0, TIE * largest, values.size)
