"""Closest-point search on chains of segments, at near-linear cost.

Consecutive segments are grouped by fours into a tree of *fat chords*. A sub-chain from
node A to node B lies within a deviation δ of its chord AB, and AB lies within δ of the
sub-chain: as a point moves along the sub-chain, its closest point on AB traverses all
of AB. Hence the distance from any point p satisfies

    |p − AB| − δ  ≤  |p − sub-chain|  ≤  |p − AB| + δ.

A query for a point descends the tree into all sub-chains that these bounds do not rule
out. On a smooth chain, δ decreases with the square of the sub-chain's length, so that
each query visits O(1) sub-chains per level at any distance. With bounding boxes or
balls, the number of visited sub-chains would grow with the distance. Leaves are
segments with δ = 0, so that the result is exact. In the worst case, the point is
equidistant from the whole chain (the centre of an arc), and no sub-chain can be ruled
out.
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

#: closest points within this distance in ξ of an end of a segment are moved to this end
VERTEX_TOLERANCE = 1e-9


BRANCHES = 4
ROOTS = 16  #: largest number of sub-chains on the top level; smaller values are slower
#: relative tolerance for rounding of distances; without it, equally close segments
#: could rule each other out
ROUNDING = 1e-12


@dataclass(frozen=True)
class Reach:
    """Limits on the angle between the normals, and on the distance, of two sides."""

    #: largest n_s·n_m of the normals of slave and master; −½ admits normals that are at
    #: most 60° from opposite
    cosine: float = -0.5
    #: largest distance, m; None selects the larger extent of the two sides
    distance: float | None = None

    def __post_init__(self) -> None:
        if not -1 <= self.cosine <= 1:
            raise InputError(f"reach: cosine={self.cosine} must be in [-1, 1]")
        if self.distance is not None and not self.distance > 0:
            raise InputError(f"reach: distance={self.distance} m must be positive")

    def max_distance(self, slave: Surface, master: Surface) -> float:
        """Return the largest distance allowed between two sides, m."""
        if self.distance is not None:
            return self.distance
        return max(slave.extent, master.extent)


class Chords(NamedTuple):
    """One level of the tree: sub-chains in the order of the chain.

    All sub-chains have equally many segments, except that the last may have fewer.
    """

    start: Points  #: (k, 2) position of the first node, m
    edge: Points  #: (k, 2) vector from the first to the last node, m
    inverse: Vector  #: (k,) 1/|edge|², 0 if the ends of a sub-chain coincide
    deviation: Vector  #: (k,) deviation δ, m


#: function that maps a level and pairs of a query (p,) and a sub-chain (p,) to a mask
#: of the pairs whose sub-chains are visited
Criterion = Callable[[Chords, Nodes, Nodes], NDArray[np.bool_]]


class Nearest(NamedTuple):
    """Closest points on a chain; segments are numbered as in its `Surface`."""

    segment: Nodes  #: (s,) number of the segment with the closest point
    xi: Vector  #: (s,) coordinate on the segment, 0 at its first node, 1 at its second


class ClosestPoints(NamedTuple):
    """Closest points of s positions on a chain of nodes."""

    #: (s,) position in the chain of the first node of the segment that contains the
    #: closest point
    segment: Nodes
    xi: Vector  #: (s,) coordinate on the segment, 0 at its first node, 1 at its second
    normal: Points  #: (s, 2) outward unit normal of the master at the closest point
    #: (s,) distance along the master by which a point is beyond its end, m; else 0
    beyond: Vector


def nearest(x: Points, line: Surface) -> Nearest:
    """Return the closest point of a chain to each point of x (s, 2).

    If several segments are equally close up to rounding, the first one is selected.
    """

    def keep(level: Chords, query: Nodes, node: Nodes) -> NDArray[np.bool_]:
        distance = _to_chords(x.take(query, axis=0), level, node)[1]
        deviation = level.deviation[node]
        bound = _minimum_per_query(distance + deviation, query)
        # lower bound of this sub-chain ≤ least upper bound of all
        followed: NDArray[np.bool_] = distance - deviation <= (1 + ROUNDING) * bound
        return followed

    levels = _levels(line)
    query, closest = _descend(len(x), levels, keep)
    segment = closest[_first_of_each(query)]
    return Nearest(segment, _to_chords(x, levels[-1], segment)[0])


def closest_points(x: Points, line: Surface) -> ClosestPoints:
    """Return the closest points of x (s, 2) on a chain, with outward normals."""
    segment, xi = nearest(x, line)
    first, second = line.facets.T[:, segment]
    # snap to vertices, where the normal is averaged: rounding must not select a segment
    at_first, at_second = xi <= VERTEX_TOLERANCE, xi >= 1 - VERTEX_TOLERANCE
    xi = np.where(at_first, 0.0, np.where(at_second, 1.0, xi))
    normal = np.where(at_first[:, None], line.node_normal[first], line.normal[segment])
    normal = np.where(at_second[:, None], line.node_normal[second], normal)
    along, length = along_lines(x, line, first)
    starts = at_first & (segment == 0)
    ends = at_second & (segment == len(line.facets) - 1)
    excess = np.where(starts, -along, np.where(ends, along - 1, 0.0))
    excess = np.where(excess > VERTEX_TOLERANCE, excess, 0.0)
    return ClosestPoints(first, xi, normal, excess * length)


def along_lines(x: Points, line: Surface, segment: Nodes) -> tuple[Vector, Vector]:
    """Project x (s, 2) onto the lines through segments; return ξ and the lengths.

    segment : (s,) position in the chain of the first node of each segment
    """
    edge = line.x[segment + 1] - line.x[segment]
    square = np.einsum("sx,sx->s", edge, edge)
    xi = np.einsum("sx,sx->s", x - line.x[segment], edge) / square
    return np.asarray(xi), np.sqrt(square)


def facing_segments(slave: Surface, master: Surface) -> tuple[Nodes, Nodes]:
    """Return the pairs of slave and master segments that may overlap along normals.

    Let f_j(p) = (x_j − p) × n_j for the slave node j at x_j with the averaged normal
    n_j. A point p lies between the lines along the normals of nodes j and j + 1 if
    f_j(p) ≥ 0 ≥ f_{j+1}(p). The master segment of each returned pair has a point with
    f_j ≥ 0 and a point with f_{j+1} ≤ 0.

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

        def ends(nodes: Nodes) -> tuple[Vector, Vector]:
            along = across.take(nodes, axis=0)
            one = offset[nodes] + np.einsum("px,px->p", start, along)
            return one, one + np.einsum("px,px->p", edge, along)

        # because |n| = 1, f_j on a sub-chain is within δ of its values on the chord
        above = np.maximum(*ends(j[query])) >= -level.deviation[node]
        below = np.minimum(*ends(k[query])) <= level.deviation[node]
        followed: NDArray[np.bool_] = above & below
        return followed

    return _descend(len(j), _levels(master), keep)


def _descend(
    queries: int, levels: list[Chords], keep: Criterion
) -> tuple[Nodes, Nodes]:
    """Descend from the roots; return pairs (query, leaf) sorted by query, then leaf."""
    # the queries descend together, level by level, to vectorise the work
    roots = len(levels[0].inverse)
    query = np.repeat(np.arange(queries), roots)
    node = np.tile(np.arange(roots), queries)
    for level, below in pairwise(levels):
        followed = keep(level, query, node)
        query = np.repeat(query[followed], BRANCHES)
        node = (BRANCHES * node[followed][:, None] + np.arange(BRANCHES)).ravel()
        exists = node < len(below.inverse)
        query, node = query[exists], node[exists]
    followed = keep(levels[-1], query, node)
    return query[followed], node[followed]


def _levels(line: Surface) -> list[Chords]:
    """Return the levels of the tree, from its roots to the segments."""
    return list(_levels_from_leaves(line))[::-1]


def _levels_from_leaves(line: Surface) -> Iterator[Chords]:
    """Yield the levels of the tree, from the segments to the roots.

    If the end nodes of the parts of a sub-chain lie within a distance h of its chord,
    so do the chords of the parts, and δ = h + (largest δ of the parts) bounds the
    deviation of the sub-chain.
    """
    nodes = np.concatenate([line.start, line.end[-1:]])
    level = _chords(nodes[:-1], nodes[1:], np.zeros(len(nodes) - 1))
    yield level
    while len(level.inverse) > ROOTS:
        first = np.arange(0, len(level.inverse), BRANCHES)
        part = np.arange(len(level.inverse))
        parents = _chords(
            nodes[first], nodes[np.append(first[1:], len(part))], np.zeros(len(first))
        )
        height = _to_chords(nodes[:-1], parents, part // BRANCHES)[1]
        deviation = np.maximum.reduceat(height, first)
        deviation += np.maximum.reduceat(level.deviation, first)
        level = parents._replace(deviation=deviation)
        nodes = np.concatenate([nodes[first], nodes[-1:]])
        yield level


def _chords(start: Points, end: Points, deviation: Vector) -> Chords:
    edge = end - start
    square = np.einsum("kx,kx->k", edge, edge)
    closed = square == 0
    inverse = np.where(closed, 0.0, 1 / np.where(closed, 1.0, square))
    return Chords(start, edge, inverse, deviation)


def _to_chords(x: Points, level: Chords, node: Nodes) -> tuple[Vector, Vector]:
    """Return the closest point on each chord: coordinate in [0, 1] and distance."""
    edge = level.edge.take(node, axis=0)
    offset = x - level.start.take(node, axis=0)
    xi = np.einsum("px,px->p", offset, edge) * level.inverse[node]
    xi = np.minimum(np.maximum(xi, 0.0), 1.0)
    offset -= xi[:, None] * edge
    return xi, np.sqrt(np.einsum("px,px->p", offset, offset))


def _minimum_per_query(values: Vector, query: Nodes) -> Vector:
    """Return, for each pair, the minimum over the pairs of its query (sorted)."""
    first = _first_of_each(query)
    pairs = np.diff(first, append=query.size)
    return np.minimum.reduceat(values, first).repeat(pairs)


def _first_of_each(query: Nodes) -> Nodes:
    """Return the index of the first pair of each query; queries are sorted."""
    new = np.ones(query.size, dtype=bool)
    np.not_equal(query[1:], query[:-1], out=new[1:])
    return np.flatnonzero(new)
