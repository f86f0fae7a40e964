"""The dual of torn bodies over ranks: who holds what, and what is exchanged.

A rank holds subdomains and, of every vector of multipliers, the rows that it *owns*. A
row of B that touches subdomains of several ranks is owned by one of them, in turn; the
others get its multiplier before they multiply, and send what they add to it:

    F λ = Σ_ranks B_p K_p⁺ B_pᵀ λ

No rank makes anything of the size of the whole: it has the columns of B, and the rows
of all vectors, that its subdomains touch. Subdomains go to ranks so that these do
alike much work and share few rows, by graph partitioning (METIS). Of a kind that
several ranks have, one forms the explicit blocks, and sends them to the others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array, diags_array

from harness import QP, InputError, Solution, Vector, no_rows
from harness.digest import hex_digest
from harness.distributed.factor import Touched, local_factor, touched_rows
from harness.distributed.vectors import (
    DistributedColumns,
    DistributedVector,
    Ranks,
    Share,
    distributed,
)
from harness.operators import Product
from problems.fem.mesh import Nodes
from problems.feti.operators import (
    ROUNDING,
    SHIFT,
    DualOperator,
    Group,
    gram_inverse,
    touched,
    uncoupled,
)
from problems.feti.torn import Condensed, Dense, Subdomains


class Parts(NamedTuple):
    """What every rank knows of all."""

    rank: NDArray[np.int64]  #: (S,) of each subdomain
    reach: csr_array  #: (m, ranks) whether a row touches subdomains of a rank
    owner: NDArray[np.int64]  #: (m,) rank of each row


def partition(B: csr_array, domains: Subdomains, ranks: int) -> Parts:
    """Give subdomains, and rows of B (m, N), to ranks.

    Raises
    ------
    InputError
        Where there are fewer subdomains than ranks.

    """
    S = domains.kind.size
    rows = np.repeat(np.arange(B.shape[0]), np.diff(B.indptr))
    sub = np.searchsorted(domains.start, B.indices, side="right") - 1
    ones = np.ones(rows.size, dtype=np.int32)
    touches = csr_array((ones, (rows, sub)), shape=(B.shape[0], S))
    touches.data[:] = 1
    work, size = _work(B, domains), np.diff(domains.start)
    rank = balanced(csr_array(touches.T @ touches), work, size, ranks)
    of_rank = csr_array((ones[:S], (np.arange(S), rank)), shape=(S, ranks))
    reach = csr_array(touches @ of_rank)
    reach.sort_indices()
    reach.data[:] = 1
    return Parts(rank, reach, owners(np.arange(B.shape[0]), reach))


def owners(rows: Nodes, reach: csr_array) -> NDArray[np.int64]:
    """Choose one of the ranks that touch each of some rows (t,), in turn.

    rows : their numbers
    reach : (t, ranks) the ranks that touch them, ascending
    """
    turn = rows % np.diff(reach.indptr)
    return np.asarray(reach.indices[reach.indptr[:-1] + turn], dtype=np.int64)


def _work(B: csr_array, domains: Subdomains) -> NDArray[np.int64]:
    """Count what a product does in each subdomain: its dense block."""
    sizes = np.array([part.size for part in touched(B, domains)])
    return (sizes**2)[domains.kind]


EVEN = 1.1  #: largest/mean of what ranks do, or hold, that is good enough
SEEDS = 12  #: of METIS, that are tried
SHARES = (0.25, 0.5, 1.0)  #: of size in the weight, beside work


def balanced(
    graph: csr_array, work: NDArray[np.int64], size: NDArray[np.int64], ranks: int
) -> NDArray[np.int64]:
    """Partition the graph of subdomains that share rows, by work and size (S,).

    METIS balances one weight: first the work. Where ranks hold uneven parts then, as
    where few subdomains have most of the work, it weighs both in several ways, and of
    what leaves the work even the partition with the most even sizes is taken.

    graph : (S, S) how many rows they share
    """
    if work.size < ranks:
        raise InputError(
            f"{ranks} ranks for {work.size} subdomains; expected at most one rank for "
            "each"
        )
    if ranks == 1:
        return np.zeros(work.size, dtype=np.int64)
    graph = graph.copy()
    graph.setdiag(0)
    graph.eliminate_zeros()

    def uneven(weight: NDArray[np.int64], rank: NDArray[np.int64]) -> float:
        sums = np.bincount(rank, weight, minlength=ranks)
        return float(sums.max() / sums.mean())

    rank = _partitioned(graph, work // max(int(work.min()), 1), ranks)
    best = uneven(size, rank)
    for seed, share in product(range(SEEDS), SHARES):
        if best <= EVEN:
            break
        weight = work / work.mean() + share * size / size.mean()
        other = _partitioned(graph, (weight / weight.min()).astype(int), ranks, seed)
        if uneven(work, other) <= EVEN and uneven(size, other) < best:
            rank, best = other, uneven(size, other)
    return rank


def _partitioned(
    graph: csr_array, weight: NDArray[np.int64], ranks: int, seed: int | None = None
) -> NDArray[np.int64]:
    """Partition a graph by weights (S,), by METIS."""
    from pymetis import CSRAdjacency, Options, part_graph  # late: one rank needs none

    _, found = part_graph(
        ranks, CSRAdjacency(graph.indptr, graph.indices), eweights=graph.data,
        vweights=weight, recursive=True,
        options=Options() if seed is None else Options(seed=seed),
    )  # fmt: skip
    rank = np.array(found, dtype=np.int64)
    for idle in np.setdiff1d(np.arange(ranks), rank):  # few subdomains: each gets one
        largest = np.bincount(rank, minlength=ranks).argmax()
        rank[np.flatnonzero(rank == largest)[-1]] = idle
    return rank


@dataclass(frozen=True, eq=False)
class Halo:
    """Rows that a rank touches, those it owns among them, and its neighbours' others.

    Multipliers of rows of a neighbour come in the order of the rows, and what is added
    to them goes back in it.
    """

    ranks: Ranks
    rows: Nodes  #: (t,) all that its subdomains touch or that it owns, ascending
    own: Nodes  #: (o,) places of the owned ones in `rows`
    #: (l,) places in the owned ones of what others need, neighbour by neighbour
    lent: Nodes
    #: (t − o,) places in `rows` of what others own, neighbour by neighbour
    borrowed: Nodes
    lends: NDArray[np.int64]  #: (ranks,) how many go to each, l in all
    borrows: NDArray[np.int64]  #: (ranks,) how many come from each

    @property
    def is_shared(self) -> NDArray[np.bool_]:
        """Which of its rows other ranks touch, too."""
        shared = np.zeros(self.rows.size, dtype=bool)
        shared[self.borrowed] = shared[self.own[self.lent]] = True
        return shared

    def borrowing(self, x: Vector) -> Callable[[], Vector]:
        """Send of the owned rows (o,) what others need; returns theirs (t − o,)."""
        with self.ranks.clocked("exchange"):
            return self.ranks.exchange(x[self.lent], self.lends, self.borrows)

    def returning(self, y: Vector) -> Callable[[Vector], Vector]:
        """Send what this rank has for rows of others (t − o,).

        Returns what adds that of the others to what it has for its own rows (o,).
        """
        with self.ranks.clocked("exchange"):
            arrived = self.ranks.exchange(y, self.borrows, self.lends)

        def added(own: Vector) -> Vector:
            with self.ranks.clocked("exchange"):
                np.add.at(own, self.lent, arrived())
            return own

        return added

    def gathered(self, x: Vector) -> Vector:
        """Complete the owned rows (o,) to all that are touched (t,)."""
        arrived, found = self.borrowing(x), np.empty(self.rows.size)
        found[self.own] = x
        found[self.borrowed] = arrived()
        return found

    def added(self, y: Vector) -> Vector:
        """Add up what all ranks have for the rows that this one owns (o,)."""
        return self.returning(y[self.borrowed])(y[self.own])


def halo(ranks: Ranks, rows: Nodes, reach: csr_array, owner: NDArray[np.int64]) -> Halo:
    """Find what this rank exchanges with the others.

    Parameters
    ----------
    rows : (t,) all that its subdomains touch, ascending
    reach : (t, ranks) which ranks touch them
    owner : (t,) rank of each

    """
    me, touched_by = ranks.rank, reach.tocsc()
    own = np.flatnonzero(owner == me)
    lent, borrowed = [], []
    for r in range(ranks.size):
        theirs = touched_by.indices[touched_by.indptr[r] : touched_by.indptr[r + 1]]
        needed = np.sort(theirs[(owner[theirs] == me) & (r != me)])
        lent.append(np.searchsorted(own, needed))
        borrowed.append(np.flatnonzero((owner == r) & (r != me)))
    return Halo(
        ranks=ranks, rows=rows, own=own,
        lent=np.concatenate(lent), borrowed=np.concatenate(borrowed),
        lends=np.array([*map(len, lent)]), borrows=np.array([*map(len, borrowed)]),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class RowsOverRanks:
    """Rows B of multipliers on what a rank has of them, in products Bᵀx and By.

    What neighbours exchange is sent first, and waited for when own rows are done.
    """

    at: Halo
    own: csr_array  #: (o, M) of owned rows
    transposed: csr_array  #: (M, o)
    borrowed: csr_array  #: (t − o, M) of the neighbours' rows
    borrowed_transposed: (
        csr_array  #: (k, t − o) rows of its transpose, without zero ones
    )
    reached: Nodes  #: (k,) which ones they are

    @classmethod
    def of(cls, B: csr_array, at: Halo) -> RowsOverRanks:
        """Split B (t, M) of all rows that a rank touches."""
        own, borrowed = csr_array(B[at.own]), csr_array(B[at.borrowed])
        reached = np.unique(borrowed.indices)
        return cls(
            at, own, csr_array(own.T), borrowed,
            csr_array(borrowed[:, reached].T), reached,
        )  # fmt: skip

    def transposed_times(self, x: Vector) -> Vector:
        """Return Bᵀx (M,) of this rank's slice x (o,)."""
        arrived = self.at.borrowing(x)
        with self.at.ranks.clocked("products"):
            X = self.transposed @ x
            X[self.reached] += self.borrowed_transposed @ arrived()
        return np.asarray(X)

    def times(self, X: Vector) -> Vector:
        """Return this rank's slice (o,) of Σ_ranks B X, with X (M,) of each."""
        with self.at.ranks.clocked("products"):
            added = self.at.returning(self.borrowed @ X)
            return added(self.own @ X)


@dataclass(frozen=True, eq=False)
class RankOperator:
    """F over ranks: takes and gives this rank's slice of vectors of multipliers."""

    local: DualOperator  #: rows that this rank touches, its own subdomains
    halo: Halo

    @property
    def shape(self) -> tuple[int, int]:
        """Rows that this rank owns, twice."""
        return (self.halo.own.size,) * 2

    def __call__(self, x: Dense) -> DistributedVector:
        """Multiply with F."""
        y = self._congruence(self._rows, self.local.inverses, np.asarray(x))
        return distributed(y, self.halo.ranks)

    def __matmul__(self, x: Dense) -> DistributedVector:
        return self(x)

    def diagonal(self) -> DistributedVector:
        """Give the diagonal of F."""
        return distributed(self.halo.added(self.local.diagonal()), self.halo.ranks)

    @cached_property
    def _rows(self) -> RowsOverRanks:
        return RowsOverRanks.of(self.local.packed.B, self.halo)

    def _congruence(
        self, rows: RowsOverRanks, blocks: Sequence[Any], x: Vector
    ) -> Vector:
        X = rows.transposed_times(x)
        with self.halo.ranks.clocked("products"):
            Y = self.local.packed.multiplied(blocks, X)
        return rows.times(Y)

    def onto_rows(self) -> Product:
        """Make the orthogonal projector onto the range of B:  x ↦ BBᵀ(BBᵀ)⁺x."""
        of = self.local.packed
        solve = self._gram_inverse(csr_array(of.B @ of.BT))
        return lambda x: self._rows.times(self._rows.transposed_times(solve(x)))

    def preconditioner(self, kind: str, scaling: str) -> Product:
        """Make x ↦ B_D diag(D) B_Dᵀx, as `DualOperator.preconditioner`."""
        of, ranks = self.local.packed, self.halo.ranks
        blocks, weights = self.local.weighted_blocks(kind, scaling)
        BW = csr_array(of.B @ diags_array(weights))
        rows = RowsOverRanks.of(BW, self.halo)
        solve = self._gram_inverse(csr_array(BW @ of.BT))

        def product(x: Dense) -> Dense:
            y = self._congruence(rows, blocks, solve(np.asarray(x)))
            return distributed(solve(y), ranks)

        return product

    def _gram_inverse(self, part: csr_array) -> Callable[[Dense], Dense]:
        """Make x ↦ (B W Bᵀ)⁻¹x of the sum of all ranks' parts, on owned rows.

        Most equations are coupled with no other row, all of them if gluing is
        orthonormal; all ranks alike solve for those that are. Contact rows are coupled
        along the contact. They are solved for rank by rank, unless ranks share many.
        """
        at, equalities = self.halo, self.local.equalities
        diagonal = at.added(part.diagonal())
        is_contact = at.rows >= equalities
        coupled = np.isin(at.rows, _coupled(part, at, diagonal, ~is_contact))
        contact = touched_rows(at.rows[is_contact], at.ranks)
        solves = []
        if contact.few_shared:
            of_contact = csc_array(part[is_contact][:, is_contact])
            solves.append(_rank_by_rank(of_contact, contact, at, diagonal))
        else:
            coupled |= is_contact
        if at.ranks.extreme(float(coupled.any()), np.max):
            solves.append(_alike(part, coupled, at, equalities))

        def solve(x: Dense) -> Dense:
            x = np.asarray(x)
            y = x / diagonal
            for owned, inverse in solves:
                y[owned] = inverse(x[owned])
            return np.asarray(y)

        return solve


def _coupled(
    part: csr_array, at: Halo, diagonal: Vector, some: NDArray[np.bool_]
) -> Nodes:
    """Find which of some rows (t,) the sum of all parts couples beyond rounding."""
    row, column = part.tocoo().coords
    size = np.sqrt(at.gathered(diagonal))
    share = part.tocoo().data / (size[row] * size[column])
    beside = (row != column) & some[row] & some[column] & (share != 0)
    between = at.is_shared[row] & at.is_shared[column]
    found = [at.rows[row[beside & ~between & (np.abs(share) > ROUNDING)]]]
    told = [v[beside & between] for v in (at.rows[row], at.rows[column], share)]
    rows, columns, shares = map(
        np.concatenate, zip(*at.ranks.comm.allgather(told), strict=True)
    )
    pairs, place = np.unique(np.stack([rows, columns]), axis=1, return_inverse=True)
    total = np.abs(np.bincount(place.ravel(), shares, pairs.shape[1]))
    return np.concatenate([*found, pairs[0, total > ROUNDING]])


def _rank_by_rank(
    part: csc_array, rows: Touched, at: Halo, diagonal: Vector
) -> tuple[Nodes, Callable[[Dense], Dense]]:
    """Invert the sum of the ranks' parts (k, k) of B W Bᵀ on some rows.

    Returns the places of these among the owned rows (o,), whose sum has this diagonal,
    and the inverse for what is there.
    """
    size = 1 / np.sqrt(at.gathered(diagonal)[np.searchsorted(at.rows, rows.rows)])
    unit = csc_array(diags_array(size) @ part @ diags_array(size))
    unit += csc_array(diags_array(SHIFT * unit.diagonal()))
    factor = local_factor(unit, rows).completed()
    _, mine, owned = np.intersect1d(rows.rows, at.rows[at.own], return_indices=True)

    def inverse(x: Dense) -> Dense:
        t = np.zeros(rows.rows.size)
        t[mine] = size[mine] * x
        return np.asarray(factor(t))[mine] * size[mine]

    return owned, inverse


def _alike(
    part: csr_array, some: NDArray[np.bool_], at: Halo, equalities: int
) -> tuple[Nodes, Callable[[Dense], Dense]]:
    """Do as `_rank_by_rank`, the same on all ranks.

    some : (t,) which of the touched rows
    """
    ranks, entries = at.ranks, part.tocoo()
    known = np.unique(np.concatenate(ranks.comm.allgather(at.rows[some])))
    told = at.rows[entries.row], at.rows[entries.col], entries.data
    of_known = np.isin(told[0], known) & np.isin(told[1], known)
    row, column, data = map(
        np.concatenate,
        zip(*ranks.comm.allgather([t[of_known] for t in told]), strict=True),
    )
    places = np.searchsorted(known, row), np.searchsorted(known, column)
    gram = csr_array((data, places), shape=(known.size,) * 2)
    gram.sum_duplicates()
    first = int(np.searchsorted(known, equalities))
    solve = gram_inverse(uncoupled(gram, first), first)
    _, place, owned = np.intersect1d(known, at.rows[at.own], return_indices=True)

    def inverse(x: Dense) -> Dense:
        whole = np.zeros(known.size)
        whole[place] = x
        return np.asarray(solve(ranks.total(whole))[place])

    return owned, inverse


def condensed_by_ranks(groups: Sequence[Group], ranks: Ranks) -> list[Condensed]:
    """Form the blocks of equal groups on one of the ranks that have them.

    Largest first, each goes to the rank that has the least to do so far (Graham 1969).
    """
    names = [_name(group) for group in groups]
    work = {
        n: g.kind.K.nnz * g.touched.size for n, g in zip(names, groups, strict=True)
    }
    have = ranks.comm.allgather(work)
    loads, maker = [0] * ranks.size, dict[str, int]()
    everyones = {name: size for one in have for name, size in one.items()}
    for name in sorted(everyones, key=lambda name: (-everyones[name], name)):
        able = [r for r, one in enumerate(have) if name in one]
        maker[name] = min(able, key=loads.__getitem__)
        loads[maker[name]] += everyones[name]
    found, sent = dict[str, Condensed](), []
    ours = dict(zip(names, groups, strict=True))
    for name, rank in maker.items():
        if rank == ranks.rank:
            group = ours[name]
            found[name] = group.kind.condensed(group.touched)
            blocks = np.stack(found[name])
            to = [r for r, one in enumerate(have) if name in one and r != rank]
            sent += [(ranks.comm.Isend(blocks, dest=r), blocks) for r in to]
    for name, rank in maker.items():
        if name in ours and rank != ranks.rank:
            n = ours[name].touched.size
            blocks = np.empty((2, n, n))
            with ranks.clocked("waiting"):
                ranks.comm.Recv(blocks, source=rank)
            found[name] = Condensed(*blocks)
    for request, _ in sent:
        request.wait()
    return [found[name] for name in names]


def _name(group: Group) -> str:
    """Name what the blocks of a group depend on by its content."""
    kind = group.kind
    parts = (
        kind.K.data, kind.K.indices, kind.K.indptr, kind.R, kind.fixing, kind.boundary,
        group.touched,
    )  # fmt: skip
    return hex_digest((np.ascontiguousarray(part).tobytes() for part in parts), 32)


def shared(qp: QP, operator: DualOperator, ranks: Ranks) -> Share:
    """Take this rank's share of a dual of torn bodies.

    Raises
    ------
    InputError
        Where there are fewer subdomains than ranks.

    """
    B, domains = operator.B, operator.domains
    parts = partition(B, domains, ranks.size)
    touched_here = np.flatnonzero(parts.reach[:, [ranks.rank]].toarray())
    reach = csr_array(parts.reach[touched_here])
    at = halo(ranks, touched_here, reach, parts.owner[touched_here])
    mine = np.flatnonzero(parts.rank == ranks.rank)
    kinds, kind = np.unique(domains.kind[mine], return_inverse=True)
    columns = np.concatenate(
        [np.arange(domains.start[s], domains.start[s + 1]) for s in mine]
    )
    local = DualOperator(
        csr_array(B[at.rows][:, columns]),
        Subdomains(tuple(domains.kinds[k] for k in kinds), kind),
        operator.explicit[kinds],
        operator.equalities,
        partial(condensed_by_ranks, ranks=ranks),
    )
    own = at.rows[at.own]
    q, lb, ub = (distributed(v[own], ranks) for v in (qp.q, qp.lb, qp.ub))
    part = QP(
        P=RankOperator(local, at),
        q=q, lb=lb, ub=ub, G=no_rows(own.size), h=np.zeros(0),
        A=DistributedColumns(csr_array(qp.A[:, own]), ranks), b=np.array(qp.b),
    )  # fmt: skip

    return Share(part, gathered_on_one(at, qp.q.size))


def gathered_on_one(at: Halo, count: int) -> Callable[[Solution], Solution | None]:
    """Make what gathers a solution of so many multipliers on rank 0."""

    def whole(s: Solution) -> Solution | None:
        told = at.rows[at.own], np.asarray(s.x), np.asarray(s.z_box)
        found = at.ranks.comm.gather(told)
        if found is None:
            return None
        x, z_box = np.empty(count), np.empty(count)
        for rows, x_part, z_part in found:
            x[rows], z_box[rows] = x_part, z_part
        return replace(s, x=x, z_box=z_box)

    return whole
