"""Torn bodies: subdomains with their copies of nodes, and the rows B that join them.

Rank 0 computes the numbers of the copies, the classes of congruent subdomains and the
rows of B. These take little time compared with the matrices of the subdomains, which
each rank assembles for its own subdomains (`TornBodies.parts`).

B consists of support, gluing and contact rows, in this order (Total FETI, Dostál, Horák
and Kučera 2006). Every copy of a fixed component has a support row. The m copies
v_1 … v_m of a free component are glued by one of

* ``orthonormal``: m − 1 orthonormal rows that are orthogonal to (1, …, 1),
* ``redundant``: all m(m − 1)/2 rows  v_p − v_q = 0.

Contact rows act on the average of the copies, because all copies are equal at the
solution. Therefore a contact condition at a node of several subdomains is a single row.
This row is orthogonal to the gluing rows.

Support and gluing rows are scaled by √E, with Young's modulus E of their body. Contact
rows are normalised, then scaled by √E of the softest body they touch. If each body is
homogeneous, the block of F = BK⁺Bᵀ for supports and gluing is therefore independent of
E, and all other entries depend only on ratios of moduli.
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, csr_array

from mortarbench.harness import Vector
from mortarbench.harness.distributed.comm import Placed, Team
from mortarbench.problems.fem.mesh import Nodes
from mortarbench.problems.feti.subdivision import (
    Integers,
    Subdivision,
    TornNodes,
)
from mortarbench.problems.feti.subdomain_classes import (
    Assembly,
    SubdomainClass,
    Subdomains,
)
from mortarbench.problems.feti.tearing import SubdomainMesh, classify

Weights = Callable[[int], NDArray[np.float64]]
T = TypeVar("T")


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
    """Global contact rows followed by friction rows."""

    rows: csr_array  #: (m_I, n) rows in components of the undivided bodies
    c: Vector  #: (m_I,) right-hand side
    bound: Vector  #: (k,) friction bounds of the last k rows
    tangents: int = 1  #: number of friction rows per tangential vector


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
    load: Vector  #: (n,) forces at global components
    fixed: Nodes  #: prescribed global components, in the order of their rows
    #: (n,) prescribed displacements, and zeros; None: all are zero
    lift: Vector | None = None
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

        B_i is the row on the torn unknowns before scaling. All rows of a tangential
        vector have the scale of its first row, so that discs remain discs.
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
    """Entries of B."""

    row: NDArray[np.int64]  #: (e,) rows
    column: NDArray[np.int64]  #: (e,) torn unknowns
    value: Vector  #: (e,) values of the entries


@dataclass(frozen=True, eq=False)
class TornBodies:
    """Decomposed bodies; most properties are evaluated on first use.

    On several ranks, this object exists on rank 0, and the other ranks have only their
    subdomains.
    """

    problem: DecomposedProblem
    team: Team = field(default_factory=Team)

    @property
    def nodes(self) -> TornNodes:
        """Torn nodes of all subdomains, (M,)."""
        return self.problem.layout.torn

    @property
    def component(self) -> Nodes:
        """Component of each torn unknown, (N,)."""
        d = self.problem.components
        return np.asarray((d * self.nodes.number[:, None] + np.arange(d)).ravel())

    @cached_property
    def spread(self) -> csr_array:
        """T (N, n), which maps displacements to torn unknowns in subdomain axes.

        Each torn node has a block Qᵀ, the transpose of the rotation of its subdomain.
        """
        d, place = self.problem.components, self.nodes.number
        M, n = place.size, d * self.problem.layout.nodes
        if d == 1:
            return csr_array((np.ones(M), place, np.arange(M + 1)), shape=(M, n))
        turn = self.rotation[self.nodes.subdomain].transpose(0, 2, 1)
        blocks = np.ascontiguousarray(turn), place, np.arange(M + 1)
        T = csr_array(bsr_array(blocks, shape=(d * M, n)))
        T.eliminate_zeros()
        return T

    @cached_property
    def _classified(self) -> tuple[Subdomains, NDArray[np.float64]]:
        """Subdomains in classes, and their rotations from the frames of the classes."""
        problem, of = self.problem, self.problem.layout
        material, every = problem.material.tolist(), range(of.count)
        points = [of.points_of(s) for s in every]
        keys = ((of.key(s), material[s]) for s in every)
        first, class_of, rotation = classify(keys, points)
        of_class = [points[s] for s in first]

        def mesh(k: int) -> SubdomainMesh:
            cells = of.cells_of(first[k])
            of_cells = np.full(len(cells), material[first[k]])
            return SubdomainMesh(of_class[k], cells, of_cells)

        sizes = problem.components * np.array([len(at) for at in of_class])
        assembly = Assembly(mesh, problem.assemble_class)
        return Subdomains(template=assembly, sizes=sizes, class_of=class_of), rotation

    @cached_property
    def rank(self) -> NDArray[np.int64]:
        """Rank of each subdomain, (S,), ascending."""
        return subdomain_ranks(self.problem, self.team.comm.size)

    @cached_property
    def ends(self) -> list[int]:
        """First torn unknown of each rank, then the total number N."""
        first = np.searchsorted(self.rank, np.arange(self.team.comm.size + 1))
        ends: list[int] = self.domains.start[first].tolist()
        return ends

    @cached_property
    def parts(self) -> Placed:
        """The subdomains of each rank, as a `Subdomains` on that rank."""
        own, team = [self.domains], self.team
        if team.comm.size > 1:
            ranks = range(team.comm.size)
            own = [self._part(np.flatnonzero(self.rank == rank)) for rank in ranks]
        return team.place(itself, own)

    def _part(self, members: NDArray[np.int64]) -> Subdomains:
        """Return some of the subdomains, which can be sent to another rank."""
        class_of, assembly = self.domains.class_of[members], self.domains.template
        assert isinstance(assembly, Assembly)
        template = assembly.selected(np.unique(class_of).tolist())
        return replace(self.domains, template=template, class_of=class_of)

    def apply(self, method: str, v: NDArray[Any]) -> NDArray[Any]:
        """Apply a method of `Subdomains` to a torn vector (N,)."""
        return self.parts.apply(method, v, self.ends)

    def kernel(self) -> csr_array:
        """Return R = diag(R_1 … R_S) (N, r), the rigid motions of all subdomains."""
        R_of, start = self.of_classes("modes"), self.domains.start
        blocks = [R_of[k] for k in self.domains.class_of.tolist()]
        N, S, r = start[-1], len(blocks), blocks[0].shape[1]
        column = np.arange(r * S, dtype=np.int32).reshape(S, r)
        columns = np.repeat(column, np.diff(start), axis=0).ravel()
        ends = r * np.arange(N + 1, dtype=np.int32)
        data = np.concatenate(blocks).ravel()
        R = csr_array((data, columns, ends), shape=(N, r * S))
        R.eliminate_zeros()
        return R

    def moved(self, alpha: Vector) -> Vector:
        """Return Rα (N,), without forming R, which is large."""
        domains, R_of = self.domains, self.of_classes("modes")
        motions, v = (
            alpha.reshape(domains.class_of.size, -1),
            np.empty(domains.start[-1]),
        )
        for k, members in domains.members:
            place = domains.start[members] + np.arange(domains.sizes[k])[:, None]
            v[place] = R_of[k] @ motions[members].T
        return v

    def of_classes(self, method: str, *arguments: Any) -> dict[int, Any]:
        """Return the results of a method of `Subdomains` for all classes."""
        return dict(ChainMap(*self.parts(method, *arguments)))

    @property
    def rotation(self) -> NDArray[np.float64]:
        """Rotations (S, dim, dim) from the axes of each class to the global axes."""
        return self._classified[1]

    @property
    def domains(self) -> Subdomains:
        """The subdomains."""
        return self._classified[0]

    @cached_property
    def f(self) -> Vector:
        """Torn load (N,) in subdomain axes; copies of a node have equal shares."""
        d = self.problem.components
        multiplicity = np.repeat(self.nodes.multiplicity, d)
        load = self.problem.load[self.component] / multiplicity
        if d > 1:
            shared = load.reshape(-1, d)
            loaded = np.flatnonzero(shared.any(axis=1))
            rotation = self.rotation[self.nodes.subdomain[loaded]]
            shared[loaded] = np.einsum("mkq,mk->mq", rotation, shared[loaded])
        return np.asarray(load)

    def row_stiffness(self, node: Nodes) -> Vector:
        """Return the moduli (k,) at torn nodes whose square roots scale rows of B.

        All copies of a node have the modulus of the softest of its bodies, because a
        gluing row is a difference of copies.
        """
        of, E_of, number = self.problem.layout, self.problem.E, self.nodes.number[node]
        E = E_of[of.body[self.nodes.subdomain[node]]]
        if self.problem.piece is not None:
            last = of.multiplicity(number) - 1
            for copy in range(int(last.max(initial=-1)) + 1):
                body = of.body[of.holder(number, np.minimum(copy, last))]
                E = np.minimum(E, E_of[body])
        return E

    @cached_property
    def rows(self) -> Rows:
        """The rows of B."""
        return _rows(self)

    def with_bound(self, bound: Vector) -> TornBodies:
        """Return a copy with friction bounds `bound` (k,); cached results are kept."""
        contact = self.problem.contact._replace(bound=bound)
        copy = replace(self, problem=replace(self.problem, contact=contact))
        # cached properties remain valid, because none depends on the values of bounds
        vars(copy).update({**vars(self), "problem": copy.problem})
        return copy

    def with_problem(self, problem: DecomposedProblem) -> TornBodies:
        """Return the subdomains of a problem that has the same bodies.

        Load and contact may differ. The classes of subdomains are reused because their
        assembly is expensive.
        """
        copy = replace(self, problem=problem)
        kept = ("_classified", "rank", "parts", "ends")
        vars(copy).update({name: getattr(self, name) for name in kept})
        return copy


def itself(part: T) -> T:
    """Return the argument."""
    return part


class Rows(NamedTuple):
    """The rows Bv = c, or Bv ≤ c for contact, of torn bodies."""

    B: csr_array  #: (m, N) rows in torn unknowns
    c: Vector  #: (m,) right-hand side
    equalities: int  #: number of equality rows, which come first


def subdomain_ranks(problem: DecomposedProblem, ranks: int) -> NDArray[np.int64]:
    """Return the rank (S,) of each subdomain; the ranks have consecutive subdomains.

    Products with the dual operator sum whole vectors, so that the ranks need not have
    few common rows. The work of a product and the number of nodes are balanced.

    ranks : number of ranks, at most S
    """
    of, S = problem.layout, problem.layout.count
    touched = of.glued()
    d = problem.components
    node = np.unique(np.concatenate([problem.fixed, problem.contact.rows.indices]) // d)
    single = node[of.multiplicity(node) == 1]
    touched = touched + np.bincount(of.holder(single), minlength=S)
    work = touched**2 / max((touched**2).sum(), 1) + of.sizes / of.sizes.sum()
    middle = np.cumsum(work) - work / 2
    first = np.searchsorted(middle, np.arange(1, ranks) * work.sum() / ranks)
    for k in range(ranks - 1):  # no rank is idle
        least = first[k - 1] + 1 if k else 1
        first[k] = min(max(first[k], least), S - ranks + 1 + k)
    return np.searchsorted(first, np.arange(S), side="right")


def _rows(torn: TornBodies) -> Rows:
    """Assemble the rows of B, in the order of supports, gluing and contact."""
    problem, d = torn.problem, torn.problem.components
    entries = [_support_rows(torn), _gluing_rows(torn), _contact_rows(torn)]
    row, column, value = (np.concatenate(p) for p in zip(*entries, strict=True))
    contact, scale = problem.contact, problem.contact_scale
    E = _equality_count(problem)
    shape = E + scale.size, d * torn.nodes.number.size
    B = csr_array((value, (row, column)), shape=shape)
    c = np.append(np.zeros(E), scale * contact.c)
    if problem.lift is not None:
        supports = slice(0, int(problem.layout.multiplicity(problem.fixed // d).sum()))
        c[supports] = (B @ (torn.spread @ problem.lift))[supports]
    return Rows(B=B, c=c, equalities=E)


def _support_rows(torn: TornBodies) -> Entries:
    """Return the support rows: one per copy of a fixed component, last first."""
    problem, d = torn.problem, torn.problem.components
    node, k = np.divmod(problem.fixed, d)
    of, copy, at = _copies(torn, node)
    row = np.cumsum(problem.layout.multiplicity(node))[of] - 1 - copy
    value = np.sqrt(torn.row_stiffness(at))
    return _rotated(torn, row, at, k[of], value)


def _copies(torn: TornBodies, node: Nodes) -> tuple[Nodes, Nodes, Nodes]:
    """Return all copies (k,) of given nodes, in the order of the nodes.

    The results are the indices of the nodes in the list, the numbers of the copies from
    0, and the torn nodes.
    """
    of = torn.problem.layout
    multiplicity = of.multiplicity(node)
    place = np.repeat(np.arange(multiplicity.size), multiplicity)
    first = np.cumsum(multiplicity) - multiplicity
    copy = np.arange(place.size) - first[place]
    return place, copy, of.index(node[place], copy)


def _gluing_rows(torn: TornBodies) -> Entries:
    """Return the gluing rows, ordered by multiplicity, then by node and component."""
    problem, nodes, of = torn.problem, torn.nodes, torn.problem.layout
    d = problem.components
    fixed = np.sort(problem.fixed)
    fixed_multiplicity = of.multiplicity(fixed // d)
    base = int(fixed_multiplicity.sum())
    none = np.zeros(0, dtype=np.int64)
    parts = [Entries(none, none, np.zeros(0))]
    for m, nodes_with in sorted(of.nodes_by_multiplicity.items()):
        W = GLUE[problem.glue](m)
        fixed_m = fixed[fixed_multiplicity == m]
        several = np.flatnonzero(nodes.multiplicity == m)
        number = nodes.number[several]
        before = of.before(number)
        stiffness = np.sqrt(torn.row_stiffness(several))
        for k in range(d):
            component = d * number + k
            free = ~np.isin(component, fixed_m)
            first = d * before + k - np.searchsorted(fixed_m, component)
            for r, weights in enumerate(W):
                value = weights[nodes.copy[several]]
                rows = np.flatnonzero(free & (value != 0))
                row = base + first[rows] * len(W) + r
                axis, scaled = np.full(rows.size, k), stiffness[rows] * value[rows]
                parts.append(_rotated(torn, row, several[rows], axis, scaled))
        base += len(W) * (d * nodes_with - fixed_m.size)
    return Entries(*(np.concatenate(p) for p in zip(*parts, strict=True)))


def _contact_rows(torn: TornBodies) -> Entries:
    """Return the contact and friction rows, which act on averages of copies."""
    problem, d = torn.problem, torn.problem.components
    entries = problem.contact.rows.tocoo()
    node, k = np.divmod(entries.col.astype(np.int64), d)
    of, _, at = _copies(torn, node)
    row = _equality_count(problem) + entries.row.astype(np.int64)
    share = problem.contact_scale[entries.row] * entries.data
    share = share / problem.layout.multiplicity(node)
    return _rotated(torn, row[of], at, k[of], share[of])


def _rotated(
    torn: TornBodies,
    row: NDArray[np.int64],
    node: NDArray[np.int64],
    k: NDArray[np.int64],
    value: Vector,
) -> Entries:
    """Rotate entries along global axes k (j,) at torn nodes (j,) to subdomain axes.

    Only nonzero entries are returned.
    """
    d = torn.problem.components
    if d == 1:
        return Entries(row, node, value)
    # row k of Q, because u_k = Σ Q_kq v_q
    rotation = torn.rotation[torn.nodes.subdomain[node], k]
    nonzero = rotation != 0
    column = d * node[:, None] + np.arange(d)
    rows = np.broadcast_to(row[:, None], nonzero.shape)
    scaled = rotation * value[:, None]
    return Entries(rows[nonzero], column[nonzero], scaled[nonzero])


def _equality_count(problem: DecomposedProblem) -> int:
    """Return the number of rows of supports and gluing."""
    of, d = problem.layout, problem.components
    multiplicity = of.multiplicity(problem.fixed // d)
    glued = sum(
        len(GLUE[problem.glue](m)) * (d * count - int((multiplicity == m).sum()))
        for m, count in of.nodes_by_multiplicity.items()
    )
    return int(multiplicity.sum()) + glued
