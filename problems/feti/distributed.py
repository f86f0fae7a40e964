"""The dual of decomposed bodies, distributed over MPI ranks.

Each rank p stores some of the subdomains, with their stiffness K_p and their columns
B_p of B. A rank stores the entries of vectors of multipliers for the rows of B that it
*owns*. A row of B that touches subdomains of several ranks is owned by one of these
ranks, chosen round-robin, and is a *ghost* row on the others. Before a product with
B_pᵀ, the owner of a row sends the multiplier of the row to the ranks where it is a
ghost row. After the product with B_p, these ranks send their contributions back to the
owner, so that the result is

    F λ = Σ_p B_p K_p⁺ B_pᵀ λ

In these products, no rank stores a vector of global size: each rank stores only the
columns of B for its subdomains, and the entries of vectors for the rows that touch
these subdomains. Graph partitioning (METIS) distributes the subdomains so that the work
is balanced and few rows are shared. If a class of congruent subdomains occurs on
several ranks, one of these ranks computes the explicit blocks of the class and sends
them to the others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from mortarbench.harness import (
    QP,
    Box,
    Discs,
    InputError,
    Solution,
    Vector,
    no_rows,
)
from mortarbench.harness.digest import hex_digest
from mortarbench.harness.distributed.discs import DistributedDiscs
from mortarbench.harness.distributed.sparse import CompressedRows, LinearMap
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
    COUPLING_ROUNDING,
    DualOperator,
    Group,
    decouple_contact,
    gram_inverse,
    scaled_columns,
    touched_components,
)
from mortarbench.problems.feti.subdomain_classes import (
    Condensed,
    Dense,
    Subdomains,
)

#: estimated fraction of the work on a class that remains after the factorisation of its
#: stiffness matrix; used only to balance the load of the ranks
BLOCK_SHARE = 0.25


class Partition(NamedTuple):
    """Partition data replicated on every rank."""

    rank: NDArray[np.int64]  #: (S,) rank of each subdomain
    reach: csr_array  #: (m, ranks) nonzero where a row touches subdomains of a rank
    owner: NDArray[np.int64]  #: (m,) rank that owns each row


def partition(
    B: csr_array,
    domains: Subdomains,
    ranks: int,
    discs: Sequence[Discs] = (),
) -> Partition:
    """Distribute the subdomains and the rows of B (m, N) over ranks.

    discs : sets of friction multipliers; a rank that touches one row of a disc counts
        as touching all rows of this disc

    Raises
    ------
    InputError
        If there are fewer subdomains than ranks.

    """
    S = domains.class_of.size
    rows = np.repeat(np.arange(B.shape[0]), np.diff(B.indptr))
    subdomain = np.searchsorted(domains.start, B.indices, side="right") - 1
    ones = np.ones(rows.size, dtype=np.int32)
    touches = csr_array((ones, (rows, subdomain)), shape=(B.shape[0], S))
    group = np.arange(B.shape[0])
    for one in discs:
        group[one.index] = one.index[:, :1]
    members = group, np.arange(group.size)
    same = csr_array((np.ones(group.size, dtype=np.int32), members))
    touches = csr_array(same.T @ (same @ touches))
    touches.data[:] = 1
    work, size = _work(B, domains), np.diff(domains.start)
    graph = csr_array(touches.T @ touches)
    rank = balanced_partition(graph, work, size, ranks)
    of_rank = csr_array((ones[:S], (np.arange(S), rank)), shape=(S, ranks))
    reach = csr_array(touches @ of_rank)
    reach.sort_indices()
    reach.data[:] = 1
    return Partition(rank, reach, assign_owners(group, reach))


def assign_owners(group: Nodes, reach: csr_array) -> NDArray[np.int64]:
    """Return the owner (t,) of each row, a touched rank that is chosen round-robin.

    group : (t,) for a row of a disc, the number of the first row of this disc; for any
        other row, its own number. All rows of a disc have the same owner, because they
        touch the same ranks
    reach : (t, ranks) nonzero where a row touches a rank, with ascending column indices
    """
    turn = group % np.diff(reach.indptr)
    return np.asarray(reach.indices[reach.indptr[:-1] + turn], dtype=np.int64)


def _work(B: csr_array, domains: Subdomains) -> NDArray[np.int64]:
    """Return the work (S,) of a product with F: the number of entries of each block."""
    sizes = np.array([part.size for part in touched_components(B, domains)])
    return (sizes**2)[domains.class_of]


#: work (or sizes) of the ranks count as balanced if the ratio of the maximum to the
#: mean is at most this value
MAX_IMBALANCE = 1.1
METIS_SEEDS = 12  #: number of random seeds tried for METIS
SIZE_WEIGHTS = (0.25, 0.5, 1.0)  #: trial weights of the size relative to the work


def balanced_partition(
    graph: csr_array,
    work: NDArray[np.int64],
    size: NDArray[np.int64],
    ranks: int,
) -> NDArray[np.int64]:
    """Partition S subdomains over ranks, balancing both work and size.

    METIS balances a single weight. The work is tried first. On graded half discs, where
    a few subdomains account for most of the work, the sizes are then out of balance. In
    such cases, several combinations of work and size are tried. A trial replaces the
    best partition so far if its work is balanced and its sizes are better balanced.

    Parameters
    ----------
    graph : (S, S) number of rows shared by each pair of subdomains
    work, size : (S,) work and size of each subdomain, each in an arbitrary unit

    Returns
    -------
    rank of each subdomain, (S,)

    Raises
    ------
    InputError
        If there are fewer subdomains than ranks.

    """
    if work.size < ranks:
        raise InputError(
            f"{ranks} ranks for {work.size} subdomain{'s' * (work.size > 1)}; expected "
            "at most one rank per subdomain"
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
    """Partition a graph with vertex weights (S,); return the rank of each vertex."""
    from pymetis import CSRAdjacency, Options, part_graph  # unused on a single rank

    _, labels = part_graph(
        ranks,
        CSRAdjacency(graph.indptr, graph.indices),
        eweights=graph.data,
        vweights=weight,
        recursive=True,
        options=Options() if seed is None else Options(seed=seed),
    )
    rank = np.array(labels, dtype=np.int64)
    # with few subdomains METIS may leave a rank empty
    for idle in np.setdiff1d(np.arange(ranks), rank):
        largest = np.bincount(rank, minlength=ranks).argmax()
        rank[np.flatnonzero(rank == largest)[-1]] = idle
    return rank


@dataclass(frozen=True, eq=False)
class Halo:
    """Rows of B that touch a rank: its owned rows, and ghost rows that others own.

    A message from one rank to another contains the values of the rows that one of them
    owns and the other stores as ghost rows, sorted by row.
    """

    ranks: Ranks
    rows: Nodes  #: (t,) all rows that this rank touches or owns, ascending
    owned: Nodes  #: (o,) indices of the owned rows in `rows`
    #: (l,) indices in `owned` of the rows that are ghost rows on other ranks, ordered
    #: by these ranks; a row occurs once for each of them
    exported: Nodes
    #: (t − o,) indices in `rows` of the ghost rows, ordered by their owners
    ghosts: Nodes
    #: (ranks,) number of values sent to each rank by `start_gather`, l in total
    export_counts: NDArray[np.int64]
    #: (ranks,) number of values received from each rank by `start_gather`
    ghost_counts: NDArray[np.int64]

    @property
    def is_shared(self) -> NDArray[np.bool_]:
        """Mask (t,) of the rows that several ranks store."""
        shared = np.zeros(self.rows.size, dtype=bool)
        shared[self.ghosts] = shared[self.owned[self.exported]] = True
        return shared

    def start_gather(self, x: Vector) -> Callable[[], Vector]:
        """Send the values x (o,) of owned rows to the ranks where they are ghosts.

        Returns
        -------
        function that waits for the values (t − o,) of the ghost rows of this rank and
        returns them
        """
        with self.ranks.clocked("exchange"):
            return self.ranks.exchange(
                x[self.exported], self.export_counts, self.ghost_counts
            )

    def start_accumulate(self, y: Vector) -> Callable[[Vector], Vector]:
        """Send contributions to ghost rows (t − o,) to their owners.

        Returns
        -------
        function of the values (o,) of the owned rows; it waits for the contributions of
        other ranks, adds them to these values in place, and returns the sum

        """
        with self.ranks.clocked("exchange"):
            arrived = self.ranks.exchange(y, self.ghost_counts, self.export_counts)

        def added(own: Vector) -> Vector:
            with self.ranks.clocked("exchange"):
                np.add.at(own, self.exported, arrived())
            return own

        return added

    def gather(self, x: Vector) -> Vector:
        """Return the values of all touched rows (t,) from those of owned rows (o,)."""
        arrived, values = self.start_gather(x), np.empty(self.rows.size)
        values[self.owned] = x
        values[self.ghosts] = arrived()
        return values

    def accumulate(self, y: Vector) -> Vector:
        """Sum the contributions (t,) of all ranks; return the owned entries (o,)."""
        return self.start_accumulate(y[self.ghosts])(y[self.owned])


def build_halo(
    ranks: Ranks, rows: Nodes, reach: csr_array, owner: NDArray[np.int64]
) -> Halo:
    """Return the owned rows and ghost rows of this rank.

    Parameters
    ----------
    rows : (t,) all rows that the local subdomains touch, ascending
    reach : (t, ranks) nonzero where a rank touches a row
    owner : (t,) rank that owns each row

    """
    me, touched_by = ranks.rank, reach.tocsc()
    owned = np.flatnonzero(owner == me)
    exported, ghosts = [], []
    for r in range(ranks.size):
        theirs = touched_by.indices[touched_by.indptr[r] : touched_by.indptr[r + 1]]
        needed = np.sort(theirs[(owner[theirs] == me) & (r != me)])
        exported.append(np.searchsorted(owned, needed))
        ghosts.append(np.flatnonzero((owner == r) & (r != me)))
    return Halo(
        ranks=ranks,
        rows=rows,
        owned=owned,
        exported=np.concatenate(exported),
        ghosts=np.concatenate(ghosts),
        export_counts=np.array([*map(len, exported)]),
        ghost_counts=np.array([*map(len, ghosts)]),
    )


@dataclass(frozen=True, eq=False)
class RowsOverRanks:
    """Local rows of B for the products Bᵀx and By with distributed vectors.

    M is the number of columns of the local rows. Messages are posted first and
    completed after the products with owned rows, so that communication and computation
    overlap.
    """

    halo: Halo
    owned: CompressedRows  #: (o, M) owned rows
    transposed: CompressedRows  #: (M, o) transpose of `owned`
    ghosts: CompressedRows  #: (t − o, M) ghost rows
    #: (k, t − o) nonzero rows of the transpose of `ghosts`
    ghosts_transposed: CompressedRows
    reached: Nodes  #: (k,) indices of these nonzero rows in the transpose

    @classmethod
    def of(cls, B: csr_array, at: Halo) -> RowsOverRanks:
        """Split the rows B (t, M) that a rank touches into owned and ghost rows."""
        owned, ghosts = csr_array(B[at.owned]), csr_array(B[at.ghosts])
        columns = np.unique(ghosts.indices)
        return cls(
            at,
            CompressedRows(owned),
            CompressedRows(csr_array(owned.T)),
            CompressedRows(ghosts),
            CompressedRows(csr_array(ghosts[:, columns].T)),
            columns,
        )

    def transposed_times(self, x: Vector) -> Vector:
        """Return Bᵀx (M,) on this rank, given the owned slice of x, (o,)."""
        arrived = self.halo.start_gather(x)
        with self.halo.ranks.clocked("products"):
            X = self.transposed @ x
            X[self.reached] += self.ghosts_transposed @ arrived()
        return X

    def times(self, X: Vector) -> Vector:
        """Return the owned slice (o,) of Σ_p B_p X_p, given X_p (M,) of this rank p."""
        with self.halo.ranks.clocked("products"):
            added = self.halo.start_accumulate(self.ghosts @ X)
            return added(self.owned @ X)


@dataclass(frozen=True, eq=False)
class RankOperator:
    """F distributed over ranks; acts on the owned slices of vectors of multipliers."""

    local: DualOperator  #: contribution of the local subdomains, on all touched rows
    halo: Halo

    @property
    def semidefinite(self) -> bool:
        """True if Fλ = 0 for some λ ≠ 0; equal on all ranks."""
        return self.local.semidefinite

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (o, o) of the operator on owned slices."""
        return (self.halo.owned.size,) * 2

    def __call__(self, x: Dense) -> DistributedVector:
        """Return Fx."""
        y = self._congruence(self._rows, self.local.inverse_map, np.asarray(x))
        return distributed(y, self.halo.ranks)

    def __matmul__(self, x: Dense) -> DistributedVector:
        return self(x)

    def diagonal(self) -> DistributedVector:
        """Return the diagonal of F."""
        return distributed(self.halo.accumulate(self.local.diagonal()), self.halo.ranks)

    @cached_property
    def _rows(self) -> RowsOverRanks:
        return RowsOverRanks.of(self.local.packed.B, self.halo)

    def _congruence(self, rows: RowsOverRanks, blocks: LinearMap, x: Vector) -> Vector:
        X = rows.transposed_times(x)
        with self.halo.ranks.clocked("products"):
            Y = blocks(X)
        return rows.times(Y)

    def onto_rows(self) -> Product:
        """Return the orthogonal projector onto the range of B,  x ↦ BBᵀ(BBᵀ)⁺x.

        It is exact for B without contact rows; see `_gram_inverse`.
        """
        packed = self.local.packed
        solve = self._gram_inverse(csr_array(packed.B @ packed.BT))
        return lambda x: self._rows.times(self._rows.transposed_times(solve(x)))

    def preconditioner(self, kind: str, scaling: str) -> Product:
        """Return x ↦ B_D diag(D) B_Dᵀx; see `DualOperator.preconditioner`."""
        packed, ranks = self.local.packed, self.halo.ranks
        each, weights = self.local.weighted_blocks(kind, scaling)
        blocks = packed.block_diagonal(each)
        BW = scaled_columns(packed.B, weights)
        rows = RowsOverRanks.of(BW, self.halo)
        solve = self._gram_inverse(csr_array(BW @ packed.BT))

        def product(x: Dense) -> Dense:
            y = self._congruence(rows, blocks, solve(np.asarray(x)))
            return distributed(solve(y), ranks)

        return product

    def _gram_inverse(self, part: csr_array) -> Callable[[Dense], Dense]:
        """Return x ↦ (B W Bᵀ)⁺x on owned rows, with a diagonal matrix W of weights.

        The coupling of contact rows with equality rows is neglected. Most equality rows
        (all of them if gluing is orthonormal and the copies of each node have equal
        weights) are uncoupled and only require a division. The system of all other rows
        is solved redundantly on all ranks.

        part : (t, t) contribution of the local subdomains to B W Bᵀ, which is the sum
            of the contributions of all ranks
        """
        halo, equalities = self.halo, self.local.equalities
        diagonal = halo.accumulate(part.diagonal())
        is_contact = halo.rows >= equalities
        coupled = np.isin(halo.rows, _coupled(part, halo, diagonal, ~is_contact))
        coupled |= is_contact
        solves = []
        if halo.ranks.extreme(float(coupled.any()), np.max):
            solves.append(_replicated_inverse(part, coupled, halo, equalities))

        def solve(x: Dense) -> Dense:
            x = np.asarray(x)
            y = x / diagonal
            for owned, inverse in solves:
                y[owned] = inverse(x[owned])
            return np.asarray(y)

        return solve


def _coupled(
    part: csr_array, halo: Halo, diagonal: Vector, selected: NDArray[np.bool_]
) -> Nodes:
    """Return the numbers of the selected rows that are coupled to each other.

    Two rows are coupled if their entry in the sum of `part` over all ranks is nonzero.
    Entries below `COUPLING_ROUNDING`, relative to the diagonal, count as zero.
    """
    row, column = part.tocoo().coords
    beside = np.flatnonzero((row != column) & selected[row] & selected[column])
    row, column = row[beside], column[beside]
    size = np.sqrt(halo.gather(diagonal))
    share = part.data[beside] / (size[row] * size[column])
    between = halo.is_shared[row] & halo.is_shared[column]
    inside = halo.rows[row[~between & (np.abs(share) > COUPLING_ROUNDING)]]
    # an entry that couples two shared rows may be a sum of contributions of several
    # ranks
    between &= share != 0
    message = [v[between] for v in (halo.rows[row], halo.rows[column], share)]
    rows, columns, shares = map(
        np.concatenate, zip(*halo.ranks.comm.allgather(message), strict=True)
    )
    pairs, place = np.unique(np.stack([rows, columns]), axis=1, return_inverse=True)
    total = np.abs(np.bincount(place.ravel(), shares, pairs.shape[1]))
    return np.concatenate([inside, pairs[0, total > COUPLING_ROUNDING]])


def _replicated_inverse(
    part: csr_array, selected: NDArray[np.bool_], halo: Halo, equalities: int
) -> tuple[Nodes, Callable[[Dense], Dense]]:
    """Invert B W Bᵀ on selected rows, redundantly on every rank.

    selected : (t,) mask of the touched rows

    Returns
    -------
    indices of the selected rows among the owned rows, and the inverse on these rows

    """
    ranks, entries = halo.ranks, part.tocoo()
    all_rows = np.unique(np.concatenate(ranks.comm.allgather(halo.rows[selected])))
    message = halo.rows[entries.row], halo.rows[entries.col], entries.data
    of_known = np.isin(message[0], all_rows) & np.isin(message[1], all_rows)
    row, column, data = map(
        np.concatenate,
        zip(*ranks.comm.allgather([t[of_known] for t in message]), strict=True),
    )
    places = np.searchsorted(all_rows, row), np.searchsorted(all_rows, column)
    gram = csr_array((data, places), shape=(all_rows.size,) * 2)
    first = int(np.searchsorted(all_rows, equalities))
    solve = gram_inverse(decouple_contact(gram, first), first)
    _, place, owned = np.intersect1d(
        all_rows, halo.rows[halo.owned], return_indices=True
    )

    def inverse(x: Dense) -> Dense:
        whole = np.zeros(all_rows.size)
        whole[place] = x
        return np.asarray(solve(ranks.total(whole))[place])

    return owned, inverse


class Assignment(NamedTuple):
    """Ranks that factorise and condense a class of congruent subdomains."""

    work: int  #: estimated work in an arbitrary unit, which is the same for all classes
    ranks: list[int]  #: ranks with subdomains of the class
    factor_rank: int  #: rank that factorises the stiffness matrix
    block_rank: int  #: rank that computes the blocks and sends them to other ranks


def assign_factorisations(work: Sequence[Mapping[str, int]]) -> dict[str, Assignment]:
    """Assign one rank to the factorisation, and one to the blocks, of each class.

    In order of decreasing work, each class is assigned to the rank with the smallest
    load so far, among the ranks with subdomains of the class (longest processing time
    first, Graham 1969). Then the computation of blocks, which follows the
    factorisation, is reassigned from ranks with high loads to ranks with low loads.

    work : for each rank, a map from the names of its classes to their work
    """
    have: dict[str, list[int]] = {}
    for rank, one in enumerate(work):
        for name in one:
            have.setdefault(name, []).append(rank)
    size = {name: work[ranks[0]][name] for name, ranks in have.items()}
    loads, tasks = [0.0] * len(work), dict[str, Assignment]()
    for name in sorted(have, key=lambda name: (-size[name], name)):
        rank = min(have[name], key=loads.__getitem__)
        loads[rank] += size[name]
        tasks[name] = Assignment(size[name], have[name], rank, rank)
    for name, task in tasks.items():
        rank, part = min(task.ranks, key=loads.__getitem__), BLOCK_SHARE * task.work
        # move only if the larger of the two loads decreases by `part`
        if loads[rank] + 2 * part <= loads[task.factor_rank]:
            loads[rank] += part
            loads[task.factor_rank] -= part
            tasks[name] = task._replace(block_rank=rank)
    return tasks


def blocks_before_exchange(tasks: Mapping[str, Assignment], rank: int) -> int:
    """Return the number of blocks that a rank computes before factors are exchanged.

    These blocks require only factors of this rank. They are computed while slower ranks
    are still factorising. If no factors are exchanged, the result is the total number
    of blocks of the rank.
    """
    factors: dict[int, float] = {}
    for task in tasks.values():
        if len(task.ranks) > 1:
            factorisation = (1 - BLOCK_SHARE) * task.work
            factors[task.factor_rank] = (
                factors.get(task.factor_rank, 0.0) + factorisation
            )
    factors_given = [
        factors[t.factor_rank] for t in tasks.values() if t.factor_rank != t.block_rank
    ]
    time = max(factors_given, default=np.inf) - factors.get(rank, 0.0)
    blocks = [t for t in tasks.values() if t.factor_rank == t.block_rank == rank]
    durations = [t.work * (BLOCK_SHARE if len(t.ranks) > 1 else 1.0) for t in blocks]
    return int(np.count_nonzero(np.cumsum(durations) - np.array(durations) / 2 < time))


def condense_over_ranks(
    groups: Sequence[Group], ranks: Ranks
) -> Iterator[tuple[int, Condensed]]:
    """Yield the blocks of all groups; equal groups are condensed on one rank only.

    For classes that occur on several ranks, each rank first computes the factors
    assigned to it, then some blocks while slower ranks are still factorising. Next, the
    ranks exchange factors, compute the remaining blocks, and exchange the blocks.
    Blocks of a class that occurs on this rank alone are yielded immediately and not
    stored.
    """
    me, names = ranks.rank, [_name(group) for group in groups]
    groups_by_name = dict(zip(names, groups, strict=True))
    border = {
        name: g.template.border(g.touched).size for name, g in groups_by_name.items()
    }
    work = {name: groups_by_name[name].template.K.nnz * h for name, h in border.items()}
    tasks = assign_factorisations(ranks.comm.allgather(work))
    sent = [n for n, t in tasks.items() if t.factor_rank == me != t.block_rank]
    received = [n for n, t in tasks.items() if t.factor_rank != me == t.block_rank]
    local = [n for n, t in tasks.items() if t.factor_rank == me == t.block_rank]
    exclusive = {n for n in local if len(tasks[n].ranks) == 1}
    positions = dict[str, list[int]]()
    for i, name in enumerate(names):  # two bodies may have equal subdomains
        positions.setdefault(name, []).append(i)
    factors = {
        n: groups_by_name[n].template.border_factor(groups_by_name[n].touched)
        for n in sent + local
        if n not in exclusive
    }
    blocks = dict[str, Dense]()  # (2, b, b) blocks of classes on several ranks

    def formed(some: list[str]) -> Iterator[tuple[int, Condensed]]:
        for n in some:
            kind, touched = groups_by_name[n].template, groups_by_name[n].touched
            if n in exclusive:
                condensed = kind.condense(touched)
                yield from ((i, condensed) for i in positions[n])
            else:
                blocks[n] = np.stack(kind.blocks(touched, factors.pop(n)))

    before = blocks_before_exchange(tasks, me)
    yield from formed(local[:before])
    arrays = _exchange_blocks(
        ranks,
        [(tasks[n].block_rank, np.ascontiguousarray(factors.pop(n).T)) for n in sent],
        [(tasks[n].factor_rank, (border[n], border[n])) for n in received],
    )
    factors |= {n: L.T for n, L in zip(received, arrays, strict=True)}
    yield from formed(local[before:] + received)
    foreign = [
        n for n, t in tasks.items() if n in groups_by_name and t.block_rank != me
    ]
    destinations = [
        (r, n) for n in tasks if n in blocks for r in tasks[n].ranks if r != me
    ]
    arrays = _exchange_blocks(
        ranks,
        [(r, blocks[n]) for r, n in destinations],
        [
            (tasks[n].block_rank, (2, *2 * (groups_by_name[n].touched.size,)))
            for n in foreign
        ],
    )
    blocks |= dict(zip(foreign, arrays, strict=True))
    del arrays  # so that each full block is released once the caller has packed it
    for n in list(blocks):
        condensed = Condensed(*blocks.pop(n))
        yield from ((i, condensed) for i in positions[n])


def _exchange_blocks(
    ranks: Ranks,
    out: Sequence[tuple[int, Dense]],
    coming: Sequence[tuple[int, tuple[int, ...]]],
) -> list[Dense]:
    """Send each array of `out` to its rank; receive arrays with shapes `coming`."""
    arrays = [np.empty(shape) for _, shape in coming]
    requests = [
        ranks.comm.Irecv(array, source=rank)
        for array, (rank, _) in zip(arrays, coming, strict=True)
    ]
    requests += [ranks.comm.Isend(array, dest=rank) for rank, array in out]
    with ranks.clocked("waiting"):
        for request in requests:
            request.Wait()
    return arrays


def _name(group: Group) -> str:
    """Return a digest of all data that determine the blocks of a group."""
    return f"{group.template.name} {hex_digest((group.touched.tobytes(),), 32)}"


def local_share(qp: QP, operator: DualOperator, ranks: Ranks) -> Share:
    """Return the part of a dual QP of decomposed bodies that this rank stores.

    Raises
    ------
    InputError
        If there are fewer subdomains than ranks.

    """
    B, domains = operator.B, operator.domains
    discs = tuple(one for one in qp.sets if isinstance(one, Discs))
    partitioned = partition(B, domains, ranks.size, discs)
    touched = np.flatnonzero(partitioned.reach[:, [ranks.rank]].toarray())
    reach = csr_array(partitioned.reach[touched])
    halo = build_halo(ranks, touched, reach, partitioned.owner[touched])
    subdomains = np.flatnonzero(partitioned.rank == ranks.rank)
    classes, class_of = np.unique(domains.class_of[subdomains], return_inverse=True)
    columns = np.concatenate(
        [np.arange(domains.start[s], domains.start[s + 1]) for s in subdomains]
    )
    local_domains = Subdomains(
        tuple(domains.classes[k].without_factor(str(k)) for k in classes), class_of
    )
    local = DualOperator(
        csr_array(B[halo.rows][:, columns]),
        local_domains,
        operator.explicit[classes],
        operator.equalities,
        partial(condense_over_ranks, ranks=ranks),
        operator.redundant,
    )
    owned = halo.rows[halo.owned]
    q, lb, ub = (distributed(v[owned], ranks) for v in (qp.q, qp.lb, qp.ub))
    qp_local = QP(
        P=RankOperator(local, halo),
        q=q,
        sets=(Box(lb, ub), *(DistributedDiscs.of(one, owned, ranks) for one in discs)),
        G=DistributedColumns(no_rows(owned.size), ranks),
        h=np.zeros(0),
        A=DistributedColumns(csr_array(qp.A[:, owned]), ranks),
        b=np.array(qp.b),
    )

    return Share(qp_local, gather_on_rank_0(halo, qp.q.size))


def gather_on_rank_0(halo: Halo, count: int) -> Callable[[Solution], Solution | None]:
    """Return a function that gathers a solution of `count` multipliers on rank 0.

    On all other ranks, the returned function returns None.
    """

    def whole(s: Solution) -> Solution | None:
        message = halo.rows[halo.owned], np.asarray(s.x), np.asarray(s.z_box)
        messages = halo.ranks.comm.gather(message)
        if messages is None:
            return None
        x, z_box = np.empty(count), np.empty(count)
        for rows, x_part, z_part in messages:
            x[rows], z_box[rows] = x_part, z_part
        return replace(s, x=x, z_box=z_box)

    return whole
