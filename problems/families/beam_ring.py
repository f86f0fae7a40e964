"""The paper's benchmark: an elastic beam pressed onto a half ring (Section 2).

A beam of 2 m × 0.25 m (Figure 1 of the paper), with its lower left corner at height
0.5 m, is clamped on the left and pulled down by F₀ = 10⁸ N/m at its upper right corner.
Below the beam is a half ring with radii 0.3 m and 0.49 m around (1 m, 0), clamped at
both feet. The initial gap is 1 cm.

The paper is not consistent in some details. The 313 nodes that it states for Nr = 4,
Nh = 3 imply a ring with Nh radial layers (``radial=3``), whereas the text and Table 1
of the paper imply 2·Nh layers (424 nodes). m_E is the number of prescribed displacement
components, 2(Nr + 1) + 4(radial + 1), not of prescribed nodes. Plane strain and a force
per unit thickness are implied, not stated.

With depth > 0 the bodies are extruded to `depth` layers of hexahedra over a thickness
of 1 m. The end faces are free, or in plane strain (u_z = 0). Clamped sides are fixed in
all directions, and F₀ = 10⁸ N is distributed over the loaded edge.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from mortarbench.harness import InputError, Solution, Vector
from mortarbench.harness.keys import DERIVED, Range
from mortarbench.problems.contact.bodies import (
    Bodies,
    ContactPair,
    UnassembledBodies,
    structured,
)
from mortarbench.problems.contact.friction import law_of
from mortarbench.problems.contact.stepping import load_steps
from mortarbench.problems.duality.newton import Iteration, NewtonPath
from mortarbench.problems.duality.problem import (
    ContactProblem,
    keyed_linearisation,
)
from mortarbench.problems.families.contact import ContactFamily
from mortarbench.problems.fem.elasticity import Material, Plane
from mortarbench.problems.fem.mesh import (
    Mesh,
    Nodes,
    as_vectors,
    dofs_of,
    extruded,
    half_ring,
    nodal_lengths,
    nodes_of_side,
    rectangle,
)
from mortarbench.problems.keys import (
    CONTACT_FORMS,
    MAX_STEPS,
    PLANE_ONLY,
    UNSET,
    Basis,
    Bound,
    ContactStiffness,
    Feti,
    Glue,
    Kinematics,
    Law,
    Loading,
    MaterialLaw,
    Method,
    Mu,
    Newton,
    PlaneState,
    Step,
    Steps,
    check_memory,
    refuse_unbuilt,
    refuse_unused,
)

LENGTH = 2.0  #: l, length of the beam, m
LOAD = 1e8  #: F₀, N per m of thickness
THICKNESS = 1.0  #: thickness of extruded bodies, m
NAMES = ("beam", "ring")
BEAM = Material(E=200e9, nu=0.3)
RING = Material(E=20e9, nu=0.3)


#: largest number of nodes in the plane, due to 32-bit indices of the entries of K
MAX_NODES = 50_000_000


@dataclass(frozen=True, kw_only=True)
class BeamRing(ContactFamily):
    """The paper's benchmark: a beam on a half ring, plane or extruded."""

    forms: ClassVar = CONTACT_FORMS

    Nr: Annotated[int, Range(1), "the beam has 8·Nr × Nr cells"] = 10
    Nh: Annotated[int, Range(1), "the ring has 12·Nh cells along its arc"] = 5
    radial: Annotated[int, Range(1), "layers of the ring; default: 2·Nh"] = DERIVED
    steps: Steps = 10
    step: Step = DERIVED
    contact: Method = "nts"
    basis: Basis = "dual"
    relin: Annotated[int, Range(1, MAX_STEPS), "linearisations per load step"] = 1
    plane: PlaneState = "strain"
    friction: Law = "none"
    bound: Bound = UNSET
    mu: Mu = UNSET
    loading: Loading = "quasi-static"
    feti: Feti = 0
    glue: Glue = "orthonormal"
    kinematics: Kinematics = "linear"
    material: MaterialLaw = "neo-hooke"
    newton: Newton = 0
    contact_stiffness: ContactStiffness = "none"
    depth: Annotated[
        int, Range(0), "layers of hexahedra across a thickness of 1 m; 0: plane bodies"
    ] = 0
    sides: Annotated[
        Literal["free", "plane-strain"], "condition on the end faces in 3D"
    ] = "free"

    def __post_init__(self) -> None:
        """Derive `radial` and `step`; check the size and the dimension."""
        self.derive(radial=2 * self.Nh, step=self.steps)
        super().__post_init__()
        nodes = (8 * self.Nr + 1) * (self.Nr + 1)
        nodes += (12 * self.Nh + 1) * (self.radial + 1)
        if nodes > MAX_NODES:
            raise InputError(
                f"Nr={self.Nr}, Nh={self.Nh} result in {nodes:.2g} nodes; expected at "
                f"most {MAX_NODES:.2g}"
            )
        check_memory((3 * (self.depth + 1) if self.depth else 2) * nodes)
        if self.depth:
            refuse_unbuilt(self, PLANE_ONLY, f"depth={self.depth}", "a plane problem")
        else:
            refuse_unused(self, "sides", "depth=0", "depth=1 or more")

    def bodies(self) -> UnassembledBodies:
        """Return the beam and the ring, loaded by F₀."""
        return bodies(self.Nr, self.Nh, self.radial, self.plane, self.depth, self.sides)

    def problem(self) -> ContactProblem:
        """Return the benchmark, loaded in `steps` equal load steps."""
        elastic = self.bodies()
        tip, share = _tip(elastic.mesh)
        return ContactProblem(
            bodies=elastic,
            linearise=keyed_linearisation(self.contact, self.basis),
            stages=load_steps(
                self.steps,
                self.relin,
                elastic.f,
                elastic.fixed,
                (law_of(self.friction, self.bound, self.mu),),
                quasi_static=self.loading == "quasi-static",
            ),
            results=lambda answer: {
                "tip": (
                    share @ as_vectors(answer.at(tip), elastic.mesh.dim) * LENGTH
                ).tolist()
            },
        )

    def finite_bodies(self) -> Bodies:
        """Return the assembled beam and ring."""
        return self.bodies().assembled

    def newton_results(
        self, path: NewtonPath, at: Iteration, s: Solution
    ) -> Mapping[str, Any]:
        """Return the displacement of the loaded corner, m."""
        tip, _ = _tip(self.bodies().mesh)
        return {"tip": (s.x[tip] * LENGTH).tolist()}


@lru_cache(maxsize=4)
def bodies(
    Nr: int, Nh: int, radial: int, plane: Plane, depth: int = 0, sides: str = "free"
) -> UnassembledBodies:
    """Return a beam of 8Nr × Nr cells above a ring of 12Nh × radial cells.

    depth : number of layers across the thickness; 0 for plane bodies
    sides : condition on the end faces in 3D, "free" or "plane-strain"
    """
    parts = [
        rectangle((0.0, 0.5), (LENGTH, 0.25), (8 * Nr, Nr)),
        half_ring((1.0, 0.0), (0.3, 0.49), (12 * Nh, radial)),
    ]
    if depth:
        parts = [extruded(part, depth, THICKNESS) for part in parts]
    shape = structured(*parts)
    mesh, by_name = shape.mesh, shape.mesh.boundaries
    # in 2D, these are m_E = 2(Nr + 1) + 4(radial + 1) components
    clamped = [
        dofs_of(nodes_of_side(by_name[b]), mesh.dim)
        for b in ("left", "left_foot", "right_foot")
    ]
    if sides == "plane-strain":
        ends = np.isin(mesh.points[:, 2], (0.0, THICKNESS))
        clamped.append(dofs_of(np.flatnonzero(ends), 3, 2))
    fixed = np.concatenate(clamped)
    f, (tip, share) = np.zeros(mesh.dofs), _tip(mesh)
    f[tip[1 :: mesh.dim]] = -share
    return UnassembledBodies(
        shape=shape,
        names=NAMES,
        materials=(BEAM, RING),
        plane=None if depth else plane,
        length=LENGTH,
        force=LOAD,
        fixed=np.unique(fixed) if depth else fixed,
        f=f,
        # as in the paper: the ring is the slave, the beam the master
        pairs=(ContactPair(slave=by_name["outer"], master=by_name["bottom"]),),
    )


def model(Nr: int, Nh: int, radial: int, plane: Plane) -> Bodies:
    """Mesh and assemble the beam and the ring."""
    return bodies(Nr, Nh, radial, plane).assembled


def _tip(mesh: Mesh) -> tuple[Nodes, Vector]:
    """Return the components of the loaded corner, at the upper right of the beam.

    Returns
    -------
    components (dim·k,) of the k nodes of the corner (an edge in 3D), and the
    fraction (k,) of the load that acts on each node

    """
    sides = mesh.boundaries
    nodes = np.intersect1d(sides["top"], sides["right"])
    share = np.ones(1)
    if mesh.dim == 3:
        share = nodal_lengths(mesh.points[nodes]) / THICKNESS
    return dofs_of(nodes, mesh.dim), share
