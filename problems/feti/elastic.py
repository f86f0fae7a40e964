"""Elastic bodies torn into subdomains."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from harness import QP, Friction, Value, Vector
from harness.mechanics import NO_FRICTION, contact_rows
from problems.contact.bodies import Bodies
from problems.fem.elasticity import rigid_modes, stiffness
from problems.fem.fixing import fixing_nodes
from problems.fem.mesh import Mesh, boundary_edges, dofs_of
from problems.feti.gluing import glue
from problems.feti.tearing import Decomposition, Part, decompose
from problems.feti.torn import Kind, Torn


@dataclass(frozen=True, eq=False)
class SubdividedBodies:
    """Bodies in subdomains, before anything holds these together."""

    bodies: Bodies
    decomposition: Decomposition
    kinds: tuple[Kind, ...]


def subdivide(bodies: Bodies, label: NDArray[np.int64]) -> SubdividedBodies:
    """Cut bodies into the subdomains that their cells (E,) are labelled with."""
    mesh = bodies.mesh
    decomposition = decompose(mesh.points, mesh.cells, label, bodies.body)
    D = bodies.elasticity * (bodies.length / bodies.force)
    kinds = tuple(elastic_kind(part, D, bodies.moduli) for part in decomposition.parts)
    return SubdividedBodies(bodies, decomposition, kinds)


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
        E=bodies.moduli[bodies.body_of_node], rows=rows,
    )  # fmt: skip
