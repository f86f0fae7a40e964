"""Line contact of cylinders against Hertz's exact solution (Johnson 1985, Section 4.2).

With 1/R = 1/R₁ + 1/R₂, 1/E* = Σ(1 − νᵢ²)/Eᵢ (plane stress: Σ1/Eᵢ) and the force P per
thickness, two elastic half spaces of these curvatures touch over |x| ≤ a under

    p(x) = p₀√(1 − x²/a²),   a = √(4PR/(πE*)),   p₀ = 2P/(πa),   ∫px² dx = Pa²/4

Bodies are half discs, pressed by a uniform pressure on the flat side; the approach is
not determined by the theory, so that the force is given. Only contact holds the upper
body up: ``dual-bounds`` does not exist.

More cells per a (`n`, `m`) refine the contact alone: away from it, cells grow by GROWTH
whatever their number. Every one of `halvings` halves all cells.

R = 8, E = 200, ν = 0.3 and P = 10 are a benchmark of the literature; it gives no units,
here they are mm, GPa and MN/m. It has a = 0.68078 mm and p₀ = 9.3514 GPa.

A tangential force Q on two cylinders of one material acts on the flat sides, as shear
tractions ±Q and, so that no support takes their moment, normal ones that grow linearly
along the side. Both bodies are loaded and deformed alike: the upper one is held by
contact and friction alone, the lower one without reactions. The tractions are those of
`problems.models.line_contact`. The load comes

* normal-first: P without friction, then Q, and Q down from its peak, one step each;
* proportional: both in steps with friction, P ∝ k² so that a grows evenly. Then the
  traction is (Q/P)p and nothing slips, where slip is that of each step (quasi-static).
  Of a single static load it is as if Q had come last.

What no mesh removes: the bodies are finite (0.1 %), and a/R is not zero. Two cylinders
are in contact as linearised at the undeformed state, along normals that differ from the
vertical by up to a/R; the difference from Hertz is of order a²/R² ∝ P, 1 % at P = 10.
Their load is therefore smaller unless it is set.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import QP, Case, Friction, Reference, Solution, Value, Vector
from mortarbench.problems.contact.bodies import (
    Bodies,
    ContactPair,
    ContactSides,
    UnassembledBodies,
)
from mortarbench.problems.contact.friction import FrictionLaw, law_of
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.results import contact_forces
from mortarbench.problems.contact.rigid_plane import rigid_plane_rows
from mortarbench.problems.contact.stepping import Forces, Stage, State, load_steps
from mortarbench.problems.duality.case_forms import with_exact_tractions
from mortarbench.problems.duality.newton import NewtonPath
from mortarbench.problems.duality.newton_case import newton_case, newton_path
from mortarbench.problems.duality.problem import (
    ContactProblem,
    ContactSolution,
    ElasticBodies,
    HalfDiscs,
    Linearise,
    cached_problem,
)
from mortarbench.problems.fem.elasticity import Material, Plane
from mortarbench.problems.fem.mesh import (
    HalfDisc,
    Nodes,
    as_vectors,
    dofs_of,
    joined_sides,
    nodal_lengths,
)
from mortarbench.problems.models.line_contact import LineContact, TangentialContact

RADIUS = 8e-3  #: m
NAMES = ("upper", "lower")
MATERIAL = Material(E=200e9, nu=0.3)
UNIT_LOAD = 1e6  #: of the key `load`, N/m

GROWTH = 1.15  #: of neighbouring cells away from the contact
UNIFORM_HALF_WIDTH = 1.5  #: half width of the evenly meshed part of the arc, in a
CURVE_POINTS = 601  #: points of exact tractions in pictures, over that part


@cached_problem
def on_plane(params: Mapping[str, Value]) -> ContactProblem:
    """State the linear problem of a cylinder on a rigid plane."""
    of, exact = _on_plane(params)

    def results(found: ContactSolution) -> dict[str, Any]:
        bodies, primal, s, _ = found.sides
        return pressure_quantities(bodies, primal, exact, s)

    return ContactProblem(
        bodies=of, stages=load_steps(1, 1, of.forces, of.fixed),
        linearise=lambda bodies, _: lambda u: rigid_plane_rows(
            bodies.mesh, bodies.pairs[0].slave
        ),
        results=results,
        exact=_curve(exact),
    )  # fmt: skip


def newton_step(form: str, params: Mapping[str, Value], reference: Reference) -> Case:
    """Emit the QP of a cylinder on a plane at finite strain; the gap is linear, too."""
    exact = _on_plane(params)[1]
    path = _newton_path(tuple({**params, "newton": 0}.items()), reference)
    case = newton_case(
        path, form, 1, int(params["newton"]),
        lambda at, s: pressure_quantities(at.tangent, at.primal, exact, s),
    )  # fmt: skip
    return with_exact_tractions(case, _curve(exact))


@lru_cache(maxsize=4)
def _newton_path(
    items: tuple[tuple[str, Any], ...], reference: Reference
) -> NewtonPath:
    bodies = _on_plane(dict(items))[0].assembled
    rows = rigid_plane_rows(bodies.mesh, bodies.pairs[0].slave)
    return newton_path(bodies, lambda u: rows, dict(items), reference)


def _on_plane(params: Mapping[str, Value]) -> tuple[ElasticBodies, LineContact]:
    """Put the cylinder on a rigid plane, n cells per a; with Hertz's solution."""
    p: Any = params
    exact = LineContact(
        p["load"] * UNIT_LOAD, RADIUS, 1 / _compliance(MATERIAL, p["plane"])
    )
    a = min(exact.a, RADIUS)  # as of `half_cylinders`
    shape = HalfDiscs((_half_cylinder(RADIUS, a / p["n"], a, p["halvings"]),))
    sides = shape.sides
    return ElasticBodies(
        shape=shape, names=("cylinder",), materials=(MATERIAL,), plane=p["plane"],
        length=RADIUS, force=exact.P, fixed=_on_axis(sides),
        forces=_pressed(shape.parts, "flat", 1.0),
        pairs=(ContactPair(sides["arc"], np.zeros(0, dtype=np.int64)),),
    ), exact  # fmt: skip


class HalfCylinders(NamedTuple):
    """Half cylinders that meet at (0, 0), and Hertz's solution."""

    discs: tuple[HalfDisc, ...]
    materials: tuple[Material, ...]
    exact: LineContact


@cached_problem
def problem(params: Mapping[str, Value]) -> ContactProblem:
    """State two cylinders, with contact linearised at the undeformed state.

    Where a tangential force acts, it is there in the last stage only.
    """
    p: Any = params
    of, exact = two_cylinders(p)
    laws, shear = (law_of(p),), _exact_shear(exact, p) if p["peak"] else None

    def linearise(
        bodies: UnassembledBodies | ContactSides, laws: Sequence[FrictionLaw]
    ) -> Linearise:
        rows = linearisation(bodies, p["contact"], p["basis"], laws)
        return lambda u: rows(np.zeros_like(u))

    def results(found: ContactSolution) -> dict[str, Any]:
        bodies, primal, s, friction = found.sides
        told = pressure_quantities(bodies, primal, exact, s)
        if shear is not None:
            told |= shear_quantities(bodies, primal, exact, s, friction, p, shear)
        if p["friction"] == "coulomb":
            told["tresca_problems"] = found.problems
        return told

    stages = load_steps(1, 1, of.forces, of.fixed, laws)
    is_known = p["friction"] == "none" or shear is not None
    return ContactProblem(
        bodies=of, linearise=linearise, results=results,
        stages=stages if shear is None else _programme(p, of),
        exact=_curve(exact, shear or np.zeros_like) if is_known else None,
    )  # fmt: skip


def _programme(params: Mapping[str, Value], of: ElasticBodies) -> tuple[Stage, ...]:
    """List what acts in turn: P without friction, then P and Q.

    First, supports on the axis keep the upper cylinder, which P does not load there.
    Two cylinders without friction roll on each other almost freely: nothing but the
    polygons that their arcs are resists. The slip of the next stage would begin there,
    and Q would do work on it.
    """
    p: Any = params
    discs, sides = half_cylinders(p).discs, of.shape.sides
    pressing = [_pressed(discs, "upper_flat", 1.0), _pressed(discs, "lower_flat", -1.0)]
    loads = _loads(p)
    quasi_static = p["loading"] == "quasi-static"

    def acting(P: float, Q: float) -> Forces:
        forces = [Forces(at, P * value) for at, value in pressing]
        return _added(forces + (_shearing(discs, Q * p["mu"]) if Q else []))

    def begin(k: int, left: State) -> State:
        """Begin where the stage before has ended; normal forces grow with P."""
        before = loads[max(k - 1, 0)][0]
        at_rest = not k and _forgets_pressing(p)
        u = np.zeros_like(left.u) if at_rest else left.u
        slip = u if quasi_static else np.zeros_like(u)
        return State(u, slip, loads[k][0] / before * left.normal_forces)

    kept = np.append(of.fixed, _on_axis(sides, "upper_"))
    first = Stage(step=1, part=1.0, forces=acting(loads[0][0], 0.0), fixed=kept)
    return first, *(
        Stage(
            step=1, part=1.0, forces=acting(P, Q), fixed=of.fixed, laws=(law_of(p),),
            begin=partial(begin, k),
        )
        for k, (P, Q) in enumerate(loads)
    )  # fmt: skip


def half_cylinders(params: Mapping[str, Value]) -> HalfCylinders:
    """Divide the cylinders, n cells per a on the upper one and m on the lower.

    Where Hertz's a exceeds a radius, as with a body too soft for his theory, cells are
    those of an a as long as the radius: evenly meshed arcs must not wind around it. The
    upper one has R = 8 mm, E = 200 GPa, the lower one `radius` and `ratio` times
    that.
    """
    p: Any = params
    below = Material(p["ratio"] * MATERIAL.E, MATERIAL.nu)
    radius = p["radius"] * RADIUS
    compliance = _compliance(MATERIAL, p["plane"]) + _compliance(below, p["plane"])
    exact = LineContact(
        p["load"] * UNIT_LOAD, 1 / (1 / RADIUS + 1 / radius), 1 / compliance
    )
    a, halvings = min(exact.a, RADIUS, radius), p["halvings"]
    upper = _half_cylinder(RADIUS, a / p["n"], a, halvings).prefixed("upper_")
    lower = _half_cylinder(-radius, a / p["m"], a, halvings).prefixed("lower_")
    return HalfCylinders((upper, lower), (MATERIAL, below), exact)


def two_cylinders(params: Mapping[str, Value]) -> tuple[ElasticBodies, LineContact]:
    """Put the cylinders on each other under P alone; with Hertz's solution.

    Where there is a tangential force, the supports are those that take no part in it:
    no symmetry is bent.
    """
    p: Any = params
    halves = half_cylinders(params)
    discs, exact, shape = halves.discs, halves.exact, HalfDiscs(halves.discs)
    sides, flat = shape.sides, shape.sides["lower_flat"]
    forces = [_pressed(discs, "upper_flat", 1.0)]
    on_axis = _on_axis(sides, "lower_")
    if p["peak"]:
        forces.append(_pressed(discs, "lower_flat", -1.0))
        fixed = np.append(on_axis, dofs_of(flat[flat.size // 2], 2, 1))
    else:
        upper = _on_axis(sides, "upper_")
        fixed = np.concatenate([upper, on_axis, dofs_of(flat, 2, 1)])
    return ElasticBodies(
        shape=shape, names=NAMES, materials=halves.materials, plane=p["plane"],
        length=RADIUS, force=exact.P, fixed=fixed, forces=_added(forces),
        pairs=(_pair(params, sides),),
    ), exact  # fmt: skip


def _pair(params: Mapping[str, Value], sides: Mapping[str, Nodes]) -> ContactPair:
    upper, lower = sides["upper_arc"], sides["lower_arc"]
    return ContactPair(
        *((upper, lower) if params["slave"] == "upper" else (lower, upper))
    )


def _shear_of(points: NDArray[np.float64], Q: float) -> Vector:
    """Return the forces (2k,) of Q at the nodes of a flat side, x and y in turn."""
    share, (x, y) = nodal_lengths(points), points.T
    forces = Q * share / share.sum(), Q * y[0] * share * x / (share @ x**2)
    return np.column_stack(forces).ravel()


def _shearing(discs: tuple[HalfDisc, ...], Q: float) -> list[Forces]:
    """Return the forces of Q at both flat sides."""
    sides = joined_sides(discs)
    of = zip(discs, ("upper_flat", "lower_flat"), (Q, -Q), strict=True)
    return [
        Forces(
            dofs_of(sides[flat], 2), _shear_of(disc.position(disc.sides[flat]), part)
        )
        for disc, flat, part in of
    ]


def _added(forces: Sequence[Forces]) -> Forces:
    """Add up forces: each component once."""
    component, value = (np.concatenate(part) for part in zip(*forces, strict=True))
    at, place = np.unique(component, return_inverse=True)
    found = np.zeros(at.size)
    np.add.at(found, place, value)
    return Forces(at, found)


def _loads(params: Mapping[str, Value]) -> list[tuple[float, float]]:
    """Return the parts of P and of μP that act in each step with friction."""
    p: Any = params
    if p["loading"] == "static":
        return [(1.0, p["Q"])]
    if p["programme"] == "proportional":
        parts = (np.arange(1, p["steps"] + 1) / p["steps"]) ** 2  # a grows evenly
        return [(part, part * p["Q"]) for part in parts]
    return [(1.0, Q) for Q in dict.fromkeys((p["peak"], p["Q"]))]


def _forgets_pressing(params: Mapping[str, Value]) -> bool:
    """Whether slip begins at rest, not where P alone has pressed the cylinders."""
    return params["loading"] == "static" or params["programme"] == "proportional"


def _half_cylinder(centre: float, h: float, a: float, halvings: int) -> HalfDisc:
    """Divide the half at (0, 0) of a cylinder with its centre at a height of `centre`.

    Angles about (0, 0) and radii from the arc are graded, from cells of size h there;
    then all are halved.
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
    return HalfDisc((0.0, centre), angles, radii)


def graded_points(h: float, uniform: float, total: float) -> Vector:
    """Divide [0, total]: cells of size h up to `uniform`, then growing by GROWTH.

    Where cells of size h reach the end, all are as long, and at most h.
    """
    even = h * np.arange(np.ceil(uniform / h) + 1)
    if even[-1] >= total:
        return np.linspace(0, total, int(np.ceil(total / h)) + 1)
    rest = total - even[-1]
    count = np.ceil(np.log1p(rest * (GROWTH - 1) / (GROWTH * h)) / np.log(GROWTH))
    sizes = GROWTH ** np.arange(1, count + 1)
    return np.append(even, even[-1] + rest * np.cumsum(sizes) / sizes.sum())


def insert_midpoints(x: Vector, times: int) -> Vector:
    """Insert the midpoints of an increasing sequence, so many times."""
    places = np.arange(x.size)
    return np.interp(np.linspace(0, x.size - 1, (x.size - 1) * 2**times + 1), places, x)


def _pressed(discs: tuple[HalfDisc, ...], flat: str, P: float) -> Forces:
    """Spread P evenly over a flat side."""
    (disc,) = (disc for disc in discs if flat in disc.sides)
    share = nodal_lengths(disc.position(disc.sides[flat]))
    return Forces(dofs_of(joined_sides(discs)[flat], 2, 1), -P * share / share.sum())


def pressure_quantities(
    bodies: Bodies | ContactSides, primal: QP, exact: LineContact, s: Solution
) -> dict[str, Any]:
    """Compare the pressure on the slave side with Hertz's.

    Nodal pressure: vertical contact force on the node / ∫N_j dx. Errors are relative;
    that of the half width is of √(4∫px² dx/P), as the last active node is ±h off.
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
    bodies: Bodies | ContactSides,
    primal: QP,
    exact: LineContact,
    s: Solution,
    friction: Friction,
    params: Mapping[str, Value],
    shear: Callable[[Vector], Vector],
) -> dict[str, Any]:
    """Compare the shear traction on the slave side with the exact one.

    Nodal traction: horizontal friction force on the node / ∫N_j dx. Errors are
    relative, that of the force to the largest before. shear_centre: at x = 0.
    stick_half_width: of a traction with this ∫x²q under pressures with this ∫x²p, so
    that what finite bodies do to both does not matter; of proportional steps there is
    none, as nothing slips.
    """
    p: Any = params
    slave, upper = bodies.pairs[0].slave, p["slave"] == "upper"
    x = bodies.mesh.points[slave, 0]
    width = nodal_lengths(x[:, None])
    normal, tangential = np.split(s.z * bodies.force, [primal.h.size])
    pressing = np.abs(as_vectors(primal.G.T @ normal, 2)[slave, 1])
    force = as_vectors(friction.T.T @ tangential, 2)[slave, 0]
    force = force * (1.0 if upper else -1.0)
    mindlin = TangentialContact(exact, p["mu"], p["Q"], p["peak"])
    Q = p["Q"] * p["mu"] * exact.P
    expected, centre = shear(x), float(shear(np.zeros(1))[0])
    q = force / width
    at_centre = float(np.interp(0.0, np.sort(x), q[np.argsort(x)]))
    found = {
        "tangential_force": float(force.sum()),
        "tangential_force_error": float(
            (force.sum() - Q) / (p["peak"] * p["mu"] * exact.P)
        ),
        "shear_centre": at_centre,
        "shear_centre_error": at_centre / centre - 1,
        "shear_l2_error": float(
            np.sqrt(width @ (q - expected) ** 2 / (width @ expected**2))
        ),
    }
    if _without_slip(params):
        return found
    c = mindlin.stick_half_width(float(force @ x**2), float(pressing @ x**2))
    return found | {
        "stick_half_width": c, "stick_half_width_error": c / mindlin.c - 1,
    }  # fmt: skip


def _without_slip(params: Mapping[str, Value]) -> bool:
    """Whether P and Q come in steps that are in proportion."""
    together = params["programme"] == "proportional"
    return together and params["loading"] == "quasi-static"


def _exact_shear(
    exact: LineContact, params: Mapping[str, Value]
) -> Callable[[Vector], Vector]:
    """Return the exact shear traction on the lower cylinder, Pa, as a function of x."""
    p: Any = params
    if _without_slip(params):
        return lambda x: exact.pressure(x) * (p["Q"] * p["mu"])
    return TangentialContact(exact, p["mu"], p["Q"], p["peak"]).traction


def _curve(
    exact: LineContact, shear: Callable[[Vector], Vector] = np.zeros_like
) -> NDArray[np.float64]:
    """Return the exact tractions on the slave side, see `ContactProblem.exact`.

    Its tangent (−n_y, n_x) is along x on the upper cylinder, whose traction is −q, and
    against it on the lower one: either way the shear is −q.
    """
    x = exact.a * np.linspace(-UNIFORM_HALF_WIDTH, UNIFORM_HALF_WIDTH, CURVE_POINTS)
    return np.column_stack([x, exact.pressure(x), -shear(x)])


def _on_axis(sides: Mapping[str, Nodes], prefix: str = "") -> Nodes:
    """List u_x of the middle of the arc and of the centre, which symmetry holds."""
    chains = [sides[prefix + name] for name in ("arc", "flat")]
    return dofs_of(np.array([chain[chain.size // 2] for chain in chains]), 2, 0)


def _compliance(material: Material, plane: Plane) -> float:
    return (1 - (material.nu**2 if plane == "strain" else 0.0)) / material.E
