"""Classes of congruent subdomains, and bodies decomposed into subdomains (Total FETI).

In Total FETI (Dostál, Horák and Kučera 2006, Commun. Numer. Methods Eng. 22) every
subdomain floats; supports, gluing and contact are rows of one matrix B. The kernel of
every stiffness matrix is therefore known in advance: the rigid motions.

The torn unknowns v (N,) are the displacement components of all copies of all nodes, in
the frames of their subdomains, numbered by subdomain and then by node. Subdomains that
differ only by a rigid motion, such as those in one layer of a ring, are congruent. They
have the same stiffness matrix, factor and explicit blocks; their rotations enter B. A
displacement u (n,) of the undivided bodies corresponds to v = T u, where T has one d×d
block per copy of a node.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, lapack
from scipy.sparse import csc_array, csc_matrix, csr_array
from sksparse.cholmod import Factor, analyze, cholesky

from mortarbench.harness import Vector
from mortarbench.harness.digest import hex_digest
from mortarbench.harness.distributed.factor import with_int32
from mortarbench.harness.mechanics import in_precision
from mortarbench.problems.fem.mesh import Nodes
from mortarbench.problems.feti.tearing import SubdomainMesh

Dense = NDArray[np.float64]
#: number of subdomains whose products are computed at a time, so that their vectors
#: stay in the cache
STRIP_COLUMNS = 32
_STRIP = 256  #: right-hand sides per solve; bounds the memory for the solutions


@dataclass(frozen=True, eq=False, kw_only=True)
class SubdomainClass:
    """Data shared by all congruent subdomains of a class.

    K⁺ = K_ρ⁻¹ with K_ρ = K + ρR*R*ᵀ, where ρ is the largest diagonal entry of K, and R*
    consists of the rows of R at the fixing components, orthonormalised, and zeros
    elsewhere (see `problems.fem.inverse`). The systems of all subdomains of a class are
    solved at once, with one column of the right-hand side for each subdomain.
    """

    K: csc_array  #: (n_k, n_k) stiffness in the frame of the subdomain
    R: NDArray[np.float64]  #: (n_k, r) orthonormal basis of ker K
    fixing: Nodes  #: components of a few nodes; fixing them excludes all rigid motions
    #: ascending components of all nodes, glued or free, on the boundary of the
    #: subdomain, onto which Dirichlet preconditioners condense
    boundary: Nodes
    #: (n_k,) mean modulus of the cells around each component, in units of K
    stiffness: Vector

    @cached_property
    def name(self) -> str:
        """Digest of the data, equal on all ranks."""
        K = self.K
        return hex_digest(
            map(
                np.ndarray.tobytes,
                (K.data, K.indices, K.indptr, self.R, self.fixing, self.boundary),
            ),
            32,
        )

    def inverse(self, b: Dense) -> Dense:
        """Apply K⁺ to columns (n_k, k)."""
        return np.asarray(self._factor(b))

    def block(self, b: Nodes) -> csr_array:
        """Return the block K_bb of K for the components b."""
        return csr_array(self.K[b][:, b])

    def condense(self, b: Nodes) -> Condensed:
        """Return (K⁺)_bb and S_bb, both from one elimination of the interior.

        ::

            (K⁺)_bb = (S_ρ⁻¹)_bb,    S_ρ = S_h + ρR*R*ᵀ,   S_h = K_hh − K_hi K_ii⁻¹K_ih

        where h is the union of the boundary, b and the fixing components, and i denotes
        the other components. If the components h are ordered last, the trailing block L
        of the Cholesky factor of K_ρ satisfies S_ρ = LLᵀ. S is the Schur complement on
        the union of the boundary and b, see `Condensed`.
        """
        h = np.union1d(np.union1d(self.boundary, b), self.fixing)
        i = np.setdiff1d(np.arange(self.K.shape[0]), h)
        if i.size:  # order i to reduce fill; h stays last, so that L is trailing
            i = i[analyze(with_int32(self.K[i][:, i]), use_long=False).P()]
        order = np.concatenate([i, h])
        K_rho = with_int32(self._fixed[order][:, order])
        factor = analyze(K_rho, ordering_method="natural", use_long=False)
        factor.cholesky_inplace(K_rho)
        L = np.asarray(factor.L()[i.size :, i.size :].toarray())
        places_b, places_fixing = np.searchsorted(h, b), np.searchsorted(h, self.fixing)
        C = cho_solve((L, True), np.eye(h.size)[:, places_b])[places_b]
        S = L @ L.T  # S_ρ; the next line subtracts ρR*R*ᵀ, which leaves S_h
        S[np.ix_(places_fixing, places_fixing)] -= self._fixing_term
        S_bb = S[np.ix_(places_b, places_b)]
        inner = ~np.isin(h, np.union1d(self.boundary, b))
        if inner.any():  # S_bb excludes interior fixing components: eliminate them
            S_ib = S[inner][:, places_b]
            S_bb -= S_ib.T @ np.linalg.solve(S[inner][:, inner], S_ib)
        return Condensed(_symmetric(C), _symmetric(S_bb))

    def elimination(self, h: Nodes) -> Elimination:
        """Eliminate all components except h; return the Schur complement of K on h."""
        i = np.setdiff1d(np.arange(self.K.shape[0]), h)
        order = np.concatenate([h, i])
        K = csc_array(csc_array(self.K[:, order])[order])
        K_hh, K_ih = csr_array(K[: h.size, : h.size]), csr_array(K[h.size :, : h.size])
        factor = cholesky(csc_matrix(K[h.size :, h.size :])) if i.size else None
        return Elimination(K_hh, K_ih, factor)

    @cached_property
    def _fixing_term(self) -> Dense:
        """ρR*R*ᵀ at the fixing components, (p, p)."""
        star = np.linalg.qr(self.R[self.fixing])[0]
        return np.asarray(self.K.diagonal().max() * (star @ star.T))

    @cached_property
    def _factor(self) -> Factor:
        """Factor of K_ρ, computed on first use."""
        return cholesky(csc_matrix(self._fixed))

    @property
    def _fixed(self) -> csc_array:
        """K_ρ (n_k, n_k), the regularised stiffness matrix."""
        p = self.fixing.size
        where = np.repeat(self.fixing, p), np.tile(self.fixing, p)
        added = csc_array((self._fixing_term.ravel(), where), shape=self.K.shape)
        return csc_array(self.K + added)


class Condensed(NamedTuple):
    """Local blocks of one class on components b."""

    compliance: Dense  #: (K⁺)_bb
    schur: Dense  #: S_bb, where S is the Schur complement on the boundary and b


class Elimination(NamedTuple):
    """The Schur complement S = K_hh − K_hi K_ii⁻¹K_ih, applied to columns."""

    K_hh: csr_array
    K_ih: csr_array
    factor: Factor | None  #: factor of K_ii; None if i is empty

    def __matmul__(self, X: Dense) -> Dense:
        SX = np.asarray(self.K_hh @ X)
        if self.factor is not None:
            for begin in range(0, X.shape[1], _STRIP):
                strip = slice(begin, begin + _STRIP)
                SX[:, strip] -= self.K_ih.T @ self.factor(self.K_ih @ X[:, strip])
        return SX


class Assembly:
    """Classes of subdomains by number, each assembled on its first use.

    mesh : returns the mesh of a subdomain of a class
    assemble : assembles the class of a floating subdomain
    """

    def __init__(
        self,
        mesh: Callable[[int], SubdomainMesh],
        assemble: Callable[[SubdomainMesh], SubdomainClass],
    ) -> None:
        self.mesh, self._assemble = mesh, assemble
        self._classes: dict[int, SubdomainClass] = {}

    def __call__(self, k: int) -> SubdomainClass:
        """Return class k."""
        if k not in self._classes:
            self._classes[k] = self._assemble(self.mesh(k))
        return self._classes[k]

    def selected(self, classes: Iterable[int]) -> Assembly:
        """Return an assembly of some classes, which can be sent to another rank."""
        meshes = {k: self.mesh(k) for k in classes}
        return Assembly(meshes.__getitem__, self._assemble)


@dataclass(frozen=True, eq=False, kw_only=True)
class Subdomains:
    """S subdomains before gluing, grouped into classes.

    On several ranks, each rank has the object of its own subdomains.
    """

    #: map from the number of a class to the class, which the first call assembles
    template: Callable[[int], SubdomainClass]
    sizes: NDArray[np.int64]  #: (classes,) number of torn unknowns of a subdomain
    class_of: NDArray[np.int64]  #: (S,) class of each subdomain

    @cached_property
    def start(self) -> NDArray[np.int64]:
        """First torn unknown of each subdomain, then the total number N, (S + 1,)."""
        return np.concatenate([[0], np.cumsum(self.sizes[self.class_of])])

    @cached_property
    def members(self) -> tuple[tuple[int, NDArray[np.int64]], ...]:
        """Classes that occur, each with its subdomains."""
        order = np.argsort(self.class_of, kind="stable")
        classes, first = np.unique(self.class_of[order], return_index=True)
        return tuple(zip(classes.tolist(), np.split(order, first[1:]), strict=True))

    def places(self) -> Iterator[tuple[SubdomainClass, NDArray[np.int64]]]:
        """Yield the classes with the unknowns of their subdomains.

        The unknowns (n_k, S_k) have a column for each subdomain.
        """
        for k, members in self.members:
            yield (
                self.template(k),
                self.start[members] + np.arange(self.sizes[k])[:, None],
            )

    def names(self) -> dict[int, str]:
        """Return the digests of all classes that occur."""
        return {k: self.template(k).name for k, _ in self.members}

    def modes(self) -> dict[int, Dense]:
        """Return the rigid motions R_k (n_k, r) of all classes that occur."""
        return {k: self.template(k).R for k, _ in self.members}

    def inverse(self, b: Vector) -> Vector:
        """Apply K⁺ to a torn vector (N,)."""
        v = np.zeros_like(b)
        for template, places in self.places():
            columns = b[places]
            if columns.any():
                v[places] = template.inverse(columns)
        return v

    def product(self, v: NDArray[Any]) -> NDArray[Any]:
        """Apply PKP to v (N,) in the precision of v.

        P is the orthogonal projector that removes rigid motions.
        """
        image = np.zeros_like(v)
        for template, every in self.places():
            K, R = in_precision(template.K, v.dtype), template.R
            for first in range(0, every.shape[1], STRIP_COLUMNS):
                place = every[:, first : first + STRIP_COLUMNS]
                place = place[:, (v[place] != 0).any(axis=0)]  # PKP maps zero to zero
                columns = v[place]
                columns -= R @ (R.T @ columns)
                columns = K @ columns
                columns -= R @ (R.T @ columns)
                image[place] = columns
        return image

    def squared_product(self, v: Vector) -> Vector:
        """Apply K∘K, the squares of the entries of K, to v (N,)."""
        image = np.zeros_like(v)
        for template, place in self.places():
            image[place] = template.K.power(2) @ v[place]
        return image

    def solve(self, b: Vector) -> Vector:
        """Apply PK⁺P, with P of `product`, to b (N,).

        The systems of all subdomains of a class where b is nonzero are solved at once,
        with one column of the right-hand side for each of these subdomains.
        """
        solution = np.zeros_like(b)
        for template, place in self.places():
            place = place[:, b[place].any(axis=0)]  # the solution is zero where b = 0
            columns, R = b[place], template.R
            columns -= R @ (R.T @ columns)
            image = template.inverse(columns)
            image -= R @ (R.T @ image)
            solution[place] = image
        return solution

    def nodal_blocks(self, d: int) -> dict[int, Dense]:
        """Return the diagonal blocks of K_k for each node, (n_k/d, d, d), by class.

        d : number of components of a node
        """
        return {k: _nodal_blocks(self.template(k).K, d) for k, _ in self.members}


def upper_triangle(M: Dense) -> Vector:
    """Return the upper triangle of a symmetric matrix, column by column."""
    return np.asarray(lapack.dtrttp(M)[0])


def _nodal_blocks(K: csc_array, d: int) -> Dense:
    blocks = np.empty((K.shape[0] // d, d, d))
    for i, j in np.ndindex(d, d):
        blocks[:, i, j] = K.diagonal(j - i)[min(i, j) :: d]
    return blocks


def _symmetric(M: Dense) -> Dense:
    return np.asarray((M + M.T) / 2)
