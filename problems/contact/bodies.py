"""Elastic bodies that may touch: everything about a contact problem but its rows."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.sparse import csc_array, csr_array, eye_array

from mortarbench.harness import InputError, Vector
from mortarbench.problems.fem.elasticity import (
    Material,
    Plane,
    elasticity_matrix,
    rigid_modes,
    stiffness,
)
from mortarbench.problems.fem.fixing import fixing_nodes
from mortarbench.problems.fem.inverse import (
    GeneralisedInverse,
    Interface,
    floating_inverse,
    regular_inverse,
    supported_inverse,
)
from mortarbench.problems.fem.mesh import Mesh, Nodes, boundary_facets, dofs_of


class ContactPair(NamedTuple):
    """Two sides that may touch."""

    slave: Nodes  #: chain of nodes; each may get a contact row
    master: Nodes  #: chain of nodes, its body on the left; empty for a rigid one


@dataclass(frozen=True, eq=False, kw_only=True)
class ContactSides:
    """The sides of bodies that may touch, and nothing else of the bodies."""

    mesh: Mesh  #: their nodes, without cells, m
    body_of_node: NDArray[np.int64]  #: (N,)
    names: tuple[str, ...]  #: of all bodies
    pairs: tuple[ContactPair, ...]
    length: float  #: l, m, as of `Bodies`
    force: float  #: F₀, N/m, as of `Bodies`


@dataclass(frozen=True, eq=False, kw_only=True)
class UnassembledBodies:
    """Bodies numbered one after another, their supports, load and contact sides.

    f and the moduli are non-dimensional: lengths by `length`, forces per thickness by
    `force`.

    Raises
    ------
    ValueError
        When the nodes are not numbered body by body.

    """

    mesh: Mesh  #: of all bodies, m
    body: NDArray[np.int64]  #: (E,) of each cell
    names: tuple[str, ...]
    materials: tuple[Material, ...]
    plane: Plane | None  #: None in space
    length: float  #: l, m
    force: float  #: F₀, N/m
    f: Vector  #: (n,) full load
    B_D: csr_array  #: (m_E, n) one unit entry per prescribed component
    pairs: tuple[ContactPair, ...]  #: sides that may touch

    def __post_init__(self) -> None:
        if (np.diff(self.body_of_node) < 0).any():
            raise ValueError("nodes must be numbered one body after another")

    @property
    def body_of_node(self) -> NDArray[np.int64]:
        """Body of each node, (N,)."""
        owner = np.zeros(len(self.mesh.points), dtype=np.int64)
        owner[self.mesh.cells.ravel()] = np.repeat(self.body, self.mesh.cells.shape[1])
        return owner

    @property
    def interface(self) -> Nodes:
        """Displacement components that contact rows can touch, ascending."""
        sides = [np.zeros(0, dtype=np.int64), *(n for pair in self.pairs for n in pair)]
        return np.unique(dofs_of(np.concatenate(sides), self.mesh.dim))

    @property
    def rigid(self) -> NDArray[np.float64]:
        """Orthonormal rigid motions of every body on its own, (n, r bodies)."""
        return np.asarray(block_diag(*map(rigid_modes, self.points_of_bodies)))

    @property
    def points_of_bodies(self) -> list[NDArray[np.float64]]:
        """Nodes of each body, (N_b, dim)."""
        ends = np.cumsum(np.bincount(self.body_of_node, minlength=len(self.names)))
        return np.split(self.mesh.points, ends[:-1])

    @property
    def mesh_size(self) -> float:
        """Mean distance of neighbours on the slave sides, in lengths `length`.

        Where there are none, on all sides.
        """
        mesh, slaves = self.mesh, [pair.slave for pair in self.pairs]
        chains = slaves or boundary_facets(mesh.cells, mesh.dim)
        sides = [mesh.points[chain] for chain in chains]
        steps = [np.linalg.norm(np.diff(side, axis=0), axis=1) for side in sides]
        return float(np.concatenate(steps).mean() / self.length)

    @property
    def D(self) -> NDArray[np.float64]:
        """Elasticity matrix of each cell, (E, v, v), Pa."""
        return self.elasticity[self.body]

    @property
    def moduli(self) -> Vector:
        """Young's modulus of each body, (bodies,), as K has it: without dimension."""
        return np.array([m.E for m in self.materials]) * (self.length / self.force)

    @property
    def elasticity(self) -> NDArray[np.float64]:
        """Elasticity matrix of each body, (bodies, v, v), Pa."""
        return elasticity_matrices(self.materials, self.plane)


@dataclass(frozen=True, eq=False, kw_only=True)
class Bodies(UnassembledBodies):
    """Bodies with their stiffness, non-dimensional: K' = K·l/F₀ and u' = u/l."""

    K: csc_array  #: (n, n)


def assemble(
    mesh: Mesh,
    body: NDArray[np.int64],
    *,
    names: tuple[str, ...],
    materials: tuple[Material, ...],
    plane: Plane | None,
    units: tuple[float, float],
    fixed: Nodes,
    load: Vector,
    pairs: tuple[ContactPair, ...],
) -> Bodies:
    """Assemble the bodies of a joined mesh.

    Parameters
    ----------
    body : (E,) of each cell
    names, materials : per body
    units : (l, F₀) of the non-dimensional QPs, m and N/m
    fixed : displacement components that are zero
    load : (n,) nodal forces: N/m in the plane, N in space

    """
    length, force = units
    return assemble_stiffness(
        UnassembledBodies(
            mesh=mesh, body=body, names=names, materials=materials, plane=plane,
            length=length, force=force, f=load / force,
            B_D=support_rows(mesh, fixed), pairs=pairs,
        )
    )  # fmt: skip


def support_rows(mesh: Mesh, fixed: Nodes) -> csr_array:
    """Return the rows (m_E, n) of prescribed components."""
    return csr_array(eye_array(mesh.dofs, format="csr")[fixed])


def assemble_stiffness(bodies: UnassembledBodies) -> Bodies:
    """Assemble their stiffness."""
    known = {part.name: getattr(bodies, part.name) for part in fields(bodies)}
    D = bodies.elasticity * (bodies.length / bodies.force)
    return Bodies(**known, K=stiffness(bodies.mesh, D, bodies.body))


def factorise_floating(bodies: Bodies, *, condense: bool = True) -> GeneralisedInverse:
    """Factorise K with all its rigid modes, as Dirichlet rows in B need it.

    Condensed onto what constraints can touch, or else (the paper's way) with one solve
    per constraint row of each load step.
    """
    parts = bodies.points_of_bodies
    kernels = [rigid_modes(part) for part in parts]
    fixing = [dofs_of(fixing_nodes(part), bodies.mesh.dim) for part in parts]
    touched = np.union1d(bodies.interface, bodies.B_D.indices)
    interface = Interface(touched, bodies.mesh.points) if condense else None
    return floating_inverse(bodies.K, kernels, fixing, interface)


def factorise_clamped(bodies: Bodies) -> GeneralisedInverse:
    """Factorise K without the prescribed components, which must hold every body.

    Raises
    ------
    InputError
        When a rigid motion of some body is left.

    """
    held = bodies.B_D.indices
    # not left to the factorisation: rounding may make a singular K look regular
    if np.linalg.matrix_rank(bodies.rigid[held]) < bodies.rigid.shape[1]:
        raise InputError(
            "the supports leave a rigid motion of some body, so dual-bounds does not "
            "exist; expected form primal or dual"
        )
    free = np.setdiff1d(np.arange(bodies.mesh.dofs), held)
    interface = Interface(bodies.interface, bodies.mesh.points)
    return regular_inverse(bodies.K, free, interface)


def factorise_supported(bodies: Bodies) -> GeneralisedInverse:
    """Factorise K without the prescribed components, and what else a body needs."""
    free = np.setdiff1d(np.arange(bodies.mesh.dofs), bodies.B_D.indices)
    interface = Interface(bodies.interface, bodies.mesh.points)
    return supported_inverse(bodies.K, free, bodies.rigid, interface)


def elasticity_matrices(
    materials: tuple[Material, ...], plane: Plane | None
) -> NDArray[np.float64]:
    """Return the elasticity matrix of each material, (k, v, v), Pa."""
    return np.stack([elasticity_matrix(m, plane) for m in materials])
