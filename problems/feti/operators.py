"""The dual operator of Total FETI, F = B K⁺Bᵀ, and its preconditioners.

Only the components b with nonzero columns in B contribute. Let B_b be these columns,
packed group by group. A product with F consists of a sparse, a dense and a second
sparse product:

    F λ = B_b diag((K⁺)_bb) B_bᵀ λ

A group is the set of subdomains that share a dense block. Their components form the
columns of one matrix, so that each group requires one product of two dense matrices. If
a group consists of a single subdomain, only one triangle of the block is stored,
because memory bandwidth limits the speed of the product. The blocks (K⁺)_bb, and S_bb
for preconditioners, are computed in advance (*explicit*) for as many classes as fit
into memory, which pays off after about ten products. For all other classes, each
product requires a solve with the factor of the class.

Preconditioners approximate F⁻¹ (Farhat and Roux 1991, lumped; Farhat, Mandel and Roux
1994, Dirichlet; Rixen and Farhat 1999, scaling):

    B_D diag(D) B_Dᵀ,    B_D = (B W Bᵀ)⁻¹B W

with D = K_bb (lumped) or S_bb (Dirichlet), where S = K_gg − K_gi K_ii⁻¹K_ig is
condensed onto the union g of b and the boundary of a subdomain, and the weights W = 1
(multiplicity) or the reciprocal moduli (stiffness). Redundant rows make B W Bᵀ
singular. Its diagonal block for the equality rows is itself block diagonal, with one
block per node. The Moore-Penrose inverse of this block keeps λ free of components in
ker Bᵀ.

Entries of B W Bᵀ that couple contact rows with equality rows are dropped. In
homogeneous bodies, such entries exist only where contact touches supports. They would
adapt the weights of the equality rows to contact rows that are mostly inactive. The
final face consists of the multipliers that are free at the solution. In
beam-ring/Nr=8/Nh=5/steps=1/feti=8, the condition number on this face is 58 with the
coupling entries and 3.7 without them. It is also 3.7 if B contains only the rows of the
face.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array, diags_array, vstack
from scipy.sparse.csgraph import connected_components

from mortarbench.harness import Vector
from mortarbench.harness.distributed.factor import bordered_factor
from mortarbench.harness.distributed.sparse import (
    Block,
    Composition,
    CompressedRows,
    DirectSum,
    Identity,
    LinearMap,
)
from mortarbench.harness.operators import Product
from mortarbench.problems.fem.mesh import Nodes
from mortarbench.problems.feti.subdomain_classes import (
    Dense,
    SubdomainClass,
    Subdomains,
    upper_triangle,
)

#: largest memory (MiB) for all explicit blocks of an operator
MAX_EXPLICIT_MIB = 2048
#: number of columns, or of rows, that are evaluated at a time to limit the memory
STRIP_COLUMNS = 256
#: multiple of the diagonal of B W Bᵀ that is added to its contact part, which is
#: singular where contact rows are linearly dependent
CONTACT_SHIFT = 1e-8
#: eigenvalues of a block of B W Bᵀ below this fraction of the largest count as zero
EIGENVALUE_CUTOFF = 1e-10
#: off-diagonal entries of B W Bᵀ below this fraction of the diagonal count as rounding
#: errors
COUPLING_ROUNDING = 1e-12


class Group(NamedTuple):
    """Subdomains of one class, with the components that B touches in any of them."""

    template: SubdomainClass
    explicit: bool  #: True if (K⁺)_bb is computed in advance
    members: NDArray[np.int64]  #: (S_g,) subdomains
    touched: Nodes  #: b (n_g,) components within a subdomain, ascending


@dataclass(frozen=True, eq=False)
class Packed:
    """Rows of B on the components that they touch, numbered group by group.

    Within a group, the subdomain index varies fastest, so that the packed vector of a
    group is a matrix (n_g, S_g) stored by rows.
    """

    groups: tuple[Group, ...]
    B: csr_array  #: (m, M) packed columns of B
    BT: csr_array  #: (M, m) the transpose, stored by rows

    def congruence(self, blocks: LinearMap) -> Composition:
        """Return the map x ↦ B_b diag(blocks) B_bᵀx for x (m,) or (m, k)."""
        return Composition(CompressedRows(self.B), blocks, CompressedRows(self.BT))

    def block_diagonal(self, blocks: Sequence[Any]) -> DirectSum:
        """Return the block diagonal map of packed components (M,), one block per group.

        blocks : block of each group, as for `Block`
        """
        pairs = zip(blocks, self.groups, strict=True)
        return DirectSum(*(Block(M, g.touched.size, g.members.size) for M, g in pairs))

    def diagonal(self, blocks: Sequence[Any]) -> Vector:
        """Return the diagonal of  B_b diag(blocks) B_bᵀ.

        Entry r is the sum of B_ri M_ij B_rj over all pairs of entries of row r in the
        same subdomain, where M is the block of that subdomain.
        """
        B, members = self.B, [group.members.size for group in self.groups]
        sizes = [g.touched.size * g.members.size for g in self.groups]
        group = np.searchsorted(np.cumsum(sizes), B.indices, side="right")
        within = B.indices - (np.cumsum(sizes) - sizes)[group]
        component, subdomain = np.divmod(within, np.array(members)[group])

        # form all pairs of entries in the same row, then select those in one subdomain
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


def pack(
    B: csr_array,
    domains: Subdomains,
    explicit: NDArray[np.bool_],
    touched: Sequence[Nodes],
) -> Packed:
    """Pack the columns of B (m, N) with nonzeros, class by class.

    The groups have classes of their own, so that their factors are computed anew.

    Parameters
    ----------
    explicit : (classes,) True for classes with explicit blocks
    touched : for each class, components that include those that B touches

    """
    groups, number, end = [], np.empty(B.shape[1], dtype=np.int64), 0
    for k, members in domains.members:
        template = replace(domains.template(k))
        groups.append(Group(template, bool(explicit[k]), members, touched[k]))
        unknowns = domains.start[members] + touched[k][:, None]
        number[unknowns.ravel()] = np.arange(end, end + unknowns.size)
        end += unknowns.size
    indices = number[B.indices].astype(B.indices.dtype)
    B_b = csr_array((B.data, indices, B.indptr), shape=(B.shape[0], end))
    return Packed(tuple(groups), B_b, csr_array(B_b.T))


def touched_components(B: csr_array, domains: Subdomains) -> list[Nodes]:
    """Return, for each class, the components that B touches in any subdomain."""
    columns = np.zeros(B.shape[1], dtype=bool)
    columns[B.indices] = True
    unknowns = np.flatnonzero(columns)
    subdomain = np.searchsorted(domains.start, unknowns, side="right") - 1
    largest = int(domains.sizes.max())
    class_of, component = np.divmod(
        np.unique(
            domains.class_of[subdomain] * largest + unknowns - domains.start[subdomain]
        ),
        largest,
    )
    ends = np.cumsum(np.bincount(class_of, minlength=domains.sizes.size))
    return np.split(component, ends[:-1])


@dataclass(frozen=True, eq=False)
class DualOperator:
    """The operator F of decomposed bodies, applied to arrays (m,) or (m, k).

    On several ranks, each rank has the operator of its own subdomains, and F is the sum
    of these operators (`problems.feti.served`).
    """

    B: csr_array  #: (m, N) rows on all torn unknowns
    domains: Subdomains
    explicit: NDArray[np.bool_]  #: (classes,) True for classes with explicit blocks
    equalities: int  #: number of equality rows, which come first; contact rows follow
    semidefinite: bool = False  #: True if Fλ = 0 for some λ ≠ 0: redundant rows
    #: for each class, the components that B touches in any subdomain, on all ranks;
    #: None if there is one rank
    touched: Sequence[Nodes] | None = None

    def __call__(self, x: Dense) -> Dense:
        """Return Fx."""
        return np.asarray(self.linear_map(x))

    @cached_property
    def linear_map(self) -> Composition:
        """F as a composition of compiled linear maps."""
        inverses = self.packed.block_diagonal(self._blocks[0])
        return self.packed.congruence(inverses)

    def prepare(self) -> None:
        """Factorise the subdomains."""
        _ = self.linear_map

    def forget(self) -> None:
        """Discard all factors; the next product computes them again."""
        for name in set(vars(self)) - set(self.__dataclass_fields__):
            del vars(self)[name]

    def diagonal(self) -> Vector:
        """Return the diagonal of F, (m,)."""
        return self._diagonal

    def preconditioner(self, kind: str, scaling: str) -> LinearMap:
        """Return the map x ↦ B_D diag(D) B_Dᵀx ≈ F⁻¹x for x (m,) or (m, k).

        Parameters
        ----------
        kind : "lumped" or "dirichlet"
        scaling : "multiplicity" or "stiffness"

        Raises
        ------
        ValueError
            If `kind` or `scaling` is not one of these names.

        """
        name = kind, scaling
        if name not in self._preconditioners:
            inverse, outer = gram_inverses(self.gram(kind, scaling), self.equalities)
            self.weigh(kind, scaling, inverse)
            self._preconditioners[name] = Composition(
                outer, self._weighted[name], outer
            )
        return self._preconditioners[name]

    @cached_property
    def _preconditioners(self) -> dict[tuple[str, str], LinearMap]:
        return {}

    def gram(self, kind: str, scaling: str) -> csr_array:
        """Return B W Bᵀ, (m, m)."""
        _, weights = self.weighted_blocks(kind, scaling)
        return csr_array(self.packed.B @ diags_array(weights) @ self.packed.BT)

    def weigh(self, kind: str, scaling: str, inverse: csr_array) -> None:
        """Define the map that `weighted` applies.

        inverse : (B W Bᵀ)⁺ of equality rows, as sparse as B
        """
        blocks, weights = self.weighted_blocks(kind, scaling)
        packed, E = self.packed, self.equalities
        BW = csr_array(packed.B @ diags_array(weights))
        B_D = csr_array(vstack([inverse @ BW[:E], BW[E:]]))
        self._weighted[kind, scaling] = Composition(
            CompressedRows(B_D),
            packed.block_diagonal(blocks),
            CompressedRows(csr_array(B_D.T)),
        )

    def weighted(self, kind: str, scaling: str, x: Dense) -> Dense:
        """Apply B_D diag(D) B_Dᵀ without the inverse for contact rows."""
        return np.asarray(self._weighted[kind, scaling](x))

    @cached_property
    def _weighted(self) -> dict[tuple[str, str], Composition]:
        return {}

    def weighted_blocks(self, kind: str, scaling: str) -> tuple[list[Any], Vector]:
        """Return the block D of each group, and weights W (M,) of packed components.

        Raises
        ------
        ValueError
            If `kind` or `scaling` is not a name that `preconditioner` accepts.

        """
        for name, value, known in (
            ("preconditioner", kind, ("lumped", "dirichlet")),
            ("scaling", scaling, ("multiplicity", "stiffness")),
        ):
            if value not in known:
                raise ValueError(f"{name} {value!r}; known: {', '.join(known)}")
        groups = self.packed.groups
        blocks = (
            [g.template.block(g.touched) for g in groups]
            if kind == "lumped"
            else self._blocks[1]
        )
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
        """Rows of B restricted to the components that they touch."""
        touched = self.touched or touched_components(self.B, self.domains)
        return pack(self.B, self.domains, self.explicit, touched)

    @cached_property
    def _diagonal(self) -> Vector:
        return self.packed.diagonal(self._blocks[0])

    @cached_property
    def _blocks(self) -> tuple[list[Any], list[Any]]:
        """(K⁺)_bb and S_bb of each group: matrices, triangles, or objects with `@`."""
        both = [
            _explicit(g) if g.explicit else _implicit(g) for g in self.packed.groups
        ]
        return [one[0] for one in both], [one[1] for one in both]


def _explicit(group: Group) -> tuple[Any, Any]:
    blocks = group.template.condense(group.touched)
    if group.members.size == 1:
        return upper_triangle(blocks.compliance), upper_triangle(blocks.schur)
    return blocks


def _implicit(group: Group) -> tuple[Any, Any]:
    kind, b = group.template, group.touched
    g = np.union1d(kind.boundary, b)
    at = np.searchsorted(g, b)
    return _Part(kind.K.shape[0], b, kind.inverse), _Part(
        g.size, at, kind.elimination(g).__matmul__
    )


class _Part(NamedTuple):
    """The block M_bb of a matrix M (n, n), given by a function that multiplies by M."""

    n: int
    b: Nodes
    product: Product

    def __matmul__(self, X: Dense) -> Dense:
        whole = np.zeros((self.n, X.shape[1]))
        whole[self.b] = X
        return self.product(whole)[self.b]


def _entries(block: Any, i: NDArray[np.int64], j: NDArray[np.int64]) -> Vector:
    """Return the entries (i, j) of a block; implicit blocks are evaluated in strips."""
    if not isinstance(block, _Part) and block.ndim == 1:  # a triangle
        i, j = np.minimum(i, j), np.maximum(i, j)
        return np.asarray(block[j * (j + 1) // 2 + i])
    if not isinstance(block, _Part):
        return np.asarray(block[i, j])
    values, n = np.empty(i.size), block.b.size
    for first in range(0, n, STRIP_COLUMNS):
        part = (first <= j) & (j < first + STRIP_COLUMNS)
        unit = np.eye(n, min(STRIP_COLUMNS, n - first), -first)
        values[part] = (block @ unit)[i[part], j[part] - first]
    return values


def decouple_contact(gram: csr_array, equalities: int) -> csr_array:
    """Drop rounding errors, and coupling of contact with equality rows, from B W Bᵀ."""
    diagonal = gram.diagonal()
    rows, columns = gram.tocoo().coords
    size = np.sqrt(diagonal[rows] * diagonal[columns])
    # rounding errors would connect the small blocks that `block_pseudoinverse`
    # separates
    kept = (np.abs(gram.data) > COUPLING_ROUNDING * size) & (
        (rows < equalities) == (columns < equalities)
    )
    parts = (gram.data[kept], (rows[kept], columns[kept]))
    return csr_array(parts, shape=gram.shape)


def gram_inverses(gram: csr_array, equalities: int) -> tuple[csr_array, LinearMap]:
    """Return (B W Bᵀ)⁺ of equality rows, and a map with the inverse for contact rows.

    The block of contact rows is made regular by `CONTACT_SHIFT`. The map leaves
    equality rows unchanged.
    """
    gram = decouple_contact(gram, equalities)
    inverse = block_pseudoinverse(gram[:equalities, :equalities])
    contact = csc_array(gram[equalities:, equalities:])
    contact += diags_array(CONTACT_SHIFT * contact.diagonal(), format="csc")
    factor = bordered_factor(contact, np.zeros(0, dtype=np.int64))
    return inverse, DirectSum(Identity(equalities), factor)


def block_pseudoinverse(M: csr_array) -> csr_array:
    """Return M⁺ of a symmetric M that is block diagonal up to a permutation."""
    if not M.nnz:
        return M
    _, block = connected_components(M, directed=False)
    size = np.bincount(block)
    order = np.argsort(block, kind="stable")
    within = np.empty_like(order)
    within[order] = np.arange(order.size) - (np.cumsum(size) - size)[block[order]]
    rows, columns = M.tocoo().coords
    data, coordinates = [], []
    for n in np.unique(size):
        same = size == n
        number = np.cumsum(same) - 1
        dense = np.zeros((same.sum(), n, n))
        inside = same[block[rows]]
        place = (
            number[block[rows[inside]]],
            within[rows[inside]],
            within[columns[inside]],
        )
        dense[place] = M.data[inside]
        members = order[same[block[order]]].reshape(-1, n)
        data.append(
            np.linalg.pinv(dense, rcond=EIGENVALUE_CUTOFF, hermitian=True).ravel()
        )
        coordinates.append([np.repeat(members, n), np.tile(members, n).ravel()])
    entries = np.concatenate(data), tuple(np.concatenate(coordinates, axis=1))
    return csr_array(entries, shape=M.shape)


def explicit_classes(B: csr_array, domains: Subdomains) -> NDArray[np.bool_]:
    """Return a mask of the classes with explicit blocks.

    These are the classes with the smallest blocks, as many as fit into
    `MAX_EXPLICIT_MIB`.
    """
    sizes = np.array([part.size for part in touched_components(B, domains)])
    order = np.argsort(sizes, kind="stable")
    fits = np.zeros(sizes.size, dtype=bool)
    fits[order] = (
        np.cumsum(block_bytes(sizes, domains)[order]) <= MAX_EXPLICIT_MIB * 2**20
    )
    return fits


def block_bytes(sizes: NDArray[np.int64], domains: Subdomains) -> NDArray[np.int64]:
    """Return the memory (bytes) for the blocks (K⁺)_bb and S_bb of each class.

    sizes : (classes,) number of components of the blocks
    """
    alone = np.bincount(domains.class_of, minlength=sizes.size) == 1
    return np.where(alone, 8 * sizes * (sizes + 1), 16 * sizes**2)
