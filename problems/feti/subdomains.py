"""The local subdomains of one rank, and their rows of B.

Each rank assembles only its local subdomains: their meshes, stiffness matrices and
loads, and the rows of B with entries at their nodes (the rows that *touch* them). A
single process assembles all subdomains. Global numbers are determined by the
subdivision (`problems.feti.subdivision`), which is replicated on all ranks. It consists
of tables for the rows and columns of structured grids, or of a list of the nodes on
interfaces. In addition, each rank stores a few numbers for every subdomain of every
rank. These numbers require about as much memory as a vector of the coarse problem.

B consists of support, gluing and contact rows, in this order (Total FETI, Dostál, Horák
and Kučera 2006). Every copy of a fixed component has a support row, unless fixed
components are eliminated. The m copies v_1 … v_m of a free component are glued by one
of

* ``orthonormal``: m − 1 orthonormal rows that are orthogonal to (1, …, 1),
* ``redundant``: all m(m − 1)/2 rows  v_p − v_q = 0.

Contact rows act on the average of the copies, because all copies are equal at the
solution. Therefore a contact condition at a node of several subdomains is a single row.
This row is orthogonal to the gluing rows.

Support and gluing rows are scaled by √E, with Young's modulus E of their body. Contact
rows are normalised, then scaled by √E of the softest body they touch. If each body is
homogeneous, the block of F = BK⁺Bᵀ for supports and gluing is therefore independent of
E, and all other entries depend only on ratios of moduli. In support and gluing rows, E
may be multiplied by a factor for the shape of the cells (`problems.feti.structured`).
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
from mortarbench.problems.feti.distributed import balanced_partition
from mortarbench.problems.feti.subdivision import (
    Integers,
    Points,
    Subdivision,
    SubdomainNodes,
)
from mortarbench.problems.feti.subdomain_classes import (
    DecomposedBodies,
    SubdomainClass,
    Subdomains,
)
from mortarbench.problems.feti.tearing import (
    CONGRUENCE_TOL,
    SubdomainMesh,
    classify,
    congruent,
    spread_of,
)

Weights = Callable[[int], NDArray[np.float64]]


def _orthonormal(m: int) -> NDArray[np.float64]:
    return np.asarray(np.linalg.qr(np.ones((m, 1)), mode="complete")[0][:, 1:].T)


def _redundant(m: int) -> NDArray[np.float64]:
    p, q = np.array(list(combinations(range(m), 2))).T
    return np.asarray(np.eye(m)[p] - np.eye(m)[q])


#: mapping from the name of the gluing to a function that returns the weights (rows, m)
#: of m copies
GLUE: Mapping[str, Weights] = MappingProxyType(
    {"orthonormal": _orthonormal, "redundant": _redundant}
)


class Contact(NamedTuple):
    """Global contact rows followed by friction rows, replicated on every rank."""

    rows: csr_array  #: (m_I, n) rows in components of the undivided bodies
    c: Vector  #: (m_I,) right-hand side
    bound: Vector  #: (k,) friction bounds of the last k rows
    tangents: int = 1  #: number of friction rows per tangential vector

    @property
    def groups(self) -> Nodes:
        """First row (m_I,) of the tangential vector that contains each row.

        For a contact row, this is the row itself.
        """
        group = np.arange(self.rows.shape[0])
        first = group.size - self.bound.size
        group[first:] = np.repeat(group[first :: self.tangents], self.tangents)
        return group


@dataclass(frozen=True, eq=False, kw_only=True)
class DecomposedProblem:
    """A contact problem on decomposed bodies, nondimensional, before assembly."""

    layout: Subdivision  #: the S subdomains
    components: int  #: number of components per node; 1 for a scalar field
    material: Integers  #: (S,) material of each subdomain
    #: function that assembles the class of a floating subdomain
    assemble_class: Callable[[SubdomainMesh], SubdomainClass]
    E: Vector  #: (bodies,) moduli for the scaling of rows
    names: tuple[str, ...]  #: names of the pieces
    #: (bodies,) piece of each body; bodies of a piece have common nodes. None: every
    #: body is a piece
    piece: Integers | None = None
    #: map from numbers of subdomains to a function that evaluates the factors of E at
    #: their torn nodes, see `problems.feti.structured.Layout.shaping`; None if all
    #: factors are 1
    shaping: Callable[[Nodes], Callable[[Nodes, Nodes, bool], Vector]] | None = None
    load: Callable[[Nodes], Vector]  #: map from global components (k,) to forces (k,)
    fixed: Nodes  #: prescribed global components, in the order of their rows
    #: map from global components (k,) to prescribed displacements, or zero elsewhere;
    #: None: all are zero
    lift: Callable[[Nodes], Vector] | None = None
    #: True to eliminate fixed components, as in FETI-1 (Farhat and Roux 1991), instead
    #: of adding rows to B. Subdomains with supports then do not float and keep the
    #: global axes
    eliminated: bool = False
    contact: Contact
    glue: str  #: name of the gluing, one of `GLUE`

    @property
    def piece_of(self) -> Integers:
        """Piece of each subdomain, (S,)."""
        body = self.layout.body
        return body if self.piece is None else self.piece[body]

    @property
    def redundant(self) -> bool:
        """True if rows of supports and gluing may be linearly dependent."""
        return self.glue == "redundant"

    @cached_property
    def contact_scale(self) -> Vector:
        """Scale √E/‖B_i‖ of each contact row (m,), with E of the softest body touched.

        B_i is the row on the torn unknowns before scaling. The scales of all rows of a
        tangential vector are equal in exact arithmetic and are set to that of its first
        row.
        """
        rows, of = self.contact.rows, self.layout
        if not rows.shape[0]:
            return np.zeros(0)
        node = rows.indices // self.components
        E = self.E[of.body[of.holder(node)]]
        # an entry b at a node with m copies becomes m entries b/m of B; the sum of the
        # squares of these entries is b²/m
        norm2 = np.add.reduceat(rows.data**2 / of.multiplicity(node), rows.indptr[:-1])
        softest = np.minimum.reduceat(E, rows.indptr[:-1])
        scale = np.sqrt(softest / norm2)
        first, d = scale.size - self.contact.bound.size, self.contact.tangents
        scale[first:] = np.repeat(scale[first::d], d)
        return np.asarray(scale)


class Entries(NamedTuple):
    """Entries of B in the columns of this rank, and the ranks that touch their rows."""

    row: NDArray[np.int64]  #: (e,) global rows
    column: NDArray[np.int64]  #: (e,) local torn unknowns
    value: Vector  #: (e,) values of the entries
    reached: NDArray[np.int64]  #: (k, 2) pairs of a row and a rank that touches it


@dataclass(frozen=True, eq=False)
class LocalSubdomains:
    """The subdomains of one rank; most properties are evaluated on first use."""

    problem: DecomposedProblem
    ranks: Ranks
    rank: NDArray[np.int64]  #: (S,) rank of each subdomain

    @cached_property
    def number(self) -> NDArray[np.int64]:
        """Global numbers of the local subdomains, (S_p,)."""
        return np.flatnonzero(self.rank == self.ranks.rank)

    @cached_property
    def nodes(self) -> SubdomainNodes:
        """Torn nodes of the local subdomains, (M_p,)."""
        return self.problem.layout.subdomain_nodes(self.number)

    def local_nodes(self, subdomain: Nodes, node: Nodes) -> Nodes:
        """Return the indices (k,) in `nodes` of copies of nodes in given subdomains.

        Parameters
        ----------
        subdomain : (k,) global numbers of local subdomains
        node : (k,) global numbers of nodes

        """
        nodes, N = self.nodes, self.problem.layout.nodes
        keys = nodes.subdomain * np.int64(N) + nodes.number
        return np.searchsorted(
            keys, np.searchsorted(self.number, subdomain) * np.int64(N) + node
        )

    @property
    def component(self) -> Nodes:
        """Global component of each torn unknown, (N_p,)."""
        return self._component[self.free]

    @property
    def _component(self) -> Nodes:
        """Global component of each torn unknown, including eliminated components."""
        return self._of_nodes(self.nodes.number)

    @cached_property
    def _distinct(self) -> tuple[Nodes, Nodes]:
        """Global nodes on this rank, and the index of each torn node among them."""
        return np.unique(self.nodes.number, return_inverse=True)

    @property
    def components(self) -> Nodes:
        """Global components on this rank, ascending, (n_p,)."""
        return self._of_nodes(self._distinct[0])

    @property
    def place(self) -> Nodes:
        """Index of each torn unknown in `components`, (N_p,)."""
        return self._of_nodes(self._distinct[1])[self.free]

    def _of_nodes(self, node: Nodes) -> Nodes:
        """Return the components of given nodes, node by node."""
        d = self.problem.components
        return np.asarray((d * node[:, None] + np.arange(d)).ravel())

    @cached_property
    def spread(self) -> csr_array:
        """T (N_p, n_p), which maps `components` to torn unknowns in subdomain axes.

        Each torn node has a block Qᵀ, the transpose of the rotation of its subdomain.
        Eliminated components have no rows.
        """
        d, place = self.problem.components, self._distinct[1]
        M, n = place.size, d * self._distinct[0].size
        if d == 1:
            T = csr_array((np.ones(M), place, np.arange(M + 1)), shape=(M, n))
        else:
            turn = self.rotation[self.nodes.subdomain].transpose(0, 2, 1)
            blocks = np.ascontiguousarray(turn), place, np.arange(M + 1)
            T = csr_array(bsr_array(blocks, shape=(d * M, n)))
            T.eliminate_zeros()
        return csr_array(T[self.free]) if self.problem.eliminated else T

    @property
    def multiplicity(self) -> NDArray[np.int64]:
        """Number of copies of each torn unknown on all ranks, (N_p,)."""
        multiplicity = np.repeat(self.nodes.multiplicity, self.problem.components)
        return np.asarray(multiplicity[self.free])

    @cached_property
    def free(self) -> slice | Nodes:
        """Indices of the torn unknowns among all components of all torn nodes."""
        if not self.problem.eliminated:
            return slice(None)
        return np.flatnonzero(~np.isin(self._component, self.problem.fixed))

    @cached_property
    def _classified(self) -> tuple[Subdomains, NDArray[np.float64]]:
        """Local subdomains in classes, and rotations from the frames of their classes.

        All ranks use the same frame for a class.
        """
        problem, of = self.problem, self.problem.layout
        material = problem.material[self.number].tolist()
        keys = list(zip(of.keys(self.number), material, strict=True))
        points = of.points(self.number)
        first, class_of, rotation = classify(keys, points)
        representative = self._representatives(
            [(int(self.number[s]), keys[s], points[s]) for s in first]
        )
        classes = []
        for k, s in enumerate(first):
            number, origin = representative[int(self.number[s])]
            if number != self.number[s]:
                members = np.flatnonzero(class_of == k)
                rotations = congruent(
                    np.stack([origin, *(points[s] for s in members.tolist())])
                )[1]
                rotation[members] = rotations[1:]
            cells = of.cells(int(self.number[s]))
            classes.append(
                problem.assemble_class(
                    SubdomainMesh(origin, cells, np.full(len(cells), material[s]))
                )
            )
        return Subdomains(tuple(classes), class_of), rotation

    @property
    def floating(self) -> LocalSubdomains:
        """The same problem with supports as rows of B, so that all subdomains float."""
        if not self.problem.eliminated:
            return self
        return self.with_problem(replace(self.problem, eliminated=False))

    @cached_property
    def domains(self) -> Subdomains:
        """The local subdomains, without eliminated components."""
        domains = self._classified[0]
        if self.problem.eliminated:
            free = np.zeros(int(domains.start[-1]), dtype=bool)
            free[self.free] = True
            domains = domains.restrict(free)
        return domains

    def _representatives(
        self, own: list[tuple[int, Hashable, Points]]
    ) -> dict[int, tuple[int, Points]]:
        """Return the first subdomain of each class on all ranks, with its points.

        Ranks exchange the points of one subdomain per class, unless its key and
        its spread (see `spread_of`) show that the class does not occur on other ranks.

        own : number, key and points of the first local subdomain of each class

        Returns
        -------
        map from the number of the first local subdomain of a class to the number and
        points of the first subdomain of this class on all ranks

        """
        comm = self.ranks.comm
        spreads = comm.allgather([(n, key, spread_of(at)) for n, key, at in own])
        elsewhere: dict[Hashable, list[float]] = {}
        for rank, theirs in enumerate(spreads):
            for _, key, spread in theirs if rank != self.ranks.rank else ():
                elsewhere.setdefault(key, []).append(spread)

        def may_be_elsewhere(key: Hashable, at: Points) -> bool:
            spread = np.array(elsewhere.get(key, []))
            # a looser tolerance than in `classify`
            off = 3 * CONGRUENCE_TOL * np.sqrt(at.size)
            return bool((np.abs(spread - spread_of(at)) <= off * spread).any())

        candidates = [one for one in own if may_be_elsewhere(*one[1:])]
        shared = sorted(
            chain.from_iterable(comm.allgather(candidates)), key=itemgetter(0)
        )
        representatives = {number: (number, at) for number, _, at in own}
        if shared:
            first, group, _ = classify(
                [key for _, key, _ in shared], [at for *_, at in shared]
            )
            for (number, *_), k in zip(shared, group, strict=True):
                of, _, at = shared[first[k]]
                representatives[number] = of, at
        return representatives

    @property
    def rotation(self) -> NDArray[np.float64]:
        """Rotations (S_p, dim, dim) from the axes of each class to the global axes."""
        return self._classified[1]

    @cached_property
    def motions(self) -> NDArray[np.int64]:
        """First rigid motion of each subdomain, followed by the total number, (S + 1,).

        The subdomains of all ranks are included.
        """
        modes = np.array([kind.R.shape[1] for kind in self.domains.classes])
        counts = np.zeros(self.rank.size, dtype=np.int64)
        local = self.number, modes[self.domains.class_of]
        for number, count in self.ranks.comm.allgather(local):
            counts[number] = count
        return np.concatenate([[0], np.cumsum(counts)])

    @property
    def local_motions(self) -> NDArray[np.int64]:
        """Global numbers of the rigid motions of the local subdomains."""
        first, end = self.motions[self.number], self.motions[self.number + 1]
        return np.concatenate([np.arange(*m) for m in zip(first, end, strict=True)])

    @property
    def coarse_size(self) -> int:
        """Number of rigid motions of all subdomains."""
        return int(self.motions[-1])

    @cached_property
    def f(self) -> Vector:
        """Local load (N_p,) in subdomain axes.

        The load of a node is divided equally among its copies.
        """
        d = self.problem.components
        multiplicity = np.repeat(self.nodes.multiplicity, d)
        load = self.problem.load(self._component) / multiplicity
        if d > 1:
            loaded = np.flatnonzero(load.reshape(-1, d).any(axis=1))
            rotation = self.rotation[self.nodes.subdomain[loaded]]
            shared = load.reshape(-1, d)
            shared[loaded] = np.einsum("mkq,mk->mq", rotation, shared[loaded])
        return np.asarray(load[self.free])

    def resultants(self, unknown: Nodes, value: Vector) -> csr_array:
        """Return the work (k, r) of k single forces on all rigid motions.

        unknown : (k,) torn unknowns
        value : (k,) a force at each of these unknowns
        """
        domains = self.domains
        of = np.searchsorted(domains.start, unknown, side="right") - 1
        R = np.concatenate([kind.R.ravel() for kind in domains.classes])
        first = np.cumsum([0, *(kind.R.size for kind in domains.classes)])
        modes = np.diff(self.motions)[self.number[of]]
        at = first[domains.class_of[of]] + modes * (unknown - domains.start[of])
        ends = np.concatenate([[0], np.cumsum(modes)])
        along = np.arange(ends[-1]) - np.repeat(ends[:-1], modes)
        entries = R[np.repeat(at, modes) + along] * np.repeat(value, modes)
        column = np.repeat(self.motions[self.number[of]], modes) + along
        return csr_array(
            (entries, column, ends), shape=(unknown.size, self.coarse_size)
        )

    @cached_property
    def _shape(self) -> Callable[[Nodes, Nodes, bool], Vector] | None:
        shaping = self.problem.shaping
        return None if shaping is None else shaping(self.number)

    def row_stiffness(self, node: Nodes, *, supports: bool) -> Vector:
        """Return the factors (k,) at torn nodes whose square roots scale rows of B.

        All copies of a node have the modulus of the softest of its bodies, because a
        gluing row is a difference of copies.

        supports : True for rows of supports, False for rows of gluing
        """
        of, E_of = self.problem.layout, self.problem.E
        E = E_of[of.body[self.number][self.nodes.subdomain[node]]]
        if self.problem.piece is not None:
            number = self.nodes.number[node]
            last = of.multiplicity(number) - 1
            for copy in range(int(last.max(initial=-1)) + 1):
                body = of.body[of.holder(number, np.minimum(copy, last))]
                E = np.minimum(E, E_of[body])
        if self._shape is None:
            return E
        return np.asarray(E * self._shape(node, self.nodes.number[node], supports))

    @cached_property
    def rows(self) -> _Rows:
        """The rows of B that touch local subdomains."""
        return _local_rows(self)

    @cached_property
    def decomposed(self) -> DecomposedBodies:
        """The local subdomains with their rows of B."""
        domains, rows = self.domains, self.rows
        return DecomposedBodies(
            classes=domains.classes,
            class_of=domains.class_of,
            spread=self.spread,
            B=rows.B,
            c=rows.c,
            scale=self.problem.contact_scale,
            f=self.f,
            equalities=rows.equalities,
            redundant=self.problem.redundant,
        )

    def with_bound(self, bound: Vector) -> LocalSubdomains:
        """Return a copy with friction bounds `bound` (k,); cached results are kept."""
        contact = self.problem.contact._replace(bound=bound)
        copy = replace(self, problem=replace(self.problem, contact=contact))
        # cached properties remain valid, because none depends on the values of bounds
        vars(copy).update({**vars(self), "problem": copy.problem})
        return copy

    def with_problem(self, problem: DecomposedProblem) -> LocalSubdomains:
        """Return the subdomains of a problem that has the same bodies.

        Load, contact and treatment of supports may differ. The classes of subdomains
        are reused because their assembly is expensive.
        """
        copy = replace(self, problem=problem)
        same = ("number", "nodes", "_classified", "_distinct")
        vars(copy).update({k: v for k, v in vars(self).items() if k in same})
        return copy


class _Rows(NamedTuple):
    """The rows of B that touch subdomains of this rank."""

    number: Nodes  #: (t,) global numbers, ascending
    B: csr_array  #: (t, N_p) rows in local torn unknowns
    #: (t,) for a row of a tangential vector, the number of the first row of this
    #: vector; for any other row, its own number. All rows of a vector have the same
    #: owner
    group: Nodes
    reach: csr_array  #: (t, ranks) nonzero where a rank touches a row of the group
    c: Vector  #: (t,) right-hand side
    equalities: int  #: number of equality rows on all ranks
    total: int  #: number of rows on all ranks


def subdomains_of(problem: DecomposedProblem, ranks: int) -> NDArray[np.int64]:
    """Return the rank (S,) of each subdomain, balancing work and memory.

    Raises
    ------
    InputError
        If there are fewer subdomains than ranks.

    """
    of, d = problem.layout, problem.components
    S = of.count
    if ranks == 1:
        return np.zeros(S, dtype=np.int64)
    one, other, nodes = of.shared_node_counts()
    graph = coo_array((d * nodes, (one, other)), shape=(S, S))
    touched = of.glued()
    node = np.unique(np.concatenate([problem.fixed, problem.contact.rows.indices]) // d)
    single = of.multiplicity(node) == 1
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
    work = (d * touched) ** 2
    return balanced_partition(csr_array(graph), work, of.sizes, ranks)


def _local_rows(local: LocalSubdomains) -> _Rows:
    """Assemble the local rows of B, in the order of supports, gluing and contact."""
    problem, ranks, d = local.problem, local.ranks, local.problem.components
    entries = [_gluing_rows(local), _contact_rows(local)]
    if not problem.eliminated:
        entries.insert(0, _support_rows(local))
    row, column, value = (
        np.concatenate(p) for p in list(zip(*entries, strict=True))[:3]
    )
    pairs = np.concatenate([part.reached for part in entries])
    # a row is listed if any row of its tangential vector touches this rank; the listed
    # row itself may have no entries on this rank
    number = np.unique(pairs[pairs[:, 1] == ranks.rank, 0])
    place = np.searchsorted(number, row)
    unknowns = problem.components * local.nodes.number.size
    B = csr_array((value, (place, column)), shape=(number.size, unknowns))
    if problem.eliminated:
        B = csr_array(B[:, local.free])
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
    E = _equality_count(problem)
    touching = number >= E
    c = np.zeros(number.size)
    c[touching] = (scale * contact.c)[number[touching] - E]
    if problem.lift is not None:
        supports = number < int(problem.layout.multiplicity(problem.fixed // d).sum())
        moved = local.spread @ problem.lift(local.components)
        c[supports] = (B @ moved)[supports]
    group = number.copy()
    group[touching] = E + contact.groups[number[touching] - E]
    return _Rows(
        number=number,
        B=B,
        group=group,
        reach=reach,
        c=c,
        equalities=E,
        total=E + scale.size,
    )


def _support_rows(local: LocalSubdomains) -> Entries:
    """Return the local support rows: one per copy of a fixed component, last first."""
    problem, d = local.problem, local.problem.components
    node, k = np.divmod(problem.fixed, d)
    multiplicity = problem.layout.multiplicity(node)
    copies = _local_copies(local, node)
    of = copies.node[copies.local]
    row = np.cumsum(multiplicity)[of] - 1 - copies.copy[copies.local]
    value = np.sqrt(local.row_stiffness(copies.local_node, supports=True))
    reached = np.stack([row, np.full(row.size, local.ranks.rank)], axis=1)
    return Entries(*_rotated(local, row, copies.local_node, k[of], value), reached)


class _Copies(NamedTuple):
    """Copies of given nodes on all ranks, in the order of the nodes."""

    node: NDArray[np.int64]  #: (k,) index in the list of nodes
    copy: NDArray[np.int64]  #: (k,) number of the copy, from 0
    rank: NDArray[np.int64]  #: (k,) rank of the copy
    local: NDArray[np.int64]  #: (l,) indices of the copies on this rank
    local_node: NDArray[np.int64]  #: (l,) local torn node of each of these copies


def _local_copies(local: LocalSubdomains, node: Nodes) -> _Copies:
    """Return the copies of given nodes on all ranks."""
    of = local.problem.layout
    multiplicity = of.multiplicity(node)
    place = np.repeat(np.arange(multiplicity.size), multiplicity)
    copy = np.arange(place.size) - np.repeat(
        np.cumsum(multiplicity) - multiplicity, multiplicity
    )
    subdomain = of.holder(node[place], copy)
    rank = local.rank[subdomain]
    mine = np.flatnonzero(rank == local.ranks.rank)
    torn = local.local_nodes(subdomain[mine], node[place[mine]])
    return _Copies(place, copy, rank, mine, torn)


def _gluing_rows(local: LocalSubdomains) -> Entries:
    """Return the gluing rows, ordered by multiplicity, then by node and component."""
    problem, nodes, of = local.problem, local.nodes, local.problem.layout
    d = problem.components
    fixed = np.sort(problem.fixed)
    fixed_multiplicity = of.multiplicity(fixed // d)
    base = 0 if problem.eliminated else int(fixed_multiplicity.sum())
    none = np.zeros(0, dtype=np.int64)
    parts = [Entries(none, none, np.zeros(0), none.reshape(0, 2))]
    for m, nodes_with in sorted(of.nodes_by_multiplicity.items()):
        W = GLUE[problem.glue](m)
        fixed_m = fixed[fixed_multiplicity == m]
        several = np.flatnonzero(nodes.multiplicity == m)
        number = nodes.number[several]
        before = of.before(number)
        ranks = np.stack([local.rank[of.holder(number, p)] for p in range(m)], axis=1)
        for k in range(d):
            component = d * number + k
            free = ~np.isin(component, fixed_m)
            first = d * before + k - np.searchsorted(fixed_m, component)
            for r, weights in enumerate(W):
                rows = np.flatnonzero(free & (weights[nodes.copy[several]] != 0))
                row = base + first[rows] * len(W) + r
                node = several[rows]
                value = weights[nodes.copy[node]]
                entries = _rotated(
                    local,
                    row,
                    node,
                    np.full(node.size, k),
                    np.sqrt(local.row_stiffness(node, supports=False)) * value,
                )
                ranks_there = ranks[rows][:, weights != 0]
                reached = np.stack(
                    [np.repeat(row, ranks_there.shape[1]), ranks_there.ravel()], axis=1
                )
                parts.append(Entries(*entries, reached))
        base += len(W) * (d * nodes_with - fixed_m.size)
    return Entries(*(np.concatenate(p) for p in zip(*parts, strict=True)))


def _contact_rows(local: LocalSubdomains) -> Entries:
    """Return the contact and friction rows, which act on averages of copies."""
    problem, d = local.problem, local.problem.components
    entries = problem.contact.rows.tocoo()
    node, k = np.divmod(entries.col.astype(np.int64), d)
    copies = _local_copies(local, node)
    E, group = _equality_count(problem), problem.contact.groups
    row = E + entries.row.astype(np.int64)
    # all rows of a disc have the same owner: a rank that one row touches stores all
    # rows
    pairs = np.stack([group[entries.row][copies.node], copies.rank], axis=1)
    pairs = np.unique(pairs, axis=0)
    members = np.bincount(group, minlength=1)[pairs[:, 0]]
    reached = np.repeat(pairs, members, axis=0)
    before = np.repeat(np.cumsum(members) - members, members)
    reached[:, 0] += E + np.arange(before.size) - before
    multiplicity = problem.layout.multiplicity(node)
    share = problem.contact_scale[entries.row] * entries.data / multiplicity
    of = copies.node[copies.local]
    return Entries(
        *_rotated(local, row[of], copies.local_node, k[of], share[of]), reached
    )


def _rotated(
    local: LocalSubdomains,
    row: NDArray[np.int64],
    node: NDArray[np.int64],
    k: NDArray[np.int64],
    value: Vector,
) -> tuple[NDArray[np.int64], NDArray[np.int64], Vector]:
    """Rotate entries along global axes k (j,) at torn nodes (j,) to subdomain axes.

    Returns
    -------
    rows, columns (local torn unknowns) and values of the nonzero entries

    """
    d = local.problem.components
    if d == 1:
        return row, node, value
    # row k of Q, because u_k = Σ Q_kq v_q
    rotation = local.rotation[local.nodes.subdomain[node], k]
    nonzero = rotation != 0
    column = d * node[:, None] + np.arange(d)
    rows = np.broadcast_to(row[:, None], nonzero.shape)
    return rows[nonzero], column[nonzero], (rotation * value[:, None])[nonzero]


def _equality_count(problem: DecomposedProblem) -> int:
    """Return the number of rows of supports and gluing on all ranks."""
    of, d = problem.layout, problem.components
    multiplicity = of.multiplicity(problem.fixed // d)
    glued = sum(
        len(GLUE[problem.glue](m)) * (d * count - int((multiplicity == m).sum()))
        for m, count in of.nodes_by_multiplicity.items()
    )
    return glued if problem.eliminated else int(multiplicity.sum()) + glued


def on_one_process(problem: DecomposedProblem) -> LocalSubdomains:
    """Return all subdomains as the local subdomains of a single process."""
    every = np.zeros(problem.layout.count, dtype=np.int64)
    return LocalSubdomains(problem, single_process(), every)
