"""Elastic bodies torn into subdomains."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array, diags_array, vstack

from mortarbench.harness import QP, Friction, Solution, Status, Value, Vector, no_rows
from mortarbench.harness.mechanics import NO_FRICTION, contact_rows
from mortarbench.problems.contact.bodies import (
    Bodies,
    ContactPair,
    ContactSides,
    elasticity_matrices,
)
from mortarbench.problems.contact.friction import (
    FrictionLaw,
    forces_at_nodes,
    friction_of,
)
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.node_to_segment import ContactRows
from mortarbench.problems.contact.results import Inside, results_of
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
from mortarbench.problems.feti.emission import Contact, FixedPoint, ProblemInParts
from mortarbench.problems.feti.gluing import glue
from mortarbench.problems.feti.own_bodies import OwnSolution
from mortarbench.problems.feti.structured import Layout
from mortarbench.problems.feti.subdivision import Subdivision
from mortarbench.problems.feti.tearing import Decomposition, Part, decompose
from mortarbench.problems.feti.torn import Kind, Torn


@dataclass(frozen=True, eq=False)
class SubdividedBodies:
    """Bodies in subdomains, before anything holds these together."""

    bodies: Bodies
    decomposition: Decomposition
    kinds: tuple[Kind, ...]
    shape: Vector | float  #: factor of E in the rows that hold them, (n,) or one


def subdivide(
    bodies: Bodies, label: NDArray[np.int64], layout: Layout | None = None
) -> SubdividedBodies:
    """Cut bodies into the subdomains that their cells (E,) are labelled with.

    layout : the same blocks of grids, where bodies are such: then rows that hold them
        follow the shape of cells (`problems.feti.structured`)
    """
    mesh = bodies.mesh
    decomposition = decompose(mesh.points, mesh.cells, label, bodies.body)
    D = bodies.elasticity * (bodies.length / bodies.force)
    kinds = tuple(elastic_kind(part, D, bodies.moduli) for part in decomposition.parts)
    shape = 1.0 if layout is None else _shape(bodies, layout)
    return SubdividedBodies(bodies, decomposition, kinds, shape)


def _shape(bodies: Bodies, layout: Layout) -> Vector:
    """Return the factor of each component; those held are on sides of the grids."""
    share, held = longitudinal_share(bodies.elasticity), bodies.B_D.indices
    free, at_ends = (
        np.repeat(layout.shapes(share, ends=ends), 2) for ends in (False, True)
    )
    free[held] = at_ends[held]
    return np.asarray(free)


def longitudinal_share(D: NDArray[np.float64]) -> Vector:
    """Return C₁₁ / (C₁₁ + C₆₆) of elasticity matrices (k, 3, 3)."""
    return np.asarray(D[:, 0, 0] / (D[:, 0, 0] + D[:, 2, 2]))


def elastic_kind(part: Part, D: NDArray[np.float64], E: Vector) -> Kind:
    """Assemble one floating subdomain.

    Parameters
    ----------
    D : (k, 3, 3) elasticity matrices of the materials, without dimension
    E : (k,) their moduli, without dimension

    """
    cells, dim = part.cells, part.points.shape[1]
    around = np.bincount(cells.ravel(), np.repeat(E[part.material], cells.shape[1]))
    return Kind(
        K=stiffness(Mesh(part.points, cells, {}), D, part.material),
        R=rigid_modes(part.points),
        fixing=dofs_of(fixing_nodes(part.points), dim),
        boundary=dofs_of(np.unique(boundary_facets(cells, dim)), dim),
        stiffness=np.repeat(around / np.bincount(cells.ravel()), dim),
    )


def posed_on(
    params: Mapping[str, Value],
    subdivided: Callable[[], SubdividedBodies],
    primal: QP,
    friction: Friction = NO_FRICTION,
) -> Callable[[], Torn] | None:
    """Prepare what the keys `feti` and `glue` ask for; None for bodies in one piece."""
    if not params["feti"]:
        return None
    return lambda: torn(subdivided(), primal, friction, str(params["glue"]))


def torn(
    subdomains: SubdividedBodies,
    primal: QP,
    friction: Friction = NO_FRICTION,
    rows: str = "orthonormal",
) -> Torn:
    """Pose a problem of the bodies, `primal` with `friction`, on their subdomains.

    rows : how subdomains are glued, see `problems.feti.gluing`
    """
    bodies = subdomains.bodies
    contact, c = contact_rows(primal, friction)
    return glue(
        subdomains.decomposition, subdomains.kinds, load=-primal.q,
        supports=csr_array(primal.A), supported=primal.b, contact=contact, c=c,
        E=bodies.moduli[bodies.body_of_node], shape=subdomains.shape, rows=rows,
    )  # fmt: skip


class Displaced(NamedTuple):
    """Where contact is linearised: components of `side_nodes` (w,), dimensionless."""

    u: Vector  #: (w,)
    before: Vector  #: (w,) where the slip begins
    #: (places,) normal forces of slave nodes, which Coulomb's law begins from
    pressed: Vector


def at_rest(pairs: Sequence[ContactPair], pressed: float = 0.0) -> Displaced:
    """Begin where nothing is displaced, and each slave node is pressed alike."""
    nothing = np.zeros(2 * side_nodes(pairs).size)
    places = sum(pair.slave.size for pair in pairs)
    return Displaced(nothing, nothing, np.full(places, pressed))


def side_nodes(pairs: Sequence[ContactPair]) -> Nodes:
    """List the nodes of all sides that may touch."""
    return np.unique(np.concatenate([side for pair in pairs for side in pair]))


def load_path(
    posed: Callable[[int, Displaced], ProblemInParts],
    pairs: Sequence[ContactPair],
    steps: Sequence[int],
    *,
    quasi_static: bool,
    pressed: float = 0.0,
) -> ProblemInParts:
    """Chain problems, each linearised at the solution of the one before.

    As `problems.duality.stepping.LoadPath` does.

    Parameters
    ----------
    posed : the problem of a load step, linearised somewhere
    steps : ascending; a step that is there several times is linearised anew
    quasi_static : whether slip is that of the step
    pressed : normal force of each slave node that the first bound of Coulomb's law is
        of, without dimension

    """

    def problem(i: int, at: Displaced) -> ProblemInParts:
        found = posed(steps[i], at)
        return (
            replace(found, then=partial(after, i, at)) if i + 1 < len(steps) else found
        )

    def after(i: int, at: Displaced, found: OwnSolution) -> ProblemInParts:
        u, forces = at_sides(found, pairs)
        ends = quasi_static and steps[i + 1] > steps[i]
        return problem(i + 1, Displaced(u, u if ends else at.before, forces))

    return problem(0, at_rest(pairs, pressed))


def at_sides(found: OwnSolution, pairs: Sequence[ContactPair]) -> tuple[Vector, Vector]:
    """Tell all ranks what a solution is at the sides, without dimensions.

    Returns
    -------
    displacement (w,) of `side_nodes`, and normal forces (places,) of the slave nodes

    """
    contact = found.subdomains.problem.contact
    u = found.at(dofs_of(side_nodes(pairs), 2))
    places = sum(pair.slave.size for pair in pairs)
    normal = found.z[: contact.place.size]
    return u, forces_at_nodes(normal, contact.place, places)


def tresca_problems(found: OwnSolution) -> int:
    """Count the problems of the last fixed point; 1 without Coulomb's law."""
    coulomb = found.subdomains.problem.coulomb
    return 1 if coulomb is None else coulomb.problems


class AtSides(NamedTuple):
    """What is known along the sides that may touch, as of the bodies themselves."""

    bodies: ContactSides
    primal: QP  #: of the nodes of the sides; of P, the diagonal where there is friction
    solution: Solution
    friction: Friction


def nothing_more(found: OwnSolution, at: AtSides) -> dict[str, Any]:
    """Report nothing besides what all elastic bodies report."""
    return {}


def in_parts(
    layout: Subdivision,
    *,
    materials: tuple[Material, ...],
    plane: Plane,
    units: tuple[float, float],
    names: tuple[str, ...],
    fixed: Nodes,
    load: tuple[Nodes, Vector],
    pairs: Sequence[ContactPair],
    linearise: Callable[[ContactSides, Vector], ContactRows],
    laws: Sequence[FrictionLaw] = (),
    glue: str,
    displaced: Displaced | None = None,
    step: int = 1,
    iterate: int = 0,
    results: Callable[[OwnSolution, AtSides], Mapping[str, Any]] = nothing_more,
) -> ProblemInParts:
    """Describe elastic bodies in contact, linearised, before they are torn.

    It is the problem of `problems.contact.bodies.assemble` and `torn`, of which every
    rank can emit its share (`problems.feti.emission`).

    Parameters
    ----------
    materials, plane, units, names, fixed, pairs : as of `assemble`
    load : components with a force, and the forces, N/m; each component once
    linearise : takes the rows at a displacement, m, from the nodes of the sides alone
    laws : of friction, one per pair
    displaced : where contact is linearised; None: at rest
    step, iterate : of Coulomb's law, see `FixedPoint`
    results : reports more of what ranks have found than of all elastic bodies; called
        by all ranks

    """
    length, force = units
    D = elasticity_matrices(materials, plane) * (length / force)
    E = np.array([m.E for m in materials]) * (length / force)
    share = longitudinal_share(D)
    at = displaced or at_rest(pairs)
    sides = _linearised(layout, pairs, names, units, linearise, laws, at)
    coulomb = any(law.mu for law in laws) or iterate > 1  # which there may not be

    def reported(found: OwnSolution) -> dict[str, Any]:
        own = found.subdomains
        cells = sum(len(layout.cells(int(s))) for s in own.number)
        inside = Inside(
            nodes=layout.nodes, supports=fixed.size,
            elements=int(own.ranks.total(np.array([float(cells)]))[0]),
            energy=found.energy * force * length,
            max_von_mises=_largest_von_mises(layout, found, length, materials, plane),
        )  # fmt: skip
        at = sides.found(found)
        known = results_of(inside, at.bodies, at.primal, at.solution, at.friction)
        return {**known, **results(found, at)}

    return ProblemInParts(
        layout=layout, components=2, material=layout.body,
        kind=partial(elastic_kind, D=D, E=E), E=E, names=names,
        shaping=partial(layout.shaping, share) if isinstance(layout, Layout) else None,
        held=fixed,
        load=forces_at(load[0], load[1] / force), glue=glue,
        contact=sides.of_whole(layout.nodes), results=reported,
        coulomb=FixedPoint(sides.friction, step, iterate) if coulomb else None,
    )  # fmt: skip


def forces_at(component: Nodes, force: Vector) -> Callable[[Nodes], Vector]:
    """Make what looks forces up by components; zero elsewhere."""
    order = np.argsort(component)
    known = component[order]

    def of(asked: Nodes) -> Vector:
        found = np.zeros(asked.size)
        loaded = np.isin(asked, known)
        found[loaded] = force[order[np.searchsorted(known, asked[loaded])]]
        return found

    return of


def linearised_by(
    contact: str, basis: Any, laws: Sequence[FrictionLaw] = ()
) -> Callable[[ContactSides, Vector], ContactRows]:
    """Make what linearises contact of sides, see `linearisation`."""
    return lambda sides, u: linearisation(sides, contact, basis, laws)(u)


@dataclass(frozen=True, eq=False, kw_only=True)
class _LinearisedSides:
    """Contact linearised from the nodes of the sides alone, without dimensions."""

    bodies: ContactSides  #: of N nodes
    node: Nodes  #: (N,) their numbers in the whole
    B: csr_array  #: (m, 2N)
    c: Vector  #: (m,)
    friction: Friction  #: none without rows; with the first bound of Coulomb's law
    place: Nodes  #: (m,) slave node of each row

    def of_whole(self, nodes: int) -> Contact:
        """Give the rows the columns of all components of so many nodes."""
        friction, B, c = self.friction, self.B, self.c
        if friction.bound.size:
            B = csr_array(vstack([B, friction.T]))
            c = np.append(c, friction.start)
        column = dofs_of(self.node, 2)[B.indices]
        rows = csr_array((B.data, column, B.indptr), shape=(B.shape[0], 2 * nodes))
        return Contact(rows, c, friction.bound, self.place)

    def found(self, found: OwnSolution) -> AtSides:
        """Gather what ranks have found along the sides; called by all of them."""
        at = dofs_of(self.node, 2)
        K = found.diagonal(at) if self.friction.bound.size else np.zeros(at.size)
        free = np.full(at.size, np.inf)
        primal = QP(
            P=csc_array(diags_array(K)), q=np.zeros(at.size), A=no_rows(at.size),
            b=np.zeros(0), G=self.B, h=self.c, lb=-free, ub=free,
        )  # fmt: skip
        s = Solution(
            status=Status.SOLVED, x=found.at(at), y=np.zeros(0), z=found.z,
            z_box=np.zeros(at.size),
        )  # fmt: skip
        bound = found.subdomains.problem.contact.bound
        return AtSides(self.bodies, primal, s, replace(self.friction, bound=bound))


def _linearised(
    layout: Subdivision,
    pairs: Sequence[ContactPair],
    names: tuple[str, ...],
    units: tuple[float, float],
    linearise: Callable[[ContactSides, Vector], ContactRows],
    laws: Sequence[FrictionLaw],
    displaced: Displaced,
) -> _LinearisedSides:
    """Linearise contact, as of `in_parts`."""
    length, force = units
    node = side_nodes(pairs)
    bodies = ContactSides(
        mesh=Mesh(layout.position(node), np.zeros((0, 4), dtype=np.int64), {}),
        body_of_node=np.asarray(layout.body[layout.holder(node)]), names=names,
        pairs=tuple(
            ContactPair(*(np.searchsorted(node, side) for side in pair))
            for pair in pairs
        ),
        length=length, force=force,
    )  # fmt: skip
    rows = linearise(bodies, displaced.u * length)
    return _LinearisedSides(
        bodies=bodies, node=node, B=csr_array(rows.B), c=rows.c / length,
        friction=friction_of(bodies, rows, laws, displaced.before, displaced.pressed),
        place=rows.place,
    )  # fmt: skip


class OwnMesh(NamedTuple):
    """Some subdomains of a rank and the cells around them, with their displacement."""

    body: int
    mesh: Mesh  #: N nodes
    inner: NDArray[np.bool_]  #: (N,) those of the subdomains
    u: Vector  #: (2N,) m


BATCH = 2**15  #: nodes of subdomains that are evaluated at once
REACH = 3  #: cells from a node to the last that its recovered stress may depend on


def own_meshes(
    layout: Subdivision, found: OwnSolution, length: float, reach: int = 0
) -> Iterator[OwnMesh]:
    """Give the displaced subdomains of each rank; called by all ranks.

    Parameters
    ----------
    length : of which displacements are multiples, m
    reach : how many cells around subdomains are added, where there are so many

    """
    batches = _batches(layout, found.subdomains.number)
    around = [_around(layout, batch, reach) for batch in batches]
    node = np.unique(np.concatenate([part.node for part in around]))
    here = found.bodies.components[::2] // 2
    place = np.minimum(np.searchsorted(here, node), here.size - 1)
    lacks = here[place] != node
    u = as_vectors(found.u, 2)[place]
    everyones = found.bodies.ranks.comm.allgather(node[lacks])
    asked = np.unique(np.concatenate(everyones))
    told = as_vectors(found.at(dofs_of(asked, 2)), 2)
    u[lacks] = told[np.searchsorted(asked, node[lacks])]

    def meshes() -> Iterator[OwnMesh]:
        for batch, part in zip(batches, around, strict=True):
            at = np.searchsorted(node, part.node)
            mesh = Mesh(layout.position(part.node), part.cells, {})
            body = int(layout.body[batch[0]])
            yield OwnMesh(body, mesh, part.inner, u[at].ravel() * length)

    return meshes()


def _batches(layout: Subdivision, subdomains: Nodes) -> list[Nodes]:
    """Put subdomains of one body together, up to `BATCH` nodes or one subdomain."""
    sizes = np.diff(layout.torn_nodes(subdomains).start)
    first, held = [0], 0
    for s, size in enumerate(sizes):
        other = layout.body[subdomains[s]] != layout.body[subdomains[first[-1]]]
        if s > first[-1] and (other or held + size > BATCH):
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
    own = np.unique(layout.torn_nodes(subdomains).number)
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
    torn = layout.torn_nodes(subdomains)
    nodes, place = np.unique(torn.number, return_inverse=True)
    cells = [
        place[begin + layout.cells(int(s))]
        for s, begin in zip(subdomains, torn.start, strict=False)
    ]
    return nodes, np.concatenate(cells)


def _holders(layout: Subdivision, node: Nodes) -> Nodes:
    """List the subdomains that have any of some nodes besides others."""
    times = layout.times(node)
    several = times > 1
    copies = range(int(times.max(initial=1)))
    held = [layout.holder(node[several & (times > c)], c) for c in copies]
    return np.unique(np.concatenate(held))


def _largest_von_mises(
    layout: Subdivision,
    found: OwnSolution,
    length: float,
    materials: tuple[Material, ...],
    plane: Plane,
) -> list[float]:
    """Return the largest von Mises stress of each body, recovered at nodes, Pa."""
    D = elasticity_matrices(materials, plane)
    largest = np.zeros(len(materials))
    for b, mesh, inner, u in own_meshes(layout, found, length, REACH):
        stress = recover(mesh, centre_stress(mesh, D[b], u))[inner]
        most = von_mises(stress, materials[b].nu, plane).max()
        largest[b] = max(largest[b], most)
    everyones = found.bodies.ranks.everyones(largest)
    return [float(most) for most in everyones.max(axis=0)]
