"""Local problems of subdomains: K⁺, its traces and Schur complements, kind by kind.

K⁺ = K_ρ⁻¹ with K_ρ = K + ρR*R*ᵀ, where R* has the rows of the kernel at the fixing
components, orthonormalised, and zeros elsewhere (see `problems.fem.inverse`). All
subdomains of a kind are solved for at once, as columns of one right-hand side.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csc_matrix, csr_array
from sksparse.cholmod import Factor, cholesky

from harness import Vector
from problems.fem.mesh import Nodes
from problems.feti.torn import Kind, Torn

Dense = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Local:
    """The stiffness of one kind and what fixes it; factors are made when needed."""

    K: csc_array  #: (n, n) positive semidefinite
    fixing: Nodes  #: (p,) components
    star: Dense  #: (p, r) rows of R* there; columns of zeros may follow
    boundary: Nodes  #: components that S condenses onto, ascending
    stiffness: Vector  #: (n,) modulus around each component

    def inverse(self, b: Dense) -> Dense:
        """Apply K⁺ to columns (n, k)."""
        return np.asarray(self._factor(b))

    def compliance(self, b: Nodes) -> Dense:
        """Return (K⁺)_bb."""
        unit = np.zeros((self.K.shape[0], b.size))
        unit[b, np.arange(b.size)] = 1
        return _symmetric(self.inverse(unit)[b])

    def lumped(self, b: Nodes) -> csr_array:
        """Return K_bb."""
        return csr_array(self.K[b][:, b])

    def schur(self, b: Nodes) -> Dense:
        """Return S_bb of  S = K_gg − K_gi K_ii⁻¹K_ig  on g: boundary and b."""
        g = np.union1d(self.boundary, b)
        S, i = self.lumped(g).toarray(), np.setdiff1d(np.arange(self.K.shape[0]), g)
        if i.size:
            K_ig = self.K[i][:, g]
            S -= K_ig.T @ cholesky(csc_matrix(self.K[i][:, i]))(K_ig.toarray())
        kept = np.isin(g, b)
        return _symmetric(S[kept][:, kept])

    @cached_property
    def _factor(self) -> Factor:
        p, n = self.fixing.size, self.K.shape[0]
        block = self.K.diagonal().max() * (self.star @ self.star.T)
        where = np.repeat(self.fixing, p), np.tile(self.fixing, p)
        K_rho = self.K + csc_array((block.ravel(), where), shape=(n, n))
        return cholesky(csc_matrix(K_rho))


def local(kind: Kind) -> Local:
    """Fix one kind:  R* = Q at the fixing components of R = QT."""
    star = np.linalg.qr(kind.R[kind.fixing])[0]
    return Local(kind.K, kind.fixing, star, kind.boundary, kind.stiffness)


@dataclass(frozen=True, eq=False)
class Subdomains:
    """The subdomains S of torn bodies, each of one of few kinds."""

    kinds: tuple[Local, ...]
    kind: NDArray[np.int64]  #: (S,)

    @cached_property
    def start(self) -> NDArray[np.int64]:
        """First torn unknown of each subdomain, and N: (S + 1,)."""
        sizes = np.array([local.K.shape[0] for local in self.kinds])[self.kind]
        return np.concatenate([[0], np.cumsum(sizes)])

    @cached_property
    def members(self) -> tuple[NDArray[np.int64], ...]:
        """Subdomains of each kind."""
        order = np.argsort(self.kind, kind="stable")
        ends = np.cumsum(np.bincount(self.kind, minlength=len(self.kinds)))
        return tuple(np.split(order, ends[:-1]))

    def places(self) -> Iterator[NDArray[np.int64]]:
        """Give the torn unknowns of each kind, (n_k, S_k): a column per subdomain."""
        for local, members in zip(self.kinds, self.members, strict=True):
            yield self.start[members] + np.arange(local.K.shape[0])[:, None]

    def inverse(self, b: Vector) -> Vector:
        """Apply K⁺ to a torn vector (N,)."""
        v = np.empty_like(b)
        for local, place in zip(self.kinds, self.places(), strict=True):
            v[place] = local.inverse(b[place])
        return v


def subdomains(torn: Torn) -> Subdomains:
    """Take the subdomains of torn bodies, each kind fixed."""
    return Subdomains(tuple(map(local, torn.kinds)), torn.kind)


def kernel(torn: Torn) -> csr_array:
    """Return R = diag(R_1 … R_S) (N, Σr)."""
    modes = np.array([kind.R.shape[1] for kind in torn.kinds])[torn.kind]
    sizes = np.diff(torn.start)
    entries = np.concatenate([torn.kinds[k].R.ravel() for k in torn.kind])
    per_row = np.repeat(modes, sizes)
    ends = np.concatenate([[0], np.cumsum(per_row)])
    along = np.arange(entries.size) - np.repeat(ends[:-1], per_row)
    columns = np.repeat(np.cumsum(modes) - modes, sizes * modes) + along
    return csr_array((entries, columns, ends), shape=(sizes.sum(), modes.sum()))


def _symmetric(M: Dense) -> Dense:
    return np.asarray((M + M.T) / 2)
