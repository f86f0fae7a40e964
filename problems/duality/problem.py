"""Description of a contact problem, returned by its family, before assembly.

From this description, `problems.duality.monolithic` derives the QPs of undivided
bodies, and `problems.duality.decomposed` those of decomposed bodies on one or several
processes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from mortarbench.harness import QP, Friction, Solution, Vector
from mortarbench.problems.contact.bodies import (
    Bodies,
    ContactPair,
    UnassembledBodies,
    assemble_stiffness,
    factorise_clamped,
    factorise_floating,
    factorise_supported,
    is_supported,
    support_rows,
)
from mortarbench.problems.contact.friction import FrictionLaw
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.rows import ContactRows
from mortarbench.problems.contact.stepping import Forces, Stage, forces_of
from mortarbench.problems.fem.elasticity import Material, Plane
from mortarbench.problems.fem.inverse import GeneralisedInverse
from mortarbench.problems.fem.mesh import (
    Mesh,
    Nodes,
    join,
)

if TYPE_CHECKING:
    from mortarbench.problems.feti.subdivision import Subdivision

#: function that linearises contact at a displacement (n,) in m
Linearise: TypeAlias = Callable[[Vector], ContactRows]


@dataclass(frozen=True, eq=False)
class Shape:
    """Geometry of bodies."""

    mesh: Mesh  #: joined mesh of all bodies, m
    body: NDArray[np.int64]  #: (E,) body of each cell
    #: grid of each body, without cells; empty for unstructured meshes
    parts: tuple[Mesh, ...] = ()

    @property
    def dim(self) -> int:
        """Number of coordinates of a point."""
        return self.mesh.dim

    @property
    def sides(self) -> Mapping[str, Nodes]:
        """Contact sides by name: chains of nodes in 2D, faces in 3D."""
        return self.mesh.boundaries

    def layout(self, size: int) -> Subdivision:
        """Cut the bodies into subdomains.

        size : largest number of cells along a side of a subdomain; for unstructured
            meshes, which METIS cuts, the number of subdomains
        """
        from mortarbench.problems.feti.partition import graph_partition
        from mortarbench.problems.feti.structured import blocks_of_meshes
        from mortarbench.problems.feti.subdivision import Subdivision

        if self.parts:
            return blocks_of_meshes(self.parts, size, (self.mesh, self.body))
        label = graph_partition(self.mesh.points, self.mesh.cells, self.body, size)
        return Subdivision(self.mesh, label, self.body)


def structured(*parts: Mesh) -> Shape:
    """Return the shape of structured bodies with distinct names of all boundaries."""
    mesh, body = join(parts)
    ends, no_cells = np.cumsum([len(part.points) for part in parts]), mesh.cells[:0]
    # `layout` needs no cells of the parts, which would take memory on every rank
    grids = [
        Mesh(points, no_cells, {}, part.divisions)
        for points, part in zip(np.split(mesh.points, ends[:-1]), parts, strict=True)
    ]
    return Shape(mesh, body, tuple(grids))


#: fields that `ElasticBodies` and `UnassembledBodies` have in common
COMMON = (
    "names", "materials", "plane", "length", "force", "pairs", "piece", "lift",
    "springs",
)  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class ElasticBodies:
    """Elastic bodies with materials, supports, full load and contact sides."""

    shape: Shape
    names: tuple[str, ...]
    materials: tuple[Material, ...]  #: material of each body
    plane: Plane | None  #: plane state; None in 3D
    length: float  #: l, unit of length of the QPs, m
    force: float  #: F₀, unit of force of the QPs: N/m in 2D, N in 3D
    fixed: Nodes  #: displacement components that are prescribed
    forces: Forces  #: full load
    pairs: tuple[ContactPair, ...]
    piece: NDArray[np.int64] | None = None  #: see `UnassembledBodies`
    lift: Vector | None = None  #: see `UnassembledBodies`
    springs: csr_array | None = None  #: see `UnassembledBodies`

    @cached_property
    def assembled(self) -> Bodies:
        """The undivided bodies with their stiffness matrix."""
        return assemble_stiffness(self.whole)

    @cached_property
    def whole(self) -> UnassembledBodies:
        """The undivided bodies without stiffness matrix."""
        mesh, body = self.shape.mesh, self.shape.body
        common: dict[str, Any] = {name: getattr(self, name) for name in COMMON}
        return UnassembledBodies(
            mesh=mesh,
            body=body,
            f=self.forces.on(mesh.dofs),
            B_D=support_rows(mesh, self.fixed),
            **common,
        )

    @cached_property
    def is_supported(self) -> bool:
        """True if the supports exclude all rigid motions of every body."""
        return is_supported(self.whole)

    @cached_property
    def floating(self) -> GeneralisedInverse:
        """K⁺ of the floating bodies, with the kernel R of all rigid motions."""
        return factorise_floating(self.assembled)

    @cached_property
    def clamped(self) -> GeneralisedInverse:
        """K⁺ with zeros at fixed components.

        Raises
        ------
        InputError
            If the supports allow a rigid motion of some body.

        """
        return factorise_clamped(self.assembled)

    @cached_property
    def supported(self) -> GeneralisedInverse:
        """K⁺ like `clamped`, but also for bodies supported by contact alone."""
        return factorise_supported(self.assembled)


def elastic_bodies_of(bodies: UnassembledBodies) -> ElasticBodies:
    """Return meshed bodies as `ElasticBodies`; an assembled stiffness is kept."""
    common: dict[str, Any] = {name: getattr(bodies, name) for name in COMMON}
    result = ElasticBodies(
        shape=Shape(bodies.mesh, bodies.body),
        fixed=bodies.B_D.indices,
        forces=forces_of(bodies.f),
        **common,
    )
    vars(result)["whole"] = bodies
    if isinstance(bodies, Bodies):
        vars(result)["assembled"] = bodies
    return result


class InterfaceState(NamedTuple):
    """Data and solution of a contact problem."""

    bodies: UnassembledBodies
    primal: QP  #: only the diagonal of P is used, and only with friction
    solution: Solution
    rows: ContactRows  #: contact rows of `primal`
    friction: Friction


class ContactSolution(NamedTuple):
    """Solution of a contact problem."""

    sides: InterfaceState
    #: number of Tresca problems solved for Coulomb's law; 1 for other laws
    problems: int

    def at(self, component: Nodes) -> Vector:
        """Return the nondimensional displacement at global components (k,)."""
        return np.asarray(self.sides.solution.x[component])


@dataclass(frozen=True, eq=False, kw_only=True)
class ContactProblem:
    """Elastic bodies with their contact law and load stages."""

    bodies: ElasticBodies
    stages: tuple[Stage, ...]
    #: function of the bodies (or their contact sides) and the friction laws of their
    #: pairs; it returns a function that maps a displacement in m to contact rows
    linearise: Callable[[UnassembledBodies, Sequence[FrictionLaw]], Linearise]
    #: normal force per slave node for the first friction bound of Coulomb's law
    initial_force: float = 0.0
    #: function that evaluates quantities beyond those common to all elastic bodies
    results: Callable[[ContactSolution], Mapping[str, Any]] = lambda _: {}
    #: (k, 3) with the columns x in m, exact pressure and exact shear in Pa on the slave
    #: side; None if unknown
    exact: NDArray[np.float64] | None = None


class Choice(NamedTuple):
    """Selection of one QP of a contact problem."""

    step: int = 1  #: number of the load step, from 1
    size: int = 0  #: argument of `Shape.layout`; 0 for undivided bodies
    glue: str = "orthonormal"  #: one of `problems.feti.subdomains.GLUE`


def keyed_linearisation(
    contact: str, basis: str
) -> Callable[[UnassembledBodies, Sequence[FrictionLaw]], Linearise]:
    """Return the linearisation that the keys `contact` and `basis` select."""
    return lambda bodies, laws: linearisation(bodies, contact, basis, laws)
