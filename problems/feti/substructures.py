"""Local problems of subdomains for certificates: stiffness, kernel and inverse."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, csr_array

from mortarbench.harness import Vector
from mortarbench.harness.mechanics import in_precision
from mortarbench.problems.feti.subdomain_classes import SubdomainClass
from mortarbench.problems.feti.subdomains import TornBodies

#: number of subdomains whose products are computed at a time, so that their vectors
#: stay in the cache
STRIP_COLUMNS = 32


@dataclass(frozen=True, eq=False)
class LocalProblems:
    """Local problems of torn bodies; see `harness.mechanics.Substructures`.

    Stiffness matrices are factorised on first use. All processes call each method
    together, and the results are valid on the first one.
    """

    torn: TornBodies

    @cached_property
    def spread(self) -> csr_array:
        """T (N, n), which maps displacements to torn unknowns."""
        return self.torn.spread

    @cached_property
    def kernel(self) -> csr_array:
        """R (N, r), a basis of the rigid motions of all subdomains."""
        return self.torn.domains.kernel()

    @property
    def weight(self) -> Vector:
        """Sum of the diagonal entries of K at the node of each torn unknown, (N,)."""
        d, domains = self.torn.problem.components, self.torn.domains
        weight = np.zeros(domains.start[-1])
        for template, place in domains.places():
            trace = template.K.diagonal().reshape(-1, d).sum(axis=1)
            weight[place] = np.repeat(trace, d)[:, None]
        return domains.combined(weight)

    def diagonal(self, at: NDArray[np.int64]) -> Vector:
        """Return the diagonal entries of TᵀKT for the columns `at` (k,) of T."""
        d, domains = self.torn.problem.components, self.torn.domains
        is_near = np.isin(self.torn.nodes.number, np.unique(at // d))
        nodes = np.flatnonzero(is_near)
        number = np.full(is_near.size, -1)
        number[nodes] = np.arange(nodes.size)
        blocks = np.zeros((nodes.size, d, d))
        for template, place in domains.places():
            places = number[place[::d] // d]
            node, subdomain = np.nonzero(places >= 0)
            blocks[places[node, subdomain]] = _nodal(template, d)[node]
        T = csr_array(self.torn.spread_to(nodes)[:, at])
        ends = np.arange(nodes.size + 1)
        K = csr_array(bsr_array((blocks, ends[:-1], ends), shape=(d * nodes.size,) * 2))
        return domains.sum(np.asarray(T.multiply(K @ T).sum(axis=0)))

    def product(self, v: NDArray[Any]) -> NDArray[Any]:
        """Apply PKP to v (N,) in the precision of v.

        P is the orthogonal projector that removes rigid motions.
        """
        image, domains = np.zeros_like(v), self.torn.domains
        for template, every in domains.places():
            K, R = in_precision(template.K, v.dtype), template.R
            for first in range(0, every.shape[1], STRIP_COLUMNS):
                place = every[:, first : first + STRIP_COLUMNS]
                place = place[:, (v[place] != 0).any(axis=0)]  # PKP maps zero to zero
                columns = v[place]
                columns -= R @ (R.T @ columns)
                columns = K @ columns
                columns -= R @ (R.T @ columns)
                image[place] = columns
        return domains.combined(image)

    def squared_product(self, v: Vector) -> Vector:
        """Apply K∘K, the squares of the entries of K, to v (N,)."""
        image = np.zeros_like(v)
        for template, place in self.torn.domains.places():
            K = template.K.copy()
            K.data = K.data**2
            image[place] = K @ v[place]
        return self.torn.domains.combined(image)

    def solve(self, b: Vector) -> Vector:
        """Apply PK⁺P, with P of `product`, to b (N,).

        The systems of all subdomains of a class where b is nonzero are solved at once,
        with one column of the right-hand side for each of these subdomains.
        """
        solution, domains = np.zeros_like(b), self.torn.domains
        for template, place in domains.places():
            place = place[:, b[place].any(axis=0)]  # the solution is zero where b = 0
            columns, R = b[place], template.R
            columns -= R @ (R.T @ columns)
            image = template.inverse(columns)
            image -= R @ (R.T @ image)
            solution[place] = image
        return domains.combined(solution)


def _nodal(template: SubdomainClass, d: int) -> NDArray[np.float64]:
    """Return the diagonal block of K for each node, (n_k/d, d, d)."""
    blocks = np.empty((template.K.shape[0] // d, d, d))
    for i, j in np.ndindex(d, d):
        blocks[:, i, j] = template.K.diagonal(j - i)[min(i, j) :: d]
    return blocks
