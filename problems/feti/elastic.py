"""Elastic bodies torn into subdomains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from harness import QP, Friction
from harness.mechanics import NO_FRICTION, contact_rows
from problems.contact.bodies import Bodies
from problems.fem.elasticity import rigid_modes, stiffness
from problems.fem.fixing import fixing_nodes
from problems.fem.mesh import Mesh, dofs_of
from problems.feti.gluing import glue
from problems.feti.tearing import Decomposition, Part, decompose
from problems.feti.torn import Kind, Torn


@dataclass(frozen=True, eq=False)
class Subdomains:
    """Bodies in subdomains, before anything holds these together."""

    bodies: Bodies
    decomposition: Decomposition
    kinds: tuple[Kind, ...]


def subdivide(bodies: Bodies, label: NDArray[np.int64]) -> Subdomains:
    """Cut bodies into the subdomains that their cells (E,) are labelled with."""
    mesh = bodies.mesh
    decomposition = decompose(mesh.points, mesh.cells, label, bodies.body)
    D = bodies.elasticity * (bodies.length / bodies.force)
    kinds = tuple(elastic_kind(part, D) for part in decomposition.parts)
    return Subdomains(bodies, decomposition, kinds)


def elastic_kind(part: Part, D: NDArray[np.float64]) -> Kind:
    """Assemble one floating subdomain.

    D : (k, 3, 3) of the materials, without dimension
    """
    return Kind(
        K=stiffness(Mesh(part.points, part.cells, {}), D, part.material),
        R=rigid_modes(part.points),
        fixing=dofs_of(fixing_nodes(part.points)),
    )


def torn(
    subdomains: Subdomains,
    primal: QP,
    friction: Friction = NO_FRICTION,
    rows: str = "orthonormal",
) -> Torn:
    """Pose a problem of the bodies, `primal` with `friction`, on their subdomains.

    rows : how subdomains are glued, see `problems.feti.gluing`
    """
    bodies = subdomains.bodies
    E = np.array([m.E for m in bodies.materials]) * (bodies.length / bodies.force)
    contact, c = contact_rows(primal, friction)
    return glue(
        subdomains.decomposition, subdomains.kinds, load=-primal.q,
        supports=csr_array(primal.A), supported=primal.b, contact=contact, c=c,
        E=E[bodies.body_of_node], rows=rows,
    )  # fmt: skip
