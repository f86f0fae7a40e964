"""Elastic bodies torn into subdomains."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, vstack

from harness import QP, Friction, Value, Vector
from harness.mechanics import NO_FRICTION, contact_rows
from problems.contact.bodies import (
    Bodies,
    ContactPair,
    ContactSides,
    elasticity_matrices,
)
from problems.contact.friction import FrictionLaw, friction_of
from problems.contact.linearise import linearisation
from problems.contact.node_to_segment import ContactRows
from problems.fem.elasticity import Material, Plane, rigid_modes, stiffness
from problems.fem.fixing import fixing_nodes
from problems.fem.mesh import Mesh, Nodes, boundary_edges, dofs_of
from problems.feti.emission import Contact, ProblemInParts
from problems.feti.gluing import glue
from problems.feti.structured import Layout
from problems.feti.subdivision import Subdivision
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


def in_parts(
    layout: Subdivision,
    *,
    materials: tuple[Material, ...],
    plane: Plane,
    units: tuple[float, float],
    fixed: Nodes,
    load: tuple[Nodes, Vector],
    pairs: Sequence[ContactPair],
    linearise: Callable[[ContactSides], ContactRows],
    laws: Sequence[FrictionLaw] = (),
    glue: str,
) -> ProblemInParts:
    """Describe elastic bodies in contact, linearised at rest, before they are torn.

    It is the problem of `problems.contact.bodies.assemble` and `torn`, of which every
    rank can emit its share (`problems.feti.emission`).

    Parameters
    ----------
    materials, plane, units, fixed, pairs : as of `assemble`
    load : components with a force, and the forces, N/m; each component once
    linearise : takes the rows at rest from the nodes of the sides alone
    laws : of friction with a given bound, one per pair

    """
    length, force = units
    D = elasticity_matrices(materials, plane) * (length / force)
    E = np.array([m.E for m in materials]) * (length / force)
    share = longitudinal_share(D)
    return ProblemInParts(
        layout=layout, components=2, material=layout.body,
        kind=partial(elastic_kind, D=D, E=E), E=E,
        shaping=partial(layout.shaping, share) if isinstance(layout, Layout) else None,
        held=fixed,
        load=forces_at(load[0], load[1] / force), glue=glue,
        contact=_contact_of_sides(layout, pairs, linearise, laws, units),
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


def at_rest(
    contact: str, basis: Any, laws: Sequence[FrictionLaw] = ()
) -> Callable[[ContactSides], ContactRows]:
    """Make what linearises contact of sides at rest, see `linearisation`."""
    return lambda sides: linearisation(sides, contact, basis, laws)(
        np.zeros(sides.mesh.dofs)
    )


def _contact_of_sides(
    layout: Subdivision,
    pairs: Sequence[ContactPair],
    linearise: Callable[[ContactSides], ContactRows],
    laws: Sequence[FrictionLaw],
    units: tuple[float, float],
) -> Contact:
    """Linearise contact at rest from the nodes of the sides alone."""
    n = 2 * layout.nodes
    length, force = units
    node = np.unique(np.concatenate([side for pair in pairs for side in pair]))
    sides = ContactSides(
        mesh=Mesh(layout.position(node), np.zeros((0, 4), dtype=np.int64), {}),
        pairs=tuple(
            ContactPair(*(np.searchsorted(node, side) for side in pair))
            for pair in pairs
        ),
        force=force,
    )  # fmt: skip
    rows = linearise(sides)
    pressed = np.zeros(sum(pair.slave.size for pair in pairs))
    friction = friction_of(sides, rows, laws, np.zeros(sides.mesh.dofs), pressed)
    B = csr_array(vstack([rows.B, friction.T])) if friction.bound.size else rows.B
    of_whole = csr_array(
        (B.data, dofs_of(node)[B.indices], B.indptr), shape=(B.shape[0], n)
    )
    c = np.append(rows.c / length, friction.start)
    return Contact(of_whole, c, friction.bound)
