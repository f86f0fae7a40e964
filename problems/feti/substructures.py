"""Local problems of subdomains for certificates: stiffness, kernel and inverse."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, csr_array

from mortarbench.harness import Vector
from mortarbench.problems.fem.mesh import dofs_of
from mortarbench.problems.feti.subdomains import TornBodies


@dataclass(frozen=True, eq=False)
class LocalProblems:
    """Local problems of torn bodies; see `harness.mechanics.Substructures`.

    Stiffness matrices are factorised on first use.
    """

    torn: TornBodies

    @cached_property
    def spread(self) -> csr_array:
        """T (N, n), which maps displacements to torn unknowns."""
        return self.torn.spread

    @cached_property
    def kernel(self) -> csr_array:
        """R (N, r), a basis of the rigid motions of all subdomains."""
        return self.torn.kernel()

    @property
    def weight(self) -> Vector:
        """Sum of the diagonal entries of K at the node of each torn unknown, (N,)."""
        d = self.torn.problem.components
        trace = self._nodal_blocks.trace(axis1=1, axis2=2)
        return np.repeat(trace, d)

    def diagonal(self, at: NDArray[np.int64]) -> Vector:
        """Return the diagonal entries of TᵀKT for the columns `at` (k,) of T."""
        d = self.torn.problem.components
        copies = np.flatnonzero(np.isin(self.torn.nodes.number, at // d))
        T, ends = self.spread[dofs_of(copies, d)], np.arange(copies.size + 1)
        blocks = self._nodal_blocks[copies], ends[:-1], ends
        K = csr_array(bsr_array(blocks, shape=(T.shape[0],) * 2))
        return np.asarray(T.multiply(K @ T).sum(axis=0)[at])

    @property
    def _nodal_blocks(self) -> NDArray[np.float64]:
        """Diagonal block of K for each torn node, (M, d, d)."""
        of_class = self.torn.of_classes("nodal_blocks", self.torn.problem.components)
        members = self.torn.domains.class_of.tolist()
        return np.concatenate([of_class[k] for k in members])

    def product(self, v: NDArray[Any]) -> NDArray[Any]:
        """Apply PKP to v (N,); see `Subdomains.product`."""
        return self.torn.apply("product", v)

    def squared_product(self, v: Vector) -> Vector:
        """Apply K∘K, the squares of the entries of K, to v (N,)."""
        return self.torn.apply("squared_product", v)

    def solve(self, b: Vector) -> Vector:
        """Apply PK⁺P to b (N,); see `Subdomains.solve`."""
        return self.torn.apply("solve", b)
