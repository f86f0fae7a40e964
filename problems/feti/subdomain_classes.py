"""Bodies torn into subdomains: what every part of Total FETI works on.

Dostál, Horák and Kučera 2006: every subdomain floats; supports, gluing and contact are
rows of one matrix B, so that the kernel of every stiffness is known beforehand.

Torn unknowns v (N,) are numbered subdomain after subdomain, and within one node by
node, each component in the frame of its subdomain. Subdomains that differ by a rigid
motion only, as those in one layer of a ring, are of one kind then: they share one
stiffness, one factor and one explicit operator, and B holds the rotations. A
displacement u (n,) of the whole is v = T u, one d×d block per torn node.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, null_space, qr
from scipy.sparse import csc_array, csc_matrix, csr_array
from sksparse.cholmod import Factor, analyze, cholesky

from mortarbench.harness import Vector
from mortarbench.harness.digest import hex_digest
from mortarbench.harness.distributed.factor import with_int32
from mortarbench.problems.fem.mesh import Nodes

Dense = NDArray[np.float64]
_STRIP = 256  #: right-hand sides that are solved for at once


@dataclass(frozen=True, eq=False, kw_only=True)
class SubdomainClass:
    """A subdomain, up to its place: what all subdomains of one kind share.

    K⁺ = K_ρ⁻¹ with K_ρ = K + ρR*R*ᵀ, where R* has the rows of R at the fixing
    components, orthonormalised, and zeros elsewhere (see `problems.fem.inverse`). All
    subdomains of a kind are solved for at once, as columns of one right-hand side.
    """

    K: csc_array  #: (n_k, n_k) stiffness in the frame of the subdomain
    R: NDArray[np.float64]  #: (n_k, r) orthonormal basis of ker K
    fixing: Nodes  #: components of few nodes that no motion of R leaves at rest
    #: components of all nodes on the boundary of the subdomain, ascending: those that
    #: Dirichlet preconditioners condense onto, glued or free
    boundary: Nodes
    stiffness: Vector  #: (n_k,) modulus of the cells around each component, as K has it

    @cached_property
    def name(self) -> str:
        """A digest of its numbers: the same on all ranks that have it, there only."""
        K = self.K
        return hex_digest(
            map(
                np.ndarray.tobytes,
                (K.data, K.indices, K.indptr, self.R, self.fixing, self.boundary),
            ),
            32,
        )

    def without_factor(self, name: str = "") -> SubdomainClass:
        """Return the same to be factorised anew, under its name or another one."""
        found = replace(self)
        vars(found)["name"] = name or self.name
        return found

    def inverse(self, b: Dense) -> Dense:
        """Apply K⁺ to columns (n_k, k)."""
        return np.asarray(self._factor(b))

    def block(self, b: Nodes) -> csr_array:
        """Return K_bb."""
        return csr_array(self.K[b][:, b])

    def condense(self, b: Nodes) -> Condensed:
        """Condense onto components b: what is inside is eliminated once for both.

        ::

            (K⁺)_bb = (S_ρ⁻¹)_bb,    S_ρ = S_h + ρR*R*ᵀ,   S_h = K_hh − K_hi K_ii⁻¹K_ih

        where h are the boundary, b and the fixing components, and i all others. With h
        last, S_ρ = LLᵀ is the last block of the Cholesky factor of K_ρ.
        """
        return self.blocks(b, self.border_factor(b))

    def border(self, b: Nodes) -> Nodes:
        """Return h, ascending."""
        return np.union1d(np.union1d(self.boundary, b), self.fixing)

    def border_factor(self, b: Nodes) -> Dense:
        """Return L (h, h) of S_ρ = LLᵀ, the greater part of the work of `condense`."""
        h = self.border(b)
        i = np.setdiff1d(np.arange(self.K.shape[0]), h)
        if i.size:
            i = i[analyze(with_int32(self.K[i][:, i]), use_long=False).P()]
        order = np.concatenate([i, h])
        K_rho = with_int32(self._fixed[order][:, order])
        factor = analyze(K_rho, ordering_method="natural", use_long=False)
        factor.cholesky_inplace(K_rho)
        return np.asarray(factor.L()[i.size :, i.size :].toarray())

    def blocks(self, b: Nodes, L: Dense) -> Condensed:
        """Do what is left of `condense`, with L of `border_factor`."""
        g, h = np.union1d(self.boundary, b), self.border(b)
        at, fixed = np.searchsorted(h, b), np.searchsorted(h, self.fixing)
        C = cho_solve((L, True), np.eye(h.size)[:, at])[at]
        S = L @ L.T
        S[np.ix_(fixed, fixed)] -= self._held
        S_bb, inner = S[np.ix_(at, at)], ~np.isin(h, g)
        if inner.any():
            S_ib = S[inner][:, at]
            S_bb -= S_ib.T @ np.linalg.solve(S[inner][:, inner], S_ib)
        return Condensed(_symmetric(C), _symmetric(S_bb))

    def elimination(self, h: Nodes) -> Elimination:
        """Eliminate all components but h; S on these multiplies columns."""
        i = np.setdiff1d(np.arange(self.K.shape[0]), h)
        order = np.concatenate([h, i])
        K = csc_array(csc_array(self.K[:, order])[order])
        K_hh, K_ih = csr_array(K[: h.size, : h.size]), csr_array(K[h.size :, : h.size])
        factor = cholesky(csc_matrix(K[h.size :, h.size :])) if i.size else None
        return Elimination(K_hh, K_ih, factor)

    @cached_property
    def _held(self) -> Dense:
        """ρR*R*ᵀ at the fixing components, (p, p)."""
        star = np.linalg.qr(self.R[self.fixing])[0]
        return np.asarray(self.K.diagonal().max() * (star @ star.T))

    @cached_property
    def _factor(self) -> Factor:
        """Factorise K_ρ, where it is first needed."""
        return cholesky(csc_matrix(self._fixed))

    @property
    def _fixed(self) -> csc_array:
        """K_ρ, (n_k, n_k)."""
        p = self.fixing.size
        where = np.repeat(self.fixing, p), np.tile(self.fixing, p)
        held = csc_array((self._held.ravel(), where), shape=self.K.shape)
        return csc_array(self.K + held)


class Condensed(NamedTuple):
    """Blocks of one kind on components b."""

    compliance: Dense  #: (K⁺)_bb
    schur: Dense  #: S_bb of S condensed onto the boundary and b


class Elimination(NamedTuple):
    """S = K_hh − K_hi K_ii⁻¹K_ih, applied to columns."""

    K_hh: csr_array
    K_ih: csr_array
    factor: Factor | None  #: of K_ii, where there is any i

    def __matmul__(self, X: Dense) -> Dense:
        SX = np.asarray(self.K_hh @ X)
        if self.factor is not None:
            for begin in range(0, X.shape[1], _STRIP):
                strip = slice(begin, begin + _STRIP)
                SX[:, strip] -= self.K_ih.T @ self.factor(self.K_ih @ X[:, strip])
        return SX


@dataclass(frozen=True, eq=False)
class Subdomains:
    """S subdomains, each of one of few kinds, that nothing holds together yet."""

    classes: tuple[SubdomainClass, ...]
    class_of: NDArray[np.int64]  #: (S,) of each subdomain

    @cached_property
    def start(self) -> NDArray[np.int64]:
        """First torn unknown of each subdomain, and N: (S + 1,)."""
        sizes = np.array([kind.R.shape[0] for kind in self.classes])[self.class_of]
        return np.concatenate([[0], np.cumsum(sizes)])

    @cached_property
    def members(self) -> tuple[NDArray[np.int64], ...]:
        """Subdomains of each kind."""
        order = np.argsort(self.class_of, kind="stable")
        ends = np.cumsum(np.bincount(self.class_of, minlength=len(self.classes)))
        return tuple(np.split(order, ends[:-1]))

    @cached_property
    def kernel(self) -> csr_array:
        """R = diag(R_1 … R_S), (N, Σr)."""
        modes = np.array([kind.R.shape[1] for kind in self.classes])[self.class_of]
        sizes = np.diff(self.start)
        entries = np.concatenate([self.classes[k].R.ravel() for k in self.class_of])
        per_row = np.repeat(modes, sizes)
        ends = np.concatenate([[0], np.cumsum(per_row)])
        along = np.arange(entries.size) - np.repeat(ends[:-1], per_row)
        columns = np.repeat(np.cumsum(modes) - modes, sizes * modes) + along
        return csr_array((entries, columns, ends), shape=(sizes.sum(), modes.sum()))

    def places(self) -> Iterator[NDArray[np.int64]]:
        """Give the torn unknowns of each kind, (n_k, S_k): a column per subdomain."""
        for kind, members in zip(self.classes, self.members, strict=True):
            yield self.start[members] + np.arange(kind.R.shape[0])[:, None]

    def without(self, free: NDArray[np.bool_]) -> Subdomains:
        """Return the subdomains without all but their free torn unknowns (N,)."""
        classes, kind = list[SubdomainClass](), np.empty_like(self.class_of)
        known = dict[tuple[int, bytes], int]()
        for s, k in enumerate(self.class_of):
            mine = free[self.start[s] : self.start[s + 1]]
            found = known.setdefault((int(k), mine.tobytes()), len(classes))
            if found == len(classes):
                classes.append(_held(self.classes[k], mine))
            kind[s] = found
        return Subdomains(tuple(classes), kind)

    def inverse(self, b: Vector) -> Vector:
        """Apply K⁺ to a torn vector (N,)."""
        v = np.empty_like(b)
        for kind, place in zip(self.classes, self.places(), strict=True):
            own = b[place]
            v[place] = kind.inverse(own) if own.any() else 0.0
        return v


@dataclass(frozen=True, eq=False, kw_only=True)
class DecomposedBodies:
    """A contact problem on torn bodies, without dimensions.

    ::

        min ½vᵀKv − fᵀv   subject to   B_E v = c_E,  B_I v ≤ c_I,   K = diag(K_1 … K_S)

    Rows of B are those of supports and gluing (E), then of contact (normals, then
    tangents). Those of contact are multiplied with `scale`, so that λ of the rows as
    they were is scale·λ.
    """

    classes: tuple[SubdomainClass, ...]
    class_of: NDArray[np.int64]  #: (S,) of each subdomain
    spread: csr_array  #: T (N, n)
    B: csr_array  #: (m, N), scaled
    c: Vector  #: (m,), scaled
    scale: Vector  #: positive, of the rows of contact, the last ones
    f: Vector  #: (N,) Tᵀf is the load of the whole
    equalities: int  #: rows of B that are equations, the first ones

    @property
    def start(self) -> NDArray[np.int64]:
        """First torn unknown of each subdomain, and N: (S + 1,)."""
        return self.domains.start

    @cached_property
    def domains(self) -> Subdomains:
        """The subdomains on their own, with what is factorised once."""
        return Subdomains(self.classes, self.class_of)


def _symmetric(M: Dense) -> Dense:
    return np.asarray((M + M.T) / 2)


def _held(kind: SubdomainClass, free: NDArray[np.bool_]) -> SubdomainClass:
    """Return a subdomain without all but its free components (n_k,)."""
    if free.all():
        return kind
    R = kind.R @ null_space(kind.R[~free])
    R = np.linalg.qr(R[free])[0]
    number = np.cumsum(free) - 1
    return SubdomainClass(
        K=csc_array(kind.K[free][:, free]), R=R,
        fixing=np.sort(qr(R.T, mode="r", pivoting=True)[1][: R.shape[1]]),
        boundary=number[kind.boundary[free[kind.boundary]]],
        stiffness=kind.stiffness[free],
    )  # fmt: skip
