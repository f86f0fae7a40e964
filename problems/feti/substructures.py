"""Local problems of subdomains for certificates: stiffness, kernel and inverse."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, csr_array

from mortarbench.harness import Vector
from mortarbench.harness.verify.products import projected_products
from mortarbench.problems.feti.subdomain_classes import DecomposedBodies, SubdomainClass


@dataclass(frozen=True, eq=False)
class LocalProblems:
    """The local problems of torn bodies; see `harness.mechanics.Substructures`.

    Factors are made when they are needed.
    """

    torn: DecomposedBodies
    components: int = 2  #: of a node; torn unknowns are numbered node by node

    @property
    def spread(self) -> csr_array:
        """T (N, n)."""
        return self.torn.spread

    @property
    def kernel(self) -> csr_array:
        """R (N, r)."""
        return self.torn.domains.kernel

    @cached_property
    def weight(self) -> Vector:
        """Sum of the diagonal entries of K at each torn node, (N,)."""
        d, found = self.components, np.empty(self.spread.shape[0])
        for kind, place in self._kinds():
            trace = kind.K.diagonal().reshape(-1, d).sum(axis=1)
            found[place] = np.repeat(trace, d)[:, None]
        return found

    def diagonal(self, at: NDArray[np.int64]) -> Vector:
        """Return the diagonal of  TᵀK_T T  at components `at` (k,)."""
        d = self.components
        nodes = np.unique(csr_array(self.spread[:, at]).nonzero()[0] // d)
        number = np.full(self.spread.shape[0] // d, -1)
        number[nodes] = np.arange(nodes.size)
        blocks = np.empty((nodes.size, d, d))
        for kind, place in self._kinds():
            own = number[place[::d] // d]
            node, subdomain = np.nonzero(own >= 0)
            blocks[own[node, subdomain]] = _nodal(kind, d)[node]
        rows = (d * nodes[:, None] + np.arange(d)).ravel()
        T = csr_array(self.spread[rows][:, at])
        ends = np.arange(nodes.size + 1)
        K = csr_array(bsr_array((blocks, ends[:-1], ends), shape=(rows.size,) * 2))
        return np.asarray(T.multiply(K @ T).sum(axis=0))

    def product(self, v: NDArray[Any]) -> NDArray[Any]:
        """Apply PKP in the precision of v."""
        found, domains = np.zeros_like(v), self.torn.domains
        for kind, members in zip(domains.classes, domains.members, strict=True):
            K, R = kind.K, np.ascontiguousarray(kind.R)
            projected_products(
                K.data, K.indices, K.indptr, R, domains.start[members], v, found
            )
        return found

    def squared_product(self, v: Vector) -> Vector:
        """Apply K∘K, the squares of the entries of K, to v (N,)."""
        found = np.empty_like(v)
        for kind, place in self._kinds():
            K = kind.K.copy()
            K.data = K.data**2
            found[place] = K @ v[place]
        return found

    def solve(self, b: Vector) -> Vector:
        """Apply PK⁺P with one factor per kind; all subdomains of a kind at once."""
        found, domains = np.zeros_like(b), self.torn.domains
        acting = np.logical_or.reduceat(b != 0, domains.start[:-1])
        for (kind, place), members in zip(self._kinds(), domains.members, strict=True):
            place = place[:, acting[members]]  # 0 of the others is 0
            own, R = b[place], kind.R
            own -= R @ (R.T @ own)
            image = kind.inverse(own)
            image -= R @ (R.T @ image)
            found[place] = image
        return found

    def _kinds(self) -> zip[tuple[SubdomainClass, NDArray[np.int64]]]:
        """Give each kind with the torn unknowns (n_k, S_k) of its subdomains."""
        return zip(self.torn.classes, self.torn.domains.places(), strict=True)


def _nodal(kind: SubdomainClass, d: int) -> NDArray[np.float64]:
    """Return the blocks of K of each node, (n_k/d, d, d)."""
    blocks = np.empty((kind.K.shape[0] // d, d, d))
    for i, j in np.ndindex(d, d):
        blocks[:, i, j] = kind.K.diagonal(j - i)[min(i, j) :: d]
    return blocks
