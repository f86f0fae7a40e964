"""Torn bodies as certificates see them: local stiffness, its kernel and its inverse."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from harness import Vector
from harness.mechanics import Extended, Real
from problems.feti.torn import Subdomains, Torn


@dataclass(frozen=True, eq=False)
class LocalProblems:
    """The local problems of torn bodies; see `harness.mechanics.Substructures`."""

    spread: csr_array  #: (N, n)
    kernel: csr_array  #: (N, r)
    domains: Subdomains
    components: int  #: of a node

    @cached_property
    def weight(self) -> Vector:
        """Sum of the diagonal entries of K at each torn node, (N,)."""
        d, found = self.components, np.empty(self.spread.shape[0])
        for local, place in zip(self.domains.kinds, self.domains.places(), strict=True):
            trace = local.K.diagonal().reshape(-1, d).sum(axis=1)
            found[place] = np.repeat(trace, d)[:, None]
        return found

    def product(self, v: Extended) -> Extended:
        """Multiply by kinds, all their subdomains at once."""
        found = np.empty_like(v)
        for local, place in zip(self.domains.kinds, self.domains.places(), strict=True):
            found[place] = local.K.astype(Real) @ v[place]
        return found

    def solve(self, b: Vector) -> Vector:
        """Solve by kinds, with one factor each."""
        return self.domains.inverse(b)


def local_problems(torn: Torn, components: int = 2) -> LocalProblems:
    """Take the local problems of torn bodies; factors are made when needed.

    components : of a node; torn unknowns are numbered node by node
    """
    return LocalProblems(torn.spread, torn.domains.kernel, torn.domains, components)
