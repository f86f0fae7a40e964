"""The dual of bodies in subdomains, made by the ranks that hold it.

Each rank builds its own subdomains only: their meshes, stiffness, loads and the rows of
B that touch them. What is numbered in the whole follows from what all ranks know of the
subdivision (`problems.feti.subdivision`): tables as long as the sides of structured
grids, or a list of the nodes of interfaces. Contact rows are linearised from the sides
alone. Beyond that, a rank has a few numbers for each subdomain of the whole, as a
coarse problem has.

What ranks tell one another: of subdomains that may be alike, the points of one of each
kind, so that subdomains of one kind have one frame on all ranks; what they add to rows
that another one owns, of the right side q and of RᵀBᵀ; and their part of Rᵀf.

The QP is that of `problems.feti.gluing` and `problems.duality.torn_dual`, row by row.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import chain, pairwise
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, csr_array

from mortarbench.harness import (
    QP,
    Friction,
    InputError,
    ReferenceOverRanks,
    Solution,
    Vector,
    no_rows,
)
from mortarbench.harness.digest import hex_digest
from mortarbench.harness.distributed.vectors import (
    EMITTED,
    DistributedColumns,
    DistributedVector,
    Emitted,
    Ranks,
    Share,
    distributed,
)
from mortarbench.problems.contact.friction import iterate_of, settled
from mortarbench.problems.fem.mesh import Nodes
from mortarbench.problems.feti.distributed import (
    Halo,
    RankOperator,
    balanced,
    condensed_by_ranks,
    gathered_on_one,
    halo,
    owners,
)
from mortarbench.problems.feti.gluing import GLUE, without
from mortarbench.problems.feti.operators import (
    DualOperator,
    block_bytes,
    explicit_kinds,
    touched,
)
from mortarbench.problems.feti.own_bodies import (
    OwnSolution,
    Results,
    answers,
    contact_multipliers,
    own_solution,
)
from mortarbench.problems.feti.subdivision import (
    Integers,
    Points,
    Subdivision,
    TornNodes,
)
from mortarbench.problems.feti.tearing import ALIKE, Part, classify, images, spread_of
from mortarbench.problems.feti.torn import Kind, Subdomains


class Contact(NamedTuple):
    """Rows of contact, then of friction, of the whole; every rank has them."""

    rows: csr_array  #: (m_I, n) columns are components of the whole
    c: Vector  #: (m_I,)
    bound: Vector  #: (k,) of the last rows, those of friction with a given bound
    #: (m_I − k,) slave node of each row of contact; none where nobody asks
    place: Nodes = np.zeros(0, dtype=np.int64)


class FixedPoint(NamedTuple):
    """Coulomb's law as a sequence of given bounds (`problems.contact.friction`)."""

    friction: Friction  #: of the rows of friction, with the bound that it begins from
    step: int  #: number of the load step, which refusals name
    iterate: int  #: the problem that is emitted, 1, 2, …; 0: the last
    problems: int = 0  #: how many there are, once they are solved


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
    #: whether these are eliminated, as by `problems.feti.gluing.without_supports`, and
    #: have no rows; axes of subdomains are those of the whole there
    eliminated: bool = False
    contact: Contact
    coulomb: FixedPoint | None = None  #: where the bound is that of Coulomb's law
    glue: str  #: how copies are glued, one of `problems.feti.gluing.GLUE`
    #: what an answer means physically; None where only the whole tells
    results: Results | None = None
    #: what follows once this, and the fixed point of Coulomb's law, is solved, and is
    #: emitted in its place; None where this is
    then: Callable[[OwnSolution], ProblemInParts] | None = None

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
        d = self.problem.components
        return np.asarray((d * self.nodes.number[:, None] + np.arange(d)).ravel())

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
        found = replace(self, problem=replace(self.problem, eliminated=False))
        same = ("number", "nodes", "_classified")  # none depends on how it is held
        vars(found).update({name: getattr(self, name) for name in same})
        return found

    @cached_property
    def domains(self) -> Subdomains:
        """Its subdomains on their own."""
        found = self._classified[0]
        if self.problem.eliminated:
            free = np.zeros(int(found.start[-1]), dtype=bool)
            free[self.kept] = True
            found = without(found, free)
        kinds = [replace(kind, name=_name_of(kind)) for kind in found.kinds]
        return Subdomains(tuple(kinds), found.kind)

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

    def bounded(self, coulomb: FixedPoint) -> OwnSubdomains:
        """Hold the same with the bound of another problem of the fixed point."""
        contact = self.problem.contact._replace(bound=coulomb.friction.bound)
        problem = replace(self.problem, contact=contact, coulomb=coulomb)
        found = replace(self, problem=problem)
        # nothing that is remembered here depends on the bound
        vars(found).update({**vars(self), "problem": problem})
        return found


class _Rows(NamedTuple):
    """The rows of B that touch subdomains of this rank."""

    number: Nodes  #: (t,) ascending
    B: csr_array  #: (t, N_p)
    reach: csr_array  #: (t, ranks) which ranks touch them
    c: Vector  #: (t,)
    equalities: int  #: of all rows of the whole
    total: int  #: rows of the whole


def emitted(
    problem: ProblemInParts, ranks: Ranks, reference: ReferenceOverRanks
) -> Emitted:
    """Make this rank's share of the dual; called by all ranks.

    The digest of a problem that others come before is that of the first of these, with
    their number: what was solved differs by rounding where ranks are more or less.

    Parameters
    ----------
    reference : solves what comes before, a share of it on each rank

    Raises
    ------
    InputError
        Where there are fewer subdomains than ranks, ranks know different ones, or
        Coulomb's law does not settle or has less problems than are asked for.

    """
    rank = _agreed(problem, ranks)
    dual, before = _dual(OwnSubdomains(problem, ranks, rank)), list[str]()
    sequence, solved = _fixed_point(dual, reference)
    while (then := dual.own.problem.then) is not None:
        before += (before[:1] or [_digest(dual.own)]) * len(sequence)
        last = sequence[-1]
        found = own_solution(last.own, last.at, last.scale, solved())
        dual = _dual(OwnSubdomains(then(found), ranks, rank))
        sequence, solved = _fixed_point(dual, reference)
    chosen = _chosen(sequence)
    if others := sequence.index(chosen):
        before += (before[:1] or [_digest(dual.own)]) * others
    own, (lower, upper) = chosen.own, chosen.bounds(chosen.own.problem.contact.bound)

    def digest() -> str:
        return EMITTED + hex_digest(map(str.encode, before or [_digest(own)]), 16)

    return Emitted(
        variables=own.rows.total, equality_rows=own.coarse,
        bounds=sum(int(np.count_nonzero(np.isfinite(v))) for v in (lower, upper)),
        share=chosen.share, digest=digest,
        answer=answers(own, chosen.at, chosen.scale, _torn(own, chosen.explicit)),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Dual:
    """What this rank has made of a problem."""

    own: OwnSubdomains
    at: Halo
    scale: Vector  #: (m,) of the rows of contact and friction
    explicit: NDArray[np.bool_]  #: kinds whose blocks are formed
    q: Vector  #: (o,) of own rows
    G: csr_array  #: (r, o)
    b: Vector  #: (r,)

    def share(self) -> Share:
        """Put the operator together, without any factor."""
        rows, domains, ranks = self.own.rows, self.own.domains, self.own.ranks
        anew = Subdomains(tuple(map(replace, domains.kinds)), domains.kind)
        local = DualOperator(
            rows.B, anew, self.explicit, rows.equalities,
            partial(condensed_by_ranks, ranks=ranks),
        )  # fmt: skip
        lower, upper = self.bounds(self.own.problem.contact.bound)
        part = QP(
            P=RankOperator(local, self.at), q=distributed(self.q, ranks),
            lb=lower, ub=upper, G=no_rows(self.q.size), h=np.zeros(0),
            A=DistributedColumns(self.G, ranks), b=self.b,
        )  # fmt: skip
        return Share(part, gathered_on_one(self.at, rows.total))

    def bounds(self, bound: Vector) -> tuple[DistributedVector, DistributedVector]:
        """Bound the multipliers of own rows (o,), those of friction by (k,)."""
        ranks, E = self.own.ranks, self.own.rows.equalities
        pressing = self.scale.size - bound.size
        bound = bound / self.scale[pressing:]
        below = np.concatenate([np.zeros(pressing), -bound])
        above = np.concatenate([np.full(pressing, np.inf), bound])
        number = self.at.rows[self.at.own]
        touching = number >= E
        lower, upper = (np.full(number.size, x) for x in (-np.inf, np.inf))
        lower[touching] = below[number[touching] - E]
        upper[touching] = above[number[touching] - E]
        return distributed(lower, ranks), distributed(upper, ranks)


def _fixed_point(
    dual: _Dual, reference: ReferenceOverRanks
) -> tuple[list[_Dual], Callable[[], Solution]]:
    """Settle Coulomb's law; without it, the problem is the only one.

    Returns
    -------
    the problems of the fixed point, and the solution of the last

    """
    coulomb = dual.own.problem.coulomb
    if coulomb is None:
        return [dual], lambda: reference(dual.share().qp)
    qp, found = dual.share().qp, list[Solution]()
    contacts = dual.scale.size - coulomb.friction.bound.size

    def normal(friction: Friction) -> Vector:
        bounded = qp.with_bounds(*dual.bounds(friction.bound))
        found[:] = [reference(bounded, found[0] if found else None)]
        z = contact_multipliers(dual.own, dual.at, dual.scale, found[0])
        return z[:contacts]

    frictions = settled(coulomb.friction, normal, coulomb.step)
    known = coulomb._replace(problems=len(frictions))
    owns = [dual.own.bounded(known._replace(friction=f)) for f in frictions]
    return [replace(dual, own=own) for own in owns], lambda: found[0]


def _chosen(sequence: list[_Dual]) -> _Dual:
    """Choose the problem of a fixed point that is asked for."""
    coulomb = sequence[-1].own.problem.coulomb
    if coulomb is None:
        return sequence[-1]
    return iterate_of(sequence, coulomb.iterate, coulomb.step)


def dual_of(own: OwnSubdomains) -> QP:
    """Make this rank's share of the dual; called by all ranks."""
    return _dual(own).share().qp


def _dual(own: OwnSubdomains) -> _Dual:
    rows, domains, ranks = own.rows, own.domains, own.ranks
    at = halo(ranks, rows.number, rows.reach, owners(rows.number, rows.reach))
    return _Dual(
        own, at, own.problem.contact_scale, explicit_kinds(rows.B, domains),
        q=rows.c[at.own] - at.added(rows.B @ domains.inverse(own.f)),
        G=_coarse_rows(own, at.rows[at.own]), b=_resultants(own),
    )  # fmt: skip


def _torn(own: OwnSubdomains, explicit: NDArray[np.bool_]) -> dict[str, Any]:
    """Report how bodies are torn, as `problems.duality.torn_dual.torn_quantities`.

    explicit_mib: what blocks take on all ranks together; one of a kind that several
    ranks have is on each of these.
    """
    domains, rows, ranks = own.domains, own.rows, own.ranks
    sizes = np.array([part.size for part in touched(rows.B, domains)])
    taken = block_bytes(sizes, domains)[explicit].sum() / 2**20
    counts = [own.f.size, explicit[domains.kind].sum(), taken]
    torn_dofs, formed, mib = ranks.total(np.array(counts, dtype=float)).tolist()
    kinds = ranks.comm.allgather({kind.name for kind in domains.kinds})
    return {
        "subdomains": own.rank.size, "kinds": len(set().union(*kinds)),
        "torn_dofs": int(torn_dofs), "multipliers": rows.total,
        "explicit_subdomains": int(formed), "explicit_mib": mib,
    }  # fmt: skip


def _name_of(kind: Kind) -> str:
    """Name a kind of subdomain by its numbers."""
    return hex_digest(map(np.ndarray.tobytes, (
        kind.K.data, kind.K.indices, kind.K.indptr, kind.R, kind.fixing, kind.boundary,
    )), 32)  # fmt: skip


def _digest(own: OwnSubdomains) -> str:
    """Name the numbers of the QP, whichever rank has which subdomain.

    That of each subdomain: its kind, its load, and its columns of B; and of all of them
    in turn, with what every rank has of the contact.
    """
    domains, rows, contact = own.domains, own.rows, own.problem.contact
    names = [kind.name.encode() for kind in domains.kinds]
    B = csc_array(rows.B)
    B.sort_indices()
    told = []
    for s, (begin, end) in enumerate(pairwise(domains.start)):
        ends = B.indptr[begin : end + 1]
        entries = slice(ends[0], ends[-1])
        parts = rows.number[B.indices[entries]], B.data[entries], ends - ends[0]
        numbers = (*map(np.ndarray.tobytes, parts), own.f[begin:end].tobytes())
        name = hex_digest((names[domains.kind[s]], *numbers))
        told.append((int(own.number[s]), name))
    of_all = sorted(chain.from_iterable(own.ranks.comm.allgather(told)))
    shared = contact.rows.data, contact.c, contact.bound
    content = (*(name.encode() for _, name in of_all), *(v.tobytes() for v in shared))
    return hex_digest(content, 64)


def _agreed(problem: ProblemInParts, ranks: Ranks) -> NDArray[np.int64]:
    """Give subdomains to ranks (S,), if all ranks know the same subdomains.

    Partitions of graphs are made on every rank, by whatever library it has.

    Raises
    ------
    InputError
        Where they know others, or there are fewer subdomains than ranks.

    """
    found = subdomains_of(problem, ranks.size)
    known = hex_digest(x.tobytes() for x in (found, *problem.layout.sharing()))
    if len(set(ranks.comm.allgather(known))) > 1:
        raise InputError(
            "ranks have cut the bodies into different subdomains; expected the same "
            "version of METIS on all nodes"
        )
    return found


def subdomains_of(problem: ProblemInParts, ranks: int) -> NDArray[np.int64]:
    """Give subdomains to ranks (S,), so that these do and hold alike much.

    Raises
    ------
    InputError
        Where there are fewer subdomains than ranks.

    """
    of, d = problem.layout, problem.components
    S = of.count
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
    """Fill the rows of B, numbered as by `problems.feti.gluing.glue`."""
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


def _coarse_rows(own: OwnSubdomains, mine: Nodes) -> csr_array:
    """Return the columns of RᵀBᵀ that belong to own rows, (3S, o)."""
    ranks, rows = own.ranks, own.rows
    B, t = rows.B, rows.number.size
    unknown, place = np.unique(B.indices, return_inverse=True)
    R = own.resultants(unknown, np.ones(unknown.size))
    touched = csr_array((B.data, place, B.indptr), shape=(t, unknown.size))
    part = csr_array(touched @ R)
    owner = owners(rows.number, rows.reach)
    told: list[tuple[NDArray[Any], ...]] = [()] * ranks.size
    for one in set(range(ranks.size)) - {ranks.rank}:
        theirs = np.flatnonzero(owner == one)
        entries = coo_array(part[theirs])
        told[one] = rows.number[theirs][entries.row], entries.col, entries.data
    found = csr_array(part[np.flatnonzero(owner == ranks.rank)])
    for row, column, data in filter(None, ranks.comm.alltoall(told)):
        places = np.searchsorted(mine, row), column
        found += csr_array((data, places), shape=found.shape)
    return csr_array(found.T)


def _resultants(own: OwnSubdomains) -> Vector:
    """Return Rᵀf (3S,) of all subdomains."""
    loaded = np.flatnonzero(own.f)
    mine = own.resultants(loaded, own.f[loaded])
    found = np.zeros(own.coarse)
    for number, part in own.ranks.comm.allgather((mine.indices, mine.data)):
        np.add.at(found, number, part)
    return found
