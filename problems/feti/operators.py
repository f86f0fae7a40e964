"""The dual operator of Total FETI, F = B K⁺Bᵀ, and its preconditioners.

Only components that rows touch matter: with B_b the columns of B there and all of them
packed group by group, a product is sparse, dense, sparse:

    F λ = B_b diag((K⁺)_bb) B_bᵀ λ

A group is subdomains that share a dense block; what they gather are the columns of one
matrix, so that a group is one product of two dense matrices. Of the block of a single
subdomain one triangle is kept, since reading it takes the time. Blocks (K⁺)_bb and S_bb
are formed where they fit (*explicit*; it pays after about ten products); beyond, a
product solves with the factors of its kind.

Preconditioners approximate F⁻¹ (Farhat and Roux 1991; Rixen and Farhat 1999):

    B_D diag(D) B_Dᵀ,    B_D = (B W Bᵀ)⁻¹B W

with D = K_bb (lumped) or S_bb (Dirichlet), where S = K_gg − K_gi K_ii⁻¹K_ig is
condensed onto the whole boundary g of a subdomain, and the weights W = 1 (multiplicity)
or the reciprocal moduli (stiffness). Redundant rows make B W Bᵀ singular; of the
equations it is block diagonal, a block for each node, and inverted as Moore and Penrose
do, so that nothing is added to λ that Bᵀ does not feel.

Of B W Bᵀ, what couples contact rows with the equations is left out. There is some only
where contact touches supports; there it would weigh the equations for contact that most
faces do not have: κ in the final face of beam-ring/Nr=8/Nh=5/steps=1/feti=8 is 58 with
it, and 3.7 without, as it is if B holds the rows of that face alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, lapack
from scipy.sparse import csc_matrix, csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from sksparse.cholmod import cholesky

from mortarbench.harness import Vector
from mortarbench.harness.operators import Product
from mortarbench.problems.fem.mesh import Nodes
from mortarbench.problems.feti.blocks import multiply
from mortarbench.problems.feti.subdomain_classes import (
    Condensed,
    Dense,
    SubdomainClass,
    Subdomains,
)

MAX_EXPLICIT_MIB = 2048  #: that all explicit blocks of an operator may take
STRIP_COLUMNS = 256  #: of a block that is not formed, multiplied out at a time
#: of the diagonal of B W Bᵀ, added where contact rows might depend on one another
CONTACT_SHIFT = 1e-8
EIGENVALUE_CUTOFF = (
    1e-10  #: of the largest eigenvalue of a block of B W Bᵀ: taken for zero
)
COUPLING_ROUNDING = 1e-12  #: of an entry of B W Bᵀ, relative to its diagonal


class Group(NamedTuple):
    """The subdomains of one kind, with what rows touch of any of them."""

    template: SubdomainClass
    explicit: bool  #: whether (K⁺)_bb is formed
    members: NDArray[np.int64]  #: (S_g,) subdomains
    touched: Nodes  #: b (n_g,) components within each, ascending


def condense_groups(groups: Sequence[Group]) -> Iterable[tuple[int, Condensed]]:
    """Form (K⁺)_bb and S_bb of each group, when it is asked for, with its place."""
    return ((i, g.template.condense(g.touched)) for i, g in enumerate(groups))


@dataclass(frozen=True, eq=False)
class Packed:
    """The touched components of all subdomains, numbered group by group.

    Within a group by component, then by subdomain: what a group gathers is (n_g, S_g).
    """

    groups: tuple[Group, ...]
    B: csr_array  #: (m, M) columns of B, packed
    BT: csr_array  #: (M, m) its transpose by rows

    def congruence(self, blocks: Sequence[Any], x: Dense) -> Dense:
        """Multiply  B_b diag(blocks) B_bᵀ  with x (m,) or (m, k)."""
        return np.asarray(self.B @ self.block_products(blocks, self.BT @ x))

    def block_products(self, blocks: Sequence[Any], X: Dense) -> Dense:
        """Multiply each subdomain's part of X (M,) or (M, k) with its group's block."""
        Y, end = np.empty_like(X), 0
        for block, group in zip(blocks, self.groups, strict=True):
            n = group.touched.size
            begin, end = end, end + n * group.members.size
            x, y = (v[begin:end].reshape(n, -1) for v in (X, Y))
            if isinstance(block, np.ndarray):
                multiply(block, x, y)
            else:
                y[:] = block @ x
        return Y

    def diagonal(self, blocks: Sequence[Any]) -> Vector:
        """Return the diagonal of  B_b diag(blocks) B_bᵀ.

        Row r has the sum of B_ri M_ij B_rj over pairs of its entries that are in one
        subdomain, with the block M of that.
        """
        B, members = self.B, [group.members.size for group in self.groups]
        sizes = [g.touched.size * g.members.size for g in self.groups]
        group = np.searchsorted(np.cumsum(sizes), B.indices, side="right")
        within = B.indices - (np.cumsum(sizes) - sizes)[group]
        component, subdomain = np.divmod(within, np.array(members)[group])

        entries = np.diff(B.indptr)
        row = np.repeat(np.arange(entries.size), entries)
        left = np.repeat(np.arange(B.nnz), entries[row])
        before = np.cumsum(entries[row]) - entries[row]
        right = B.indptr[row[left]] + np.arange(left.size) - before[left]
        one = (group[left] == group[right]) & (subdomain[left] == subdomain[right])
        left, right = left[one], right[one]
        by_group = np.argsort(group[left], kind="stable")
        ends = np.cumsum(np.bincount(group[left], minlength=len(self.groups)))

        total = np.zeros(entries.size)
        for block, pairs in zip(blocks, np.split(by_group, ends[:-1]), strict=True):
            i, j = left[pairs], right[pairs]
            M_ij = _entries(block, component[i], component[j])
            total += np.bincount(row[i], B.data[i] * M_ij * B.data[j], total.size)
        return total


def pack(B: csr_array, domains: Subdomains, explicit: NDArray[np.bool_]) -> Packed:
    """Pack the columns of B (m, N)."""
    groups, number, end = [], np.full(B.shape[1], -1, dtype=np.int64), 0
    parts = touched_components(B, domains)
    for k, (kind, members) in enumerate(
        zip(domains.classes, domains.members, strict=True)
    ):
        groups.append(Group(kind, bool(explicit[k]), members, parts[k]))
        places = domains.start[members] + parts[k][:, None]
        number[places.ravel()] = np.arange(end, end + places.size)
        end += places.size
    indices = number[B.indices].astype(B.indices.dtype)
    B_b = csr_array((B.data, indices, B.indptr), shape=(B.shape[0], end))
    return Packed(tuple(groups), B_b, csr_array(B_b.T))


def touched_components(B: csr_array, domains: Subdomains) -> list[Nodes]:
    """List the components that rows touch of any subdomain of each kind, ascending."""
    columns = np.zeros(B.shape[1], dtype=bool)
    columns[B.indices] = True
    found = np.flatnonzero(columns)
    sub = np.searchsorted(domains.start, found, side="right") - 1
    largest = int(np.diff(domains.start).max())
    kind, at = np.divmod(
        np.unique(domains.class_of[sub] * largest + found - domains.start[sub]), largest
    )
    ends = np.cumsum(np.bincount(kind, minlength=len(domains.classes)))
    return np.split(at, ends[:-1])


@dataclass(frozen=True, eq=False)
class DualOperator:
    """F of torn bodies; x ↦ Fx takes (m,) and (m, k)."""

    B: csr_array  #: (m, N)
    domains: Subdomains
    explicit: NDArray[np.bool_]  #: (kinds,) whose blocks are formed
    equalities: int  #: rows that are equations, the first ones; the others are contact
    #: forms (K⁺)_bb and S_bb of explicit groups, in any order, with their places
    condense: Callable[[Sequence[Group]], Iterable[tuple[int, Condensed]]] = (
        condense_groups
    )

    def __call__(self, x: Dense) -> Dense:
        """Multiply with F."""
        return self.packed.congruence(self.inverses, x)

    def diagonal(self) -> Vector:
        """Give the diagonal of F."""
        return self._diagonal

    def preconditioner(self, kind: str, scaling: str) -> Product:
        """Make x ↦ B_D diag(D) B_Dᵀx ≈ F⁻¹x for (m,) and (m, k).

        kind : lumped or dirichlet
        scaling : multiplicity or stiffness

        Raises
        ------
        ValueError
            For other names.

        """
        blocks, weights = self.weighted_blocks(kind, scaling)
        BW = scaled_columns(self.packed.B, weights)
        gram = decouple_contact(csr_array(BW @ self.packed.BT), self.equalities)
        WB, solve = csr_array(BW.T), gram_inverse(gram, self.equalities)

        def product(x: Dense) -> Dense:
            return solve(BW @ self.packed.block_products(blocks, WB @ solve(x)))

        return product

    def weighted_blocks(self, kind: str, scaling: str) -> tuple[list[Any], Vector]:
        """Return D of each group, and the weights W of all that rows touch.

        Raises
        ------
        ValueError
            As of `preconditioner`.

        """
        for name, value, known in (
            ("preconditioner", kind, ("lumped", "dirichlet")),
            ("scaling", scaling, ("multiplicity", "stiffness")),
        ):
            if value not in known:
                raise ValueError(f"{name} {value!r}; known: {', '.join(known)}")
        groups = self.packed.groups
        blocks = (
            [g.template.block(g.touched) for g in groups] if kind == "lumped"
            else [schur for _, schur in self._blocks]
        )  # fmt: skip
        softness = [
            np.repeat(1 / g.template.stiffness[g.touched], g.members.size)
            for g in groups
        ]
        weights = np.concatenate(softness)
        if scaling == "multiplicity":
            weights = np.ones_like(weights)
        return blocks, weights

    @cached_property
    def packed(self) -> Packed:
        """Its rows on what they touch."""
        return pack(self.B, self.domains, self.explicit)

    @property
    def inverses(self) -> list[Any]:
        """(K⁺)_bb of each group: a matrix, or what multiplies with it."""
        return [inverse for inverse, _ in self._blocks]

    @cached_property
    def _diagonal(self) -> Vector:
        return self.packed.diagonal(self.inverses)

    @cached_property
    def _blocks(self) -> list[tuple[Any, Any]]:
        """(K⁺)_bb and S_bb of each group: matrices, or what multiplies with them."""
        groups = self.packed.groups
        found = {i: _implicit(g) for i, g in enumerate(groups) if not g.explicit}
        places = [i for i, g in enumerate(groups) if g.explicit]
        for at, blocks in self.condense([groups[i] for i in places]):
            found[places[at]] = _explicit(groups[places[at]], blocks)
        return [found[i] for i in range(len(groups))]


def _explicit(group: Group, blocks: Condensed) -> tuple[Any, Any]:
    if group.members.size == 1:
        return _Triangle.of(blocks.compliance), _Triangle.of(blocks.schur)
    return blocks


def _implicit(group: Group) -> tuple[Any, Any]:
    kind, b = group.template, group.touched
    g = np.union1d(kind.boundary, b)
    at = np.searchsorted(g, b)
    return _Part(kind.K.shape[0], b, kind.inverse), _Part(
        g.size, at, kind.elimination(g).__matmul__
    )


class _Triangle(NamedTuple):
    """A symmetric matrix by its upper triangle, column by column."""

    n: int
    entries: Vector

    @classmethod
    def of(cls, M: Dense) -> _Triangle:
        return cls(len(M), lapack.dtrttp(M)[0])

    def __matmul__(self, X: Dense) -> Dense:
        return np.stack([blas.dspmv(self.n, 1.0, self.entries, x) for x in X.T], axis=1)


class _Part(NamedTuple):
    """M_bb of a matrix M (n, n) that columns can be multiplied with."""

    n: int
    b: Nodes
    product: Product

    def __matmul__(self, X: Dense) -> Dense:
        whole = np.zeros((self.n, X.shape[1]))
        whole[self.b] = X
        return self.product(whole)[self.b]


def _entries(block: Any, i: NDArray[np.int64], j: NDArray[np.int64]) -> Vector:
    """Read entries of a block; one that only multiplies is multiplied out in parts."""
    if isinstance(block, _Triangle):
        i, j = np.minimum(i, j), np.maximum(i, j)
        return np.asarray(block.entries[j * (j + 1) // 2 + i])
    if not isinstance(block, _Part):
        return np.asarray(block[i, j])
    found, n = np.empty(i.size), block.b.size
    for first in range(0, n, STRIP_COLUMNS):
        part = (first <= j) & (j < first + STRIP_COLUMNS)
        unit = np.eye(n, min(STRIP_COLUMNS, n - first), -first)
        found[part] = (block @ unit)[i[part], j[part] - first]
    return found


def scaled_columns(B: csr_array, weights: Vector) -> csr_array:
    """Multiply the columns of B (m, M) with weights (M,)."""
    return csr_array((B.data * weights[B.indices], B.indices, B.indptr), shape=B.shape)


def decouple_contact(gram: csr_array, equalities: int) -> csr_array:
    """Leave out of B W Bᵀ what couples contact rows with equations, and rounding."""
    diagonal = gram.diagonal()
    rows, columns = gram.tocoo().coords
    size = np.sqrt(diagonal[rows] * diagonal[columns])
    kept = (np.abs(gram.data) > COUPLING_ROUNDING * size) & (
        (rows < equalities) == (columns < equalities)
    )
    parts = (gram.data[kept], (rows[kept], columns[kept]))
    return csr_array(parts, shape=gram.shape)


def gram_inverse(gram: csr_array, equalities: int) -> Product:
    """Make x ↦ (B W Bᵀ)⁺x of what `decouple_contact` leaves."""
    m = gram.shape[0]
    inverse = block_pseudoinverse(csr_array(gram[:equalities, :equalities]))
    if equalities == m:
        return lambda x: np.asarray(inverse @ x)
    contact = csc_matrix(gram[equalities:, equalities:])
    factor = cholesky(
        csc_matrix(contact + diags_array(CONTACT_SHIFT * contact.diagonal()))
    )

    def solve(x: Dense) -> Dense:
        y = np.empty_like(x)
        y[:equalities] = inverse @ x[:equalities]
        y[equalities:] = factor(x[equalities:])
        return y

    return solve


def block_pseudoinverse(M: csr_array) -> csr_array:
    """Return M⁺ of a symmetric M with many small blocks, in whatever order of rows."""
    if not M.nnz:
        return M
    _, block = connected_components(M, directed=False)
    size = np.bincount(block)
    order = np.argsort(block, kind="stable")
    within = np.empty_like(order)
    within[order] = np.arange(order.size) - (np.cumsum(size) - size)[block[order]]
    rows, columns = M.tocoo().coords
    data, places = [], []
    for n in np.unique(size):
        mine = size == n
        number = np.cumsum(mine) - 1
        dense = np.zeros((mine.sum(), n, n))
        of = mine[block[rows]]
        at = number[block[rows[of]]], within[rows[of]], within[columns[of]]
        dense[at] = M.data[of]
        members = order[mine[block[order]]].reshape(-1, n)
        data.append(
            np.linalg.pinv(dense, rcond=EIGENVALUE_CUTOFF, hermitian=True).ravel()
        )
        places.append([np.repeat(members, n), np.tile(members, n).ravel()])
    entries = np.concatenate(data), tuple(np.concatenate(places, axis=1))
    return csr_array(entries, shape=M.shape)


def explicit_classes(B: csr_array, domains: Subdomains) -> NDArray[np.bool_]:
    """Choose the kinds whose blocks are formed: the smallest, as many as fit."""
    sizes = np.array([part.size for part in touched_components(B, domains)])
    order = np.argsort(sizes, kind="stable")
    found = np.zeros(sizes.size, dtype=bool)
    found[order] = (
        np.cumsum(block_bytes(sizes, domains)[order]) <= MAX_EXPLICIT_MIB * 2**20
    )
    return found


def block_bytes(sizes: NDArray[np.int64], domains: Subdomains) -> NDArray[np.int64]:
    """Return what both blocks of each kind take, formed on so many components."""
    alone = np.array([members.size == 1 for members in domains.members])
    return np.where(alone, 8 * sizes * (sizes + 1), 16 * sizes**2)
