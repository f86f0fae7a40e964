"""Elastic subdomains: stiffness and largest stresses, as each rank evaluates them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Vector
from mortarbench.harness.mechanics import boundary_facets
from mortarbench.problems.fem.elasticity import Plane, rigid_modes, stiffness
from mortarbench.problems.fem.fixing import fixing_nodes
from mortarbench.problems.fem.mesh import Mesh, Nodes, dofs_of
from mortarbench.problems.fem.stress import centre_stress, recover, von_mises
from mortarbench.problems.feti.subdomain_classes import SubdomainClass
from mortarbench.problems.feti.tearing import SubdomainMesh

#: number of layers of cells around a node on which its recovered stress may depend
STRESS_LAYERS = 3


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


class Patch(NamedTuple):
    """Part of the mesh of a body, with the surroundings on which stresses depend."""

    points: NDArray[np.float64]  #: (N, dim), m
    cells: Nodes  #: (E, corners)
    u: NDArray[np.float64]  #: (N, dim) displacements, m
    is_inside: NDArray[np.bool_]  #: (N,) nodes at which stresses are evaluated
    D: NDArray[np.float64]  #: (v, v) elasticity matrix, Pa
    nu: float
    plane: Plane | None


def largest_in_patches(patches: list[Patch]) -> Vector:
    """Return the largest nodal von Mises stress of each patch, Pa; 0 if it is empty."""
    return np.array([_largest_stress(patch) for patch in patches])


def _largest_stress(patch: Patch) -> float:
    if not patch.is_inside.any():
        return 0.0
    mesh = Mesh(patch.points, patch.cells, {})
    stress = recover(mesh, centre_stress(mesh, patch.D, patch.u.ravel()))
    return float(von_mises(stress[patch.is_inside], patch.nu, patch.plane).max())
