"""Elastic bodies that may touch: everything about a contact problem but its rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array, eye_array

from harness import Vector
from problems.elasticity import (
    Material,
    Plane,
    elasticity_matrix,
    rigid_modes,
    stiffness,
)
from problems.inverse import (
    GeneralisedInverse,
    fixing_nodes,
    floating_inverse,
)
from problems.mesh import Mesh, Nodes, dofs_of, join


@dataclass(frozen=True, eq=False, kw_only=True)
class Bodies:
    """Bodies numbered one after another, their supports, load and contact sides.

    K, f and what is derived from them are non-dimensional: lengths by `length`, forces
    per thickness by `force`, hence K' = K·l/F₀ and u' = u/l.
    """

    mesh: Mesh  #: of all bodies, m
    body: NDArray[np.int64]  #: (E,) of each cell
    names: tuple[str, ...]
    materials: tuple[Material, ...]
    plane: Plane
    length: float  #: l, m
    force: float  #: F₀, N/m
    K: csc_array  #: (n, n)
    f: Vector  #: (n,) full load
    B_D: csr_array  #: (m_E, n) one unit entry per prescribed component
    slave: Nodes  #: each gets a contact row
    master: Nodes  #: chain of nodes, its body on the left

    @property
    def body_of_node(self) -> NDArray[np.int64]:
        """Body of each node, (N,)."""
        owner = np.zeros(len(self.mesh.points), dtype=np.int64)
        owner[self.mesh.cells.ravel()] = np.repeat(self.body, 4)
        return owner


def assemble(
    meshes: tuple[Mesh, ...],
    names: tuple[str, ...],
    materials: tuple[Material, ...],
    *,
    plane: Plane,
    units: tuple[float, float],
    fixed: tuple[str, ...],
    load: tuple[str, str, tuple[float, float]],
    contact: tuple[str, str],
) -> Bodies:
    """Assemble bodies from meshes whose boundaries have distinct names.

    Parameters
    ----------
    units : (l, F₀) of the non-dimensional QPs, m and N/m
    fixed : boundaries clamped in both components
    load : two boundaries whose common node carries the force (F_x, F_y) in N/m
    contact : slave and master boundary

    """
    mesh, body = join(meshes)
    length, force = units
    D = np.stack([elasticity_matrix(m, plane) for m in materials])[body]
    clamped = np.concatenate([dofs_of(mesh.boundaries[b]) for b in fixed])
    f = np.zeros(mesh.dofs)
    corner = np.intersect1d(mesh.boundaries[load[0]], mesh.boundaries[load[1]])
    f[dofs_of(corner)] = np.asarray(load[2]) / force
    return Bodies(
        mesh=mesh, body=body, names=names, materials=materials, plane=plane,
        length=length, force=force, K=stiffness(mesh, D) * (length / force), f=f,
        B_D=csr_array(eye_array(mesh.dofs, format="csr")[clamped]),
        slave=mesh.boundaries[contact[0]], master=mesh.boundaries[contact[1]],
    )  # fmt: skip


def floating(bodies: Bodies) -> GeneralisedInverse:
    """Factorise K with all its rigid modes, as Dirichlet rows in B need it."""
    owner, points = bodies.body_of_node, bodies.mesh.points
    parts = [points[owner == b] for b in range(len(bodies.names))]
    kernels = [rigid_modes(part) for part in parts]
    return floating_inverse(bodies.K, kernels, [fixing_nodes(part) for part in parts])
