"""Subdivision of bodies into subdomains, replicated on every rank.

The global numbers of torn nodes and of gluing rows are determined by the subdomains
that contain each node. For blocks of structured grids, these subdomains are computed
from tables with one entry per row, or per column, of nodes
(`problems.feti.structured.Layout`). For all other bodies, the interface nodes, which
belong to several subdomains, are listed (`ListedSubdivision`).
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness.digest import hex_digest
from mortarbench.problems.fem.mesh import HalfDisc, Mesh, Nodes
from mortarbench.problems.feti.tearing import Block, label_blocks

Integers = NDArray[np.integer[Any]]
Points = NDArray[np.float64]


class SubdomainNodes(NamedTuple):
    """Nodes of given subdomains, sorted by subdomain and then by number."""

    subdomain: Integers  #: (M,) index in the list of subdomains
    number: Nodes  #: (M,) global numbers
    multiplicity: Integers  #: (M,) number of copies of the node in all subdomains
    copy: Integers  #: (M,) number of this copy among all copies of the node, from 0
    #: (subdomains + 1,) index of the first node of each subdomain, followed by M
    start: NDArray[np.int64]


class Subdivision(Protocol):
    """Subdivision of one or more bodies into S subdomains.

    Copies of a node are numbered in the order of their subdomains. Arguments `node` are
    global numbers (k,); arguments `subdomains` are lists of subdomain numbers.
    """

    @property
    def count(self) -> int:
        """Number of subdomains, S."""

    @property
    def nodes(self) -> int:
        """Number of nodes of all bodies."""

    @property
    def body(self) -> Integers:
        """Body of each subdomain, (S,)."""

    @property
    def sizes(self) -> NDArray[np.int64]:
        """Number of nodes of each subdomain, (S,)."""

    def subdomain_nodes(self, subdomains: Nodes) -> SubdomainNodes:
        """Return the nodes of given subdomains."""

    def keys(self, subdomains: Nodes) -> Sequence[Hashable]:
        """Return a key per subdomain; subdomains with the same cells have equal keys.

        Cells are compared as indices into the nodes of their subdomain.
        """

    def points(self, subdomains: Nodes) -> Sequence[Points]:
        """Return the points (n, dim) of the nodes of each subdomain."""

    def cells(self, subdomain: int) -> Nodes:
        """Return the cells (E, corners) of a subdomain, as indices into its nodes."""

    @property
    def label(self) -> NDArray[np.int64]:
        """Subdomain of each cell of the whole mesh, (E,)."""

    def multiplicity(self, node: Nodes) -> NDArray[np.int64]:
        """Return the number of copies of each node, (k,)."""

    def holder(self, node: Nodes, copy: Integers | int = 0) -> Nodes:
        """Return the subdomain (k,) that contains the given copy of each node.

        copy : (k,) number of the copy, from 0
        """

    def position(self, node: Nodes) -> Points:
        """Return the points of given nodes, (k, dim)."""

    def before(self, node: Nodes) -> NDArray[np.int64]:
        """Count, for each node, the preceding nodes of equal multiplicity, (k,)."""

    @property
    def nodes_by_multiplicity(self) -> Mapping[int, int]:
        """Number of nodes with m copies, for each m > 1."""

    def glued(self) -> NDArray[np.int64]:
        """Return, for each subdomain (S,), the number of its nodes on interfaces."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ListedSubdivision:
    """Subdivision with a list of the nodes that subdomains share; see `Subdivision`.

    `holder` and `before` accept listed nodes only.
    """

    nodes: int  #: number of nodes of all bodies
    body: Integers  #: (S,) body of each subdomain
    sizes: NDArray[np.int64]  #: (S,) number of nodes of each subdomain
    node: Nodes  #: (k,) listed nodes, ascending
    #: (k + 1,) index in `holders` of the first holder of each node, followed by l
    start: NDArray[np.int64]
    holders: Nodes  #: (l,) subdomains that contain each node, ascending
    #: function that returns the nodes (n,) of a subdomain, ascending, and its cells (E,
    #: corners) as indices into these nodes
    part: Callable[[int], tuple[Nodes, Nodes]]
    position: Callable[[Nodes], Points]
    labelling: Callable[[], NDArray[np.int64]]  #: function that computes `label`

    @property
    def label(self) -> NDArray[np.int64]:
        """Subdomain of each cell of the whole mesh, (E,)."""
        return self.labelling()

    @property
    def count(self) -> int:
        """Number of subdomains, S."""
        return self.body.size

    def subdomain_nodes(self, subdomains: Nodes) -> SubdomainNodes:
        """Return the nodes of given subdomains."""
        parts = [self.part(int(s))[0] for s in subdomains]
        sizes = np.array([part.size for part in parts])
        number = np.concatenate(parts)
        place = np.minimum(np.searchsorted(self.node, number), self.node.size - 1)
        subdomain = np.repeat(np.arange(sizes.size, dtype=np.int32), sizes)
        copy = np.zeros(number.size, dtype=np.int32)
        listed = np.flatnonzero(self.node[place] == number)
        # `searchsorted` applies because the holders of each listed node are ascending
        pairs = np.repeat(np.arange(self.node.size), np.diff(self.start))
        position = np.searchsorted(
            pairs * self.count + self.holders,
            place[listed] * self.count + subdomains[subdomain[listed]],
        )
        copy[listed] = position - self.start[place[listed]]
        return SubdomainNodes(
            subdomain,
            number,
            self.multiplicity(number).astype(np.int32),
            copy,
            np.concatenate([[0], np.cumsum(sizes)]),
        )

    def keys(self, subdomains: Nodes) -> Sequence[Hashable]:
        """Return a digest of the cells of each subdomain."""
        cells = (np.ascontiguousarray(self.cells(int(s))) for s in subdomains)
        return [hex_digest((c.tobytes(),), 32) for c in cells]

    def points(self, subdomains: Nodes) -> Sequence[Points]:
        """Return the points (n, dim) of the nodes of each subdomain."""
        return [self.position(self.part(int(s))[0]) for s in subdomains]

    def cells(self, subdomain: int) -> Nodes:
        """Return the cells (E, corners) of a subdomain, as indices into its nodes."""
        return self.part(subdomain)[1]

    def _place(self, node: Nodes) -> Nodes:
        """Return the indices of listed nodes in the list."""
        return np.searchsorted(self.node, node)

    def multiplicity(self, node: Nodes) -> NDArray[np.int64]:
        """Return the number of copies of each node, (k,); 1 for unlisted nodes."""
        place = np.minimum(self._place(node), self.node.size - 1)
        return np.where(self.node[place] == node, np.diff(self.start)[place], 1)

    def holder(self, node: Nodes, copy: Integers | int = 0) -> Nodes:
        """Return the subdomain (k,) that contains the given copy of each listed node.

        copy : (k,) number of the copy, from 0
        """
        return np.asarray(self.holders[self.start[self._place(node)] + copy])

    def before(self, node: Nodes) -> NDArray[np.int64]:
        """Count, for listed nodes, the preceding listed nodes of equal multiplicity."""
        return np.asarray(self._before[self._place(node)])

    @cached_property
    def _before(self) -> NDArray[np.int64]:
        multiplicity = np.diff(self.start)
        before = np.empty_like(multiplicity)
        for m in np.unique(multiplicity):
            nodes = np.flatnonzero(multiplicity == m)
            before[nodes] = np.arange(nodes.size)
        return before

    @cached_property
    def nodes_by_multiplicity(self) -> Mapping[int, int]:
        """Number of nodes with m copies, for each m > 1."""
        multiplicity, count = np.unique(np.diff(self.start), return_counts=True)
        return {
            int(m): int(n) for m, n in zip(multiplicity, count, strict=True) if m > 1
        }

    def glued(self) -> NDArray[np.int64]:
        """Return, for each subdomain (S,), the number of its nodes on interfaces."""
        multiplicity = np.diff(self.start)
        several = np.repeat(multiplicity > 1, multiplicity)
        return np.bincount(self.holders[several], minlength=self.count)


def sort_holders(
    number: Nodes, subdomain: Nodes, subdomains: int
) -> tuple[Nodes, NDArray[np.int64], Nodes]:
    """Sort pairs of a node and a subdomain that contains it, without duplicates.

    number, subdomain : (e,) node and subdomain of each pair
    subdomains : total number of subdomains

    Returns
    -------
    `node`, `start` and `holders` of `ListedSubdivision`

    """
    node, holders = np.divmod(np.unique(number * subdomains + subdomain), subdomains)
    first = np.flatnonzero(np.diff(node, prepend=-1))
    return node[first], np.append(first, node.size), holders


def half_discs_in_blocks(
    discs: Sequence[HalfDisc], blocks: Sequence[Sequence[Block]]
) -> ListedSubdivision:
    """Return the subdivision of half discs into blocks; perimeter nodes are listed.

    blocks : for each disc, the ranges of rings and of angles that form each block
    """
    first = np.cumsum([0, *(disc.nodes for disc in discs)])
    body = np.repeat(np.arange(len(discs)), [len(own) for own in blocks])
    every = [
        (discs[b], first[b], *block) for b, own in enumerate(blocks) for block in own
    ]
    around = [begin + _perimeter(disc, *block) for disc, begin, *block in every]

    def part(s: int) -> tuple[Nodes, Nodes]:
        disc, begin, rings, angles = every[s]
        nodes, cells = disc.block(angles, rings)
        return begin + nodes, cells

    def position(node: Nodes) -> Points:
        disc_of = np.searchsorted(first, node, side="right") - 1
        points = np.empty((node.size, 2))
        for b in np.unique(disc_of).tolist():
            points[disc_of == b] = discs[b].position(node[disc_of == b] - first[b])
        return points

    subdomain = np.repeat(np.arange(len(every)), [nodes.size for nodes in around])
    node, start, holders = sort_holders(np.concatenate(around), subdomain, len(every))
    return ListedSubdivision(
        nodes=int(first[-1]),
        body=body,
        sizes=np.array([_nodes(disc, *block) for disc, _, *block in every]),
        node=node,
        start=start,
        holders=holders,
        part=part,
        position=position,
        labelling=lambda: _labels(blocks),
    )


def _labels(blocks: Sequence[Sequence[Block]]) -> NDArray[np.int64]:
    """Return the block of each cell, disc by disc."""
    first = np.cumsum([0, *map(len, blocks)])
    return np.concatenate(
        [label_blocks(own) + begin for own, begin in zip(blocks, first, strict=False)]
    )


def _nodes(disc: HalfDisc, rings: slice, angles: slice) -> int:
    """Return the number of nodes of a block; the centre of a disc is a single node."""
    has_centre = rings.stop == disc.radii.size
    lines = rings.stop - rings.start + (not has_centre)
    return int((angles.stop - angles.start + 1) * lines + has_centre)


def _perimeter(disc: HalfDisc, rings: slice, angles: slice) -> Nodes:
    """Return the nodes on the sides of a block of cells, with repetitions."""
    a, r = disc.angles.size, disc.radii.size
    has_centre = rings.stop == r
    i = np.arange(angles.start, angles.stop + 1)
    j = np.arange(rings.start, rings.stop + (not has_centre))
    inner = [a * r] if has_centre else a * rings.stop + i
    ends = (a * j + angles.start, a * j + angles.stop)
    return np.concatenate([a * rings.start + i, inner, *ends])


def mesh_in_subdomains(
    mesh: Mesh,
    label: NDArray[np.int64],
    body: NDArray[np.int64],
    named: Nodes,
) -> ListedSubdivision:
    """Return the subdivision of a stored mesh by the labels of its cells.

    Parameters
    ----------
    label, body : (E,) subdomain and body of each cell
    named : nodes to list even if only one subdomain contains them

    """
    points, cells, N = mesh.points, mesh.cells, len(mesh.points)
    S = int(label.max()) + 1
    by_label = np.argsort(label, kind="stable")
    ends = np.searchsorted(label[by_label], np.arange(S + 1))
    pairs = np.unique((label[by_label, None] * N + cells[by_label]).ravel())
    subdomain, number = np.divmod(pairs, N)
    kept = np.bincount(number, minlength=N) > 1
    kept[named] = True
    several = kept[number]
    node, start, holders = sort_holders(number[several], subdomain[several], S)

    def part(s: int) -> tuple[Nodes, Nodes]:
        own_cells = cells[by_label[ends[s] : ends[s + 1]]]
        nodes, corner = np.unique(own_cells, return_inverse=True)
        return nodes, corner.reshape(own_cells.shape)

    return ListedSubdivision(
        nodes=N,
        body=body[by_label[ends[:-1]]],
        sizes=np.bincount(subdomain, minlength=S),
        node=node,
        start=start,
        holders=holders,
        part=part,
        position=points.__getitem__,
        labelling=lambda: label,
    )
