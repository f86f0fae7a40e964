"""Bodies in subdomains, of which a process has some: what it makes without the whole.

Each rank builds its own subdomains only: their meshes, stiffness, loads and the rows of
B that touch them. A single process has all of them. What is numbered in the whole
follows from what all ranks know of the subdivision (`problems.feti.subdivision`):
tables as long as the sides of structured grids, or a list of the nodes of interfaces.
Beyond that, a rank has a few numbers for each subdomain of the whole, as a coarse
problem has.

Rows of B, in turn, are those of supports, of gluing and of contact. Supports are rows
of every copy of a node. Of a free component, m copies are glued by one of

* ``orthonormal``: m − 1 orthonormal rows that are orthogonal to (1, …, 1),
* ``chain``: m − 1 rows  v_p − v_q = 0  of copies that follow one another,
* ``redundant``: all m(m − 1)/2 rows  v_p − v_q = 0.

Contact rows act on the average of the copies, which is the same for all of them once
they are glued; so a contact row is there once, wherever subdomains meet, and orthogonal
to all gluing.

Rows of a body are scaled by √E of that body, contact rows by that of the softest body
they touch, after they are normalised: then F does not depend on E where each body is
homogeneous. A factor of E may follow the shape of cells (`problems.feti.structured`).
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, combinations
from operator import itemgetter
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, coo_array, csr_array

from mortarbench.harness import Vector
from mortarbench.harness.distributed.vectors import Ranks, single_process
from mortarbench.problems.fem.mesh import Nodes
from mortarbench.problems.feti.distributed import balanced
from mortarbench.problems.feti.subdivision import (
    Integers,
    Points,
    Subdivision,
    TornNodes,
)
from mortarbench.problems.feti.tearing import ALIKE, Part, classify, images, spread_of
from mortarbench.problems.feti.torn import Kind, Subdomains, Torn

Weights = Callable[[int], NDArray[np.float64]]


def _orthonormal(m: int) -> NDArray[np.float64]:
    return np.asarray(np.linalg.qr(np.ones((m, 1)), mode="complete")[0][:, 1:].T)


def _chain(m: int) -> NDArray[np.float64]:
    return np.eye(m - 1, m) - np.eye(m - 1, m, 1)


def _redundant(m: int) -> NDArray[np.float64]:
    p, q = np.array(list(combinations(range(m), 2))).T
    return np.asarray(np.eye(m)[p] - np.eye(m)[q])


#: the weights (rows, m) of m copies of a component
GLUE: Mapping[str, Weights] = MappingProxyType(
    {"orthonormal": _orthonormal, "chain": _chain, "redundant": _redundant}
)


class Contact(NamedTuple):
    """Rows of contact, then of friction, of the whole; every rank has them."""

    rows: csr_array  #: (m_I, n) columns are components of the whole
    c: Vector  #: (m_I,)
    bound: Vector  #: (k,) of the last rows, those of friction with a given bound


@dataclass(frozen=True, eq=False, kw_only=True)
class ProblemInParts:
    """A contact problem on bodies in subdomains, without dimensions, nothing made."""

    layout: Subdivision  #: of the bodies into subdomains, S in all
    components: int  #: of a node: 2 of displacements, 1 of heights
    material: Integers  #: (S,) of each subdomain
    kind: Callable[[Part], Kind]  #: assembles a floating subdomain
    E: Vector  #: (bodies,) stiffness that rows are scaled by
    names: tuple[str, ...]  #: of the bodies
    #: makes of some subdomains the factor of E in rows that hold their torn nodes, as
    #: `problems.feti.structured.Layout.shaping`; None for 1
    shaping: Callable[[Nodes], Callable[[Nodes, Nodes, bool], Vector]] | None = None
    load: Callable[[Nodes], Vector]  #: components of the whole (k,) → forces (k,)
    held: Nodes  #: components of the whole that are zero, in the order of their rows
    #: whether these are eliminated, as in FETI-1, and have no rows: such subdomains do
    #: not float. Axes of subdomains are those of the whole there
    eliminated: bool = False
    contact: Contact
    glue: str  #: how copies are glued, one of `GLUE`

    @cached_property
    def contact_scale(self) -> Vector:
        """√(E/‖B_i‖²) of contact rows (m,), E of the softest body they touch."""
        rows, of = self.contact.rows, self.layout
        if not rows.shape[0]:
            return np.zeros(0)
        node = rows.indices // self.components
        E = self.E[of.body[of.holder(node)]]
        norm2 = np.add.reduceat(rows.data**2 / of.times(node), rows.indptr[:-1])
        softest = np.minimum.reduceat(E, rows.indptr[:-1])
        return np.asarray(np.sqrt(softest / norm2))


class Entries(NamedTuple):
    """Entries of B in own columns, and who else has entries in the same rows."""

    row: NDArray[np.int64]  #: (e,) of the whole
    column: NDArray[np.int64]  #: (e,) own torn unknowns
    value: Vector  #: (e,)
    reached: NDArray[np.int64]  #: (k, 2) pairs: a row of B, and a rank that touches it


@dataclass(frozen=True, eq=False)
class OwnSubdomains:
    """What one rank holds of torn bodies."""

    problem: ProblemInParts
    ranks: Ranks
    rank: NDArray[np.int64]  #: (S,) of each subdomain

    @cached_property
    def number(self) -> NDArray[np.int64]:
        """Its subdomains among all, (S_p,)."""
        return np.flatnonzero(self.rank == self.ranks.rank)

    @cached_property
    def nodes(self) -> TornNodes:
        """Its torn nodes, (M_p,)."""
        return self.problem.layout.torn_nodes(self.number)

    def torn(self, subdomain: Nodes, node: Nodes) -> Nodes:
        """Find own torn nodes (k,) by their subdomains and their nodes, (k,) both."""
        nodes, N = self.nodes, self.problem.layout.nodes
        known = nodes.subdomain * np.int64(N) + nodes.number
        return np.searchsorted(
            known, np.searchsorted(self.number, subdomain) * np.int64(N) + node
        )

    @property
    def component(self) -> Nodes:
        """Component of the whole that each torn unknown is a copy of, (N_p,)."""
        return self._component[self.kept]

    @property
    def _component(self) -> Nodes:
        """Of those that are eliminated, too."""
        return self._of_nodes(self.nodes.number)

    @cached_property
    def _distinct(self) -> tuple[Nodes, Nodes]:
        """Own nodes of the whole, and the place of each torn node among them."""
        return np.unique(self.nodes.number, return_inverse=True)

    @property
    def components(self) -> Nodes:
        """Components of the whole that it has, ascending, (n_p,)."""
        return self._of_nodes(self._distinct[0])

    @property
    def place(self) -> Nodes:
        """Place of each torn unknown among `components`, (N_p,)."""
        return self._of_nodes(self._distinct[1])[self.kept]

    def _of_nodes(self, node: Nodes) -> Nodes:
        """Return the components of some nodes, in turn."""
        d = self.problem.components
        return np.asarray((d * node[:, None] + np.arange(d)).ravel())

    @cached_property
    def spread(self) -> csr_array:
        """T (N_p, n_p): a block Qᵀ for each torn node, into the axes of subdomains."""
        d, place = self.problem.components, self._distinct[1]
        M, n = place.size, d * self._distinct[0].size
        if d == 1:
            T = csr_array((np.ones(M), place, np.arange(M + 1)), shape=(M, n))
        else:
            turn = self.rotation[self.nodes.subdomain].transpose(0, 2, 1)
            blocks = np.ascontiguousarray(turn), place, np.arange(M + 1)
            T = csr_array(bsr_array(blocks, shape=(d * M, n)))
            T.eliminate_zeros()
        return csr_array(T[self.kept]) if self.problem.eliminated else T

    @property
    def times(self) -> NDArray[np.int64]:
        """How many copies it has on all ranks together, (N_p,)."""
        times = np.repeat(self.nodes.times, self.problem.components)
        return np.asarray(times[self.kept])

    @cached_property
    def kept(self) -> slice | Nodes:
        """Choose the torn unknowns among all components of all torn nodes."""
        if not self.problem.eliminated:
            return slice(None)
        return np.flatnonzero(~np.isin(self._component, self.problem.held))

    @cached_property
    def _classified(self) -> tuple[Subdomains, NDArray[np.float64]]:
        """Sort subdomains into kinds, which have the same frame on all ranks."""
        problem, of = self.problem, self.problem.layout
        material = problem.material[self.number].tolist()
        keys = list(zip(of.keys(self.number), material, strict=True))
        points = of.points(self.number)
        first, kind, rotation = classify(keys, points)
        leader = self._leaders(
            [(int(self.number[s]), keys[s], points[s]) for s in first]
        )
        kinds = []
        for k, s in enumerate(first):
            number, at = leader[int(self.number[s])]
            if number != self.number[s]:
                mine = np.flatnonzero(kind == k)
                turn = images(np.stack([at, *(points[s] for s in mine.tolist())]))[1]
                rotation[mine] = turn[1:]
            cells = of.cells(int(self.number[s]))
            kinds.append(
                problem.kind(Part(at, cells, np.full(len(cells), material[s])))
            )
        return Subdomains(tuple(kinds), kind), rotation

    @property
    def floating(self) -> OwnSubdomains:
        """Hold the same with supports that are rows: all its subdomains float."""
        if not self.problem.eliminated:
            return self
        return self.posed(replace(self.problem, eliminated=False))

    @cached_property
    def domains(self) -> Subdomains:
        """Its subdomains on their own."""
        found = self._classified[0]
        if self.problem.eliminated:
            free = np.zeros(int(found.start[-1]), dtype=bool)
            free[self.kept] = True
            found = found.without(free)
        return found

    def _leaders(
        self, own: list[tuple[int, Hashable, Points]]
    ) -> dict[int, tuple[int, Points]]:
        """Find the first subdomain of each kind on all ranks, with its points.

        own : number, key and points of the first subdomains of own kinds, by whose
            numbers the leaders are told
        """
        comm = self.ranks.comm
        told = comm.allgather([(n, key, spread_of(at)) for n, key, at in own])
        elsewhere: dict[Hashable, list[float]] = {}
        for rank, theirs in enumerate(told):
            for _, key, spread in theirs if rank != self.ranks.rank else ():
                elsewhere.setdefault(key, []).append(spread)

        def may_be_elsewhere(key: Hashable, at: Points) -> bool:
            spread = np.array(elsewhere.get(key, []))
            off = 3 * ALIKE * np.sqrt(at.size)  # a little more than `classify` allows
            return bool((np.abs(spread - spread_of(at)) <= off * spread).any())

        asked = [one for one in own if may_be_elsewhere(*one[1:])]
        known = sorted(chain.from_iterable(comm.allgather(asked)), key=itemgetter(0))
        found = {number: (number, at) for number, _, at in own}
        if known:
            first, group, _ = classify(
                [key for _, key, _ in known], [at for *_, at in known]
            )
            for (number, *_), k in zip(known, group, strict=True):
                of, _, at = known[first[k]]
                found[number] = of, at
        return found

    @property
    def rotation(self) -> NDArray[np.float64]:
        """(S_p, 2, 2) turns each from the axes of its kind to those of the whole."""
        return self._classified[1]

    @cached_property
    def motions(self) -> NDArray[np.int64]:
        """First rigid motion of each subdomain of the whole, and how many: (S + 1,)."""
        modes = np.array([kind.R.shape[1] for kind in self.domains.kinds])
        found = np.zeros(self.rank.size, dtype=np.int64)
        own = self.number, modes[self.domains.kind]
        for number, count in self.ranks.comm.allgather(own):
            found[number] = count
        return np.concatenate([[0], np.cumsum(found)])

    @property
    def own_motions(self) -> NDArray[np.int64]:
        """Number its rigid motions among those of all subdomains."""
        first, end = self.motions[self.number], self.motions[self.number + 1]
        return np.concatenate([np.arange(*m) for m in zip(first, end, strict=True)])

    @property
    def coarse(self) -> int:
        """How many rigid motions all subdomains have together."""
        return int(self.motions[-1])

    @cached_property
    def f(self) -> Vector:
        """Its part of the load, (N_p,) in the axes of subdomains."""
        d = self.problem.components
        times = np.repeat(self.nodes.times, d)
        found = self.problem.load(self._component) / times
        if d > 1:
            loaded = np.flatnonzero(found.reshape(-1, d).any(axis=1))
            turn = self.rotation[self.nodes.subdomain[loaded]]
            shared = found.reshape(-1, d)
            shared[loaded] = np.einsum("mkq,mk->mq", turn, shared[loaded])
        return np.asarray(found[self.kept])

    def resultants(self, unknown: Nodes, value: Vector) -> csr_array:
        """Return Rᵀ of single forces (k, r), in the columns of the rigid motions.

        unknown, value : torn unknowns and the forces there, (k,)
        """
        domains = self.domains
        of = np.searchsorted(domains.start, unknown, side="right") - 1
        R = np.concatenate([kind.R.ravel() for kind in domains.kinds])
        first = np.cumsum([0, *(kind.R.size for kind in domains.kinds)])
        modes = np.diff(self.motions)[self.number[of]]
        at = first[domains.kind[of]] + modes * (unknown - domains.start[of])
        ends = np.concatenate([[0], np.cumsum(modes)])
        along = np.arange(ends[-1]) - np.repeat(ends[:-1], modes)
        entries = R[np.repeat(at, modes) + along] * np.repeat(value, modes)
        column = np.repeat(self.motions[self.number[of]], modes) + along
        return csr_array((entries, column, ends), shape=(unknown.size, self.coarse))

    @cached_property
    def _shape(self) -> Callable[[Nodes, Nodes, bool], Vector] | None:
        shaping = self.problem.shaping
        return None if shaping is None else shaping(self.number)

    def stiffness(self, node: Nodes, *, held: bool) -> Vector:
        """Return what rows of supports, or gluing, at torn nodes (k,) are scaled by."""
        body = self.problem.layout.body[self.number]
        E = self.problem.E[body[self.nodes.subdomain[node]]]
        if self._shape is None:
            return E
        return np.asarray(E * self._shape(node, self.nodes.number[node], held))

    @cached_property
    def rows(self) -> _Rows:
        """Its rows of B."""
        return _rows(self)

    @cached_property
    def torn_bodies(self) -> Torn:
        """Collect what its subdomains are; rows and components are those it has."""
        domains, rows = self.domains, self.rows
        return Torn(
            kinds=domains.kinds, kind=domains.kind, spread=self.spread, B=rows.B,
            c=rows.c, scale=self.problem.contact_scale, f=self.f,
            equalities=rows.equalities,
        )  # fmt: skip

    def bounded(self, bound: Vector) -> OwnSubdomains:
        """Hold the same with another bound (k,) of friction."""
        contact = self.problem.contact._replace(bound=bound)
        found = replace(self, problem=replace(self.problem, contact=contact))
        # nothing that is remembered here depends on the bound
        vars(found).update({**vars(self), "problem": found.problem})
        return found

    def posed(self, problem: ProblemInParts) -> OwnSubdomains:
        """Hold the same bodies with other loads, contact or supports that are rows."""
        found = replace(self, problem=problem)
        same = ("number", "nodes", "_classified", "_distinct")
        vars(found).update({k: v for k, v in vars(self).items() if k in same})
        return found


class _Rows(NamedTuple):
    """The rows of B that touch subdomains of this rank."""

    number: Nodes  #: (t,) ascending
    B: csr_array  #: (t, N_p)
    reach: csr_array  #: (t, ranks) which ranks touch them
    c: Vector  #: (t,)
    equalities: int  #: of all rows of the whole
    total: int  #: rows of the whole


def subdomains_of(problem: ProblemInParts, ranks: int) -> NDArray[np.int64]:
    """Give subdomains to ranks (S,), so that these do and hold alike much.

    Raises
    ------
    InputError
        Where there are fewer subdomains than ranks.

    """
    of, d = problem.layout, problem.components
    S = of.count
    if ranks == 1:
        return np.zeros(S, dtype=np.int64)
    one, other, nodes = of.sharing()
    graph = coo_array((d * nodes, (one, other)), shape=(S, S))
    touched = of.glued()
    node = np.unique(np.concatenate([problem.held, problem.contact.rows.indices]) // d)
    single = of.times(node) == 1
    touched = touched + np.bincount(of.holder(node[single]), minlength=S)
    entries = problem.contact.rows.tocoo()
    touches = csr_array(
        (
            np.ones(entries.nnz, dtype=np.int64),
            (entries.row, of.holder(entries.col // d)),
        ),
        shape=(entries.shape[0], S),
    )
    touches.data[:] = 1
    graph = csr_array(graph + graph.T) + csr_array(touches.T @ touches)
    return balanced(csr_array(graph), (d * touched) ** 2, of.sizes, ranks)


def _rows(own: OwnSubdomains) -> _Rows:
    """Fill the rows of B, in the order of supports, gluing and contact."""
    problem, ranks = own.problem, own.ranks
    parts = [_glued(own), _contact(own)]
    if not problem.eliminated:
        parts.insert(0, _supports(own))
    row, column, value = (np.concatenate(p) for p in list(zip(*parts, strict=True))[:3])
    number, place = np.unique(row, return_inverse=True)
    unknowns = problem.components * own.nodes.number.size
    B = csr_array((value, (place, column)), shape=(number.size, unknowns))
    if problem.eliminated:
        B = csr_array(B[:, own.kept])
    pairs = np.concatenate([part.reached for part in parts])
    pairs = pairs[np.isin(pairs[:, 0], number)]
    reach = csr_array(
        (
            np.ones(len(pairs), dtype=np.int32),
            (np.searchsorted(number, pairs[:, 0]), pairs[:, 1]),
        ),
        shape=(number.size, ranks.size),
    )
    reach.sort_indices()
    reach.data[:] = 1
    contact, scale = problem.contact, problem.contact_scale
    E = _equalities(problem)
    touching = number >= E
    c = np.zeros(number.size)
    c[touching] = (scale * contact.c)[number[touching] - E]
    return _Rows(number, B, reach, c, E, E + scale.size)


def _supports(own: OwnSubdomains) -> Entries:
    """One row for each copy of a component that is held, the last copy first."""
    problem, d = own.problem, own.problem.components
    node, k = np.divmod(problem.held, d)
    times = problem.layout.times(node)
    copies = _own_copies(own, node)
    of = copies.node[copies.mine]
    row = np.cumsum(times)[of] - 1 - copies.copy[copies.mine]
    value = np.sqrt(own.stiffness(copies.torn, held=True))
    reached = np.stack([row, np.full(row.size, own.ranks.rank)], axis=1)
    return Entries(*_turned(own, row, copies.torn, k[of], value), reached)


class _Copies(NamedTuple):
    """The copies of some nodes on all ranks, node by node."""

    node: NDArray[np.int64]  #: (k,) place in the list of nodes
    copy: NDArray[np.int64]  #: (k,) which one it is, from 0 on
    rank: NDArray[np.int64]  #: (k,) that holds it
    mine: NDArray[np.int64]  #: (l,) places of those that this rank holds
    torn: NDArray[np.int64]  #: (l,) which of the own torn nodes they are


def _own_copies(own: OwnSubdomains, node: Nodes) -> _Copies:
    """Find the copies of some nodes (k,), and which of them this rank holds."""
    of = own.problem.layout
    times = of.times(node)
    place = np.repeat(np.arange(times.size), times)
    copy = np.arange(place.size) - np.repeat(np.cumsum(times) - times, times)
    subdomain = of.holder(node[place], copy)
    rank = own.rank[subdomain]
    mine = np.flatnonzero(rank == own.ranks.rank)
    torn = own.torn(subdomain[mine], node[place[mine]])
    return _Copies(place, copy, rank, mine, torn)


def _glued(own: OwnSubdomains) -> Entries:
    """Rows of nodes with few copies first, and among these node by node."""
    problem, nodes, of = own.problem, own.nodes, own.problem.layout
    d = problem.components
    held = np.sort(problem.held)
    held_times = of.times(held // d)
    base = 0 if problem.eliminated else int(held_times.sum())
    none = np.zeros(0, dtype=np.int64)
    found = [Entries(none, none, np.zeros(0), none.reshape(0, 2))]
    for m, nodes_with in sorted(of.having.items()):
        W = GLUE[problem.glue](m)
        held_m = held[held_times == m]
        several = np.flatnonzero(nodes.times == m)
        number = nodes.number[several]
        before = of.before(number)
        ranks = np.stack([own.rank[of.holder(number, p)] for p in range(m)], axis=1)
        for k in range(d):
            component = d * number + k
            free = ~np.isin(component, held_m)
            first = d * before + k - np.searchsorted(held_m, component)
            for r, weights in enumerate(W):
                mine = np.flatnonzero(free & (weights[nodes.copy[several]] != 0))
                row = base + first[mine] * len(W) + r
                node = several[mine]
                value = weights[nodes.copy[node]]
                entries = _turned(
                    own, row, node, np.full(node.size, k),
                    np.sqrt(own.stiffness(node, held=False)) * value,
                )  # fmt: skip
                there = ranks[mine][:, weights != 0]
                reached = np.stack(
                    [np.repeat(row, there.shape[1]), there.ravel()], axis=1
                )
                found.append(Entries(*entries, reached))
        base += len(W) * (d * nodes_with - held_m.size)
    return Entries(*(np.concatenate(p) for p in zip(*found, strict=True)))


def _contact(own: OwnSubdomains) -> Entries:
    """Rows of contact and friction, which act on the average of copies."""
    problem, d = own.problem, own.problem.components
    entries = problem.contact.rows.tocoo()
    node, k = np.divmod(entries.col.astype(np.int64), d)
    copies = _own_copies(own, node)
    row = _equalities(problem) + entries.row.astype(np.int64)
    reached = np.stack([row[copies.node], copies.rank], axis=1)
    times = problem.layout.times(node)
    share = problem.contact_scale[entries.row] * entries.data / times
    of = copies.node[copies.mine]
    return Entries(*_turned(own, row[of], copies.torn, k[of], share[of]), reached)


def _turned(
    own: OwnSubdomains,
    row: NDArray[np.int64],
    node: NDArray[np.int64],
    k: NDArray[np.int64],
    value: Vector,
) -> tuple[NDArray[np.int64], NDArray[np.int64], Vector]:
    """Give entries (e,) in the axes of subdomains, of components k of nodes (j,)."""
    d = own.problem.components
    if d == 1:
        return row, node, value
    turn = own.rotation[own.nodes.subdomain[node], k]  # row k of Q: u_k = Σ Q_kq v_q
    kept = turn != 0
    column = d * node[:, None] + np.arange(d)
    rows = np.broadcast_to(row[:, None], kept.shape)
    return rows[kept], column[kept], (turn * value[:, None])[kept]


def _equalities(problem: ProblemInParts) -> int:
    """Count the rows of supports and gluing."""
    of, d = problem.layout, problem.components
    times = of.times(problem.held // d)
    glued = sum(
        len(GLUE[problem.glue](m)) * (d * count - int((times == m).sum()))
        for m, count in of.having.items()
    )
    return glued if problem.eliminated else int(times.sum()) + glued


def on_one_process(problem: ProblemInParts) -> OwnSubdomains:
    """Hold all subdomains on a single process."""
    every = np.zeros(problem.layout.count, dtype=np.int64)
    return OwnSubdomains(problem, single_process(), every)
