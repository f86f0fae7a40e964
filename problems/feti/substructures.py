"""Torn bodies as certificates see them: local stiffness, its kernel and its inverse."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from harness import Vector
from problems.feti.local import Local, Subdomains, kernel, subdomains
from problems.feti.torn import Torn

Columns = NDArray[Any]  #: (n_k, …) of the subdomains of one kind


@dataclass(frozen=True, eq=False)
class LocalProblems:
    """The local problems of torn bodies; see `harness.mechanics.Substructures`."""

    torn: Torn
    domains: Subdomains
    components: int  #: of a node

    @property
    def spread(self) -> csr_array:
        """T (N, n)."""
        return self.torn.spread

    @cached_property
    def kernel(self) -> csr_array:
        """R (N, r)."""
        return kernel(self.torn)

    @cached_property
    def weight(self) -> Vector:
        """Sum of the diagonal entries of K at each torn node, (N,)."""
        d, found = self.components, np.empty(self.spread.shape[0])
        for at, place in zip(self.domains.kinds, self.domains.places(), strict=True):
            trace = at.K.diagonal().reshape(-1, d).sum(axis=1)
            found[place] = np.repeat(trace, d)[:, None]
        return found

    def product(self, v: NDArray[Any]) -> NDArray[Any]:
        """Apply PKP; all subdomains of a kind at once."""
        return self._by_kinds(lambda at, columns: at.K.astype(v.dtype) @ columns, v)

    def solve(self, b: Vector) -> Vector:
        """Apply PK⁺P with one factor per kind."""
        return self._by_kinds(Local.inverse, b)

    def _by_kinds(
        self, apply: Callable[[Local, Columns], Columns], v: NDArray[Any]
    ) -> NDArray[Any]:
        """Apply a map of each kind between two projections P = I − RRᵀ."""
        found, domains = np.empty_like(v), self.domains
        for kind, at, place in zip(
            self.torn.kinds, domains.kinds, domains.places(), strict=True
        ):
            own, R = v[place], kind.R
            columns = own.reshape(len(R), -1)
            image = apply(at, columns - R @ (R.T @ columns))
            found[place] = (image - R @ (R.T @ image)).reshape(own.shape)
        return found


def local_problems(torn: Torn, components: int = 2) -> LocalProblems:
    """Take the local problems of torn bodies; factors are made when needed.

    components : of a node; torn unknowns are numbered node by node
    """
    return LocalProblems(torn, subdomains(torn), components)
