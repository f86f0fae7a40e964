"""Elastic bodies torn into subdomains."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array, diags_array, vstack

from harness import QP, Friction, Solution, Status, Value, Vector, no_rows
from harness.mechanics import NO_FRICTION, contact_rows
from problems.contact.bodies import (
    Bodies,
    ContactPair,
    ContactSides,
    elasticity_matrices,
)
from problems.contact.friction import FrictionLaw, friction_of
from problems.contact.linearise import linearisation
from problems.contact.results import Inside, results_of
from problems.fem.elasticity import Material, Plane, rigid_modes, stiffness
from problems.fem.fixing import fixing_nodes
from problems.fem.mesh import (
    Mesh,
    Nodes,
    StructuredGrid,
    as_vectors,
    boundary_edges,
    cells_of_block,
    dofs_of,
)
from problems.fem.stress import centre_stress, recover, von_mises
from problems.feti.emission import Contact, StructuredBodies
from problems.feti.gluing import glue
from problems.feti.own_bodies import OwnSolution, Results
from problems.feti.structured import Layout
from problems.feti.tearing import Decomposition, Part, decompose
from problems.feti.torn import Kind, Torn


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
    cells = part.cells
    around = np.bincount(cells.ravel(), np.repeat(E[part.material], cells.shape[1]))
    return Kind(
        K=stiffness(Mesh(part.points, cells, {}), D, part.material),
        R=rigid_modes(part.points),
        fixing=dofs_of(fixing_nodes(part.points)),
        boundary=dofs_of(np.unique(boundary_edges(cells))),
        stiffness=np.repeat(around / np.bincount(cells.ravel()), 2),
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


Side = tuple[int, str]  #: a body, and the name of a side of its grid


def structured(
    grids: tuple[StructuredGrid, ...],
    most: int | tuple[int, int],
    *,
    materials: tuple[Material, ...],
    plane: Plane,
    units: tuple[float, float],
    names: tuple[str, ...],
    fixed: Nodes,
    load: tuple[Nodes, Vector],
    pairs: Sequence[tuple[Side, Side]],
    method: tuple[str, Any],
    laws: Sequence[FrictionLaw],
    glue: str,
    results: Results,
) -> StructuredBodies:
    """Describe the first load step of elastic bodies on grids, one after another.

    It is the problem of `problems.contact.bodies.assemble` and `torn`, of which every
    rank can emit its share (`problems.feti.emission`).

    Parameters
    ----------
    most : cells along a side of a subdomain, or along each
    materials, plane, units, names, fixed : as of `assemble`
    load : components with a force, and the forces, N/m; each component once
    pairs : slave and master of each contact
    method : the keys contact and basis, see `problems.contact.linearise`
    laws : of friction with a given bound, one per pair
    results : that the family reports besides those of all elastic bodies

    """
    length, force = units
    layout = Layout.of(grids, most)
    D = elasticity_matrices(materials, plane) * (length / force)
    E = np.array([m.E for m in materials]) * (length / force)
    contact = _at_rest(layout, pairs, names, units, method, laws)
    nodes = int(layout.node_start[-1])

    def reported(found: OwnSolution) -> dict[str, Any]:
        inside = Inside(
            nodes=nodes,
            elements=sum(int(np.prod(grid.divisions)) for grid in grids),
            supports=fixed.size, energy=found.energy * force * length,
            max_von_mises=_largest_von_mises(layout, found, length, materials, plane),
        )  # fmt: skip
        return {**contact.results(found, inside), **results(found)}

    return StructuredBodies(
        layout=layout, components=2, material=layout.block.body,
        kind=partial(elastic_kind, D=D, E=E), E=E, share=longitudinal_share(D),
        held=fixed,
        load=forces_at(load[0], load[1] / force), glue=glue,
        contact=contact.of_whole(nodes), results=reported,
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


@dataclass(frozen=True, eq=False, kw_only=True)
class _AtRest:
    """Contact linearised at rest from the nodes of the sides alone, not dimensional."""

    bodies: ContactSides  #: of N nodes
    node: Nodes  #: (N,) their numbers in the whole
    B: csr_array  #: (m, 2N)
    c: Vector  #: (m,)
    friction: Friction  #: none without rows

    def of_whole(self, nodes: int) -> Contact:
        """Give the rows the columns of all components of so many nodes."""
        friction, B, c = self.friction, self.B, self.c
        if friction.bound.size:
            B = csr_array(vstack([B, friction.T]))
            c = np.append(c, friction.start)
        column = dofs_of(self.node)[B.indices]
        rows = csr_array((B.data, column, B.indptr), shape=(B.shape[0], 2 * nodes))
        return Contact(rows, c, friction.bound)

    def results(self, found: OwnSolution, inside: Inside) -> dict[str, Any]:
        """Report what ranks have found; called by all of them."""
        at = dofs_of(self.node)
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
        return results_of(inside, self.bodies, primal, s, self.friction)


def _at_rest(
    layout: Layout,
    pairs: Sequence[tuple[Side, Side]],
    names: tuple[str, ...],
    units: tuple[float, float],
    method: tuple[str, Any],
    laws: Sequence[FrictionLaw],
) -> _AtRest:
    """Linearise contact at rest."""
    length, force = units
    sides = list(dict.fromkeys(side for pair in pairs for side in pair))
    chain = {
        (b, name): layout.grids[b].sides[name] + layout.node_start[b]
        for b, name in sides
    }
    node, first = np.unique(
        np.concatenate([chain[side] for side in sides]), return_index=True
    )
    points = np.concatenate([layout.grids[b].side(name) for b, name in sides])
    bodies = ContactSides(
        mesh=Mesh(points[first], np.zeros((0, 4), dtype=np.int64), {}),
        body_of_node=np.searchsorted(layout.node_start, node, side="right") - 1,
        names=names,
        pairs=tuple(
            ContactPair(*(np.searchsorted(node, chain[side]) for side in pair))
            for pair in pairs
        ),
        length=length, force=force,
    )  # fmt: skip
    at_rest = np.zeros(bodies.mesh.dofs)
    rows = linearisation(bodies, *method, laws)(at_rest)
    pressed = np.zeros(sum(pair.slave.size for pair in bodies.pairs))
    return _AtRest(
        bodies=bodies, node=node, B=rows.B, c=rows.c / length,
        friction=friction_of(bodies, rows, laws, at_rest, pressed),
    )  # fmt: skip


class OwnMesh(NamedTuple):
    """Some subdomains of a rank and the cells around them, with their displacement."""

    body: int
    mesh: Mesh  #: N nodes; subdomains share none
    inner: NDArray[np.bool_]  #: (N,) those of the subdomains
    u: Vector  #: (2N,) m


BATCH = 2**15  #: nodes of subdomains that are evaluated at once
REACH = 2  #: cells from a node to those that its recovered stress depends on


def own_meshes(
    layout: Layout, found: OwnSolution, length: float, reach: int = 0
) -> Iterator[OwnMesh]:
    """Give the displaced subdomains of each rank; called by all ranks.

    Parameters
    ----------
    length : of which displacements are multiples, m
    reach : cells around subdomains that are added, where there are so many

    """
    around = [_around(layout, int(s), reach) for s in found.subdomains.number]
    node = np.unique(np.concatenate([part.node for part in around]))
    here = found.bodies.components[::2] // 2
    place = np.minimum(np.searchsorted(here, node), here.size - 1)
    lacks = here[place] != node
    u = as_vectors(found.u)[place]
    everyones = found.bodies.ranks.comm.allgather(node[lacks])
    asked = np.unique(np.concatenate(everyones))
    told = as_vectors(found.at(dofs_of(asked)))
    u[lacks] = told[np.searchsorted(asked, node[lacks])]

    def meshes() -> Iterator[OwnMesh]:
        for part in _batches(around):
            at = np.searchsorted(node, part.node)
            mesh = Mesh(part.points, part.cells, {})
            yield OwnMesh(part.body, mesh, part.inner, u[at].ravel() * length)

    return meshes()


class _Around(NamedTuple):
    """Subdomains of one body, with what is around them."""

    body: int
    node: Nodes  #: (N,) in the whole
    points: NDArray[np.float64]  #: (N, 2) m
    cells: Nodes  #: (E, 4) of these nodes
    inner: NDArray[np.bool_]  #: (N,) those of the subdomains


def _around(layout: Layout, s: int, reach: int) -> _Around:
    """Take one subdomain of structured bodies, and the cells around it."""
    left, low, wide, high = (int(x[0]) for x in layout.corner(np.array([s])))
    b = int(layout.block.body[s])
    grid = layout.grids[b]
    i = np.arange(max(left - reach, 0), min(left + wide + reach, grid.columns.size))
    j = np.arange(max(low - reach, 0), min(low + high + reach, grid.rows.size))
    within = ((j >= low) & (j < low + high))[:, None] & (i >= left) & (i < left + wide)
    node = layout.node_start[b] + j[:, None] * grid.columns.size + i
    points = grid.block(slice(i[0], i[-1] + 1), slice(j[0], j[-1] + 1))
    cells = cells_of_block(i.size, j.size)
    return _Around(b, node.ravel(), points, cells, within.ravel())


def _batches(parts: Sequence[_Around]) -> Iterator[_Around]:
    """Put subdomains of one body together, up to `BATCH` nodes or one subdomain."""
    batch, size = list[_Around](), 0
    for part in parts:
        full = size + part.node.size > BATCH
        if batch and (full or batch[0].body != part.body):
            yield _joined(batch)
            batch, size = [], 0
        batch.append(part)
        size += part.node.size
    yield _joined(batch)


def _joined(batch: Sequence[_Around]) -> _Around:
    body, nodes, points, cells, inner = zip(*batch, strict=True)
    first = np.cumsum([0, *map(len, nodes)])
    moved = [c + at for c, at in zip(cells, first, strict=False)]
    return _Around(body[0], *map(np.concatenate, (nodes, points, moved, inner)))


def _largest_von_mises(
    layout: Layout,
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
