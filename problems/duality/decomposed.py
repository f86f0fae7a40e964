"""Elastic bodies in contact, in subdomains of one process or of several ranks.

Nothing of the size of the whole is needed: contact is linearised at the displacement of
the sides that may touch, from their nodes alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array, diags_array, vstack

from mortarbench.harness import (
    QP,
    Friction,
    ReferenceOverRanks,
    Solution,
    Status,
    Vector,
    no_rows,
)
from mortarbench.harness.distributed.vectors import DistributedQP, Ranks
from mortarbench.problems.contact.bodies import (
    ContactPair,
    ContactSides,
    elasticity_matrices,
)
from mortarbench.problems.contact.friction import forces_at_nodes, friction_of
from mortarbench.problems.contact.results import BulkResults, results_of
from mortarbench.problems.contact.stepping import Forces, LoadPath, Stage, State
from mortarbench.problems.duality.problem import (
    Choice,
    ContactProblem,
    DisplacedMesh,
    ElasticBodies,
    InterfaceState,
)
from mortarbench.problems.fem.elasticity import Material, Plane, rigid_modes, stiffness
from mortarbench.problems.fem.fixing import fixing_nodes
from mortarbench.problems.fem.mesh import (
    Mesh,
    Nodes,
    as_vectors,
    boundary_facets,
    dofs_of,
)
from mortarbench.problems.fem.stress import centre_stress, recover, von_mises
from mortarbench.problems.feti.distributed_dual import (
    LocalDual,
    distributed_qp,
    dual_on,
)
from mortarbench.problems.feti.local_bodies import (
    LocalSolution,
    contact_multipliers,
    local_solution,
)
from mortarbench.problems.feti.structured import Layout
from mortarbench.problems.feti.subdivision import Subdivision
from mortarbench.problems.feti.subdomain_classes import SubdomainClass
from mortarbench.problems.feti.subdomains import Contact, DecomposedProblem
from mortarbench.problems.feti.tearing import SubdomainMesh


@dataclass(frozen=True, eq=False)
class DecomposedLinearisation:
    """A linearised contact problem of bodies in subdomains; see `LinearisedProblem`.

    Its methods are called by all ranks, and give them the same.
    """

    stage: Stage
    dual: LocalDual
    sides: LinearisedSides
    reference: ReferenceOverRanks

    @property
    def friction(self) -> Friction:
        """That of the nodes of the sides alone."""
        return self.sides.friction

    @cached_property
    def _qp(self) -> QP:
        return self.dual.share().qp

    def solve(self, friction: Friction, start: Solution | None = None) -> Solution:
        """Solve the dual with the bound of a friction, a share of it on each rank."""
        limits = self.dual.bounds(friction.bound)
        return self.reference(self._qp.with_bounds(*limits), start)

    def normal_multipliers(self, s: Solution) -> Vector:
        """Return the multipliers λ_n (m,) of the contact rows."""
        dual = self.dual
        z = contact_multipliers(dual.subdomains, dual.halo, s)
        return z[: self.sides.place.size]

    def end_state(self, s: Solution) -> tuple[Vector, Vector]:
        """Return u (w,) at the sides, without dimension, and the normal forces."""
        dual, sides = self.dual, self.sides
        found = local_solution(dual.subdomains, dual.halo, s)
        vars(self).pop("_qp", None)  # explicit blocks are large, and done with
        forces = forces_at_nodes(self.normal_multipliers(s), sides.place, sides.places)
        return found.at(sides.component), forces


def decomposed_path(
    problem: ContactProblem, choice: Choice, ranks: Ranks, reference: ReferenceOverRanks
) -> LoadPath[DecomposedLinearisation]:
    """Prepare the load steps of a contact problem in subdomains; called by all ranks.

    reference : solves shares of a dual, on all ranks together
    """
    layout, of = cached_layout(problem.bodies, choice.size), problem.bodies
    known = list[LocalDual]()

    def pose(stage: Stage, at: State) -> DecomposedLinearisation:
        sides = linearised(problem, layout, stage, at)
        parts = decompose(of, layout, choice.glue, stage, sides.contact)
        if known:  # the bodies are the same, and so are what was made of them alone
            known[0] = LocalDual(known[0].subdomains.with_problem(parts))
        else:
            known.append(dual_on(parts, ranks))
        return DecomposedLinearisation(stage, known[0], sides, reference)

    nothing = np.zeros(of.shape.dim * side_nodes(of.pairs).size)
    places = sum(pair.slave.size for pair in of.pairs)
    rest = State(nothing, nothing, np.full(places, problem.pressed))
    return LoadPath(problem.stages, pose, rest)


@lru_cache(maxsize=4)
def cached_layout(bodies: ElasticBodies, size: int) -> Subdivision:
    """Cut bodies; see `Shape.layout`."""
    return bodies.shape.layout(size)


def distributed_qp_of(
    ranks: Ranks, problem: ContactProblem, choice: Choice, reference: ReferenceOverRanks
) -> DistributedQP:
    """Emit this rank's share of the dual that is chosen; called by all ranks.

    Raises
    ------
    InputError
        Where there are fewer subdomains than ranks, ranks know different ones, or
        Coulomb's law does not settle or has less problems than are asked for.

    """
    path = decomposed_path(problem, choice, ranks, reference)
    chosen = path.problem(choice.step, choice.iterate)
    last = path.last_of(choice.step)
    before = [one for i in range(last) for one in path.problems(i)]
    before += path.problems(last)[: path.problems(last).index(chosen)]
    linearised, count = chosen.problem, len(path.problems(last))
    sides = replace(linearised.sides, friction=chosen.friction)

    def reported(found: LocalSolution) -> dict[str, Any]:
        return _reported(
            problem, DistributedSolution(found, sides, problem.bodies, count)
        )

    dual = linearised.dual.with_bound(chosen.friction.bound)
    first = before[0].problem.dual if before else None
    return distributed_qp(dual, reported, first, len(before))


def decompose(
    bodies: ElasticBodies, layout: Subdivision, glue: str, stage: Stage,
    contact: Contact,
) -> DecomposedProblem:  # fmt: skip
    """Describe elastic bodies under the load of a stage, before they are torn."""
    unit = bodies.length / bodies.force
    D = elasticity_matrices(bodies.materials, bodies.plane) * unit
    E = np.array([m.E for m in bodies.materials]) * unit
    share = longitudinal_share(D)
    force = stage.forces._replace(value=stage.forces.value * stage.part)
    return DecomposedProblem(
        layout=layout, components=bodies.shape.dim, material=layout.body,
        assemble_class=partial(elastic_class, D=D, E=E), E=E, names=bodies.names,
        shaping=partial(layout.shaping, share) if isinstance(layout, Layout) else None,
        fixed=stage.fixed, load=force_lookup(force), glue=glue, contact=contact,
    )  # fmt: skip


def force_lookup(forces: Forces) -> Callable[[Nodes], Vector]:
    """Return a function that looks forces up by components; zero elsewhere."""
    order = np.argsort(forces.component)
    known = forces.component[order]

    def of(asked: Nodes) -> Vector:
        found = np.zeros(asked.size)
        loaded = np.isin(asked, known)
        found[loaded] = forces.value[order[np.searchsorted(known, asked[loaded])]]
        return found

    return of


def side_nodes(pairs: Sequence[ContactPair]) -> Nodes:
    """List the nodes of all sides that may touch."""
    return np.unique(np.concatenate([side for pair in pairs for side in pair]))


@dataclass(frozen=True, eq=False, kw_only=True)
class LinearisedSides:
    """Contact linearised from the nodes of the sides alone, without dimensions."""

    bodies: ContactSides  #: of N nodes
    node: Nodes  #: (N,) their numbers in the whole
    nodes: int  #: of the whole
    B: csr_array  #: (m, 2N)
    c: Vector  #: (m,)
    friction: Friction  #: none without rows
    place: Nodes  #: (m,) slave node of each row

    @property
    def component(self) -> Nodes:
        """Components of the whole that the columns are of, (2N,)."""
        return dofs_of(self.node, self.bodies.mesh.dim)

    @property
    def places(self) -> int:
        """Number of slave nodes."""
        return sum(pair.slave.size for pair in self.bodies.pairs)

    @property
    def contact(self) -> Contact:
        """The rows of contact, then of friction, on all components of the whole."""
        friction, B, c = self.friction, self.B, self.c
        if friction.bound.size:
            B = csr_array(vstack([B, friction.T]))
            c = np.append(c, friction.start)
        rows = csr_array(
            (B.data, self.component[B.indices], B.indptr),
            shape=(B.shape[0], self.bodies.mesh.dim * self.nodes),
        )
        return Contact(rows, c, friction.bound)


def linearised(
    problem: ContactProblem, layout: Subdivision, stage: Stage, at: State
) -> LinearisedSides:
    """Linearise contact where a stage begins."""
    of = problem.bodies
    node = side_nodes(of.pairs)
    bodies = ContactSides(
        mesh=Mesh(layout.position(node), np.zeros((0, 4), dtype=np.int64), {}),
        body_of_node=np.asarray(layout.body[layout.holder(node)]), names=of.names,
        pairs=tuple(
            ContactPair(*(np.searchsorted(node, side) for side in pair))
            for pair in of.pairs
        ),
        length=of.length, force=of.force,
    )  # fmt: skip
    rows = problem.linearise(bodies, stage.laws)(at.u * of.length)
    return LinearisedSides(
        bodies=bodies, node=node, nodes=layout.nodes, B=csr_array(rows.B),
        c=rows.c / of.length, place=rows.place,
        friction=friction_of(
            bodies, rows, stage.laws, at.slip_origin, at.normal_forces
        ),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class DistributedSolution:
    """The answer that ranks have found; see `ContactSolution`."""

    solution: LocalSolution
    linearised: LinearisedSides
    of: ElasticBodies
    problems: int

    def at(self, component: Nodes) -> Vector:
        """Return the displacement at components (k,) of the whole, on all ranks."""
        return self.solution.at(component)

    def largest(self, value: float) -> float:
        """Return the largest of the numbers of all ranks."""
        return self.solution.bodies.ranks.extreme(value, np.max)

    def meshes(self) -> Iterator[DisplacedMesh]:
        """Give the displaced subdomains of each rank."""
        return local_meshes(self.solution, self.of.length)

    @cached_property
    def sides(self) -> InterfaceState:
        """Gather what ranks have found along the sides."""
        sides, at = self.linearised, self.linearised.component
        diagonal = self.solution.diagonal(at) if sides.friction.bound.size else 0 * at
        free = np.full(at.size, np.inf)
        primal = QP(
            P=csc_array(diags_array(diagonal.astype(float))), q=np.zeros(at.size),
            A=no_rows(at.size), b=np.zeros(0), G=sides.B, h=sides.c, lb=-free, ub=free,
        )  # fmt: skip
        s = Solution(
            status=Status.SOLVED, x=self.at(at), y=np.zeros(0), z=self.solution.z,
            z_box=np.zeros(at.size),
        )  # fmt: skip
        return InterfaceState(sides.bodies, primal, s, sides.friction)


def _reported(problem: ContactProblem, found: DistributedSolution) -> dict[str, Any]:
    """Report what ranks have found; called by all of them."""
    of, own = problem.bodies, found.solution.subdomains
    layout = own.problem.layout
    cells = sum(len(layout.cells(int(s))) for s in own.number)
    inside = BulkResults(
        nodes=layout.nodes, supports=own.problem.fixed.size,
        elements=int(own.ranks.total(np.array([float(cells)]))[0]),
        energy=found.solution.energy * of.force * of.length,
        max_von_mises=_largest_von_mises(
            found.solution, of.length, of.materials, of.plane
        ),
    )  # fmt: skip
    at = found.sides
    known = results_of(inside, at.bodies, at.primal, at.solution, at.friction)
    return {**known, **problem.results(found)}


def longitudinal_share(D: NDArray[np.float64]) -> Vector:
    """Return C₁₁ / (C₁₁ + C₆₆) of elasticity matrices (k, v, v)."""
    return np.asarray(D[:, 0, 0] / (D[:, 0, 0] + D[:, -1, -1]))


def elastic_class(
    part: SubdomainMesh, D: NDArray[np.float64], E: Vector
) -> SubdomainClass:
    """Assemble one floating subdomain.

    Parameters
    ----------
    D : (k, v, v) elasticity matrices of the materials, without dimension
    E : (k,) their moduli, without dimension

    """
    cells, dim = part.cells, part.points.shape[1]
    around = np.bincount(cells.ravel(), np.repeat(E[part.material], cells.shape[1]))
    return SubdomainClass(
        K=stiffness(Mesh(part.points, cells, {}), D, part.material),
        R=rigid_modes(part.points),
        fixing=dofs_of(fixing_nodes(part.points), dim),
        boundary=dofs_of(np.unique(boundary_facets(cells, dim)), dim),
        stiffness=np.repeat(around / np.bincount(cells.ravel()), dim),
    )


BATCH_NODES = 2**15  #: nodes of subdomains that are evaluated at once
STRESS_LAYERS = (
    3  #: cells from a node to the last that its recovered stress may depend on
)


def local_meshes(
    found: LocalSolution, length: float, reach: int = 0
) -> Iterator[DisplacedMesh]:
    """Give the displaced subdomains of each rank; called by all ranks.

    Parameters
    ----------
    length : of which displacements are multiples, m
    reach : how many cells around subdomains are added, where there are so many

    """
    layout = found.subdomains.problem.layout
    dim = found.subdomains.problem.components
    batches = _batches(layout, found.subdomains.number)
    around = [_around(layout, batch, reach) for batch in batches]
    node = np.unique(np.concatenate([part.node for part in around]))
    here = found.bodies.components[::dim] // dim
    place = np.minimum(np.searchsorted(here, node), here.size - 1)
    lacks = here[place] != node
    u = as_vectors(found.u, dim)[place]
    everyones = found.bodies.ranks.comm.allgather(node[lacks])
    asked = np.unique(np.concatenate(everyones))
    told = as_vectors(found.at(dofs_of(asked, dim)), dim)
    u[lacks] = told[np.searchsorted(asked, node[lacks])]

    def meshes() -> Iterator[DisplacedMesh]:
        for batch, part in zip(batches, around, strict=True):
            at = np.searchsorted(node, part.node)
            mesh = Mesh(layout.position(part.node), part.cells, {})
            body = int(layout.body[batch[0]])
            yield DisplacedMesh(body, mesh, part.inner, u[at].ravel() * length)

    return meshes()


def _batches(layout: Subdivision, subdomains: Nodes) -> list[Nodes]:
    """Group subdomains of one body, up to `BATCH_NODES` nodes or one subdomain."""
    sizes = np.diff(layout.subdomain_nodes(subdomains).start)
    first, held = [0], 0
    for s, size in enumerate(sizes):
        other = layout.body[subdomains[s]] != layout.body[subdomains[first[-1]]]
        if s > first[-1] and (other or held + size > BATCH_NODES):
            first.append(s)
            held = 0
        held += int(size)
    return np.split(subdomains, first[1:])


class _Around(NamedTuple):
    """Subdomains of one body with cells around them."""

    node: Nodes  #: (N,) in the whole
    cells: Nodes  #: (E, 4) of these nodes
    inner: NDArray[np.bool_]  #: (N,) those of the subdomains


def _around(layout: Subdivision, subdomains: Nodes, reach: int) -> _Around:
    """Take subdomains of one body and so many layers of cells around them."""
    own = np.unique(layout.subdomain_nodes(subdomains).number)
    taken = np.union1d(subdomains, _holders(layout, own)) if reach else subdomains
    nodes, cells = _cells_of(layout, taken)
    reached, kept = own, np.ones(len(cells), dtype=bool)
    for _ in range(reach):
        more = np.setdiff1d(_holders(layout, reached), taken)
        if more.size:
            taken = np.concatenate([taken, more])
            nodes, cells = _cells_of(layout, taken)
        kept = np.asarray(np.isin(nodes, reached)[cells].any(axis=1))
        used = np.zeros(nodes.size, dtype=bool)
        used[cells[kept]] = True
        reached = nodes[used]
    place = np.searchsorted(reached, nodes)
    inner = np.isin(reached, own, assume_unique=True)
    return _Around(reached, place[cells[kept]], inner)


def _cells_of(layout: Subdivision, subdomains: Nodes) -> tuple[Nodes, Nodes]:
    """Return the nodes of subdomains, and their cells (E, 4) as places in these."""
    torn = layout.subdomain_nodes(subdomains)
    nodes, place = np.unique(torn.number, return_inverse=True)
    cells = [
        place[begin + layout.cells(int(s))]
        for s, begin in zip(subdomains, torn.start, strict=False)
    ]
    return nodes, np.concatenate(cells)


def _holders(layout: Subdivision, node: Nodes) -> Nodes:
    """List the subdomains that have any of some nodes besides others."""
    multiplicity = layout.multiplicity(node)
    several = multiplicity > 1
    copies = range(int(multiplicity.max(initial=1)))
    held = [layout.holder(node[several & (multiplicity > c)], c) for c in copies]
    return np.unique(np.concatenate(held))


def _largest_von_mises(
    found: LocalSolution,
    length: float,
    materials: tuple[Material, ...],
    plane: Plane | None,
) -> list[float]:
    """Return the largest von Mises stress of each body, recovered at nodes, Pa."""
    D = elasticity_matrices(materials, plane)
    largest = np.zeros(len(materials))
    for b, mesh, inner, u in local_meshes(found, length, STRESS_LAYERS):
        stress = recover(mesh, centre_stress(mesh, D[b], u))[inner]
        most = von_mises(stress, materials[b].nu, plane).max()
        largest[b] = max(largest[b], most)
    everyones = found.bodies.ranks.gather_all(largest)
    return [float(most) for most in everyones.max(axis=0)]
