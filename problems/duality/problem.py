"""A contact problem as a family states it: once, and nothing assembled.

Of it follow the QPs of undivided bodies (`problems.duality.monolithic`) and those of
subdomains, on one process or on several ranks (`problems.duality.decomposed`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, wraps
from typing import Any, Generic, NamedTuple, Protocol, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import QP, Friction, InputError, Solution, Value, Vector
from mortarbench.problems.contact.bodies import (
    Bodies,
    ContactPair,
    ContactSides,
    UnassembledBodies,
    assemble_stiffness,
    factorise_clamped,
    factorise_floating,
    factorise_supported,
    support_rows,
)
from mortarbench.problems.contact.friction import FrictionLaw
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.node_to_segment import ContactRows
from mortarbench.problems.contact.stepping import Forces, Stage, forces_of
from mortarbench.problems.fem.elasticity import Material, Plane
from mortarbench.problems.fem.inverse import GeneralisedInverse
from mortarbench.problems.fem.mesh import (
    HalfDisc,
    Mesh,
    Nodes,
    StructuredGrid,
    join,
    joined_sides,
)
from mortarbench.problems.feti.partition import graph_partition
from mortarbench.problems.feti.structured import Layout
from mortarbench.problems.feti.subdivision import (
    Subdivision,
    half_discs_in_blocks,
    mesh_in_subdomains,
)
from mortarbench.problems.feti.tearing import compact_blocks

Linearise: TypeAlias = Callable[[Vector], ContactRows]  #: displacement in m → rows


class Shape(Protocol):
    """Bodies without material, meshed when somebody asks for the mesh."""

    @property
    def dim(self) -> int:
        """Number of coordinates of a point."""

    @property
    def mesh(self) -> Mesh:
        """All bodies, joined, m."""

    @property
    def body(self) -> NDArray[np.int64]:
        """Body of each cell, (E,)."""

    @property
    def sides(self) -> Mapping[str, Nodes]:
        """Chains of nodes by their names, of which no mesh needs to be made."""

    def layout(self, size: int) -> Subdivision:
        """Cut the bodies; what `size` means depends on the shape."""


B = TypeVar("B", StructuredGrid, HalfDisc)


@dataclass(frozen=True, eq=False)
class _Joined(Generic[B]):
    """Bodies of known shape in the plane, numbered one after another."""

    parts: tuple[B, ...]
    dim = 2

    @cached_property
    def _joined(self) -> tuple[Mesh, Nodes]:
        return join(tuple(part.mesh() for part in self.parts))

    @property
    def mesh(self) -> Mesh:
        """All bodies, m."""
        return self._joined[0]

    @property
    def body(self) -> NDArray[np.int64]:
        """Body of each cell, (E,)."""
        return self._joined[1]

    @cached_property
    def sides(self) -> Mapping[str, Nodes]:
        """Chains of nodes by their names."""
        return joined_sides(self.parts)


class StructuredGrids(_Joined[StructuredGrid]):
    """Structured grids; subdomains of at most size² cells."""

    def layout(self, size: int) -> Layout:
        """Cut each grid into blocks of at most `size` cells a side."""
        return Layout.of(self.parts, size)


class HalfDiscs(_Joined[HalfDisc]):
    """Half discs; subdomains are blocks of rings and sectors."""

    def layout(self, size: int) -> Subdivision:
        """Cut each into blocks about as long as wide, of at most size² cells.

        The triangles at a centre are the last ring.
        """
        blocks = [compact_blocks(disc.lengths(), size) for disc in self.parts]
        return half_discs_in_blocks(self.parts, blocks)


@dataclass(frozen=True, eq=False)
class Meshed:
    """A mesh of any kind; `size` is the number of all subdomains, by METIS."""

    mesh: Mesh
    body: NDArray[np.int64]
    named: Nodes  #: nodes that supports and contact name

    @property
    def dim(self) -> int:
        """Number of coordinates of a point."""
        return self.mesh.dim

    @property
    def sides(self) -> Mapping[str, Nodes]:
        """Chains of nodes by their names."""
        return self.mesh.boundaries

    def layout(self, size: int) -> Subdivision:
        """Cut the bodies by graph partitioning."""
        label = graph_partition(self.mesh.points, self.mesh.cells, self.body, size)
        return mesh_in_subdomains(self.mesh, label, self.body, self.named)


@dataclass(frozen=True, eq=False, kw_only=True)
class ElasticBodies:
    """Bodies with their materials, supports, full load and contact sides."""

    shape: Shape
    names: tuple[str, ...]
    materials: tuple[Material, ...]  #: of each body
    plane: Plane | None  #: None in space
    length: float  #: l, m: lengths of QPs are multiples of it
    force: float  #: F₀, N/m
    fixed: Nodes  #: components that are zero
    forces: Forces
    pairs: tuple[ContactPair, ...]

    @cached_property
    def assembled(self) -> Bodies:
        """The bodies in one piece, with their stiffness."""
        return assemble_stiffness(self.whole)

    @cached_property
    def whole(self) -> UnassembledBodies:
        """The bodies in one piece, without any stiffness."""
        mesh = self.shape.mesh
        f = np.zeros(mesh.dofs)
        f[self.forces.component] = self.forces.value
        return UnassembledBodies(
            mesh=mesh, body=self.shape.body, names=self.names,
            materials=self.materials, plane=self.plane, length=self.length,
            force=self.force, f=f, B_D=support_rows(mesh, self.fixed),
            pairs=self.pairs,
        )  # fmt: skip

    @cached_property
    def is_supported(self) -> bool:
        """True where supports leave no rigid motion of any body."""
        rigid = self.whole.rigid
        return bool(np.linalg.matrix_rank(rigid[self.fixed]) == rigid.shape[1])

    @cached_property
    def floating(self) -> GeneralisedInverse:
        """K⁺ with all rigid motions."""
        return factorise_floating(self.assembled)

    @cached_property
    def clamped(self) -> GeneralisedInverse:
        """K⁺ without the prescribed components; InputError if these hold too little."""
        return factorise_clamped(self.assembled)

    @cached_property
    def supported(self) -> GeneralisedInverse:
        """K⁺ like `factorise_clamped`, also for bodies that contact alone holds."""
        return factorise_supported(self.assembled)


def elastic_bodies_of(bodies: UnassembledBodies) -> ElasticBodies:
    """State bodies that there is a mesh of already; their own stiffness is kept."""
    fixed = bodies.B_D.indices
    named = np.concatenate([fixed, bodies.interface]) // bodies.mesh.dim
    found = ElasticBodies(
        shape=Meshed(bodies.mesh, bodies.body, named), names=bodies.names,
        materials=bodies.materials, plane=bodies.plane, length=bodies.length,
        force=bodies.force, fixed=fixed, forces=forces_of(bodies.f), pairs=bodies.pairs,
    )  # fmt: skip
    vars(found)["whole"] = bodies
    if isinstance(bodies, Bodies):
        vars(found)["assembled"] = bodies
    return found


class InterfaceState(NamedTuple):
    """The contact: data and solution at least at the nodes of the sides."""

    bodies: Bodies | ContactSides
    primal: QP  #: of the nodes of the sides at least; of P, the diagonal with friction
    solution: Solution
    friction: Friction


class DisplacedMesh(NamedTuple):
    """Some cells of one body with their displacement."""

    body: int
    mesh: Mesh  #: N nodes
    inner: NDArray[np.bool_]  #: (N,) those that are not there for their neighbours only
    u: Vector  #: (2N,) m


class ContactSolution(Protocol):
    """An answer to a contact problem; on ranks, all of them call what they call."""

    @property
    def sides(self) -> InterfaceState:
        """The contact."""

    @property
    def problems(self) -> int:
        """Number of Tresca problems that Coulomb's law took; 1 without it."""

    def at(self, component: Nodes) -> Vector:
        """Return u, without dimension, at components (k,) of the whole."""

    def meshes(self) -> Iterator[DisplacedMesh]:
        """Give all cells, some at a time."""

    def largest(self, value: float) -> float:
        """Return the largest of the numbers of all ranks."""


def no_further_results(found: ContactSolution) -> dict[str, Any]:
    """Report nothing besides what all elastic bodies report."""
    return {}


@dataclass(frozen=True, eq=False, kw_only=True)
class ContactProblem:
    """Elastic bodies, how they touch, and how the load comes on them."""

    bodies: ElasticBodies
    stages: tuple[Stage, ...]
    #: of bodies or their sides, and laws of friction: displacement in m → rows
    linearise: Callable[
        [UnassembledBodies | ContactSides, Sequence[FrictionLaw]], Linearise
    ]
    #: normal force of each slave node that the first bound of Coulomb's law is of
    pressed: float = 0.0
    #: reports more of an answer than of all elastic bodies
    results: Callable[[ContactSolution], Mapping[str, Any]] = no_further_results
    #: (k, 3) x, m, exact pressure and shear, Pa, of the slave side, where it is known
    exact: NDArray[np.float64] | None = None


class Choice(NamedTuple):
    """The QP of a contact problem that is emitted."""

    step: int = 1  #: of the load
    iterate: int = 0  #: of the fixed point of Coulomb's law, 1, 2, …; 0: the last one
    size: int = 0  #: of subdomains, as of `Shape.layout`; 0: undivided bodies
    glue: str = "orthonormal"  #: one of `problems.feti.subdomains.GLUE`


#: keys of a case that choose among the QPs of one problem
CHOICES = ("step", "iterate", "feti", "parts", "glue")


def qp_choice(form: str, params: Mapping[str, Value]) -> Choice:
    """Return what keys say of the QP that is emitted.

    Raises
    ------
    InputError
        Where subdomains are asked for in another form than the dual.

    """
    p: Any = params
    key = "parts" if "parts" in p else "feti"
    size = p.get(key, 0)
    if size and form != "dual":
        raise InputError(
            f"{key} with form {form} is not built; expected form dual, or no {key}"
        )
    return Choice(
        p.get("step", 1), p.get("iterate", 0), size, p.get("glue", "orthonormal")
    )


def cached_problem(
    state: Callable[[Mapping[str, Any]], ContactProblem],
) -> Callable[[Mapping[str, Value]], ContactProblem]:
    """State a problem once for all QPs that keys choose of it; keep the last few."""
    kept = lru_cache(maxsize=4)(lambda items: state(dict(items)))

    @wraps(state)
    def problem(params: Mapping[str, Value]) -> ContactProblem:
        return kept(tuple((k, v) for k, v in params.items() if k not in CHOICES))

    return problem


def keyed_linearisation(
    params: Mapping[str, Any],
) -> Callable[[UnassembledBodies | ContactSides, Sequence[FrictionLaw]], Linearise]:
    """Linearise contact by the method that the keys `contact` and `basis` name."""
    return lambda bodies, laws: linearisation(
        bodies, params["contact"], params["basis"], laws
    )
