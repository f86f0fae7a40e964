"""Subdivision of bodies into subdomains, replicated on every rank.

Each cell belongs to one subdomain. A node on the boundary of several subdomains has a
copy in each of them; copies are numbered in the order of their subdomains.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array

from mortarbench.harness.digest import hex_digest
from mortarbench.problems.fem.mesh import Mesh, Nodes

Integers = NDArray[np.integer]
Points = NDArray[np.float64]


class TornNodes(NamedTuple):
    """Copies of the nodes of all subdomains, sorted by subdomain and then by number."""

    subdomain: Integers  #: (M,) subdomain of each copy
    number: Nodes  #: (M,) global numbers
    multiplicity: Integers  #: (M,) number of copies of the node
    copy: Integers  #: (M,) number of this copy among all copies of the node, from 0


@dataclass(frozen=True, eq=False)
class Subdivision:
    """Subdivision of one or more bodies into S subdomains."""

    mesh: Mesh  #: mesh of all bodies, with N nodes
    label: NDArray[np.int64]  #: (E,) subdomain of each cell, 0 … S − 1
    body_of_cell: NDArray[np.int64]  #: (E,) body of each cell

    @property
    def nodes(self) -> int:
        """Number of nodes of all bodies."""
        return len(self.mesh.points)

    @cached_property
    def _cells(self) -> list[Nodes]:
        """Numbers of the cells of each subdomain."""
        order = np.argsort(self.label, kind="stable")
        return np.split(order, np.cumsum(np.bincount(self.label))[:-1])

    @property
    def count(self) -> int:
        """Number of subdomains, S."""
        return len(self._cells)

    @cached_property
    def body(self) -> NDArray[np.int64]:
        """Body of each subdomain, (S,)."""
        return np.asarray(self.body_of_cell[[cells[0] for cells in self._cells]])

    @cached_property
    def _has(self) -> csr_array:
        """Matrix (S, N) with an entry for each copy: its index in `torn`."""
        # 32 bits, because tables of large meshes take much memory
        cells, label = self.mesh.cells.astype(np.int32), self.label.astype(np.int32)
        corners = cells.shape[1] * np.arange(len(cells) + 1)
        # with Boolean entries, products keep an entry for every common node
        nodes = csr_array(
            (np.ones(cells.size, dtype=bool), cells.ravel(), corners),
            shape=(len(cells), self.nodes),
        )
        one = np.ones(label.size, dtype=bool)
        has = csr_array(csr_array((one, (label, np.arange(label.size)))) @ nodes)
        has.sort_indices()
        entries = np.arange(has.nnz, dtype=np.int32)
        return csr_array((entries, has.indices, has.indptr), shape=has.shape)

    @cached_property
    def _copies(self) -> csc_array:
        """The matrix `_has`, stored node by node."""
        return csc_array(self._has)

    @cached_property
    def torn(self) -> TornNodes:
        """Copies of all nodes."""
        has, copies = self._has, self._copies
        several = np.diff(copies.indptr)
        copy = np.empty(has.nnz, dtype=np.int32)
        first = np.repeat(copies.indptr[:-1], several)
        copy[copies.data] = np.arange(has.nnz) - first
        number = has.indices
        subdomain = np.repeat(np.arange(self.count, dtype=np.int32), self.sizes)
        return TornNodes(subdomain, number, several[number], copy)

    @property
    def sizes(self) -> NDArray[np.int64]:
        """Number of nodes of each subdomain, (S,)."""
        return np.asarray(np.diff(self._has.indptr), dtype=np.int64)

    def nodes_of(self, subdomain: int) -> Nodes:
        """Return the nodes (n,) of a subdomain, ascending."""
        start, end = self._has.indptr[subdomain : subdomain + 2]
        return np.asarray(self._has.indices[start:end], dtype=np.int64)

    def cells_of(self, subdomain: int) -> Nodes:
        """Return the cells (E_s, corners), as indices into the nodes of a subdomain."""
        cells = self.mesh.cells[self._cells[subdomain]]
        return np.asarray(np.searchsorted(self.nodes_of(subdomain), cells))

    def key(self, subdomain: int) -> Hashable:
        """Return a digest of `cells_of`."""
        return hex_digest((self.cells_of(subdomain).tobytes(),), 32)

    def points_of(self, subdomain: int) -> Points:
        """Return the points (n, dim) of the nodes of a subdomain."""
        return self.mesh.points[self.nodes_of(subdomain)]

    def multiplicity(self, node: Nodes) -> NDArray[np.int64]:
        """Return the number of copies of each node, (k,)."""
        return np.asarray(np.diff(self._copies.indptr)[node], dtype=np.int64)

    def index(self, node: Nodes, copy: Integers) -> Nodes:
        """Return the indices (k,) in `torn` of the given copies of nodes (k,)."""
        copies = self._copies
        return np.asarray(copies.data[copies.indptr[node] + copy])

    def holder(self, node: Nodes, copy: Integers | int = 0) -> Nodes:
        """Return the subdomain (k,) that contains the given copy of each node.

        copy : (k,) number of the copy, from 0
        """
        copies = self._copies
        return np.asarray(copies.indices[copies.indptr[node] + copy], dtype=np.int64)

    def before(self, node: Nodes) -> NDArray[np.int64]:
        """Count, for each node, the preceding nodes of equal multiplicity, (k,)."""
        return np.asarray(self._before[node], dtype=np.int64)

    @cached_property
    def _before(self) -> NDArray[np.int32]:
        multiplicity = np.diff(self._copies.indptr)
        before = np.empty(self.nodes, dtype=np.int32)
        for m in np.unique(multiplicity):
            nodes = np.flatnonzero(multiplicity == m)
            before[nodes] = np.arange(nodes.size)
        return before

    @property
    def nodes_by_multiplicity(self) -> dict[int, int]:
        """Number of nodes with m copies, for each m > 1."""
        counts = np.bincount(np.diff(self._copies.indptr))
        return {m: int(n) for m, n in enumerate(counts) if m > 1 and n}

    def glued(self) -> NDArray[np.int64]:
        """Return, for each subdomain (S,), the number of its nodes on interfaces."""
        several = self.torn.multiplicity > 1
        return np.bincount(self.torn.subdomain[several], minlength=self.count)
