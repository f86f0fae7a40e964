"""Elastic bodies in contact: the data of a contact problem except its contact rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, null_space
from scipy.sparse import csc_array, csr_array, eye_array, vstack

from mortarbench.harness import InputError, Vector
from mortarbench.problems.contact.rigid import RigidBody
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
from mortarbench.problems.fem.mesh import (
    Mesh,
    Nodes,
    dofs_of,
    facet_quadrature,
    join,
)

#: rigid motions along which springs resist less than this fraction of the largest
#: resistance count as free; the rounding of normals is about 1e-16
SPRING_ROUNDING = 1e-10


class ContactPair(NamedTuple):
    """A pair of sides that may touch.

    In 2D a side is a chain of nodes, in 3D an array of faces; see `Mesh`.
    """

    slave: Nodes
    master: Nodes  #: master side; empty for a rigid master
    #: master that does not deform; None if the master is elastic
    rigid: RigidBody | None = None
    #: largest distance at which a slave node has a row, m; None selects the larger
    #: extent of the two sides, or no limit for a rigid master
    reach: float | None = None

    @property
    def sides(self) -> tuple[Nodes, Nodes]:
        """Slave side and master side."""
        return self.slave, self.master

    @property
    def slave_nodes(self) -> Nodes:
        """Slave nodes, in the order of the chain in 2D, or ascending in 3D."""
        return self.slave if self.slave.ndim == 1 else np.unique(self.slave)

    @property
    def nodes(self) -> Nodes:
        """Nodes of both sides, possibly with repetitions."""
        return np.concatenate([self.slave.ravel(), self.master.ravel()])


def slave_places(pairs: Sequence[ContactPair]) -> int:
    """Return the number of slave nodes of all pairs."""
    return sum(pair.slave_nodes.size for pair in pairs)


@dataclass(frozen=True, eq=False)
class Shape:
    """Geometry of bodies."""

    mesh: Mesh  #: joined mesh of all bodies, m
    body: NDArray[np.int64]  #: (E,) body of each cell
    #: grid of each body, without cells; empty for unstructured meshes
    grids: tuple[Mesh, ...] = ()


def structured(*parts: Mesh) -> Shape:
    """Return the shape of structured bodies with distinct names of all boundaries."""
    mesh, body = join(parts)
    ends, no_cells = np.cumsum([len(part.points) for part in parts]), mesh.cells[:0]
    # subdivision needs no cells of the grids, which would take memory on every rank
    grids = [
        Mesh(points, no_cells, {}, part.divisions)
        for points, part in zip(np.split(mesh.points, ends[:-1]), parts, strict=True)
    ]
    return Shape(mesh, body, tuple(grids))


@dataclass(frozen=True, eq=False, kw_only=True)
class UnassembledBodies:
    """Bodies without stiffness matrix: mesh, materials, supports, load, contact sides.

    Nodes are numbered body by body. f is non-dimensional: forces (in 2D per thickness)
    are divided by `force`.

    Raises
    ------
    ValueError
        If the nodes are not numbered body by body.

    """

    shape: Shape
    names: tuple[str, ...]
    materials: tuple[Material, ...]  #: material of each body
    plane: Plane | None  #: plane state; None in 3D
    length: float  #: l, unit of length, m
    force: float  #: F₀, unit of force: N/m in 2D, N in 3D
    f: Vector  #: (n,) full load of eq. (1), non-dimensional
    fixed: Nodes  #: (m_E,) prescribed components
    pairs: tuple[ContactPair, ...]  #: sides that may touch
    #: (bodies,) piece of each body; bodies of a piece have common nodes, and move
    #: rigidly together. None: every body is a piece
    piece: NDArray[np.int64] | None = None
    #: (n,) prescribed displacements of the full load, divided by `length`, and zeros;
    #: None: all are zero
    lift: Vector | None = None
    #: (s, n) rows S of springs, which add SᵀS to K', see `spring_rows`; None: no
    #: springs
    springs: csr_array | None = None

    def __post_init__(self) -> None:
        if (np.diff(self.piece_of_node) < 0).any():
            raise ValueError("nodes must be numbered in the order of their bodies")

    @property
    def mesh(self) -> Mesh:
        """Joined mesh of all bodies, m."""
        return self.shape.mesh

    @property
    def body(self) -> NDArray[np.int64]:
        """Body of each cell, (E,)."""
        return self.shape.body

    @cached_property
    def B_D(self) -> csr_array:
        """Support rows (m_E, n) of eq. (5), with one unit entry each."""
        return csr_array(eye_array(self.mesh.dofs, format="csr")[self.fixed])

    @cached_property
    def assembled(self) -> Bodies:
        """The bodies with their stiffness matrix."""
        return self if isinstance(self, Bodies) else assemble_stiffness(self)

    @cached_property
    def is_supported(self) -> bool:
        """True if supports and springs exclude all rigid motions of every piece."""
        rigid = self.rigid
        fixed = rigid[self.fixed]
        return not rigid.size or bool(np.linalg.matrix_rank(fixed) == rigid.shape[1])

    @cached_property
    def body_of_node(self) -> NDArray[np.int64]:
        """Body of each node, (N,); the last one of several bodies."""
        owner = np.zeros(len(self.mesh.points), dtype=np.int64)
        owner[self.mesh.cells.ravel()] = np.repeat(self.body, self.mesh.cells.shape[1])
        return owner

    @property
    def pieces(self) -> NDArray[np.int64]:
        """Piece of each body, (bodies,)."""
        return np.arange(len(self.names)) if self.piece is None else self.piece

    @property
    def piece_of_node(self) -> NDArray[np.int64]:
        """Piece of each node, (N,)."""
        return self.pieces[self.body_of_node]

    @property
    def piece_names(self) -> tuple[str, ...]:
        """Names of the bodies of each piece, joined by +."""
        return joined_names(self.names, self.pieces)

    @property
    def held(self) -> csr_array:
        """Rows of supports and springs, which resist rigid motions; entries ≤ 1."""
        if (S := self.springs) is None:
            return self.B_D
        return csr_array(vstack([self.B_D, S / abs(S).max()]))

    @property
    def interface(self) -> Nodes:
        """Displacement components of the nodes of all contact sides, ascending."""
        sides = [np.zeros(0, dtype=np.int64), *(pair.nodes for pair in self.pairs)]
        return np.unique(dofs_of(np.concatenate(sides), self.mesh.dim))

    @property
    def rigid(self) -> NDArray[np.float64]:
        """Orthonormal rigid motions of each piece, ignoring supports, (n, r).

        Motions that springs resist are excluded.
        """
        return np.asarray(block_diag(*self.kernels))

    @property
    def kernels(self) -> list[NDArray[np.float64]]:
        """Orthonormal rigid motions (dim·N_p, r_p) of each piece p, see `rigid`."""
        motions = list(map(rigid_modes, self.points_of_pieces))
        if self.springs is None:
            return motions
        ends = np.cumsum([len(R) for R in motions])
        resisted = [
            self.springs[:, end - len(R) : end] @ R
            for R, end in zip(motions, ends, strict=True)
        ]
        return [
            R @ null_space(SR, rcond=SPRING_ROUNDING)
            for R, SR in zip(motions, resisted, strict=True)
        ]

    @property
    def points_of_pieces(self) -> list[NDArray[np.float64]]:
        """Nodes of each piece, (N_p, dim)."""
        ends = np.cumsum(np.bincount(self.piece_of_node))
        return np.split(self.mesh.points, ends[:-1])

    @property
    def D(self) -> NDArray[np.float64]:
        """Elasticity matrix of each cell, (E, v, v), Pa."""
        return self.elasticity[self.body]

    @property
    def elasticity(self) -> NDArray[np.float64]:
        """Elasticity matrix of each body, (bodies, v, v), Pa."""
        return elasticity_matrices(self.materials, self.plane)


@dataclass(frozen=True, eq=False, kw_only=True)
class Bodies(UnassembledBodies):
    """Bodies with their stiffness matrix, non-dimensional: K' = K·l/F₀, u' = u/l."""

    K: csc_array  #: (n, n) stiffness matrix of eq. (1)

    @cached_property
    def clamped(self) -> GeneralisedInverse:
        """K⁺ with zeros at fixed components, see `factorise_clamped`."""
        return factorise_clamped(self)

    @cached_property
    def supported(self) -> GeneralisedInverse:
        """K⁺ like `clamped`, but also for bodies supported by contact alone."""
        return factorise_supported(self)

    @cached_property
    def floating(self) -> GeneralisedInverse:
        """K⁺ of the floating bodies, with the kernel R of all rigid motions."""
        return factorise_floating(self)


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
    body : (E,) body of each cell
    names, materials : name and material of each body
    units : units (l, F₀) of the non-dimensional QPs; l in m, F₀ in N/m (2D) or N (3D)
    fixed : displacement components that are prescribed as zero
    load : (n,) nodal forces: N/m in 2D, N in 3D

    """
    length, force = units
    return assemble_stiffness(
        UnassembledBodies(
            shape=Shape(mesh, body),
            names=names,
            materials=materials,
            plane=plane,
            length=length,
            force=force,
            f=load / force,
            fixed=fixed,
            pairs=pairs,
        )
    )


def joined_names(names: tuple[str, ...], piece: NDArray[np.int64]) -> tuple[str, ...]:
    """Return the names of the bodies of each piece, joined by +.

    piece : (bodies,) piece of each body
    """
    return tuple(
        "+".join(name for name, at in zip(names, piece, strict=True) if at == k)
        for k in range(int(piece.max(initial=-1)) + 1)
    )


def spring_rows(
    points: NDArray[np.float64], facets: Nodes, stiffness: float
) -> csr_array:
    """Return rows S (s, n) with uᵀSᵀS u = ∫ k (n·u)² over the facets of a boundary.

    There is one row per Gauss point, with the outward normal n at this point.

    points : (N, dim) positions of the nodes, m
    stiffness : k, N/m³
    """
    shapes, areas = facet_quadrature(points, facets)
    sizes = np.linalg.norm(areas, axis=2, keepdims=True)
    along = areas / np.sqrt(sizes) * np.sqrt(stiffness)
    values = np.einsum("qm,qkx->qkmx", shapes, along)
    columns = dofs_of(facets, points.shape[1]).reshape(1, *values.shape[1:])
    row = np.arange(values.shape[0] * values.shape[1]).reshape(*values.shape[:2], 1, 1)
    at = (np.broadcast_to(k, values.shape).ravel() for k in (row, columns))
    return csr_array((values.ravel(), tuple(at)), shape=(row.size, points.size))


def assemble_stiffness(bodies: UnassembledBodies) -> Bodies:
    """Return the bodies with their stiffness matrix assembled."""
    data = {part.name: getattr(bodies, part.name) for part in fields(bodies)}
    D = bodies.elasticity * (bodies.length / bodies.force)
    K = stiffness(bodies.mesh, D, bodies.body)
    if (S := bodies.springs) is not None:
        K = csc_array(K + S.T @ S)
        K.sort_indices()  # scipy sorts in place, which fails once a QP is read-only
    return Bodies(**data, K=K)


def factorise_floating(bodies: Bodies, *, condense: bool = True) -> GeneralisedInverse:
    """Factorise K with all rigid modes as kernel, for duals with support rows in B.

    condense : compute (K⁺)_cc once, on the components c with entries in B. If False,
        as in the paper, BK⁺Bᵀ of eq. (3) requires one solve per row of B in every load
        step
    """
    parts, kernels = bodies.points_of_pieces, bodies.kernels
    fixing = [dofs_of(fixing_nodes(part), bodies.mesh.dim) for part in parts]
    constrained = np.union1d(bodies.interface, bodies.fixed)
    interface = Interface(constrained, bodies.mesh.points) if condense else None
    return floating_inverse(bodies.K, kernels, fixing, interface)


def factorise_clamped(bodies: Bodies) -> GeneralisedInverse:
    """Factorise K without the prescribed components, which must fix every body.

    Raises
    ------
    InputError
        If the supports allow a rigid motion of some body.

    """
    # a factorisation can fail to detect a singular K, since rounding may make it
    # nonsingular
    if not bodies.is_supported:
        raise InputError(
            "the supports allow a rigid motion of some body, so dual-bounds does not "
            "exist; expected form primal or dual"
        )
    free = np.setdiff1d(np.arange(bodies.mesh.dofs), bodies.fixed)
    interface = Interface(bodies.interface, bodies.mesh.points)
    return regular_inverse(bodies.K, free, interface)


def factorise_supported(bodies: Bodies) -> GeneralisedInverse:
    """Factorise K without the prescribed components, also for floating bodies.

    Where the supports allow rigid motions, further components are fixed; see
    `problems.fem.inverse.supported_inverse`.
    """
    free = np.setdiff1d(np.arange(bodies.mesh.dofs), bodies.fixed)
    interface = Interface(bodies.interface, bodies.mesh.points)
    return supported_inverse(bodies.K, free, bodies.rigid, interface)


def elasticity_matrices(
    materials: tuple[Material, ...], plane: Plane | None
) -> NDArray[np.float64]:
    """Return the elasticity matrix of each material, (k, v, v), Pa."""
    return np.stack([elasticity_matrix(m, plane) for m in materials])
