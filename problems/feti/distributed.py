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

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array, diags_array

from mortarbench.harness import QP, InputError, Solution, Vector, no_rows
from mortarbench.harness.digest import hex_digest
from mortarbench.harness.distributed.factor import Touched, local_factor, touched_rows
from mortarbench.harness.distributed.sparse import CompressedRows
from mortarbench.harness.distributed.vectors import (
    DistributedColumns,
    DistributedVector,
    Ranks,
    Share,
    distributed,
)
from mortarbench.harness.operators import Product
from mortarbench.problems.fem.mesh import Nodes
from mortarbench.problems.feti.operators import (
    CONTACT_SHIFT,
    COUPLING_ROUNDING,
    DualOperator,
    Group,
    decouple_contact,
    gram_inverse,
    scaled_columns,
    touched_components,
)
from mortarbench.problems.feti.subdomain_classes import Condensed, Dense, Subdomains

#: of what a kind of subdomains takes, what comes after the factor of its stiffness
BLOCK_SHARE = 0.25


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
    S = domains.class_of.size
    rows = np.repeat(np.arange(B.shape[0]), np.diff(B.indptr))
    sub = np.searchsorted(domains.start, B.indices, side="right") - 1
    ones = np.ones(rows.size, dtype=np.int32)
    touches = csr_array((ones, (rows, sub)), shape=(B.shape[0], S))
    touches.data[:] = 1
    work, size = _work(B, domains), np.diff(domains.start)
    rank = balanced_partition(csr_array(touches.T @ touches), work, size, ranks)
    of_rank = csr_array((ones[:S], (np.arange(S), rank)), shape=(S, ranks))
    reach = csr_array(touches @ of_rank)
    reach.sort_indices()
    reach.data[:] = 1
    return Parts(rank, reach, assign_owners(np.arange(B.shape[0]), reach))


def assign_owners(rows: Nodes, reach: csr_array) -> NDArray[np.int64]:
    """Choose one of the ranks that touch each of some rows (t,), in turn.

    rows : their numbers
    reach : (t, ranks) the ranks that touch them, ascending
    """
    turn = rows % np.diff(reach.indptr)
    return np.asarray(reach.indices[reach.indptr[:-1] + turn], dtype=np.int64)


def _work(B: csr_array, domains: Subdomains) -> NDArray[np.int64]:
    """Count what a product does in each subdomain: its dense block."""
    sizes = np.array([part.size for part in touched_components(B, domains)])
    return (sizes**2)[domains.class_of]


MAX_IMBALANCE = 1.1  #: largest/mean of what ranks do, or hold, that is good enough
METIS_SEEDS = 12  #: of METIS, that are tried
SIZE_WEIGHTS = (0.25, 0.5, 1.0)  #: of size in the weight, beside work


def balanced_partition(
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
    for seed, share in product(range(METIS_SEEDS), SIZE_WEIGHTS):
        if best <= MAX_IMBALANCE:
            break
        weight = work / work.mean() + share * size / size.mean()
        other = _partitioned(graph, (weight / weight.min()).astype(int), ranks, seed)
        if uneven(work, other) <= MAX_IMBALANCE and uneven(size, other) < best:
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
    owned: Nodes  #: (o,) places of the owned ones in `rows`
    #: (l,) places in the owned ones of what others need, neighbour by neighbour
    exported: Nodes
    #: (t − o,) places in `rows` of what others own, neighbour by neighbour
    ghosts: Nodes
    export_counts: NDArray[np.int64]  #: (ranks,) how many go to each, l in all
    ghost_counts: NDArray[np.int64]  #: (ranks,) how many come from each

    @property
    def is_shared(self) -> NDArray[np.bool_]:
        """Which of its rows other ranks touch, too."""
        shared = np.zeros(self.rows.size, dtype=bool)
        shared[self.ghosts] = shared[self.owned[self.exported]] = True
        return shared

    def start_gather(self, x: Vector) -> Callable[[], Vector]:
        """Send of the owned rows (o,) what others need; returns theirs (t − o,)."""
        with self.ranks.clocked("exchange"):
            return self.ranks.exchange(
                x[self.exported], self.export_counts, self.ghost_counts
            )

    def start_accumulate(self, y: Vector) -> Callable[[Vector], Vector]:
        """Send what this rank has for rows of others (t − o,).

        Returns what adds that of the others to what it has for its own rows (o,).
        """
        with self.ranks.clocked("exchange"):
            arrived = self.ranks.exchange(y, self.ghost_counts, self.export_counts)

        def added(own: Vector) -> Vector:
            with self.ranks.clocked("exchange"):
                np.add.at(own, self.exported, arrived())
            return own

        return added

    def gathered(self, x: Vector) -> Vector:
        """Complete the owned rows (o,) to all that are touched (t,)."""
        arrived, found = self.start_gather(x), np.empty(self.rows.size)
        found[self.owned] = x
        found[self.ghosts] = arrived()
        return found

    def added(self, y: Vector) -> Vector:
        """Add up what all ranks have for the rows that this one owns (o,)."""
        return self.start_accumulate(y[self.ghosts])(y[self.owned])


def build_halo(
    ranks: Ranks, rows: Nodes, reach: csr_array, owner: NDArray[np.int64]
) -> Halo:
    """Find what this rank exchanges with the others.

    Parameters
    ----------
    rows : (t,) all that its subdomains touch, ascending
    reach : (t, ranks) which ranks touch them
    owner : (t,) rank of each

    """
    me, touched_by = ranks.rank, reach.tocsc()
    own = np.flatnonzero(owner == me)
    exported, ghosts = [], []
    for r in range(ranks.size):
        theirs = touched_by.indices[touched_by.indptr[r] : touched_by.indptr[r + 1]]
        needed = np.sort(theirs[(owner[theirs] == me) & (r != me)])
        exported.append(np.searchsorted(own, needed))
        ghosts.append(np.flatnonzero((owner == r) & (r != me)))
    return Halo(
        ranks=ranks, rows=rows, owned=own,
        exported=np.concatenate(exported), ghosts=np.concatenate(ghosts),
        export_counts=np.array([*map(len, exported)]),
        ghost_counts=np.array([*map(len, ghosts)]),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class RowsOverRanks:
    """Rows B of multipliers on what a rank has of them, in products Bᵀx and By.

    What neighbours exchange is sent first, and waited for when own rows are done.
    """

    at: Halo
    owned: CompressedRows  #: (o, M) of owned rows
    transposed: CompressedRows  #: (M, o)
    ghosts: CompressedRows  #: (t − o, M) of the neighbours' rows
    #: (k, t − o) rows of its transpose, without zero ones
    ghosts_transposed: CompressedRows
    reached: Nodes  #: (k,) which ones they are

    @classmethod
    def of(cls, B: csr_array, at: Halo) -> RowsOverRanks:
        """Split B (t, M) of all rows that a rank touches."""
        own, ghosts = csr_array(B[at.owned]), csr_array(B[at.ghosts])
        reached = np.unique(ghosts.indices)
        return cls(
            at, CompressedRows(own), CompressedRows(csr_array(own.T)),
            CompressedRows(ghosts),
            CompressedRows(csr_array(ghosts[:, reached].T)), reached,
        )  # fmt: skip

    def transposed_times(self, x: Vector) -> Vector:
        """Return Bᵀx (M,) of this rank's slice x (o,)."""
        arrived = self.at.start_gather(x)
        with self.at.ranks.clocked("products"):
            X = self.transposed @ x
            X[self.reached] += self.ghosts_transposed @ arrived()
        return X

    def times(self, X: Vector) -> Vector:
        """Return this rank's slice (o,) of Σ_ranks B X, with X (M,) of each."""
        with self.at.ranks.clocked("products"):
            added = self.at.start_accumulate(self.ghosts @ X)
            return added(self.owned @ X)


@dataclass(frozen=True, eq=False)
class RankOperator:
    """F over ranks: takes and gives this rank's slice of vectors of multipliers."""

    local: DualOperator  #: rows that this rank touches, its own subdomains
    halo: Halo

    @property
    def shape(self) -> tuple[int, int]:
        """Rows that this rank owns, twice."""
        return (self.halo.owned.size,) * 2

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
            Y = self.local.packed.block_products(blocks, X)
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
        BW = scaled_columns(of.B, weights)
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
            solves.append(_distributed_inverse(of_contact, contact, at, diagonal))
        else:
            coupled |= is_contact
        if at.ranks.extreme(float(coupled.any()), np.max):
            solves.append(_replicated_inverse(part, coupled, at, equalities))

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
    beside = np.flatnonzero((row != column) & some[row] & some[column])
    row, column = row[beside], column[beside]
    size = np.sqrt(at.gathered(diagonal))
    share = part.data[beside] / (size[row] * size[column])
    between = at.is_shared[row] & at.is_shared[column]
    found = at.rows[row[~between & (np.abs(share) > COUPLING_ROUNDING)]]
    between &= share != 0
    told = [v[between] for v in (at.rows[row], at.rows[column], share)]
    rows, columns, shares = map(
        np.concatenate, zip(*at.ranks.comm.allgather(told), strict=True)
    )
    pairs, place = np.unique(np.stack([rows, columns]), axis=1, return_inverse=True)
    total = np.abs(np.bincount(place.ravel(), shares, pairs.shape[1]))
    return np.concatenate([found, pairs[0, total > COUPLING_ROUNDING]])


def _distributed_inverse(
    part: csc_array, rows: Touched, at: Halo, diagonal: Vector
) -> tuple[Nodes, Callable[[Dense], Dense]]:
    """Invert the sum of the ranks' parts (k, k) of B W Bᵀ on some rows.

    Returns the places of these among the owned rows (o,), whose sum has this diagonal,
    and the inverse for what is there.
    """
    size = 1 / np.sqrt(at.gathered(diagonal)[np.searchsorted(at.rows, rows.rows)])
    unit = csc_array(diags_array(size) @ part @ diags_array(size))
    unit += csc_array(diags_array(CONTACT_SHIFT * unit.diagonal()))
    factor = local_factor(unit, rows).completed()
    _, mine, owned = np.intersect1d(rows.rows, at.rows[at.owned], return_indices=True)

    def inverse(x: Dense) -> Dense:
        t = np.zeros(rows.rows.size)
        t[mine] = size[mine] * x
        return np.asarray(factor(t))[mine] * size[mine]

    return owned, inverse


def _replicated_inverse(
    part: csr_array, some: NDArray[np.bool_], at: Halo, equalities: int
) -> tuple[Nodes, Callable[[Dense], Dense]]:
    """Do as `_distributed_inverse`, the same on all ranks.

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
    first = int(np.searchsorted(known, equalities))
    solve = gram_inverse(decouple_contact(gram, first), first)
    _, place, owned = np.intersect1d(known, at.rows[at.owned], return_indices=True)

    def inverse(x: Dense) -> Dense:
        whole = np.zeros(known.size)
        whole[place] = x
        return np.asarray(solve(ranks.total(whole))[place])

    return owned, inverse


class Assignment(NamedTuple):
    """Who forms the blocks of one kind."""

    work: int  #: in some unit
    have: list[int]  #: ranks that have the kind
    factor: int  #: rank that factorises its stiffness
    blocks: int  #: rank that forms the blocks with that factor, and sends them


def assign_factorisations(work: Sequence[Mapping[str, int]]) -> dict[str, Assignment]:
    """Share out what forms the blocks of each kind, once.

    Largest first, each goes to the rank that has the least to do so far (Graham 1969).
    Ranks that have more than others then give away what comes after the factor.

    work : of each rank, what each of its kinds takes, by its name
    """
    have: dict[str, list[int]] = {}
    for rank, one in enumerate(work):
        for name in one:
            have.setdefault(name, []).append(rank)
    size = {name: work[ranks[0]][name] for name, ranks in have.items()}
    loads, found = [0.0] * len(work), dict[str, Assignment]()
    for name in sorted(have, key=lambda name: (-size[name], name)):
        rank = min(have[name], key=loads.__getitem__)
        loads[rank] += size[name]
        found[name] = Assignment(size[name], have[name], rank, rank)
    for name, task in found.items():
        rank, part = min(task.have, key=loads.__getitem__), BLOCK_SHARE * task.work
        if loads[rank] + 2 * part <= loads[task.factor]:
            loads[rank] += part
            loads[task.factor] -= part
            found[name] = task._replace(blocks=rank)
    return found


def blocks_before_exchange(tasks: Mapping[str, Assignment], rank: int) -> int:
    """Count the blocks that a rank forms until factors are given away.

    Of those that it forms with factors of its own; all of them if none are given away.
    """
    factors: dict[int, float] = {}
    for task in tasks.values():
        if len(task.have) > 1:
            made = (1 - BLOCK_SHARE) * task.work
            factors[task.factor] = factors.get(task.factor, 0.0) + made
    giving = [factors[t.factor] for t in tasks.values() if t.factor != t.blocks]
    left = max(giving, default=np.inf) - factors.get(rank, 0.0)
    own = [t for t in tasks.values() if t.factor == t.blocks == rank]
    takes = [t.work * (BLOCK_SHARE if len(t.have) > 1 else 1.0) for t in own]
    return int(np.count_nonzero(np.cumsum(takes) - np.array(takes) / 2 < left))


def condense_over_ranks(
    groups: Sequence[Group], ranks: Ranks
) -> Iterator[tuple[int, Condensed]]:
    """Form the blocks of equal groups on one of the ranks that have them.

    Factors that are given away are sent when those who give them have made all that
    several ranks need. Who has made its own before has formed some blocks meanwhile.
    What one rank alone has is formed whole in its turn, and not kept.
    """
    me, names = ranks.rank, [_name(group) for group in groups]
    ours = dict(zip(names, groups, strict=True))
    border = {name: g.template.border(g.touched).size for name, g in ours.items()}
    work = {name: ours[name].template.K.nnz * h for name, h in border.items()}
    tasks = assign_factorisations(ranks.comm.allgather(work))
    given = [n for n, t in tasks.items() if t.factor == me != t.blocks]
    taken = [n for n, t in tasks.items() if t.factor != me == t.blocks]
    kept = [n for n, t in tasks.items() if t.factor == me == t.blocks]
    alone = {n for n in kept if len(tasks[n].have) == 1}
    place = {name: i for i, name in enumerate(names)}
    factors = {
        n: ours[n].template.border_factor(ours[n].touched)
        for n in given + kept if n not in alone
    }  # fmt: skip
    found = dict[str, Dense]()  # (2, b, b) of what several ranks have

    def formed(some: list[str]) -> Iterator[tuple[int, Condensed]]:
        for n in some:
            kind, touched = ours[n].template, ours[n].touched
            if n in alone:
                yield place[n], kind.condense(touched)
            else:
                found[n] = np.stack(kind.blocks(touched, factors.pop(n)))

    before = blocks_before_exchange(tasks, me)
    yield from formed(kept[:before])
    came = _exchange_blocks(
        ranks,
        [(tasks[n].blocks, np.ascontiguousarray(factors.pop(n).T)) for n in given],
        [(tasks[n].factor, (border[n], border[n])) for n in taken],
    )
    factors |= {n: L.T for n, L in zip(taken, came, strict=True)}
    yield from formed(kept[before:] + taken)
    others = [n for n, t in tasks.items() if n in ours and t.blocks != me]
    to = [(r, n) for n in tasks if n in found for r in tasks[n].have if r != me]
    came = _exchange_blocks(
        ranks,
        [(r, found[n]) for r, n in to],
        [(tasks[n].blocks, (2, *2 * (ours[n].touched.size,))) for n in others],
    )
    found |= dict(zip(others, came, strict=True))
    del came
    yield from ((place[n], Condensed(*found.pop(n))) for n in list(found))


def _exchange_blocks(
    ranks: Ranks,
    out: Sequence[tuple[int, Dense]],
    coming: Sequence[tuple[int, tuple[int, ...]]],
) -> list[Dense]:
    """Send arrays to ranks, and take arrays of known shapes from ranks."""
    found = [np.empty(shape) for _, shape in coming]
    posted = [
        ranks.comm.Irecv(array, source=rank)
        for array, (rank, _) in zip(found, coming, strict=True)
    ]
    posted += [ranks.comm.Isend(array, dest=rank) for rank, array in out]
    with ranks.clocked("waiting"):
        for request in posted:
            request.Wait()
    return found


def _name(group: Group) -> str:
    """Name what the blocks of a group depend on."""
    return f"{group.template.name} {hex_digest((group.touched.tobytes(),), 32)}"


def local_share(qp: QP, operator: DualOperator, ranks: Ranks) -> Share:
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
    at = build_halo(ranks, touched_here, reach, parts.owner[touched_here])
    mine = np.flatnonzero(parts.rank == ranks.rank)
    classes, kind = np.unique(domains.class_of[mine], return_inverse=True)
    columns = np.concatenate(
        [np.arange(domains.start[s], domains.start[s + 1]) for s in mine]
    )
    local = DualOperator(
        csr_array(B[at.rows][:, columns]),
        Subdomains(
            tuple(domains.classes[k].without_factor(str(k)) for k in classes), kind
        ),
        operator.explicit[classes],
        operator.equalities,
        partial(condense_over_ranks, ranks=ranks),
    )
    own = at.rows[at.owned]
    q, lb, ub = (distributed(v[own], ranks) for v in (qp.q, qp.lb, qp.ub))
    part = QP(
        P=RankOperator(local, at),
        q=q, lb=lb, ub=ub, G=no_rows(own.size), h=np.zeros(0),
        A=DistributedColumns(csr_array(qp.A[:, own]), ranks), b=np.array(qp.b),
    )  # fmt: skip

    return Share(part, gather_on_rank_0(at, qp.q.size))


def gather_on_rank_0(at: Halo, count: int) -> Callable[[Solution], Solution | None]:
    """Make what gathers a solution of so many multipliers on rank 0."""

    def whole(s: Solution) -> Solution | None:
        told = at.rows[at.owned], np.asarray(s.x), np.asarray(s.z_box)
        found = at.ranks.comm.gather(told)
        if found is None:
            return None
        x, z_box = np.empty(count), np.empty(count)
        for rows, x_part, z_part in found:
            x[rows], z_box[rows] = x_part, z_part
        return replace(s, x=x, z_box=z_box)

    return whole
