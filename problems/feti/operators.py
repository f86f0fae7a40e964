"""The dual operator of Total FETI, F = B K⁺Bᵀ, and its preconditioners, as plain arrays.

Only components that rows touch matter: with B_b the columns of B there and all of them
packed group by group, a product is sparse, dense, sparse:

    F λ = B_b diag((K⁺)_bb) B_bᵀ λ

A group is subdomains that share a dense block; what they gather are the columns of one
matrix, so that a group is one product of two dense matrices. A block (K⁺)_bb is formed
where it fits (*explicit*; it pays after about ten products, and memory traffic is less
than that of a factor); beyond, a product solves with the factor of its kind.

Preconditioners approximate F⁻¹ (Farhat and Roux 1991; Rixen and Farhat 1999):

    B_D diag(D) B_Dᵀ,    B_D = (B W Bᵀ)⁻¹B W

with D = K_bb (lumped) or S_bb = K_bb − K_bi K_ii⁻¹K_ib (Dirichlet), and the weights
W = 1 (multiplicity) or 1/diag(K) (stiffness). Redundant rows make B W Bᵀ singular; which
generalised inverse is taken changes λ by what Bᵀ does not feel.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_diag, csc_array, csc_matrix, csr_array, diags_array
from sksparse.cholmod import cholesky

from harness import Matrix, Vector
from harness.operators import Arrays, Maker, Product, SerialisableOperator
from problems.fem.mesh import Nodes
from problems.feti.local import Dense, Local, Subdomains, eliminated

NAME = "tfeti"  #: of the maker
EXPLICIT_MIB = 2048  #: that all explicit blocks of an operator may take
#: of the diagonal of B W Bᵀ, added where rows are redundant
SHIFT = 1e-8
_PARTS = ("data", "indices", "indptr")


class Group(NamedTuple):
    """Subdomains of one kind whose rows touch the same components."""

    kind: int
    members: NDArray[np.int64]  #: (S_g,) subdomains
    touched: Nodes  #: (n_g,) components within each, ascending


@dataclass(frozen=True, eq=False)
class Packed:
    """The touched components of all subdomains, numbered group by group.

    Within a group by component, then by subdomain: what a group gathers is (n_g, S_g).
    """

    groups: tuple[Group, ...]
    number: NDArray[np.int64]  #: (N,) packed number of each torn unknown, or −1
    B: csr_array  #: (m, M) columns of B, packed
    BT: csr_array  #: (M, m) its transpose by rows

    def congruence(self, blocks: Sequence[Any], x: Dense) -> Dense:
        """Multiply  B_b diag(blocks) B_bᵀ  with x (m,) or (m, k)."""
        return np.asarray(self.B @ self.multiplied(blocks, self.BT @ x))

    def multiplied(self, blocks: Sequence[Any], X: Dense) -> Dense:
        """Multiply each subdomain's part of X (M,) or (M, k) with its group's block."""
        Y, end = np.empty_like(X), 0
        for block, group in zip(blocks, self.groups, strict=True):
            n = group.touched.size
            begin, end = end, end + n * group.members.size
            part = X[begin:end]
            Y[begin:end] = (block @ part.reshape(n, -1)).reshape(part.shape)
        return Y


def packed(B: csr_array, domains: Subdomains, groups: Sequence[Group]) -> Packed:
    """Pack the columns of B (m, N)."""
    number, end = np.full(B.shape[1], -1, dtype=np.int64), 0
    for group in groups:
        places = domains.start[group.members] + group.touched[:, None]
        number[places.ravel()] = np.arange(end, end + places.size)
        end += places.size
    indices = number[B.indices].astype(B.indices.dtype)
    B_b = csr_array((B.data, indices, B.indptr), shape=(B.shape[0], end))
    return Packed(tuple(groups), number, B_b, csr_array(B_b.T))


def groups_by_kind(B: csr_array, domains: Subdomains) -> list[Group]:
    """Group the subdomains by kind, with all that rows touch of any of them."""
    sub, at = _touched(B, domains)
    kind, largest = domains.kind[sub], int(np.diff(domains.start).max())
    kind, at = np.divmod(np.unique(kind * largest + at), largest)
    ends = np.cumsum(np.bincount(kind, minlength=len(domains.kinds)))
    parts = np.split(at, ends[:-1])
    return [
        Group(k, members, touched)
        for k, (members, touched) in enumerate(zip(domains.members, parts, strict=True))
        if touched.size
    ]


def groups_by_touch(B: csr_array, domains: Subdomains) -> list[Group]:
    """Group the subdomains by kind and by what rows touch of each."""
    sub, at = _touched(B, domains)
    ends = np.cumsum(np.bincount(sub, minlength=domains.kind.size))
    alike: dict[tuple[int, bytes], list[int]] = {}
    parts = np.split(at, ends[:-1])
    for s, (kind, part) in enumerate(zip(domains.kind, parts, strict=True)):
        if part.size:
            alike.setdefault((int(kind), part.tobytes()), []).append(s)
    return [
        Group(kind, np.array(members), parts[members[0]])
        for (kind, _), members in alike.items()
    ]


def _touched(B: csr_array, domains: Subdomains) -> tuple[Nodes, Nodes]:
    """List the touched torn unknowns in turn: their subdomain, their place in it."""
    columns = np.zeros(B.shape[1], dtype=bool)
    columns[B.indices] = True
    found = np.flatnonzero(columns)
    sub = np.searchsorted(domains.start, found, side="right") - 1
    return sub, found - domains.start[sub]


@dataclass(frozen=True, eq=False)
class DualOperator:
    """F of torn bodies; x ↦ Fx takes (m,) and (m, k)."""

    B: csr_array  #: (m, N)
    domains: Subdomains
    explicit: NDArray[np.bool_]  #: (kinds,) whose (K⁺)_bb is formed

    def __call__(self, x: Dense) -> Dense:
        """Multiply with F."""
        return self._packed.congruence(self._blocks, x)

    def preconditioner(self, kind: str, scaling: str) -> Product:
        """Make x ↦ B_D diag(D) B_Dᵀx ≈ F⁻¹x for (m,) and (m, k).

        kind : lumped or dirichlet
        scaling : multiplicity or stiffness

        Raises
        ------
        ValueError
            For other names.

        """
        if kind not in BLOCKS:
            raise ValueError(f"preconditioner {kind!r}; known: {', '.join(BLOCKS)}")
        if scaling not in WEIGHTS:
            raise ValueError(f"scaling {scaling!r}; known: {', '.join(WEIGHTS)}")
        touching = packed(
            self.B, self.domains, groups_by_touch(self.B, self.domains)
        )
        blocks = BLOCKS[kind](self.domains.kinds, touching.groups)
        weights = WEIGHTS[scaling](self.domains.kinds, touching.groups)
        return _scaled(touching, blocks, weights)

    @cached_property
    def _packed(self) -> Packed:
        return packed(self.B, self.domains, groups_by_kind(self.B, self.domains))

    @cached_property
    def _blocks(self) -> list[Any]:
        kinds = self.domains.kinds
        return [
            kinds[g.kind].compliance(g.touched)
            if self.explicit[g.kind]
            else _Solved(kinds[g.kind], g.touched)
            for g in self._packed.groups
        ]


class _Solved(NamedTuple):
    """(K⁺)_bb that is not formed: a product solves with the factor."""

    local: Local
    b: Nodes

    def __matmul__(self, X: Dense) -> Dense:
        whole = np.zeros((self.local.K.shape[0], X.shape[1]))
        whole[self.b] = X
        return self.local.inverse(whole)[self.b]


def _lumped(kinds: Sequence[Local], groups: Sequence[Group]) -> list[Any]:
    return [csr_array(kinds[g.kind].stiffness(g.touched)) for g in groups]


def _dirichlet(kinds: Sequence[Local], groups: Sequence[Group]) -> list[Any]:
    """Form S_bb of each group; of those of one kind, from the one of all they touch."""
    union: dict[int, Nodes] = {}
    for g in groups:
        union[g.kind] = np.union1d(union.get(g.kind, g.touched), g.touched)
    schur = {k: kinds[k].schur(b) for k, b in union.items()}
    return [eliminated(schur[g.kind], np.isin(union[g.kind], g.touched)) for g in groups]


def _ones(kinds: Sequence[Local], groups: Sequence[Group]) -> Vector:
    return np.ones(sum(g.touched.size * g.members.size for g in groups))


def _softness(kinds: Sequence[Local], groups: Sequence[Group]) -> Vector:
    diagonals = [kinds[g.kind].K.diagonal()[g.touched] for g in groups]
    return 1 / np.concatenate([
        np.repeat(d, g.members.size) for d, g in zip(diagonals, groups, strict=True)
    ])


BLOCKS = MappingProxyType({"lumped": _lumped, "dirichlet": _dirichlet})
WEIGHTS = MappingProxyType({"multiplicity": _ones, "stiffness": _softness})


def _scaled(touching: Packed, blocks: Sequence[Any], weights: Vector) -> Product:
    """Make x ↦ B_D diag(blocks) B_Dᵀx,  B_D = (B W Bᵀ)⁻¹B W."""
    BW = csr_array(touching.B @ diags_array(weights))
    WB, solve = csr_array(BW.T), _gram_inverse(csr_array(BW @ touching.BT))

    def product(x: Dense) -> Dense:
        return solve(BW @ touching.multiplied(blocks, WB @ solve(x)))

    return product


def _gram_inverse(gram: csr_array) -> Product:
    """Make x ↦ (B W Bᵀ)⁻¹x; most rows of orthonormal gluing stand alone."""
    diagonal = gram.diagonal()
    rows = np.repeat(np.arange(diagonal.size), np.diff(gram.indptr))
    size = np.sqrt(diagonal[rows] * diagonal[gram.indices])
    couples = (rows != gram.indices) & (np.abs(gram.data) > 1e-12 * size)
    coupled = np.unique(rows[couples])
    if not coupled.size:
        return lambda x: (x.T / diagonal).T
    block = csc_array(gram[coupled][:, coupled])
    factor = cholesky(
        csc_matrix(block + diags_array(SHIFT * diagonal[coupled], format="csc"))
    )

    def solve(x: Dense) -> Dense:
        y = (x.T / diagonal).T
        y[coupled] = factor(x[coupled])
        return y

    return solve


def dual_operator(B: csr_array, domains: Subdomains) -> SerialisableOperator:
    """Make F as an operator that can be written: every kind once, and B."""
    kinds = domains.kinds
    K = csc_array(block_diag([local.K for local in kinds], format="csc"))
    most = max(local.star.shape[1] for local in kinds)
    star = [np.pad(k.star, ((0, 0), (0, most - k.star.shape[1]))) for k in kinds]
    arrays = {
        **{f"K_{part}": getattr(K, part) for part in _PARTS},
        **{f"B_{part}": getattr(B, part) for part in _PARTS},
        "sizes": np.array([local.K.shape[0] for local in kinds]),
        "fixing": np.concatenate([local.fixing for local in kinds]),
        "fixings": np.array([local.fixing.size for local in kinds]),
        "star": np.concatenate(star),
        "kind": domains.kind,
        "explicit": _explicit(B, domains),
    }
    return SerialisableOperator(B.shape[0], NAME, arrays, MAKERS)


def _explicit(B: csr_array, domains: Subdomains) -> NDArray[np.bool_]:
    """Choose the kinds whose block is formed: the smallest, as many as fit."""
    found = np.zeros(len(domains.kinds), dtype=bool)
    groups = sorted(groups_by_kind(B, domains), key=lambda g: g.touched.size)
    mib = np.cumsum([8 * g.touched.size**2 / 2**20 for g in groups])
    found[[g.kind for g in groups[: np.searchsorted(mib, EXPLICIT_MIB, "right")]]] = True
    return found


def _made(arrays: Arrays) -> DualOperator:
    """Put F together from the arrays of `dual_operator`."""
    sizes, kind = arrays["sizes"], arrays["kind"]
    ends, fixed = np.cumsum(sizes), np.cumsum(arrays["fixings"])
    data, indices, indptr = (arrays[f"K_{part}"] for part in _PARTS)
    kinds = []
    for n, end, p, last in zip(sizes, ends, arrays["fixings"], fixed, strict=True):
        columns = indptr[end - n : end + 1]
        within = slice(columns[0], columns[-1])
        parts = (data[within], indices[within] - (end - n), columns - columns[0])
        K = csc_array(parts, shape=(n, n))
        at = slice(last - p, last)
        kinds.append(Local(K, arrays["fixing"][at], arrays["star"][at]))
    parts = tuple(arrays[f"B_{part}"] for part in _PARTS)
    shape = (parts[2].size - 1, int(sizes[kind].sum()))
    domains = Subdomains(tuple(kinds), kind)
    return DualOperator(csr_array(parts, shape=shape), domains, arrays["explicit"])


MAKERS: Mapping[str, Maker] = MappingProxyType({NAME: _made})
