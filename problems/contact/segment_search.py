"""Search along a chain of segments at near-linear cost, without all pairs.

The segments are gathered four by four along the chain into a tree of *fat chords*: a
sub-chain from node A to node B lies within some deviation δ of its chord AB, and AB
lies within δ of the sub-chain (as the point of AB closest to a moving point of the
sub-chain runs over all of AB). Hence for the distance from any point p

    |p − AB| − δ  ≤  |p − sub-chain|  ≤  |p − AB| + δ.

Going down the tree, a query keeps a sub-chain unless these bounds rule it out. On a
smooth chain δ falls with the square of the sub-chain's length, so that O(1) sub-chains
per level are kept however far away the query is, where boxes or balls of the distance's
size would keep more and more; a leaf is a segment and has δ = 0, so the result is
exact. Points equally far from the whole chain (the centre of an arc) keep all of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import InputError, Vector
from mortarbench.problems.contact.surface import Points, Surface, tangents
from mortarbench.problems.fem.elements import cross
from mortarbench.problems.fem.mesh import Nodes

BRANCHES = 4
ROOTS = 16  #: levels with fewer sub-chains than this are not worth a visit
ROUNDING = 1e-12  #: relative; equally close segments must not rule each other out


@dataclass(frozen=True)
class Reach:
    """Which places may touch: those that face each other and are not too far apart."""

    cosine: float = -0.5  #: largest n_s·n_m kept; −½: at most 60° from opposite
    #: largest distance kept, m; None: the larger extent of the two sides
    distance: float | None = None

    def __post_init__(self) -> None:
        if not -1 <= self.cosine <= 1:
            raise InputError(f"reach: cosine={self.cosine} must be in [-1, 1]")
        if self.distance is not None and not self.distance > 0:
            raise InputError(f"reach: distance={self.distance} m must be positive")

    def max_distance(self, slave: Surface, master: Surface) -> float:
        """Return the largest distance kept between these sides, m."""
        if self.distance is not None:
            return self.distance
        return max(slave.extent, master.extent)


class Chords(NamedTuple):
    """One level of the tree: sub-chains of equally many segments, in order."""

    start: Points  #: (k, 2)
    edge: Points  #: (k, 2) from start to end
    inverse: Vector  #: (k,) 1/|edge|², 0 where a sub-chain closes on itself
    deviation: Vector  #: (k,) δ, m


#: (level, query (p,), sub-chain (p,)) → which of these pairs to follow
Criterion = Callable[[Chords, Nodes, Nodes], NDArray[np.bool_]]


class Nearest(NamedTuple):
    """Closest points on a chain; segments count as in its Surface."""

    segment: Nodes  #: (s,)
    xi: Vector  #: (s,) place in [0, 1] from the segment's first end to its second


def nearest(x: Points, line: Surface) -> Nearest:
    """Find the closest point of a whole chain for each point of x, (s, 2).

    Of segments that are equally close, to rounding, the first of the chain is returned.
    """

    def keep(level: Chords, query: Nodes, node: Nodes) -> NDArray[np.bool_]:
        distance = _to_chords(x.take(query, axis=0), level, node)[1]
        deviation = level.deviation[node]
        bound = _least(distance + deviation, query)
        kept: NDArray[np.bool_] = distance - deviation <= (1 + ROUNDING) * bound
        return kept

    levels = _levels(line)
    query, closest = _descend(len(x), levels, keep)
    segment = closest[_first_of_each(query)]
    return Nearest(segment, _to_chords(x, levels[-1], segment)[0])


def facing_segments(slave: Surface, master: Surface) -> tuple[Nodes, Nodes]:
    """Find which master segments may lie between the normals at a slave segment's ends.

    With f_j(p) = (x_j − p) × n_j, p lies between the lines along the averaged normals
    of the nodes j and j + 1 where f_j(p) ≥ 0 ≥ f_{j+1}(p). Each pair returned has a
    point on the right side of the one and a point on the right side of the other.

    Returns
    -------
    slave segments, master segments : (p,) each, sorted by slave segment

    """
    x, n = slave.x, slave.node_normal
    across = tangents(n)[:, 0]  # f_j(p) = offset_j + p · across_j
    offset = cross(x, n)
    j, k = slave.facets.T

    def keep(level: Chords, query: Nodes, node: Nodes) -> NDArray[np.bool_]:
        start, edge = level.start.take(node, axis=0), level.edge.take(node, axis=0)

        def ends(of: Nodes) -> tuple[Vector, Vector]:
            along = across.take(of, axis=0)
            one = offset[of] + np.einsum("px,px->p", start, along)
            return one, one + np.einsum("px,px->p", edge, along)

        above = np.maximum(*ends(j[query])) >= -level.deviation[node]
        below = np.minimum(*ends(k[query])) <= level.deviation[node]
        kept: NDArray[np.bool_] = above & below
        return kept

    return _descend(len(j), _levels(master), keep)


def _descend(
    queries: int, levels: list[Chords], keep: Criterion
) -> tuple[Nodes, Nodes]:
    """Go from the roots to the leaves with pairs (query, sub-chain), sorted by both."""
    roots = len(levels[0].inverse)
    query = np.repeat(np.arange(queries), roots)
    node = np.tile(np.arange(roots), queries)
    for level, below in pairwise(levels):
        kept = keep(level, query, node)
        query = np.repeat(query[kept], BRANCHES)
        node = (BRANCHES * node[kept][:, None] + np.arange(BRANCHES)).ravel()
        exists = node < len(below.inverse)
        query, node = query[exists], node[exists]
    kept = keep(levels[-1], query, node)
    return query[kept], node[kept]


def _levels(line: Surface) -> list[Chords]:
    """Build the tree, from its roots to the segments."""
    return list(_levels_from_leaves(line))[::-1]


def _levels_from_leaves(line: Surface) -> Iterator[Chords]:
    """Build the tree from the segments upwards.

    The chords of the parts of a sub-chain end at nodes within some h of its chord, so
    all of them lie within h, and δ = h + (largest δ of the parts) bounds the whole.
    """
    nodes = np.concatenate([line.start, line.end[-1:]])
    level = _chords(nodes[:-1], nodes[1:], np.zeros(len(nodes) - 1))
    yield level
    while len(level.inverse) > ROOTS:
        first = np.arange(0, len(level.inverse), BRANCHES)
        part = np.arange(len(level.inverse))
        bare = _chords(
            nodes[first], nodes[np.append(first[1:], len(part))], np.zeros(len(first))
        )
        height = _to_chords(nodes[:-1], bare, part // BRANCHES)[1]
        deviation = np.maximum.reduceat(height, first)
        deviation += np.maximum.reduceat(level.deviation, first)
        level = bare._replace(deviation=deviation)
        nodes = np.concatenate([nodes[first], nodes[-1:]])
        yield level


def _chords(start: Points, end: Points, deviation: Vector) -> Chords:
    edge = end - start
    square = np.einsum("kx,kx->k", edge, edge)
    closed = square == 0
    inverse = np.where(closed, 0.0, 1 / np.where(closed, 1.0, square))
    return Chords(start, edge, inverse, deviation)


def _to_chords(x: Points, level: Chords, node: Nodes) -> tuple[Vector, Vector]:
    """Return place in [0, 1] and distance of the closest point of a chord each."""
    edge = level.edge.take(node, axis=0)
    offset = x - level.start.take(node, axis=0)
    xi = np.einsum("px,px->p", offset, edge) * level.inverse[node]
    xi = np.minimum(np.maximum(xi, 0.0), 1.0)
    offset -= xi[:, None] * edge
    return xi, np.sqrt(np.einsum("px,px->p", offset, offset))


def _least(values: Vector, query: Nodes) -> Vector:
    """Return for each pair the least value of its query; queries are sorted."""
    first = _first_of_each(query)
    pairs = np.diff(first, append=query.size)
    return np.minimum.reduceat(values, first).repeat(pairs)


def _first_of_each(query: Nodes) -> Nodes:
    """Return the place of the first pair of each query; queries are sorted."""
    new = np.ones(query.size, dtype=bool)
    np.not_equal(query[1:], query[:-1], out=new[1:])
    return np.flatnonzero(new)
