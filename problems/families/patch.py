"""Contact patch test: transfer of a uniform pressure across a non-matching interface.

Two blocks of 1 m × ½ m are stacked without a gap, with or without friction. Both have
rollers on their left sides; the lower block also has rollers on its bottom. The
pressure p acts on the top of the upper block. The exact displacement is linear in each
block; bilinear elements therefore represent it exactly:

    σ_y = −p,  σ_x = τ_xy = 0      (plane strain: ε_y = −(1 − ν²)p/E, ε_x = ν(1 + ν)p/E)

A contact discretisation passes the test if it reproduces this solution, that is, if it
transfers constant pressures exactly (Taylor and Papadopoulos 1991). Mortar methods
pass. One-pass node-to-segment contact fails: its error in σ_y is of order one and does
not vanish as the mesh is refined. Friction has no effect if the blocks are of the same
material. The upper block is supported by contact alone; therefore, the form
``dual-bounds`` does not exist.

In 3D (dim=3) the blocks are 1 m × 1 m × ½ m, with rollers also on y = 0, and σ_z =
−p. Hexahedra represent linear displacements exactly even if they are distorted (key
`distort`).

At finite strain (kinematics=finite) the pressure is a dead load (a nominal stress). The
exact solution is homogeneous, with the stretches λ₁ along x and λ₂ along y,

    F = diag(λ₁, λ₂),   P₁₁(λ₁, λ₂) = 0,   P₂₂(λ₁, λ₂) = −p,   σ_y = P₂₂/λ₁

if the blocks are of the same material. The key `stretch` prescribes λ₂ instead of p.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from mortarbench.harness import InputError, Solution
from mortarbench.harness.keys import Range
from mortarbench.problems.contact.bodies import (
    Bodies,
    ContactPair,
    UnassembledBodies,
    elasticity_matrices,
    structured,
)
from mortarbench.problems.contact.friction import law_of
from mortarbench.problems.contact.results import contact_forces
from mortarbench.problems.contact.stepping import load_steps
from mortarbench.problems.duality.newton import Iteration, NewtonPath
from mortarbench.problems.duality.problem import (
    ContactProblem,
    ContactSolution,
    keyed_linearisation,
)
from mortarbench.problems.families.contact import ContactFamily
from mortarbench.problems.fem.elasticity import Material
from mortarbench.problems.fem.finite_strain import cauchy_stress, strain_energy
from mortarbench.problems.fem.hyperelastic import Hyperelastic, hyperelastic
from mortarbench.problems.fem.mesh import (
    Mesh,
    as_vectors,
    box,
    distorted,
    dofs_of,
    nodal_sizes,
    nodes_of_side,
    prefixed,
    rectangle,
)
from mortarbench.problems.fem.stress import gauss_stress
from mortarbench.problems.keys import (
    MIN_STRETCH,
    PLANE_ONLY,
    POSITIVE,
    UNSET,
    Basis,
    Bound,
    Dimension,
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
    check_memory,
    refuse_unbuilt,
    refuse_unused,
)

LENGTH, HEIGHT = 1.0, 0.5  #: size of each block, m
NAMES = ("lower", "upper")
PRESSURE = 1e6  #: pressure p, Pa
#: modulus of the upper block, Pa, and Poisson's ratio of both blocks
E_UPPER, NU = 10e6, 0.3


#: largest shift of a node, in cell sizes; shifts of half a cell could invert cells
MAX_DISTORTION = 0.35


@dataclass(frozen=True, kw_only=True)
class ContactPatch(ContactFamily):
    """Contact patch test: two stacked blocks under uniform pressure."""

    forms: ClassVar = ("primal", "dual")

    lower: Annotated[int, Range(1), "cells of the lower block along x"] = 6
    upper: Annotated[int, Range(1), "cells of the upper block along x"] = 4
    slave: Annotated[Literal["lower", "upper"], "block with the slave side"] = "upper"
    ratio: Annotated[float, POSITIVE, "ratio of the moduli, lower to upper"] = 1.0
    contact: Method = "mortar"
    basis: Basis = "dual"
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
    stretch: Annotated[
        float,
        Range(MIN_STRETCH, 1),
        "stretch along y at finite strain; 1: under the pressure of 1 MPa",
    ] = 1.0
    dim: Dimension = 2
    distort: Annotated[
        float, Range(0, MAX_DISTORTION), "largest shift of a node in 3D, in cells"
    ] = 0.0

    def __post_init__(self) -> None:
        """Check that every key is used, and that the blocks fit into memory."""
        super().__post_init__()
        if self.dim == 3:
            refuse_unbuilt(self, PLANE_ONLY, "dim=3", "a plane problem")
        else:
            refuse_unused(self, "distort", "dim=2", "dim=3")
        if self.kinematics == "linear":
            refuse_unused(self, "stretch", "kinematics=linear", "kinematics=finite")
        cells = self.lower**self.dim + self.upper**self.dim
        check_memory(self.dim * cells // 2)

    def problem(self) -> ContactProblem:
        """Return the linear problem of the blocks."""
        elastic = bodies(self)
        D = elasticity_matrices(elastic.materials, elastic.plane)
        law = law_of(self.friction, self.bound, self.mu)

        def error(answer: ContactSolution) -> dict[str, Any]:
            """Return the largest |σ_y + p|/p (in 3D |σ_z + p|/p) at Gauss points."""
            mesh, body = elastic.mesh, elastic.body
            u = answer.at(np.arange(mesh.dofs)) * elastic.length
            vertical = gauss_stress(mesh, D[body], u)[..., mesh.dim - 1]
            largest = np.abs(vertical + PRESSURE).max() / PRESSURE
            return {"stress_error": float(largest)}

        return ContactProblem(
            bodies=elastic,
            linearise=keyed_linearisation(self.contact, self.basis),
            results=error,
            stages=load_steps(1, 1, elastic.f, elastic.fixed, (law,)),
            # the first friction bound of Coulomb's law must be large enough for
            # friction to support blocks that nothing else supports
            initial_force=float(np.abs(elastic.f).sum()),
        )

    def finite_bodies(self) -> Bodies:
        """Return the assembled blocks under the pressure of the exact solution."""
        whole = bodies(self).assembled
        return replace(whole, f=whole.f * (-self.uniform().nominal / PRESSURE))

    def newton_results(
        self, path: NewtonPath, at: Iteration, s: Solution
    ) -> Mapping[str, Any]:
        """Return mean values, and errors for blocks of the same material."""
        values = _mean_state(path, at, s)
        return values | (_errors(path, s, self.uniform()) if self.ratio == 1 else {})

    def uniform(self) -> Homogeneous:
        """Return the uniform state of the upper block at finite strain."""
        material = hyperelastic(self.material, Material(E_UPPER, NU))
        if self.stretch == 1:
            return state_under_pressure(material, PRESSURE)
        return state_at_stretch(material, self.stretch)


class Homogeneous(NamedTuple):
    """State of a block in uniform compression between frictionless plates."""

    lateral: float  #: stretch λ₁ along x
    stretch: float  #: stretch λ₂ along y
    nominal: float  #: nominal stress P₂₂, force per reference length and thickness, Pa
    cauchy: float  #: Cauchy stress σ_y, Pa
    energy: float  #: strain energy W per reference area, Pa
    stiffness: float  #: derivative dP₂₂/dλ₂ at P₁₁ = 0, Pa


def homogeneous(material: Hyperelastic, stretch: float) -> Homogeneous:
    """Return the state with stretch λ₂ = `stretch`, by solving P₁₁ = 0 for λ₁."""

    def F(lateral: float) -> NDArray[np.float64]:
        return np.diag([lateral, stretch])

    lateral = float(
        brentq(lambda lateral: material.stress(F(lateral))[0, 0], 0.5, 3.0, xtol=1e-15)
    )
    P, A = material.stress(F(lateral)), material.tangent(F(lateral))
    return Homogeneous(
        lateral,
        stretch,
        float(P[1, 1]),
        float(P[1, 1] / lateral),
        float(material.energy(F(lateral))),
        # dP₁₁ = 0 determines dλ₁, which is eliminated from dP₂₂
        float(A[1, 1, 1, 1] - A[0, 0, 1, 1] ** 2 / A[0, 0, 0, 0]),
    )


def state_at_stretch(material: Hyperelastic, stretch: float) -> Homogeneous:
    """Return the state with a prescribed stretch.

    Raises
    ------
    InputError
        If a growing load cannot reach this stretch because the material softens.

    """
    softest = _softest(material)
    if stretch <= softest:
        raise InputError(
            f"stretch={stretch:g} cannot be reached by a growing load: "
            f"material=svk softens from {softest:.4f} on; expected a larger stretch, "
            "or material=neo-hooke"
        )
    return homogeneous(material, stretch)


def state_under_pressure(material: Hyperelastic, pressure: float) -> Homogeneous:
    """Return the state under a nominal pressure, Pa."""
    least = max(_softest(material), MIN_STRETCH)
    stretch = float(
        brentq(
            lambda stretch: homogeneous(material, stretch).nominal + pressure,
            least,
            1.0,
            xtol=1e-15,
        )
    )
    return homogeneous(material, stretch)


def _softest(material: Hyperelastic) -> float:
    """Return the stretch at the largest pressure; 0 if the material does not soften."""
    if homogeneous(material, MIN_STRETCH).stiffness > 0:
        return 0.0
    return float(
        brentq(
            lambda stretch: homogeneous(material, stretch).stiffness, MIN_STRETCH, 1.0
        )
    )


def _mean_state(path: NewtonPath, at: Iteration, s: Solution) -> dict[str, Any]:
    """Return mean stretches [λ₁, λ₂], stresses and the strain energy of the blocks.

    `nominal_stress` is the contact force divided by the undeformed length in Pa;
    `cauchy_stress` is the mean of σ_y over the cells in Pa; `strain_energy` is ∫W in
    J/m.
    """
    bodies, u = path.bodies, as_vectors(s.x * path.bodies.length, 2)
    sides = bodies.mesh.boundaries
    right = np.concatenate([sides["lower_right"], sides["upper_right"]])
    force = contact_forces(bodies, at.primal, s)[sides["lower_top"], 1].sum()
    stress = cauchy_stress(path.cells, s.x)[:, 1] * (bodies.force / bodies.length)
    return {
        "stretches": [
            1 + float(u[right, 0].mean()) / LENGTH,
            1 + float(u[sides["upper_top"], 1].mean()) / (2 * HEIGHT),
        ],
        "nominal_stress": float(force / LENGTH),
        "cauchy_stress": float(stress.mean()),
        "strain_energy": strain_energy(path.cells, s.x) * bodies.length * bodies.force,
    }


def _errors(path: NewtonPath, s: Solution, exact: Homogeneous) -> dict[str, Any]:
    """Return the largest relative error of σ_y, and the largest position error, m."""
    bodies = path.bodies
    stress = cauchy_stress(path.cells, s.x)[:, 1] * (bodies.force / bodies.length)
    u = as_vectors(s.x * bodies.length, 2)
    strains = np.array([exact.lateral - 1, exact.stretch - 1])
    return {
        "stress_error": float(np.abs(stress / exact.cauchy - 1).max()),
        "position_error": float(np.abs(u - bodies.mesh.points * strains).max()),
    }


def bodies(patch: ContactPatch) -> UnassembledBodies:
    """Return the stacked blocks, with `lower` and `upper` cells along x.

    In 3D, the numbers of cells along y are the same.
    """
    dim, force = patch.dim, PRESSURE * LENGTH ** (patch.dim - 1)
    shape = structured(*map(prefixed, _blocks(patch), ("lower_", "upper_")))
    mesh, sides = shape.mesh, shape.mesh.boundaries
    walls = ("left", "front", "bottom") if dim == 3 else ("left", "bottom")
    rollers = [
        dofs_of(nodes_of_side(sides[f"{name}_{wall}"]), dim, axis)
        for axis, wall in enumerate(walls)
        for name in (NAMES if axis < dim - 1 else NAMES[:1])
    ]
    fixed = np.concatenate(rollers)
    f, (top, sizes) = np.zeros(mesh.dofs), nodal_sizes(mesh.points, sides["upper_top"])
    f[dofs_of(top, dim, dim - 1)] = -PRESSURE * sizes / force
    lower, upper = sides["lower_top"], sides["upper_bottom"]
    pair = (lower, upper) if patch.slave == "lower" else (upper, lower)
    return UnassembledBodies(
        shape=shape,
        names=NAMES,
        plane=patch.plane if dim == 2 else None,
        length=LENGTH,
        force=force,
        materials=(Material(patch.ratio * E_UPPER, NU), Material(E_UPPER, NU)),
        fixed=np.unique(fixed) if dim == 3 else fixed,
        pairs=(ContactPair(*pair),),
        f=f,
    )


def _blocks(patch: ContactPatch) -> list[Mesh]:
    """Return the lower and the upper block."""
    meshes = []
    for k, n in enumerate((patch.lower, patch.upper)):
        cells, bottom = (n, -(-n // 2)), k * HEIGHT  # cells are nearly square
        if patch.dim == 2:
            meshes.append(rectangle((0.0, bottom), (LENGTH, HEIGHT), cells))
        else:
            size = LENGTH, LENGTH, HEIGHT
            block = box((0.0, 0.0, bottom), size, (n, *cells))
            meshes.append(distorted(block, patch.distort, k))
    return meshes


def model(patch: ContactPatch) -> Bodies:
    """Mesh and assemble the blocks."""
    return bodies(patch).assembled
