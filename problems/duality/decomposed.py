"""Load steps of decomposed elastic bodies in contact, on one process or several ranks.

No displacement vector of global size is allocated, because the linearisation of contact
only requires the positions and displacements of the nodes on the contact sides.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array, diags_array, eye_array, vstack

from mortarbench.harness import (
    QP,
    Friction,
    InputError,
    ReferenceOverRanks,
    Solution,
    Status,
    Vector,
)
from mortarbench.harness.distributed.vectors import DistributedQP, Ranks
from mortarbench.harness.mechanics import boundary_facets
from mortarbench.problems.contact.bodies import (
    ContactPair,
    ContactSides,
    elasticity_matrices,
    joined_names,
    slave_places,
)
from mortarbench.problems.contact.friction import friction_of
from mortarbench.problems.contact.results import BulkResults, results_of
from mortarbench.problems.contact.rows import ContactRows, without_fixed
from mortarbench.problems.contact.stepping import (
    Forces,
    LoadPath,
    Stage,
    State,
    forces_of,
)
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
    """Linearised contact problem of bodies in subdomains; see `LinearisedProblem`.

    All ranks must call its methods together; the results are equal on all ranks.
    """

    stage: Stage
    dual: LocalDual
    sides: LinearisedSides
    reference: ReferenceOverRanks

    @property
    def friction(self) -> Friction:
        """Friction at the nodes of the contact sides."""
        return self.sides.friction

    @cached_property
    def _qp(self) -> QP:
        return self.dual.share().qp

    def solve(self, friction: Friction, start: Solution | None = None) -> Solution:
        """Solve the distributed dual with the given friction bounds."""
        qp = replace(self._qp, sets=self.dual.sets(friction.bound))
        return self.reference(qp, start)

    def normal_multipliers(self, s: Solution) -> Vector:
        """Return the multipliers λ_n (m,) of the contact rows."""
        dual = self.dual
        z = contact_multipliers(dual.subdomains, dual.halo, s)
        return z[: self.sides.c.size]

    def end_state(self, s: Solution) -> tuple[Vector, Vector]:
        """Return u (w,) on the contact sides and the normal forces (places,).

        `places` is the number of slave nodes. Displacements and forces are
        nondimensional.
        """
        dual, sides = self.dual, self.sides
        solution = local_solution(dual.subdomains, dual.halo, s)
        vars(self).pop("_qp", None)  # release the large explicit blocks
        # negative multipliers of inexact solutions would be negative friction bounds
        normal = np.maximum(self.normal_multipliers(s), 0.0)
        forces = sides.rows.at_places(normal, slave_places(sides.bodies.pairs))
        return solution.at(sides.component), forces


def decomposed_path(
    problem: ContactProblem, choice: Choice, ranks: Ranks, reference: ReferenceOverRanks
) -> LoadPath[DecomposedLinearisation]:
    """Return the load path of a decomposed contact problem.

    All ranks must call this function, and the methods of the path, together.

    reference : solver of a distributed dual; all ranks call it together
    """
    if problem.bodies.lift is not None:
        raise InputError(
            "prescribed displacements on MPI ranks are not built; expected no ranks, "
            "or supports without displacement"
        )
    layout, elastic = cached_layout(problem.bodies, choice.size), problem.bodies
    previous = list[LocalDual]()

    def pose(stage: Stage, at: State) -> DecomposedLinearisation:
        sides = linearise_sides(problem, layout, stage, at)
        parts = decompose(elastic, layout, choice.glue, stage, sides.contact)
        if previous:  # the bodies are unchanged, so reuse their subdomain classes
            previous[0] = LocalDual(previous[0].subdomains.with_problem(parts))
        else:
            previous.append(dual_on(parts, ranks))
        return DecomposedLinearisation(stage, previous[0], sides, reference)

    zero = np.zeros(elastic.shape.dim * side_nodes(elastic.pairs).size)
    forces = np.full(slave_places(elastic.pairs), problem.initial_force)
    rest = State(zero, zero, forces)
    return LoadPath(problem.stages, pose, rest)


@lru_cache(maxsize=4)
def cached_layout(bodies: ElasticBodies, size: int) -> Subdivision:
    """Return the (cached) subdivision of bodies, see `Shape.layout`."""
    return bodies.shape.layout(size)


def distributed_qp_of(
    ranks: Ranks, problem: ContactProblem, choice: Choice, reference: ReferenceOverRanks
) -> DistributedQP:
    """Return the selected dual QP, distributed over ranks.

    All ranks must call this function together.

    Raises
    ------
    InputError
        If there are fewer subdomains than ranks, if the ranks computed
        different subdomains, or if the fixed-point iteration for Coulomb's law does not
        converge or takes fewer iterates than the number that `choice` selects.

    """
    path = decomposed_path(problem, choice, ranks, reference)
    chosen = path.problem(choice.step, choice.iterate)
    last = path.last_of(choice.step)
    previous = [one for i in range(last) for one in path.problems(i)]
    previous += path.problems(last)[: path.problems(last).index(chosen)]
    posed, count = chosen.problem, len(path.problems(last))
    sides = replace(posed.sides, friction=chosen.friction)

    def reported(solution: LocalSolution) -> dict[str, Any]:
        return _quantities(
            problem, DistributedSolution(solution, sides, problem.bodies, count)
        )

    dual = posed.dual.with_bound(chosen.friction.bound)
    first = previous[0].problem.dual if previous else None
    return distributed_qp(dual, reported, first, len(previous))


def decompose(
    bodies: ElasticBodies,
    layout: Subdivision,
    glue: str,
    stage: Stage,
    contact: Contact,
) -> DecomposedProblem:
    """Return the decomposed problem of elastic bodies under the load of a `Stage`.

    Raises
    ------
    InputError
        If the bodies have springs.

    """
    if bodies.springs is not None:
        raise InputError(
            "springs on bodies in parts are not built; expected no parts, or no springs"
        )
    unit, pieces = bodies.length / bodies.force, bodies.piece
    D = elasticity_matrices(bodies.materials, bodies.plane) * unit
    E = np.array([m.E for m in bodies.materials]) * unit
    share = longitudinal_share(D)
    load = stage.forces._replace(value=stage.forces.value * stage.part)
    lift = None
    if bodies.lift is not None:
        lift = force_lookup(forces_of(bodies.lift * stage.part))
    return DecomposedProblem(
        layout=layout,
        components=bodies.shape.dim,
        material=layout.body,
        assemble_class=partial(elastic_class, D=D, E=E),
        E=E,
        names=bodies.names if pieces is None else joined_names(bodies.names, pieces),
        piece=pieces,
        shaping=partial(layout.shaping, share) if isinstance(layout, Layout) else None,
        fixed=stage.fixed,
        load=force_lookup(load),
        lift=lift,
        glue=glue,
        contact=contact,
    )


def force_lookup(forces: Forces) -> Callable[[Nodes], Vector]:
    """Return a function that maps displacement components (k,) to forces (k,).

    Components that are not listed in `forces` are unloaded.
    """
    order = np.argsort(forces.component)
    components = forces.component[order]

    def of(component: Nodes) -> Vector:
        values = np.zeros(component.size)
        loaded = np.isin(component, components)
        values[loaded] = forces.value[
            order[np.searchsorted(components, component[loaded])]
        ]
        return values

    return of


def side_nodes(pairs: Sequence[ContactPair]) -> Nodes:
    """Return the nodes of all contact sides, ascending."""
    return np.unique(np.concatenate([pair.nodes for pair in pairs]))


@dataclass(frozen=True, eq=False, kw_only=True)
class LinearisedSides:
    """Nondimensional linearised contact, restricted to nodes of the contact sides."""

    bodies: ContactSides  #: contact sides with a total of N nodes
    node: Nodes  #: (N,) global numbers of these nodes
    nodes: int  #: number of nodes of the bodies
    rows: ContactRows  #: contact rows B u ≤ c in local components, m
    fixed: Nodes  #: local components that supports prescribe
    friction: Friction  #: friction rows; empty without friction

    @property
    def c(self) -> Vector:
        """Right-hand sides (m,), nondimensional."""
        return self.rows.c / self.bodies.length

    @property
    def component(self) -> Nodes:
        """Global components of the columns of `B`, (dim·N,)."""
        return dofs_of(self.node, self.bodies.mesh.dim)

    @property
    def contact(self) -> Contact:
        """Contact rows followed by friction rows, in global components."""
        friction, B, c = self.friction, self.rows.B, self.c
        if friction.bound.size:
            B = csr_array(vstack([B, friction.T]))
            c = np.append(c, friction.start)
        rows = csr_array(
            (B.data, self.component[B.indices], B.indptr),
            shape=(B.shape[0], self.bodies.mesh.dim * self.nodes),
        )
        return Contact(rows, c, friction.bound, friction.tangents)


def linearise_sides(
    problem: ContactProblem, layout: Subdivision, stage: Stage, at: State
) -> LinearisedSides:
    """Linearise contact at the start of a stage."""
    elastic = problem.bodies
    node = side_nodes(elastic.pairs)
    bodies = ContactSides(
        mesh=Mesh(layout.position(node), np.zeros((0, 4), dtype=np.int64), {}),
        body_of_node=np.asarray(layout.body[layout.holder(node)]),
        names=elastic.names,
        pairs=tuple(pair.renumbered(node) for pair in elastic.pairs),
        length=elastic.length,
        force=elastic.force,
    )
    fixed = np.flatnonzero(np.isin(dofs_of(node, elastic.shape.dim), stage.fixed))
    rows = problem.linearise(bodies, stage.laws)(at.u * elastic.length)
    rows = without_fixed(rows, fixed)
    return LinearisedSides(
        bodies=bodies,
        node=node,
        nodes=layout.nodes,
        rows=rows,
        fixed=fixed,
        friction=friction_of(
            bodies, rows, stage.laws, at.slip_origin, at.normal_forces
        ),
    )


@dataclass(frozen=True, eq=False)
class DistributedSolution:
    """Solution distributed over ranks; see `ContactSolution`."""

    solution: LocalSolution
    linearised: LinearisedSides
    elastic: ElasticBodies
    problems: int

    def at(self, component: Nodes) -> Vector:
        """Return the nondimensional displacement at global components (k,)."""
        return self.solution.at(component)

    def largest(self, value: float) -> float:
        """Return the maximum of a value over all ranks."""
        return self.solution.bodies.ranks.extreme(value, np.max)

    def meshes(self) -> Iterator[DisplacedMesh]:
        """Yield the displaced local subdomains."""
        return local_meshes(self.solution, self.elastic.length)

    @cached_property
    def sides(self) -> InterfaceState:
        """State of the contact interface, gathered on every rank."""
        sides, component = self.linearised, self.linearised.component
        w = component.size
        diagonal, free = np.zeros(w), np.full(w, np.inf)
        if sides.friction.bound.size:
            diagonal = self.solution.diagonal(component)
        primal = QP(
            P=csc_array(diags_array(diagonal)),
            q=np.zeros(w),
            A=csr_array(eye_array(w, format="csr")[sides.fixed]),
            b=np.zeros(sides.fixed.size),
            G=sides.rows.B,
            h=sides.c,
            lb=-free,
            ub=free,
        )
        s = Solution(
            status=Status.SOLVED,
            x=self.at(component),
            y=np.zeros(sides.fixed.size),
            z=self.solution.z,
            z_box=np.zeros(w),
        )
        return InterfaceState(sides.bodies, primal, s, sides.rows, sides.friction)


def _quantities(
    problem: ContactProblem, solution: DistributedSolution
) -> dict[str, Any]:
    """Return the quantities of a distributed solution; all ranks call this together."""
    elastic, local = problem.bodies, solution.solution.subdomains
    layout = local.problem.layout
    cells = sum(len(layout.cells(int(s))) for s in local.number)
    bulk = BulkResults(
        nodes=layout.nodes,
        supports=local.problem.fixed.size,
        elements=int(local.ranks.total(np.array([float(cells)]))[0]),
        energy=solution.solution.energy * elastic.force * elastic.length,
        max_von_mises=_max_von_mises(
            solution.solution, elastic.length, elastic.materials, elastic.plane
        ),
    )
    return {**results_of(bulk, *solution.sides), **problem.results(solution)}


def longitudinal_share(D: NDArray[np.float64]) -> Vector:
    """Return C₁₁ / (C₁₁ + C₆₆), (k,), for elasticity matrices (k, v, v) with entries C.

    In Voigt's notation, C₆₆ is the last diagonal entry, the shear modulus.
    """
    return np.asarray(D[:, 0, 0] / (D[:, 0, 0] + D[:, -1, -1]))


def elastic_class(
    part: SubdomainMesh, D: NDArray[np.float64], E: Vector
) -> SubdomainClass:
    """Return the class of a floating elastic subdomain, with its assembled stiffness.

    Parameters
    ----------
    D : (k, v, v) elasticity matrices of the materials, nondimensional
    E : (k,) Young's moduli of the materials, nondimensional

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


#: number of nodes per batch of subdomains; limits the memory for stresses
BATCH_NODES = 2**15
#: number of layers of cells around a node on which its recovered stress may depend
STRESS_LAYERS = 3


def local_meshes(
    solution: LocalSolution, length: float, layers: int = 0
) -> Iterator[DisplacedMesh]:
    """Return an iterator over batches of displaced local subdomains.

    All ranks must call this function together.

    Parameters
    ----------
    length : unit of length of the displacements, m
    layers : number of layers of neighbouring cells to add

    """
    layout = solution.subdomains.problem.layout
    dim = solution.subdomains.problem.components
    batches = _batches(layout, solution.subdomains.number)
    around = [_with_layers(layout, batch, layers) for batch in batches]
    node = np.unique(np.concatenate([part.node for part in around]))
    here = solution.bodies.components[::dim] // dim
    place = np.minimum(np.searchsorted(here, node), here.size - 1)
    missing = here[place] != node
    u = as_vectors(solution.u, dim)[place]
    requests = solution.bodies.ranks.comm.allgather(node[missing])
    requested = np.unique(np.concatenate(requests))
    received = as_vectors(solution.at(dofs_of(requested, dim)), dim)
    u[missing] = received[np.searchsorted(requested, node[missing])]

    def meshes() -> Iterator[DisplacedMesh]:
        for batch, part in zip(batches, around, strict=True):
            at = np.searchsorted(node, part.node)
            mesh = Mesh(layout.position(part.node), part.cells, {})
            body = int(layout.body[batch[0]])
            yield DisplacedMesh(body, mesh, part.inner, u[at].ravel() * length)

    return meshes()


def _batches(layout: Subdivision, subdomains: Nodes) -> list[Nodes]:
    """Group subdomains into batches, each of one body and `BATCH_NODES` nodes at most.

    A subdomain with more nodes forms a separate batch.
    """
    sizes = np.diff(layout.subdomain_nodes(subdomains).start)
    first, nodes = [0], 0
    for s, size in enumerate(sizes):
        other = layout.body[subdomains[s]] != layout.body[subdomains[first[-1]]]
        if s > first[-1] and (other or nodes + size > BATCH_NODES):
            first.append(s)
            nodes = 0
        nodes += int(size)
    return np.split(subdomains, first[1:])


class _Patch(NamedTuple):
    """Subdomains of one body with layers of neighbouring cells."""

    node: Nodes  #: (N,) global numbers
    cells: Nodes  #: (E, corners) indices into `node`
    inner: NDArray[np.bool_]  #: (N,) True for nodes of the subdomains


def _with_layers(layout: Subdivision, subdomains: Nodes, layers: int) -> _Patch:
    """Return subdomains of one body with layers of neighbouring cells."""
    inside = np.unique(layout.subdomain_nodes(subdomains).number)
    body = int(layout.body[subdomains[0]])
    included = subdomains
    if layers:
        included = np.union1d(subdomains, _holders(layout, inside, body))
    nodes, cells = _cells_of(layout, included)
    reached, selected = inside, np.ones(len(cells), dtype=bool)
    for _ in range(layers):
        neighbours = np.setdiff1d(_holders(layout, reached, body), included)
        if neighbours.size:
            included = np.concatenate([included, neighbours])
            nodes, cells = _cells_of(layout, included)
        selected = np.asarray(np.isin(nodes, reached)[cells].any(axis=1))
        used = np.zeros(nodes.size, dtype=bool)
        used[cells[selected]] = True
        reached = nodes[used]
    place = np.searchsorted(reached, nodes)
    inner = np.isin(reached, inside, assume_unique=True)
    return _Patch(reached, place[cells[selected]], inner)


def _cells_of(layout: Subdivision, subdomains: Nodes) -> tuple[Nodes, Nodes]:
    """Return the nodes of `subdomains`, and their cells as indices into these nodes."""
    torn = layout.subdomain_nodes(subdomains)
    nodes, place = np.unique(torn.number, return_inverse=True)
    cells = [
        place[begin + layout.cells(int(s))]
        for s, begin in zip(subdomains, torn.start, strict=False)
    ]
    return nodes, np.concatenate(cells)


def _holders(layout: Subdivision, node: Nodes, body: int) -> Nodes:
    """Return the subdomains of a body that contain interface nodes among `node`."""
    multiplicity = layout.multiplicity(node)
    several = multiplicity > 1
    copies = range(int(multiplicity.max(initial=1)))
    holders = [layout.holder(node[several & (multiplicity > c)], c) for c in copies]
    found = np.unique(np.concatenate(holders))
    return np.asarray(found[layout.body[found] == body])


def _max_von_mises(
    solution: LocalSolution,
    length: float,
    materials: tuple[Material, ...],
    plane: Plane | None,
) -> list[float]:
    """Return the largest nodal von Mises stress of each body, Pa."""
    D = elasticity_matrices(materials, plane)
    largest = np.zeros(len(materials))
    for b, mesh, inner, u in local_meshes(solution, length, STRESS_LAYERS):
        stress = recover(mesh, centre_stress(mesh, D[b], u))[inner]
        maximum = von_mises(stress, materials[b].nu, plane).max()
        largest[b] = max(largest[b], maximum)
    all_ranks = solution.bodies.ranks.gather_all(largest)
    return [float(maximum) for maximum in all_ranks.max(axis=0)]
