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
from problems.feti.torn import Kind, Torn

Columns = NDArray[Any]  #: (n_k, …) of the subdomains of one kind


@dataclass(frozen=True, eq=False)
class LocalProblems:
    """The local problems of torn bodies; see `harness.mechanics.Substructures`.

    Factors are made when they are needed.
    """

    torn: Torn
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

    def product(self, v: NDArray[Any]) -> NDArray[Any]:
        """Apply PKP in the precision of v; all subdomains of a kind at once."""
        return self._by_kinds(lambda kind, own: kind.K.astype(v.dtype) @ own, v)

    def solve(self, b: Vector) -> Vector:
        """Apply PK⁺P with one factor per kind."""
        return self._by_kinds(Kind.inverse, b)

    def _by_kinds(
        self, apply: Callable[[Kind, Columns], Columns], v: NDArray[Any]
    ) -> NDArray[Any]:
        """Apply a map of each kind between two projections P = I − RRᵀ.

        Coefficients Rᵀv are needed to the digits of doubles only: a rigid motion that
        is left is as small beside v as KR is beside K.
        """
        found = np.empty_like(v)
        for kind, place in self._kinds():
            own, R = v[place], kind.R
            own -= R.astype(v.dtype) @ (R.T @ own.astype(np.float64))
            image = apply(kind, own)
            image -= R @ (R.T @ image.astype(np.float64))
            found[place] = image
        return found

    def _kinds(self) -> zip[tuple[Kind, NDArray[np.int64]]]:
        """Give each kind with the torn unknowns (n_k, S_k) of its subdomains."""
        return zip(self.torn.kinds, self.torn.domains.places(), strict=True)
