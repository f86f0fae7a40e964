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
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from mortarbench.harness import Case, InputError, Reference, Solution, Value
from mortarbench.problems.contact.bodies import (
    Bodies,
    ContactPair,
    elasticity_matrices,
)
from mortarbench.problems.contact.friction import law_of
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.results import contact_forces
from mortarbench.problems.contact.stepping import Forces, load_steps
from mortarbench.problems.duality.newton import Iteration, NewtonPath
from mortarbench.problems.duality.newton_case import newton_case, newton_path
from mortarbench.problems.duality.problem import (
    ContactProblem,
    ContactSolution,
    ElasticBodies,
    StructuredGrids,
    StructuredSolids,
    cached_problem,
    keyed_linearisation,
)
from mortarbench.problems.fem.elasticity import Material
from mortarbench.problems.fem.finite_strain import cauchy_stress, strain_energy
from mortarbench.problems.fem.hyperelastic import Hyperelastic, hyperelastic
from mortarbench.problems.fem.mesh import (
    Nodes,
    StructuredGrid,
    as_vectors,
    box,
    distorted,
    dofs_of,
    nodal_areas,
    nodal_lengths,
    prefixed,
    rectangle_grid,
)
from mortarbench.problems.fem.stress import gauss_stress
from mortarbench.problems.ranges import MIN_STRETCH

LENGTH, HEIGHT = 1.0, 0.5  #: size of each block, m
NAMES = ("lower", "upper")
PRESSURE = 1e6  #: pressure p, Pa
#: modulus of the upper block, Pa, and Poisson's ratio of both blocks
E_UPPER, NU = 10e6, 0.3


@cached_problem
def problem(params: Mapping[str, Value]) -> ContactProblem:
    """Return the linear problem of the blocks."""
    p: Any = params
    elastic = bodies(p)
    D = elasticity_matrices(elastic.materials, elastic.plane)

    def error(answer: ContactSolution) -> dict[str, Any]:
        """Return the largest |σ_y + p|/p (in 3D |σ_z + p|/p) at Gauss points."""
        mesh, body = elastic.shape.joined
        u = answer.at(np.arange(mesh.dofs)) * elastic.length
        vertical = gauss_stress(mesh, D[body], u)[..., mesh.dim - 1]
        return {"stress_error": float(np.abs(vertical + PRESSURE).max() / PRESSURE)}

    return ContactProblem(
        bodies=elastic,
        linearise=keyed_linearisation(p),
        results=error,
        stages=load_steps(1, 1, elastic.forces, elastic.fixed, (law_of(p),)),
        # the first friction bound of Coulomb's law must be large enough for friction to
        # support blocks that nothing else supports
        initial_force=float(np.abs(elastic.forces.value).sum()),
    )


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
            f"contact-patch: stretch={stretch:g} cannot be reached by a growing load: "
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


def newton_step(form: str, params: Mapping[str, Value], reference: Reference) -> Case:
    """Return the case of one Newton iteration at finite strain."""
    p: Any = params
    path = _newton_path(tuple({**params, "newton": 0}.items()), reference)
    exact = _uniform(params)

    def results(at: Iteration, s: Solution) -> dict[str, Any]:
        values = _mean_state(path, at, s)
        if p["ratio"] == 1:
            values |= _errors(path, s, exact)
        return values

    return newton_case(path, form, 1, p["newton"], results)


@lru_cache(maxsize=4)
def _newton_path(
    items: tuple[tuple[str, Any], ...], reference: Reference
) -> NewtonPath:
    params = dict(items)
    whole = model(params)
    whole = replace(whole, f=whole.f * (-_uniform(params).nominal / PRESSURE))
    linearise = linearisation(whole, params["contact"], params["basis"])
    return newton_path(whole, linearise, params, reference)


def _uniform(params: Mapping[str, Any]) -> Homogeneous:
    """Return the uniform state of the upper block under its load."""
    material = hyperelastic(params["material"], Material(E_UPPER, NU))
    if params["stretch"] == 1:
        return state_under_pressure(material, PRESSURE)
    return state_at_stretch(material, float(params["stretch"]))


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


def bodies(params: Mapping[str, Value]) -> ElasticBodies:
    """Return the stacked blocks, with `lower` and `upper` cells along x.

    In 3D, the numbers of cells along y are the same.
    """
    p: Any = params
    if p["dim"] == 3:
        return _bodies_in_space(params)
    shape = StructuredGrids(_grids(params))
    sides, force = shape.sides, PRESSURE * LENGTH
    left = np.concatenate([sides["lower_left"], sides["upper_left"]])
    rollers = dofs_of(left, 2, 0), dofs_of(sides["lower_bottom"], 2, 1)
    pressing = -PRESSURE * nodal_lengths(shape.mesh.points[shape.sides["upper_top"]])
    return ElasticBodies(
        shape=shape,
        names=NAMES,
        plane=p["plane"],
        length=LENGTH,
        force=force,
        materials=(Material(p["ratio"] * E_UPPER, NU), Material(E_UPPER, NU)),
        fixed=np.concatenate(rollers),
        pairs=(_pair(params, sides),),
        forces=Forces(dofs_of(sides["upper_top"], 2, 1), pressing / force),
    )


def _bodies_in_space(params: Mapping[str, Value]) -> ElasticBodies:
    """Return two blocks of 1 m × 1 m × ½ m with rollers on x = 0, y = 0 and z = 0."""
    p: Any = params
    divisions = [(p[name], p[name], -(-p[name] // 2)) for name in NAMES]
    meshes = [
        prefixed(
            distorted(box((0.0, 0.0, z), (LENGTH, LENGTH, HEIGHT), n), p["distort"], k),
            f"{name}_",
        )
        for k, (name, z, n) in enumerate(
            zip(NAMES, (0.0, HEIGHT), divisions, strict=True)
        )
    ]
    shape = StructuredSolids(tuple(meshes), tuple(divisions))
    sides, force = shape.sides, PRESSURE * LENGTH**2
    rollers = [
        dofs_of(np.unique(sides[name]), 3, axis)
        for name, axis in (
            ("lower_left", 0), ("upper_left", 0), ("lower_front", 1),
            ("upper_front", 1), ("lower_bottom", 2),
        )
    ]  # fmt: skip
    top, areas = nodal_areas(shape.mesh.points, sides["upper_top"])
    return ElasticBodies(
        shape=shape,
        names=NAMES,
        plane=None,
        length=LENGTH,
        force=force,
        materials=(Material(p["ratio"] * E_UPPER, NU), Material(E_UPPER, NU)),
        fixed=np.unique(np.concatenate(rollers)),
        pairs=(_pair(params, sides),),
        forces=Forces(dofs_of(top, 3, 2), -PRESSURE * areas / force),
    )


def model(params: Mapping[str, Value]) -> Bodies:
    """Mesh and assemble the blocks."""
    return bodies(params).assembled


def _pair(params: Mapping[str, Value], sides: Mapping[str, Nodes]) -> ContactPair:
    lower, upper = sides["lower_top"], sides["upper_bottom"]
    return ContactPair(
        *((lower, upper) if params["slave"] == "lower" else (upper, lower))
    )


def _grids(params: Mapping[str, Any]) -> tuple[StructuredGrid, StructuredGrid]:
    lower, upper = (
        rectangle_grid((0.0, bottom), (LENGTH, HEIGHT), _divisions(params[name]))
        for name, bottom in (("lower", 0.0), ("upper", HEIGHT))
    )
    return lower.prefixed("lower_"), upper.prefixed("upper_")


def _divisions(n: int) -> tuple[int, int]:
    """Return numbers of cells along x and y for which cells are nearly square."""
    return n, -(-n // 2)
