"""Nested dissection of a mesh: in which order a sparse Cholesky factor eliminates it.

A set of nodes is cut in two across its longest principal axis; of the second half, the
nodes with a neighbour in the first separate the two, and are eliminated after both.
Either half is cut again until few nodes are left (George, SIAM J. Numer. Anal. 10,
1973; the cuts by coordinates, as in Gilbert, Miller and Teng, SIAM J. Sci. Comput. 19,
1998). Chosen nodes are eliminated last of all, so that the trailing block of the factor
is the Schur complement on them.

The sets that are eliminated together, leaves and separators, are the fronts of a
multifrontal factorisation (`problems.fem.multifrontal`), in postorder: both halves come
before what separates them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from harness import Matrix
from problems.fem.mesh import Nodes

LEAF = 8  #: nodes that are cut no more

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]
Marks = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Fronts:
    """Sets of positions in an order of elimination, in postorder of their tree.

    Positions number the eliminated in their order. Those of front s are
    start[s] … start[s + 1] − 1; border[first[s]:first[s + 1]] are the later ones that
    the matrix or the elimination of earlier ones couples with them, ascending. The
    `children[s]` roots of subtrees that come last before s are its children.
    """

    start: Ints  #: (F + 1,)
    first: Ints  #: (F + 1,)
    border: Ints
    children: Ints  #: (F,)
    roots: Marks  #: (F,) which of them hold the nodes to be eliminated last


def dissect(K: Matrix, points: Floats, last: Nodes) -> tuple[Nodes, Fronts]:
    """Order the nodes (N,) of a mesh, and find the fronts of this order.

    Parameters
    ----------
    K : (dN, dN) symmetric pattern in CSC; node i has the d components d·i, d·i + 1, …
    points : (N, 2) of the nodes
    last : nodes that come last in their connected component

    Returns
    -------
    the nodes in order of elimination, and the fronts of their positions in it

    """
    nodes = len(points)
    ptr, idx = node_graph(K.indptr, K.indices, K.shape[0] // nodes, nodes)
    ending = np.zeros(nodes, dtype=np.bool_)
    ending[last] = True
    order, start, children, roots = dissected(ptr, idx, points, ending, LEAF)
    first, border = borders(ptr, idx, order, start, children)
    return order.astype(np.int64), Fronts(start, first, border, children, roots)


def spread(fronts: Fronts, ends: Ints) -> Fronts:
    """Replace each position by several, or none: i by ends[i] … ends[i + 1] − 1."""
    count = np.diff(ends)[fronts.border]
    above = np.append(0, np.cumsum(count))
    each = np.arange(above[-1]) - np.repeat(above[:-1], count)
    return Fronts(
        ends[fronts.start],
        above[fronts.first].astype(np.int32),
        (np.repeat(ends[fronts.border], count) + each).astype(np.int32),
        fronts.children,
        fronts.roots,
    )


@njit(cache=True)
def node_graph(indptr: Ints, indices: Ints, d: int, nodes: int) -> tuple[Ints, Ints]:
    """Contract the pattern of a matrix with d components per node, diagonal left out.

    Returns the neighbours of each node in turn, as (ptr, idx).
    """
    ptr = np.zeros(nodes + 1, dtype=np.int32)
    idx = np.empty(len(indices), dtype=np.int32)
    seen = np.full(nodes, -1, dtype=np.int32)
    end = 0
    for a in range(nodes):
        seen[a] = a
        for t in range(indptr[d * a], indptr[d * (a + 1)]):
            b = indices[t] // d
            if seen[b] != a:
                seen[b] = a
                idx[end] = b
                end += 1
        ptr[a + 1] = end
    return ptr, idx[:end].copy()


@njit(cache=True)
def dissected(
    ptr: Ints, idx: Ints, points: Floats, ending: Marks, leaf: int
) -> tuple[Ints, Ints, Ints, Marks]:
    """Dissect each connected component; see `dissect` and `Fronts`.

    Returns order (N,), start (F + 1,), children (F,) and roots (F,).
    """
    nodes = len(points)
    order, found = np.empty(nodes, dtype=np.int32), np.zeros(nodes, dtype=np.bool_)
    side = np.zeros(nodes, dtype=np.int32)  # of the cut that a node was last in
    start, children, roots = [0], [0][:0], [False][:0]
    end = cut = 0
    for seed in range(nodes):
        if found[seed]:
            continue
        component = _component(ptr, idx, seed, found)
        inner = component[~ending[component]]
        order[end : end + len(inner)] = inner
        # reversed postorder: a separator, all of its second half, all of its first
        lengths, branches = [0][:0], [0][:0]
        todo = [(end, end + len(inner))]
        while todo and len(inner):
            low, high = todo.pop()
            middle = separator = high
            if high - low > leaf:
                cut += 2
                middle, separator = _cut(
                    ptr, idx, points, order[low:high], side, cut, low
                )
            if middle in (low, high):  # few nodes, or all in one place
                lengths.append(high - low)
                branches.append(0)
                continue
            lengths.append(high - separator)
            branches.append(2)
            todo.append((low, middle))
            todo.append((middle, separator))
        for t in range(len(lengths) - 1, -1, -1):
            start.append(start[-1] + lengths[t])
            children.append(branches[t])
            roots.append(False)
        end += len(inner)
        outer = component[ending[component]]
        order[end : end + len(outer)] = outer
        end += len(outer)
        start.append(end)
        children.append(min(1, len(inner)))
        roots.append(True)
    return (
        order,
        np.array(start, dtype=np.int32),
        np.array(children, dtype=np.int32),
        np.array(roots, dtype=np.bool_),
    )


@njit(cache=True)
def _component(ptr: Ints, idx: Ints, seed: int, found: Marks) -> Ints:
    """List the nodes that are connected with one of them, ascending; mark them."""
    reached = np.empty(len(found), dtype=np.int32)
    reached[0], count, at = seed, 1, 0
    found[seed] = True
    while at < count:
        for t in range(ptr[reached[at]], ptr[reached[at] + 1]):
            if not found[idx[t]]:
                found[idx[t]] = True
                reached[count] = idx[t]
                count += 1
        at += 1
    return np.sort(reached[:count])


@njit(cache=True)
def _cut(
    ptr: Ints, idx: Ints, points: Floats, part: Ints, side: Ints, cut: int, low: int
) -> tuple[int, int]:
    """Reorder `part` to first half, second half, separator; return where these begin.

    The places count from `low`, that of part[0]. side becomes `cut` on the first half
    and cut + 1 on the rest.
    """
    along = _along(points, part)
    value = np.partition(along, len(part) // 2)[len(part) // 2]
    # nodes level with the median but for rounding stay together
    value -= 1e-9 * (along.max() - along.min())
    count = np.zeros(3, dtype=np.int32)
    for t, a in enumerate(part):
        side[a] = cut + (along[t] >= value)
    kind = np.zeros(len(part), dtype=np.int32)
    for t, a in enumerate(part):
        if side[a] == cut + 1:
            kind[t] = 1
            for s in range(ptr[a], ptr[a + 1]):
                if side[idx[s]] == cut:
                    kind[t] = 2
                    break
        count[kind[t]] += 1
    place = np.array([0, count[0], count[0] + count[1]])
    middle, separator = low + place[1], low + place[2]
    for t, a in enumerate(part.copy()):
        part[place[kind[t]]] = a
        place[kind[t]] += 1
    return middle, separator


@njit(cache=True)
def _along(points: Floats, part: Ints) -> Floats:
    """Coordinates of nodes along their longest principal axis."""
    x, y = points[part, 0], points[part, 1]
    x, y = x - x.mean(), y - y.mean()
    angle = np.arctan2(2 * (x * y).sum(), (x * x).sum() - (y * y).sum()) / 2
    return np.asarray(x * np.cos(angle) + y * np.sin(angle))


@njit(cache=True)
def borders(
    ptr: Ints, idx: Ints, order: Ints, start: Ints, children: Ints
) -> tuple[Ints, Ints]:
    """Find the border of each front: later neighbours of its own and its children's."""
    position = np.empty(len(order), dtype=np.int32)
    position[order] = np.arange(len(order), dtype=np.int32)
    seen = np.full(len(order), -1, dtype=np.int32)
    found = np.empty(len(order), dtype=np.int32)
    parts, waiting = [found[:0]], [0][:0]
    first = np.zeros(len(start), dtype=np.int32)
    for s in range(len(start) - 1):
        end, count = start[s + 1], 0
        for _ in range(children[s]):
            for p in parts[waiting.pop() + 1]:
                if p >= end and seen[p] != s:
                    seen[p] = s
                    found[count] = p
                    count += 1
        for a in order[start[s] : end]:
            for t in range(ptr[a], ptr[a + 1]):
                p = position[idx[t]]
                if p >= end and seen[p] != s:
                    seen[p] = s
                    found[count] = p
                    count += 1
        parts.append(np.sort(found[:count]))
        waiting.append(s)
        first[s + 1] = first[s] + count
    border = np.empty(first[-1], dtype=np.int32)
    for s in range(len(start) - 1):
        border[first[s] : first[s + 1]] = parts[s + 1]
    return first, border
