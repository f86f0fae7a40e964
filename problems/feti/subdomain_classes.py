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

In hybrid FETI (Klawonn and Rheinbach 2010, Comput. Methods Appl. Mech. Eng. 199),
subdomains are joined into clusters by equal averages over common faces (`Clusters`). A
cluster has the rigid motions of a single body, which reduces the coarse problem.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag as block_diagonal
from scipy.linalg import cho_solve, eigh, lapack, null_space, qr
from scipy.sparse import block_diag, csc_array, csc_matrix, csr_array
from sksparse.cholmod import Factor, analyze, cholesky

from mortarbench.harness import Vector
from mortarbench.harness.digest import hex_digest
from mortarbench.harness.distributed.factor import with_int32
from mortarbench.problems.fem.mesh import Nodes
from mortarbench.problems.feti.blocks import BlockDiagonal

Dense = NDArray[np.float64]
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
        """Digest of the data; equal on all ranks that assemble this class."""
        K = self.K
        return hex_digest(
            map(
                np.ndarray.tobytes,
                (K.data, K.indices, K.indptr, self.R, self.fixing, self.boundary),
            ),
            32,
        )

    def without_factor(self, name: str = "") -> SubdomainClass:
        """Return a copy without cached factors; an empty `name` keeps the old name."""
        copy = replace(self)
        vars(copy)["name"] = name or self.name
        return copy

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
        return self.blocks(b, self.border_factor(b))

    def border(self, b: Nodes) -> Nodes:
        """Return the components h of `condense`, ascending."""
        return np.union1d(np.union1d(self.boundary, b), self.fixing)

    def border_factor(self, b: Nodes) -> Dense:
        """Return L (h, h) with S_ρ = LLᵀ, the most expensive part of `condense`."""
        h = self.border(b)
        i = np.setdiff1d(np.arange(self.K.shape[0]), h)
        if (
            i.size
        ):  # order i to reduce fill; h stays last, so that L is the trailing block
            i = i[analyze(with_int32(self.K[i][:, i]), use_long=False).P()]
        order = np.concatenate([i, h])
        K_rho = with_int32(self._fixed[order][:, order])
        factor = analyze(K_rho, ordering_method="natural", use_long=False)
        factor.cholesky_inplace(K_rho)
        return np.asarray(factor.L()[i.size :, i.size :].toarray())

    def blocks(self, b: Nodes, L: Dense) -> Condensed:
        """Return (K⁺)_bb and S_bb, see `condense`, from the factor L of the border."""
        g, h = np.union1d(self.boundary, b), self.border(b)
        places_b, places_fixing = np.searchsorted(h, b), np.searchsorted(h, self.fixing)
        C = cho_solve((L, True), np.eye(h.size)[:, places_b])[places_b]
        S = L @ L.T  # S_ρ; the next line subtracts ρR*R*ᵀ, which leaves S_h
        S[np.ix_(places_fixing, places_fixing)] -= self._fixing_term
        S_bb, inner = S[np.ix_(places_b, places_b)], ~np.isin(h, g)
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


@dataclass(frozen=True, eq=False)
class Subdomains:
    """S subdomains before gluing, grouped into classes."""

    classes: tuple[SubdomainClass, ...]
    class_of: NDArray[np.int64]  #: (S,) class of each subdomain

    @cached_property
    def start(self) -> NDArray[np.int64]:
        """First torn unknown of each subdomain, then the total number N, (S + 1,)."""
        sizes = np.array([kind.R.shape[0] for kind in self.classes])[self.class_of]
        return np.concatenate([[0], np.cumsum(sizes)])

    @cached_property
    def members(self) -> tuple[NDArray[np.int64], ...]:
        """Subdomains of each class."""
        order = np.argsort(self.class_of, kind="stable")
        ends = np.cumsum(np.bincount(self.class_of, minlength=len(self.classes)))
        return tuple(np.split(order, ends[:-1]))

    @property
    def modes(self) -> NDArray[np.int64]:
        """Number of rigid motions of each subdomain, (S,)."""
        return np.array([kind.R.shape[1] for kind in self.classes])[self.class_of]

    @cached_property
    def kernel(self) -> csr_array:
        """R = diag(R_1 … R_S) (N, Σr), the rigid motions of all subdomains."""
        modes, sizes = self.modes, np.diff(self.start)
        entries = np.concatenate([self.classes[k].R.ravel() for k in self.class_of])
        per_row = np.repeat(modes, sizes)
        ends = np.concatenate([[0], np.cumsum(per_row)])
        along = np.arange(entries.size) - np.repeat(ends[:-1], per_row)
        columns = np.repeat(np.cumsum(modes) - modes, sizes * modes) + along
        return csr_array((entries, columns, ends), shape=(sizes.sum(), modes.sum()))

    def places(self) -> Iterator[NDArray[np.int64]]:
        """Yield the torn unknowns of each class, (n_k, S_k), a column per subdomain."""
        for template, members in zip(self.classes, self.members, strict=True):
            yield self.start[members] + np.arange(template.R.shape[0])[:, None]

    def restrict(self, free: NDArray[np.bool_]) -> Subdomains:
        """Return the subdomains restricted to the torn unknowns in the mask (N,)."""
        classes, class_of = list[SubdomainClass](), np.empty_like(self.class_of)
        numbers = dict[tuple[int, bytes], int]()
        for s, k in enumerate(self.class_of):
            mask = free[self.start[s] : self.start[s + 1]]
            number = numbers.setdefault((int(k), mask.tobytes()), len(classes))
            if number == len(classes):
                classes.append(_restricted(self.classes[k], mask))
            class_of[s] = number
        return Subdomains(tuple(classes), class_of)

    def inverse(self, b: Vector) -> Vector:
        """Apply K⁺ to a torn vector (N,)."""
        v = np.empty_like(b)
        for template, places in zip(self.classes, self.places(), strict=True):
            columns = b[places]
            v[places] = template.inverse(columns) if columns.any() else 0.0
        return v


#: eigenvalues of C_cC_cᵀ below this fraction of the largest indicate dependent rows,
#: where C_c are the rows of C of one cluster. The modes of faces are orthonormal, so
#: that all other eigenvalues are much larger
DEPENDENT_SHARE = 1e-10


@dataclass(frozen=True, eq=False, kw_only=True)
class Clusters:
    """Clusters of subdomains; averages over common faces are equal within a cluster.

    ::

        min ½vᵀKv − bᵀv   subject to   Cv = 0

    Row i of C is the difference between the averages of two subdomains, for one mode of
    their common face. With v = K⁺(b − Cᵀμ) − Rα and V = [K⁺Cᵀ, R], the solution is

        v = K̃⁺b − RNβ,   K̃⁺ = K⁺ − V M⁺Vᵀ,   M = ⎡CK⁺Cᵀ  CR⎤
                                                  ⎣RᵀCᵀ    0⎦

    with arbitrary β. The columns of N are an orthonormal basis of ker CR. They describe
    the motions of clusters as rigid bodies, and the columns of RN span the kernel of K
    on {v : Cv = 0}. M is block diagonal, with one block per cluster. The Moore-Penrose
    inverse M⁺ is used because rows of C may be linearly dependent. K̃⁺ is positive
    semidefinite.

    The modes of a face are its rigid motions, orthonormal over its nodes. The columns
    of Φ_k are the modes of all faces at which some member of class k is joined. C is
    stored as a matrix that acts on the coordinates Φ_kᵀv_s of all subdomains s, in the
    order of the subdomains.
    """

    domains: Subdomains  #: floating subdomains
    cluster: NDArray[np.int64]  #: (S,) cluster of each subdomain, from 0
    faces: tuple[csr_array, ...]  #: Φ (n_k, q_k) for each class
    joints: csr_array  #: C in these coordinates (c, Σq), rows ordered by clusters

    @cached_property
    def coordinates(self) -> NDArray[np.int64]:
        """First coordinate of each subdomain, then the total number, (S + 1,)."""
        sizes = np.array([modes.shape[1] for modes in self.faces])
        return np.concatenate([[0], np.cumsum(sizes[self.domains.class_of])])

    @cached_property
    def averages(self) -> csr_array:
        """C (c, N), which maps torn unknowns to differences of averages."""
        faces = block_diag([self.faces[k] for k in self.domains.class_of], format="csc")
        return csr_array(self.joints @ faces.T)

    @cached_property
    def members(self) -> tuple[NDArray[np.int64], ...]:
        """Subdomains of each cluster."""
        order = np.argsort(self.cluster, kind="stable")
        return tuple(np.split(order, np.cumsum(np.bincount(self.cluster))[:-1]))

    @cached_property
    def rows(self) -> NDArray[np.int64]:
        """First row of C of each cluster, then the number of rows, (clusters + 1,)."""
        subdomain = np.searchsorted(
            self.coordinates, self.joints.indices[self.joints.indptr[:-1]], side="right"
        )
        cluster = self.cluster[subdomain - 1]
        return np.searchsorted(cluster, np.arange(len(self.members) + 1))

    @cached_property
    def unknowns(self) -> tuple[NDArray[np.int64], list[int]]:
        """Order of the unknowns (μ, α) by clusters, (μ_1, α_1, μ_2, α_2, …).

        The order is given as indices (c + r,) in (μ, α); the second array is the number
        of unknowns of each cluster.
        """
        start = np.concatenate([[0], np.cumsum(self.domains.modes)]) + self.rows[-1]
        parts = [
            np.concatenate(
                [np.arange(first, end), *(np.arange(*start[[s, s + 1]]) for s in own)]
            )
            for first, end, own in zip(
                self.rows[:-1], self.rows[1:], self.members, strict=True
            )
        ]
        return np.concatenate(parts), [part.size for part in parts]

    @cached_property
    def _joined(self) -> list[_Joined]:
        return [self._join(c) for c in range(len(self.members))]

    def _join(self, c: int) -> _Joined:
        domains = self.domains
        rows = self.joints[self.rows[c] : self.rows[c + 1]]
        parts, gram, motions = [], np.zeros((rows.shape[0],) * 2), list[Dense]()
        for s in self.members[c]:
            k = domains.class_of[s]
            coordinates = slice(self.coordinates[s], self.coordinates[s + 1])
            J, modes = rows[:, coordinates].toarray(), self.faces[k]
            parts.append((int(k), J))
            gram += J @ (modes.T @ modes).toarray() @ J.T
            motions.append(J @ (modes.T @ domains.classes[k].R))
        CR = np.concatenate(motions, axis=1)
        # subdomains joined by faces move as one body, with as many motions as one
        # subdomain
        last = domains.classes[domains.class_of[self.members[c][0]]].R.shape[1] - 1
        N = eigh(CR.T @ CR, subset_by_index=(0, last))[1]
        size, modes = np.linalg.eigh(gram)
        dependent = size <= DEPENDENT_SHARE * size.max(initial=0.0)
        return _Joined(parts, CR, N, modes[:, ~dependent], modes[:, dependent])

    @cached_property
    def motions(self) -> csr_array:
        """N (r, r̃), with rows in the order of the rigid motions of all subdomains."""
        order, rows = self.unknowns[0], self.rows[-1]
        N = block_diag([part.N for part in self._joined], format="csr")
        return csr_array(N[np.argsort(order[order >= rows])])

    @property
    def independent(self) -> csr_array:
        """Orthonormal combinations (c', c) that reduce C to independent rows."""
        return csr_array(
            block_diag([part.independent.T for part in self._joined], format="csr")
        )

    @cached_property
    def kernel(self) -> csr_array:
        """RN (N, r̃), a basis of the rigid motions of all clusters."""
        return csr_array(self.domains.kernel @ self.motions)

    def saddle_inverses(self, compliance: Sequence[Dense]) -> list[Vector]:
        """Return the upper triangle of M⁺ for each cluster, column by column.

        compliance : ΦᵀK⁺Φ (q_k, q_k) of each class
        """
        return [upper_triangle(one.saddle_inverse(compliance)) for one in self._joined]

    def gram_inverses(self, grams: Sequence[Dense]) -> list[Vector]:
        """Return the upper triangle of (CWCᵀ)⁺ for each cluster, column by column.

        grams : ΦᵀWΦ (q_k, q_k) of each class, with a diagonal matrix W of weights
        """
        return [upper_triangle(one.gram_inverse(grams)) for one in self._joined]

    @cached_property
    def _saddle_inverse(self) -> BlockDiagonal:
        """M⁺ in the order of `unknowns`."""
        compliance = [
            modes.T @ template.inverse(modes.toarray())
            for template, modes in zip(self.domains.classes, self.faces, strict=True)
        ]
        sizes = self.unknowns[1]
        return BlockDiagonal(self.saddle_inverses(compliance), sizes, [1] * len(sizes))

    def inverse(self, b: Vector) -> Vector:
        """Apply K̃⁺ to a torn vector (N,)."""
        domains, C, R = self.domains, self.averages, self.domains.kernel
        order = self.unknowns[0]
        t = np.concatenate([C @ domains.inverse(b), R.T @ b])
        y = np.empty_like(t)
        y[order] = self._saddle_inverse(t[order])
        mu, alpha = np.split(y, [C.shape[0]])
        return np.asarray(domains.inverse(b - C.T @ mu) - R @ alpha)

    def restrict(
        self, subdomains: Nodes, classes: Nodes, domains: Subdomains
    ) -> Clusters:
        """Return the restriction to a selection of clusters.

        subdomains : all subdomains of the selected clusters, ascending
        classes : distinct classes of these subdomains, ascending
        domains : these subdomains as `Subdomains`
        """
        columns = np.concatenate(
            [np.arange(*self.coordinates[[s, s + 1]]) for s in subdomains]
        )
        touched = np.isin(self.joints.indices[self.joints.indptr[:-1]], columns)
        return Clusters(
            domains=domains,
            cluster=np.unique(self.cluster[subdomains], return_inverse=True)[1],
            faces=tuple(self.faces[k] for k in classes),
            joints=csr_array(self.joints[touched][:, columns]),
        )


class _Joined(NamedTuple):
    """The c rows of C that belong to one cluster, with their kernels and ranges."""

    parts: list[tuple[int, Dense]]  #: class and columns of C (c, q_k) of each subdomain
    CR: Dense  #: (c, r)
    N: Dense  #: (r, r̃) orthonormal basis of ker CR
    independent: Dense  #: (c, c') orthonormal basis of range C
    dependent: Dense  #: (c, c − c') orthonormal basis of ker Cᵀ

    def product(self, coordinates: Sequence[Dense]) -> Dense:
        """Return CACᵀ (c, c) of a block diagonal A from the blocks ΦᵀAΦ of classes."""
        total = np.zeros((self.CR.shape[0],) * 2)
        for k, J in self.parts:
            total += J @ coordinates[k] @ J.T
        return total

    def gram_inverse(self, grams: Sequence[Dense]) -> Dense:
        """Return (CWCᵀ)⁺ on the range of C from the blocks ΦᵀWΦ of all classes."""
        U = self.independent
        return _symmetric(U @ np.linalg.inv(U.T @ self.product(grams) @ U) @ U.T)

    def saddle_inverse(self, compliance: Sequence[Dense]) -> Dense:
        """Return M⁺ of this cluster from the blocks ΦᵀK⁺Φ of all classes."""
        S, (c, r) = self.product(compliance), self.CR.shape
        # scale CK⁺Cᵀ to the magnitude of CR, which is of order one
        unit = float(np.trace(S)) / c if c else 1.0
        M = np.block([[S / unit, self.CR], [self.CR.T, np.zeros((r, r))]])
        Z = block_diagonal(self.dependent, self.N)  # ker M
        inverse = np.linalg.inv(M + Z @ Z.T) - Z @ Z.T
        scale = np.append(np.full(c, unit**-0.5), np.full(r, unit**0.5))
        return _symmetric(scale[:, None] * inverse * scale)


@dataclass(frozen=True, eq=False, kw_only=True)
class DecomposedBodies:
    """A contact problem on decomposed bodies, in nondimensional form.

    ::

        min ½vᵀKv − fᵀv   subject to   B_E v = c_E,  B_I v ≤ c_I,   K = diag(K_1 … K_S)

    The rows of B are support and gluing rows (E), followed by normal contact rows (I)
    and by tangential contact rows, along which friction acts. Contact rows are
    multiplied by `scale`, so that the multipliers of the unscaled rows are scale·λ.
    """

    classes: tuple[SubdomainClass, ...]
    class_of: NDArray[np.int64]  #: (S,) class of each subdomain
    spread: csr_array  #: T (N, n), maps displacements to torn unknowns
    B: csr_array  #: (m, N) constraint rows, scaled
    c: Vector  #: (m,) right-hand side, scaled
    scale: Vector  #: positive factors of the contact rows
    f: Vector  #: (N,) torn load; Tᵀf is the load of the undivided bodies
    equalities: int  #: number of rows of supports and gluing, which come first
    clusters: Clusters | None = None  #: None if averages join no subdomains
    redundant: bool = False  #: True if rows of supports and gluing may be dependent

    @property
    def units(self) -> Subdomains | Clusters:
        """Floating units that B glues: clusters, or subdomains without clusters."""
        return self.clusters or self.domains

    @property
    def start(self) -> NDArray[np.int64]:
        """First torn unknown of each subdomain, then the total number N, (S + 1,)."""
        return self.domains.start

    @cached_property
    def domains(self) -> Subdomains:
        """The subdomains before gluing, with cached factors."""
        return Subdomains(self.classes, self.class_of)


def upper_triangle(M: Dense) -> Vector:
    """Return the upper triangle of a symmetric matrix, column by column."""
    return np.asarray(lapack.dtrttp(M)[0])


def _symmetric(M: Dense) -> Dense:
    return np.asarray((M + M.T) / 2)


def _restricted(kind: SubdomainClass, free: NDArray[np.bool_]) -> SubdomainClass:
    """Return a class restricted to the components in the mask `free` (n_k,).

    The new kernel consists of the motions of R that vanish at the fixed components.
    """
    if free.all():
        return kind
    R = kind.R @ null_space(kind.R[~free])
    R = np.linalg.qr(R[free])[0]
    number = np.cumsum(free) - 1
    return SubdomainClass(
        K=csc_array(kind.K[free][:, free]),
        R=R,
        fixing=np.sort(qr(R.T, mode="r", pivoting=True)[1][: R.shape[1]]),
        boundary=number[kind.boundary[free[kind.boundary]]],
        stiffness=kind.stiffness[free],
    )
