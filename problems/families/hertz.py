"""Line contact of cylinders, with Hertz's exact solution (Johnson 1985, Section 4.2).

With 1/R = 1/R₁ + 1/R₂, 1/E* = Σ(1 − νᵢ²)/Eᵢ (plane stress: Σ1/Eᵢ) and the force P per
thickness, two elastic bodies with radii of curvature R₁ and R₂ touch over |x| ≤ a
with the pressure

    p(x) = p₀√(1 − x²/a²),   a = √(4PR/(πE*)),   p₀ = 2P/(πa),   ∫px² dx = Pa²/4

Bodies are half discs. A uniform pressure acts on the flat side of the upper body, and
with a tangential force also on that of the lower body. The force is prescribed, since
the theory does not determine the approach. Contact alone supports the upper body
vertically; therefore, the form ``dual-bounds`` does not exist.

The keys `n` and `m`, numbers of cells per half width a, refine the contact zone only.
Outside this zone, cells grow by the factor GROWTH, irrespective of n and m. The key
`halvings` is the number of bisections of all cells along both directions.

R = 8, E = 200, ν = 0.3 and P = 10 are a benchmark in the literature, which states no
units. Here the units are mm, GPa and MN/m, so that a = 0.68078 mm and p₀ = 9.3514 GPa.

A tangential force Q on two cylinders of the same material acts on the flat sides. The
loads are shear tractions with resultants ±Q, and normal tractions, linear along each
side, that balance the moment without supports. Loads and deformations of the two bodies
are symmetric: contact and friction alone support the upper body, and the supports of
the lower body have no reactions. Exact tractions are those of
`problems.families.line_contact`. P acts first, without friction, then Q with friction.

Two errors do not vanish as the mesh is refined, because the bodies are finite (0.1 %)
and a/R is not zero. Contact of two cylinders is linearised at the undeformed state,
along normals that differ from the vertical by up to a/R. The deviation from Hertz's
solution is of order a²/R² ∝ P, and 1 % at P = 10; the default load of two cylinders is
therefore smaller.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import (
    QP,
    Case,
    Friction,
    InputError,
    Reference,
    Solution,
    Vector,
)
from mortarbench.harness.keys import Range
from mortarbench.problems.contact.bodies import (
    ContactPair,
    UnassembledBodies,
    structured,
)
from mortarbench.problems.contact.friction import law_of
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.results import contact_forces
from mortarbench.problems.contact.rigid import RigidPlane
from mortarbench.problems.contact.stepping import (
    continue_slip,
    load_steps,
    normal_first,
    restart_slip,
)
from mortarbench.problems.duality.case_forms import with_exact_tractions
from mortarbench.problems.duality.newton import Iteration, NewtonPath
from mortarbench.problems.duality.newton_case import newton_path
from mortarbench.problems.duality.problem import (
    ContactProblem,
    ContactSolution,
    keyed_linearisation,
)
from mortarbench.problems.families.contact import ContactFamily
from mortarbench.problems.families.line_contact import LineContact, TangentialContact
from mortarbench.problems.fem.elasticity import Material, Plane
from mortarbench.problems.fem.mesh import (
    Mesh,
    Nodes,
    as_vectors,
    dofs_of,
    half_disc,
    nodal_lengths,
    prefixed,
)
from mortarbench.problems.keys import (
    POSITIVE,
    UNSET,
    Basis,
    Bound,
    Feti,
    Glue,
    Halvings,
    Kinematics,
    Law,
    Loading,
    MaterialLaw,
    Method,
    Mu,
    Newton,
    PlaneState,
    check_memory,
    check_tangential,
)

RADIUS = 8e-3  #: radius R of a cylinder, m
NAMES = ("upper", "lower")
MATERIAL = Material(E=200e9, nu=0.3)
UNIT_LOAD = 1e6  #: unit of the key `load`, N/m
GROUND = RigidPlane((0.0, 0.0), (0.0, 1.0))

GROWTH = 1.15  #: ratio of the sizes of neighbouring cells away from the contact
#: half width of the uniformly meshed part of the arc, in units of a
UNIFORM_HALF_WIDTH = 1.5
CURVE_POINTS = 601  #: number of points on the uniform part for plots of exact tractions


@dataclass(frozen=True, kw_only=True)
class HertzPlane(ContactFamily):
    """Hertz contact: an elastic half cylinder pressed onto a rigid plane."""

    forms: ClassVar = ("primal", "dual")

    n: Annotated[int, Range(1), "cells per half width of the contact"] = 10
    load: Annotated[float, POSITIVE, "force P, MN/m"] = 10.0
    plane: PlaneState = "strain"
    halvings: Halvings = 0
    feti: Feti = 0
    glue: Glue = "orthonormal"
    kinematics: Kinematics = "linear"
    material: MaterialLaw = "neo-hooke"
    newton: Newton = 0

    def __post_init__(self) -> None:
        """Check that the mesh fits into memory."""
        super().__post_init__()
        check_memory((self.n * 2**self.halvings) ** 2)

    def problem(self) -> ContactProblem:
        """Return the linear problem of a cylinder on a rigid plane."""
        elastic, exact = _cylinder_on_plane(self)

        def results(answer: ContactSolution) -> dict[str, Any]:
            bodies, primal, s, _, _ = answer.sides
            return pressure_quantities(bodies, primal, exact, s)

        return ContactProblem(
            bodies=elastic,
            stages=load_steps(1, 1, elastic.f, elastic.fixed),
            linearise=lambda bodies, _: linearisation(bodies, "nts", "dual"),
            results=results,
            exact=_curve(exact),
        )

    def newton_path(self, reference: Reference) -> NewtonPath:
        """Return the Newton iterations; gaps to a plane are linear in u."""
        bodies = _cylinder_on_plane(self)[0].assembled
        rows = linearisation(bodies, "nts", "dual")(np.zeros(bodies.mesh.dofs))
        return newton_path(bodies, lambda u: rows, reference, material=self.material)

    def newton_results(
        self, path: NewtonPath, at: Iteration, s: Solution
    ) -> dict[str, Any]:
        """Compare the pressure with Hertz's."""
        exact = _cylinder_on_plane(self)[1]
        return pressure_quantities(at.tangent, at.primal, exact, s)

    def newton_case(self, form: str, reference: Reference) -> Case:
        """Return the case of a Newton iteration, with the exact tractions."""
        case = super().newton_case(form, reference)
        return with_exact_tractions(case, _curve(_cylinder_on_plane(self)[1]))


@dataclass(frozen=True, kw_only=True)
class HertzCylinder(ContactFamily):
    """Hertz contact: an elastic half cylinder pressed onto another half cylinder."""

    forms: ClassVar = ("primal", "dual")

    n: Annotated[int, Range(1), "cells of the upper cylinder per half width"] = 10
    m: Annotated[int, Range(1), "cells of the lower cylinder per half width"] = 8
    load: Annotated[float, POSITIVE, "force P, MN/m"] = 1.0
    ratio: Annotated[float, POSITIVE, "ratio of the moduli, lower to upper"] = 1.0
    slave: Annotated[Literal["lower", "upper"], "cylinder with the slave side"] = (
        "upper"
    )
    contact: Method = "mortar"
    basis: Basis = "dual"
    plane: PlaneState = "strain"
    halvings: Halvings = 0
    friction: Law = "none"
    bound: Bound = UNSET
    mu: Mu = UNSET
    loading: Loading = "quasi-static"
    Q: Annotated[float, "tangential force, a fraction of μP"] = 0.0
    feti: Feti = 0
    glue: Glue = "orthonormal"

    def __post_init__(self) -> None:
        """Check that the mesh fits into memory, and that Q has an exact solution."""
        super().__post_init__()
        check_memory((self.n * 2**self.halvings) ** 2)
        if self.Q:
            for name, value in (("friction", "coulomb"), ("ratio", 1.0)):
                if getattr(self, name) != value:
                    raise InputError(
                        f"{name}={getattr(self, name)} is not supported with a "
                        f"tangential force; expected {name}={value}, or no Q"
                    )
            check_tangential(self.Q)
            POSITIVE.require("mu", self.mu)

    def problem(self) -> ContactProblem:
        """Return the problem of two cylinders, linearised at the undeformed state."""
        elastic, exact = two_cylinders(self)
        law = law_of(self.friction, self.bound, self.mu)
        mindlin = TangentialContact(exact, self.mu, self.Q) if self.Q else None

        def results(answer: ContactSolution) -> dict[str, Any]:
            bodies, primal, s, _, friction = answer.sides
            values = pressure_quantities(bodies, primal, exact, s)
            if mindlin is not None:
                sign = 1.0 if self.slave == "upper" else -1.0
                values |= shear_quantities(bodies, primal, mindlin, s, friction, sign)
            if self.friction == "coulomb":
                values["tresca_problems"] = answer.problems
            return values

        stages = load_steps(1, 1, elastic.f, elastic.fixed, (law,))
        if self.Q:
            both = elastic.f + self.Q * self.mu * _shearing(elastic.mesh)
            # without supports on the axis and without friction, the cylinders could
            # roll on each other almost freely, because only the polygonal shape of the
            # arcs would resist; under P, these supports have no reactions
            axis = _on_axis(elastic.mesh.boundaries, "upper_")
            begin = restart_slip if self.loading == "quasi-static" else continue_slip
            stages = normal_first(elastic.f, both, elastic.fixed, axis, law, begin)
        shear = np.zeros_like if mindlin is None else mindlin.traction
        has_exact = self.friction == "none" or mindlin is not None
        return ContactProblem(
            bodies=elastic,
            linearise=keyed_linearisation(self.contact, self.basis, undeformed=True),
            results=results,
            stages=stages,
            exact=_curve(exact, shear) if has_exact else None,
        )


def _cylinder_on_plane(
    keys: HertzPlane,
) -> tuple[UnassembledBodies, LineContact]:
    """Return the cylinder on a rigid plane with n cells per a, and Hertz's solution."""
    exact = LineContact(
        keys.load * UNIT_LOAD, RADIUS, 1 / _compliance(MATERIAL, keys.plane)
    )
    a = min(exact.a, RADIUS)  # see `half_cylinders`
    shape = structured(_half_cylinder(RADIUS, a / keys.n, a, keys.halvings))
    sides = shape.mesh.boundaries
    return UnassembledBodies(
        shape=shape,
        names=("cylinder",),
        materials=(MATERIAL,),
        plane=keys.plane,
        length=RADIUS,
        force=exact.P,
        fixed=_on_axis(sides),
        f=_pressing(shape.mesh, "flat", 1.0),
        pairs=(ContactPair(sides["arc"], sides["arc"][:0], GROUND),),
    ), exact


def two_cylinders(keys: HertzCylinder) -> tuple[UnassembledBodies, LineContact]:
    """Return the cylinders in contact under P alone, and Hertz's solution.

    Both cylinders have R = 8 mm, and touch at (0, 0). There are n (upper) and m (lower)
    cells per half width a. The upper cylinder has E = 200 GPa; the modulus of the lower
    one is multiplied by `ratio`. If Hertz's a exceeds R, because the bodies are too
    soft for the theory, the mesh is that for a = R, so that the uniform part of the arc
    does not exceed the half disc.

    With a tangential force, the supports only exclude rigid motions and have no
    reactions. Without a tangential force, the supports also enforce the symmetry about
    the axis.
    """
    materials = MATERIAL, Material(keys.ratio * MATERIAL.E, MATERIAL.nu)
    compliance = sum(_compliance(material, keys.plane) for material in materials)
    exact = LineContact(keys.load * UNIT_LOAD, RADIUS / 2, 1 / compliance)
    a, halvings = min(exact.a, RADIUS), keys.halvings
    upper = _half_cylinder(RADIUS, a / keys.n, a, halvings)
    lower = _half_cylinder(-RADIUS, a / keys.m, a, halvings)
    shape = structured(prefixed(upper, "upper_"), prefixed(lower, "lower_"))
    mesh, sides = shape.mesh, shape.mesh.boundaries
    flat, on_axis = sides["lower_flat"], _on_axis(sides, "lower_")
    f = _pressing(mesh, "upper_flat", 1.0)
    if keys.Q:
        f += _pressing(mesh, "lower_flat", -1.0)
        fixed = np.append(on_axis, dofs_of(flat[flat.size // 2], 2, 1))
    else:
        fixed = np.concatenate(
            [_on_axis(sides, "upper_"), on_axis, dofs_of(flat, 2, 1)]
        )
    arcs = sides["upper_arc"], sides["lower_arc"]
    return UnassembledBodies(
        shape=shape,
        names=NAMES,
        materials=materials,
        plane=keys.plane,
        length=RADIUS,
        force=exact.P,
        fixed=fixed,
        f=f,
        pairs=(ContactPair(*(arcs if keys.slave == "upper" else arcs[::-1])),),
    ), exact


def _shearing(mesh: Mesh) -> Vector:
    """Return the nodal forces (n,) of Q = 1 on the upper flat side, −1 on the lower."""
    forces = np.zeros_like(mesh.points)
    for side, Q in ("upper_flat", 1.0), ("lower_flat", -1.0):
        nodes = mesh.boundaries[side]
        share, (x, y) = nodal_lengths(mesh.points[nodes]), mesh.points[nodes].T
        forces[nodes, 0] = Q * share / share.sum()
        # vertical forces ∝ x balance the moment of Q about the origin
        forces[nodes, 1] = Q * y[0] * share * x / (share @ x**2)
    return forces.ravel()


def _half_cylinder(centre: float, h: float, a: float, halvings: int) -> Mesh:
    """Return the half disc around (0, 0) of a cylinder with centre (0, `centre`).

    Cells have size h at (0, 0) and grow along the arc and inwards. All cells are then
    bisected in both directions `halvings` times.
    """
    radius, towards = abs(centre), -np.copysign(np.pi / 2, centre)
    arc = (
        insert_midpoints(
            graded_points(h, UNIFORM_HALF_WIDTH * a, radius * np.pi / 2), halvings
        )
        / radius
    )
    angles = towards + np.concatenate([-arc[:0:-1], arc])
    radii = radius - insert_midpoints(graded_points(h, 0.0, radius), halvings)[:-1]
    return half_disc((0.0, centre), angles, radii)


def graded_points(h: float, uniform: float, total: float) -> Vector:
    """Divide [0, total] into cells of size h up to `uniform`, then growing by GROWTH.

    If `uniform` covers the interval, all cells have the same size, which is at most h.
    """
    equal = h * np.arange(np.ceil(uniform / h) + 1)
    if equal[-1] >= total:
        return np.linspace(0, total, int(np.ceil(total / h)) + 1)
    rest = total - equal[-1]
    # the smallest count with  h Σ GROWTH^k ≥ rest;  the sizes are then scaled to fit
    count = np.ceil(np.log1p(rest * (GROWTH - 1) / (GROWTH * h)) / np.log(GROWTH))
    sizes = GROWTH ** np.arange(1, count + 1)
    return np.append(equal, equal[-1] + rest * np.cumsum(sizes) / sizes.sum())


def insert_midpoints(x: Vector, times: int) -> Vector:
    """Insert midpoints between the numbers of an increasing sequence, repeatedly.

    times : number of repetitions
    """
    places = np.arange(x.size)
    return np.interp(np.linspace(0, x.size - 1, (x.size - 1) * 2**times + 1), places, x)


def _pressing(mesh: Mesh, flat: str, P: float) -> Vector:
    """Return the nodal forces (n,) of P along −y, uniform over the side `flat`."""
    f, nodes = np.zeros(mesh.dofs), mesh.boundaries[flat]
    share = nodal_lengths(mesh.points[nodes])
    f[dofs_of(nodes, 2, 1)] = -P * share / share.sum()
    return f


def pressure_quantities(
    bodies: UnassembledBodies, primal: QP, exact: LineContact, s: Solution
) -> dict[str, Any]:
    """Compare the pressure on the slave side with Hertz's pressure.

    The nodal pressure is the vertical contact force divided by ∫N_j dx. Errors are
    relative. The half width is √(4∫px² dx/P), which is exact for Hertz's pressure. The
    position of the last active node would have an error of ±h.
    """
    slave = bodies.pairs[0].slave
    x = bodies.mesh.points[slave, 0]
    width = nodal_lengths(x[:, None])
    pressure = replace(s, z=s.z[: primal.h.size])
    force = np.abs(contact_forces(bodies, primal, pressure)[slave, 1])
    p, hertz = force / width, exact.pressure(x)
    half_width = np.sqrt(4 * force @ x**2 / exact.P)
    return {
        "p_max": float(p.max()),
        "p_max_error": float(p.max() / exact.p0 - 1),
        "pressure_l2_error": float(
            np.sqrt(width @ (p - hertz) ** 2 / (width @ hertz**2))
        ),
        "force_error": float(force.sum() / exact.P - 1),
        "half_width": float(half_width),
        "half_width_error": float(half_width / exact.a - 1),
    }


def shear_quantities(
    bodies: UnassembledBodies,
    primal: QP,
    mindlin: TangentialContact,
    s: Solution,
    friction: Friction,
    sign: float,
) -> dict[str, Any]:
    """Compare the shear traction on the slave side with the exact one.

    The nodal traction is the horizontal friction force divided by ∫N_j dx. Errors are
    relative. `shear_centre` is the traction at x = 0. `stick_half_width` is the half
    width of the stick zone for which the ratio of ∫x²q to ∫x²p, with shear traction q
    and pressure p, is the same for the exact and for the computed tractions. In this
    ratio, the effects of the finite bodies on the two moments cancel.

    sign : 1 if the slave is the upper cylinder, −1 if it is the lower one
    """
    slave = bodies.pairs[0].slave
    x = bodies.mesh.points[slave, 0]
    width = nodal_lengths(x[:, None])
    normal, tangential = np.split(s.z * bodies.force, [primal.h.size])
    pressing = np.abs(as_vectors(primal.G.T @ normal, 2)[slave, 1])
    force = sign * as_vectors(friction.T.T @ tangential, 2)[slave, 0]
    Q = mindlin.Q * mindlin.mu * mindlin.normal.P
    expected, centre = mindlin.traction(x), float(mindlin.traction(np.zeros(1))[0])
    q = force / width
    at_centre = float(np.interp(0.0, np.sort(x), q[np.argsort(x)]))
    c = mindlin.stick_half_width(float(force @ x**2), float(pressing @ x**2))
    return {
        "tangential_force": float(force.sum()),
        "tangential_force_error": float(force.sum() / Q - 1),
        "shear_centre": at_centre,
        "shear_centre_error": at_centre / centre - 1,
        "shear_l2_error": float(
            np.sqrt(width @ (q - expected) ** 2 / (width @ expected**2))
        ),
        "stick_half_width": c,
        "stick_half_width_error": c / mindlin.c - 1,
    }


def _curve(
    exact: LineContact, shear: Callable[[Vector], Vector] = np.zeros_like
) -> NDArray[np.float64]:
    """Return the exact tractions on the slave side, see `ContactProblem.exact`.

    Shear is positive along the tangent (−n_y, n_x). On the upper cylinder, this tangent
    is +x and the traction is −q; on the lower one, the tangent is −x and the traction
    is q. The shear is −q in both cases.
    """
    x = exact.a * np.linspace(-UNIFORM_HALF_WIDTH, UNIFORM_HALF_WIDTH, CURVE_POINTS)
    return np.column_stack([x, exact.pressure(x), -shear(x)])


def _on_axis(sides: Mapping[str, Nodes], prefix: str = "") -> Nodes:
    """Return the components u_x at the middle of arc and flat side; 0 by symmetry."""
    chains = [sides[prefix + name] for name in ("arc", "flat")]
    return dofs_of(np.array([chain[chain.size // 2] for chain in chains]), 2, 0)


def _compliance(material: Material, plane: Plane) -> float:
    return (1 - (material.nu**2 if plane == "strain" else 0.0)) / material.E
