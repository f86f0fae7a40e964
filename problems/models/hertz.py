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

from mortarbench.harness import (
    QP,
    Case,
    Fields,
    Friction,
    Reference,
    Solution,
    Value,
    Vector,
)
from mortarbench.problems.contact.bodies import (
    Bodies,
    ContactPair,
    ContactSides,
    assemble,
    clamped,
    floating,
    supported,
    supports,
)
from mortarbench.problems.contact.friction import FrictionLaw, law_of
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.node_to_segment import ContactRows
from mortarbench.problems.contact.results import contact_forces, quantities
from mortarbench.problems.contact.rigid_plane import above_plane
from mortarbench.problems.duality.case_forms import contact_case
from mortarbench.problems.duality.dualisation import dualise
from mortarbench.problems.duality.newton import NewtonPath
from mortarbench.problems.duality.newton_case import newton_case, newton_path
from mortarbench.problems.duality.stepping import LoadPath, State, primal_qp
from mortarbench.problems.fem.elasticity import Material, Plane
from mortarbench.problems.fem.mesh import (
    HalfDisc,
    Mesh,
    Nodes,
    as_vectors,
    dofs_of,
    join,
    joined_sides,
    nodal_lengths,
)
from mortarbench.problems.feti.elastic import (
    AtSides,
    Displaced,
    SubdividedBodies,
    at_sides,
    in_parts,
    linearised_by,
    posed_on,
    subdivide,
    tresca_problems,
)
from mortarbench.problems.feti.emission import ProblemInParts
from mortarbench.problems.feti.own_bodies import OwnSolution
from mortarbench.problems.feti.subdivision import half_discs_in_blocks
from mortarbench.problems.feti.tearing import Block, compact_blocks, labelled
from mortarbench.problems.models.line_contact import LineContact, TangentialContact

RADIUS = 8e-3  #: m
ALONE, NAMES = ("cylinder",), ("upper", "lower")
MATERIAL = Material(E=200e9, nu=0.3)
UNIT_LOAD = 1e6  #: of the key `load`, N/m

GROWTH = 1.15  #: of neighbouring cells away from the contact
UNIFORM = 1.5  #: half width of the evenly meshed part of the arc, in a
CURVE = 601  #: points of exact tractions in pictures, over that part


def cylinder_on_plane(
    form: str, params: Mapping[str, Value], reference: Reference
) -> Case:
    """Emit the QP in one form; at finite strain the gap to the plane is linear, too."""
    bodies, rows, exact = _on_plane(params)
    if params["kinematics"] == "linear":
        return _case(bodies, rows, form, params, half_on_plane(params))
    path = _newton_path(tuple({**params, "newton": 0}.items()), reference)
    case = newton_case(
        path, form, 1, int(params["newton"]),
        lambda at, s: pressure_quantities(at.tangent, at.primal, exact, s),
    )  # fmt: skip
    return _beside(case, exact)


@lru_cache(maxsize=4)
def _newton_path(
    items: tuple[tuple[str, Any], ...], reference: Reference
) -> NewtonPath:
    bodies, rows, _ = _on_plane(dict(items))
    return newton_path(bodies, lambda u: rows, dict(items), reference)


class Halves(NamedTuple):
    """Half cylinders that meet at (0, 0), and Hertz's solution."""

    discs: tuple[HalfDisc, ...]
    materials: tuple[Material, ...]
    exact: LineContact

    def blocks(self, most: int) -> list[list[Block]]:
        """Cut each into blocks of rings and sectors, about as long as wide.

        most : blocks have at most so many cells, squared; the triangles at a centre are
            the last ring
        """
        return [compact_blocks(disc.lengths(), most) for disc in self.discs]

    def results(self, found: OwnSolution, at: AtSides) -> dict[str, Any]:
        """Compare what ranks have found with the exact pressure."""
        del found
        return pressure_quantities(at.bodies, at.primal, self.exact, at.solution)


def half_on_plane(params: Mapping[str, Value]) -> Halves:
    """Divide the cylinder on a rigid plane, n cells per a."""
    p: Any = params
    exact = LineContact(
        p["load"] * UNIT_LOAD, RADIUS, 1 / _compliance(MATERIAL, p["plane"])
    )
    a = min(exact.a, RADIUS)  # as of `two_halves`
    disc = _half_cylinder(RADIUS, a / p["n"], a, p["halvings"])
    return Halves((disc,), (MATERIAL,), exact)


def _on_plane(
    params: Mapping[str, Value],
) -> tuple[Bodies, ContactRows, LineContact]:
    """Mesh and assemble the cylinder; with Hertz's solution."""
    p: Any = params
    (disc,), materials, exact = half_on_plane(params)
    mesh = disc.mesh()
    sides = mesh.boundaries
    bodies = assemble(
        mesh, np.zeros(len(mesh.cells), dtype=np.int64), names=ALONE,
        materials=materials, plane=p["plane"], units=(RADIUS, exact.P),
        fixed=_on_axis(sides),
        load=_loaded(mesh, _pressed((disc,), "flat", exact.P)),
        pairs=(_on_rigid(sides),),
    )  # fmt: skip
    return bodies, above_plane(mesh, sides["arc"]), exact


def on_plane_in_subdomains(params: Mapping[str, Value]) -> ProblemInParts:
    """Describe the linear problem of a cylinder on a plane in subdomains."""
    p: Any = params
    halves = half_on_plane(params)
    sides = joined_sides(halves.discs)
    return in_parts(
        half_discs_in_blocks(halves.discs, halves.blocks(p["feti"])),
        materials=halves.materials, plane=p["plane"], units=(RADIUS, halves.exact.P),
        names=ALONE, fixed=_on_axis(sides),
        load=_pressed(halves.discs, "flat", halves.exact.P),
        pairs=(_on_rigid(sides),),
        linearise=lambda arc, _: above_plane(arc.mesh, arc.pairs[0].slave),
        glue=p["glue"], results=halves.results,
    )  # fmt: skip


def _on_rigid(sides: Mapping[str, Nodes]) -> ContactPair:
    return ContactPair(sides["arc"], np.zeros(0, dtype=np.int64))


def cylinder_on_cylinder(
    form: str, params: Mapping[str, Value], reference: Reference
) -> Case:
    """Emit the QP, with contact linearised at the undeformed state, in one form.

    With friction it is the last of the last step, unless another iterate is asked for.
    """
    p: Any = params
    if p["friction"] == "none":
        bodies, exact = two_cylinders(params)
        linearise = linearisation(bodies, p["contact"], p["basis"])
        rows = linearise(np.zeros(bodies.mesh.dofs))
        return _case(bodies, rows, form, params, two_halves(params))
    same_path = {**params, "iterate": 0}
    path, exact = _friction_path(tuple(same_path.items()), reference)
    bodies, problem = path.bodies, path.problem(1, p["iterate"])
    primal, friction = problem.primal, problem.friction

    shear = _exact_shear(exact, params) if p["peak"] else None

    def results(s: Solution) -> dict[str, Any]:
        found = quantities(bodies, primal, s, friction)
        found |= pressure_quantities(bodies, primal, exact, s)
        if shear is not None:
            found |= shear_quantities(bodies, primal, exact, s, friction, params, shear)
        if p["friction"] == "coulomb":
            found["tresca_problems"] = path.iterates(1)
        return found

    case = contact_case(
        bodies, primal, form,
        floating=lambda: path.inverse, clamped=lambda: clamped(bodies),
        supported=lambda: supported(bodies), quantities=results, friction=friction,
        torn=posed_on(
            params, lambda: subdivided(bodies, two_halves(params), p["feti"]), primal,
            friction,
        ),
    )  # fmt: skip
    return _beside(case, exact, shear) if shear is not None else case


def two_halves(params: Mapping[str, Value]) -> Halves:
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
    return Halves((upper, lower), (MATERIAL, below), exact)


def two_cylinders(params: Mapping[str, Value]) -> tuple[Bodies, LineContact]:
    """Mesh and assemble the cylinders under P alone; with Hertz's solution.

    Where there is a tangential force, the supports are those that take no part in it.
    """
    p: Any = params
    discs, materials, exact = two_halves(params)
    mesh, body = join(tuple(disc.mesh() for disc in discs))
    sides, load = mesh.boundaries, _loaded(mesh, _pressed(discs, "upper_flat", exact.P))
    if p["peak"]:
        load += _loaded(mesh, _pressed(discs, "lower_flat", -exact.P))
        fixed = _free_of_reactions(sides)
    else:
        fixed = _guided(sides)
    bodies = assemble(
        mesh, body, names=NAMES, materials=materials,
        plane=p["plane"], units=(RADIUS, exact.P), fixed=fixed, load=load,
        pairs=(_pair(params, sides),),
    )  # fmt: skip
    return bodies, exact


def on_cylinder_in_subdomains(params: Mapping[str, Value]) -> ProblemInParts:
    """Describe two cylinders in subdomains, and before it what friction begins from."""
    p: Any = params
    halves, law = two_halves(params), law_of(params)
    discs, sides = halves.discs, joined_sides(halves.discs)
    layout = half_discs_in_blocks(discs, halves.blocks(p["feti"]))
    pairs, exact = (_pair(params, sides),), halves.exact
    shear = _exact_shear(exact, params) if p["peak"] else None

    def results(found: OwnSolution, at: AtSides) -> dict[str, Any]:
        s, friction = at.solution, at.friction
        told = pressure_quantities(at.bodies, at.primal, exact, s)
        if shear is not None:
            told |= shear_quantities(
                at.bodies, at.primal, exact, s, friction, params, shear
            )
        if p["friction"] == "coulomb":
            told["tresca_problems"] = tresca_problems(found)
        return told

    def posed(
        fixed: Nodes,
        loads: Sequence[tuple[Nodes, Vector]],
        laws: tuple[FrictionLaw, ...],
        displaced: Displaced | None = None,
    ) -> ProblemInParts:
        linearise = linearised_by(p["contact"], p["basis"], laws)
        return in_parts(
            layout, materials=halves.materials, plane=p["plane"],
            units=(RADIUS, exact.P), names=NAMES, fixed=fixed, load=_added(loads),
            pairs=pairs, linearise=lambda arcs, u: linearise(arcs, np.zeros_like(u)),
            laws=laws, glue=p["glue"], displaced=displaced, iterate=p["iterate"],
            results=results,
        )  # fmt: skip

    pressing = [_pressed(discs, "upper_flat", exact.P)]
    if not p["peak"]:
        return posed(_guided(sides), pressing, (law,))
    pressing.append(_pressed(discs, "lower_flat", -exact.P))
    loads, free = _loads(params), _free_of_reactions(sides)

    def scaled(P: float, Q: float) -> list[tuple[Nodes, Vector]]:
        shearing = _shearing(discs, Q * p["mu"] * exact.P) if Q else []
        return [(at, P * force) for at, force in pressing] + shearing

    def after(i: int, found: OwnSolution) -> ProblemInParts:
        u, pressed = at_sides(found, pairs)
        nothing = np.zeros_like(u)
        if not i and _forgets_pressing(params):
            u = nothing
        (P, Q), before = loads[i], loads[max(i - 1, 0)][0]
        slips_from = u if p["loading"] == "quasi-static" else nothing
        at = Displaced(u, slips_from, P / before * pressed)
        problem = posed(free, scaled(P, Q), (law,), at)
        last = i + 1 == len(loads)
        return problem if last else replace(problem, then=partial(after, i + 1))

    kept = np.append(free, _on_axis(sides, "upper_"))
    first = posed(kept, scaled(loads[0][0], 0.0), ())
    return replace(first, then=partial(after, 0))


def _guided(sides: Mapping[str, Nodes]) -> Nodes:
    """Return the components that are held under P alone."""
    return np.concatenate([
        _on_axis(sides, "upper_"), _on_axis(sides, "lower_"),
        dofs_of(sides["lower_flat"], 2, 1),
    ])  # fmt: skip


def _free_of_reactions(sides: Mapping[str, Nodes]) -> Nodes:
    """Return the components that are held where Q acts, too: no symmetry is bent."""
    flat = sides["lower_flat"]
    middle = dofs_of(flat[flat.size // 2], 2, 1)
    return np.append(_on_axis(sides, "lower_"), middle)


def _pair(params: Mapping[str, Value], sides: Mapping[str, Nodes]) -> ContactPair:
    upper, lower = sides["upper_arc"], sides["lower_arc"]
    return ContactPair(
        *((upper, lower) if params["slave"] == "upper" else (lower, upper))
    )


def subdivided(bodies: Bodies, halves: Halves, most: int) -> SubdividedBodies:
    """Cut the half discs into blocks; most : as of `Halves.blocks`."""
    label = [np.zeros(0, dtype=np.int64)]
    for blocks in halves.blocks(most):
        label.append(labelled(blocks) + label[-1].max(initial=-1) + 1)
    return subdivide(bodies, np.concatenate(label))


def kept_on_axis(bodies: Bodies) -> Bodies:
    """Add supports u_x = 0 on the axis of the upper one, which P does not load.

    Two cylinders without friction roll on each other almost freely: nothing but the
    polygons that their arcs are resists. The slip of the next step would begin there,
    and Q would do work on it.
    """
    held = np.append(bodies.B_D.indices, _on_axis(bodies.mesh.boundaries, "upper_"))
    return replace(bodies, B_D=supports(bodies.mesh, held))


def sheared(mesh: Mesh) -> Vector:
    """Return the nodal forces (2N,) of Q = 1 N/m on both flat sides, without moment."""
    load = np.zeros(mesh.dofs)
    for name, Q in (("upper_flat", 1.0), ("lower_flat", -1.0)):
        flat = mesh.boundaries[name]
        load[dofs_of(flat, 2)] = _shear_of(mesh.points[flat], Q)
    return load


def _shear_of(points: NDArray[np.float64], Q: float) -> Vector:
    """Return the forces (2k,) of Q at the nodes of a flat side, x and y in turn."""
    share, (x, y) = nodal_lengths(points), points.T
    forces = Q * share / share.sum(), Q * y[0] * share * x / (share @ x**2)
    return np.column_stack(forces).ravel()


def _shearing(discs: tuple[HalfDisc, ...], Q: float) -> list[tuple[Nodes, Vector]]:
    """Return the components at both flat sides, and the forces of Q there, N/m."""
    sides = joined_sides(discs)
    of = zip(discs, ("upper_flat", "lower_flat"), (Q, -Q), strict=True)
    return [
        (dofs_of(sides[flat], 2), _shear_of(disc.position(disc.sides[flat]), part))
        for disc, flat, part in of
    ]


def _added(loads: Sequence[tuple[Nodes, Vector]]) -> tuple[Nodes, Vector]:
    """Add up forces at components: each component once."""
    component, force = (np.concatenate(part) for part in zip(*loads, strict=True))
    at, place = np.unique(component, return_inverse=True)
    found = np.zeros(at.size)
    np.add.at(found, place, force)
    return at, found


def _loads(params: Mapping[str, Value]) -> list[tuple[float, float]]:
    """Return the parts of P and of μP that act in each step with friction."""
    p: Any = params
    if p["loading"] == "static":
        return [(1.0, p["Q"])]
    if p["programme"] == "proportional":
        parts = (np.arange(1, p["steps"] + 1) / p["steps"]) ** 2  # a grows evenly
        return [(part, part * p["Q"]) for part in parts]
    return [(1.0, Q) for Q in dict.fromkeys((p["peak"], p["Q"]))]


@lru_cache(maxsize=2)
def _friction_path(
    items: tuple[tuple[str, Any], ...], reference: Reference
) -> tuple[LoadPath, LineContact]:
    """Prepare the load steps with friction, whose last one is emitted."""
    p = dict(items)
    bodies, exact = two_cylinders(p)
    law, mesh = law_of(p), bodies.mesh
    linearise = linearisation(bodies, p["contact"], p["basis"], (law,))
    rows = linearise(np.zeros(mesh.dofs))
    guided = kept_on_axis(bodies)
    path = LoadPath(
        bodies, lambda u: rows, lambda: floating(guided), reference, steps=1,
        transform=dualise, laws=(law,), quasi_static=p["loading"] == "quasi-static",
    )  # fmt: skip
    if not p["peak"]:
        return path, exact
    loads = _loads(p)
    part = loads[0][0]  # of P in the step before, whose normal forces grow with P
    pressing = replace(guided, f=part * bodies.f)
    smooth = linearisation(bodies, p["contact"], p["basis"])
    u, pressed = replace(path, bodies=pressing, linearise=smooth, laws=()).state(1)
    if _forgets_pressing(p):
        u = np.zeros(mesh.dofs)
    for P, Q in loads:
        both = replace(bodies, f=P * bodies.f + Q * p["mu"] * sheared(mesh))
        path = replace(path, bodies=both, begin=State(u, P / part * pressed))
        (u, pressed), part = path.state(1), P
    return path, exact


def _forgets_pressing(params: Mapping[str, Value]) -> bool:
    """Whether slip begins at rest, not where P alone has pressed the cylinders."""
    return params["loading"] == "static" or params["programme"] == "proportional"


def _half_cylinder(centre: float, h: float, a: float, halvings: int) -> HalfDisc:
    """Divide the half at (0, 0) of a cylinder with its centre at a height of `centre`.

    Angles about (0, 0) and radii from the arc are graded, from cells of size h there;
    then all are halved.
    """
    radius, towards = abs(centre), -np.copysign(np.pi / 2, centre)
    arc = halved(graded(h, UNIFORM * a, radius * np.pi / 2), halvings) / radius
    angles = towards + np.concatenate([-arc[:0:-1], arc])
    radii = radius - halved(graded(h, 0.0, radius), halvings)[:-1]
    return HalfDisc((0.0, centre), angles, radii)


def graded(h: float, uniform: float, total: float) -> Vector:
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


def halved(x: Vector, times: int) -> Vector:
    """Insert the midpoints of an increasing sequence, so many times."""
    places = np.arange(x.size)
    return np.interp(np.linspace(0, x.size - 1, (x.size - 1) * 2**times + 1), places, x)


def _pressed(discs: tuple[HalfDisc, ...], flat: str, P: float) -> tuple[Nodes, Vector]:
    """Spread P evenly over a flat side: the components, and the forces there, N/m."""
    (disc,) = (disc for disc in discs if flat in disc.sides)
    share = nodal_lengths(disc.position(disc.sides[flat]))
    return dofs_of(joined_sides(discs)[flat], 2, 1), -P * share / share.sum()


def _loaded(mesh: Mesh, load: tuple[Nodes, Vector]) -> Vector:
    """Return the nodal forces (2N,) of forces at some components."""
    forces = np.zeros(mesh.dofs)
    forces[load[0]] = load[1]
    return forces


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


def _beside(
    case: Case, exact: LineContact, shear: Callable[[Vector], Vector] = np.zeros_like
) -> Case:
    """Give the contact in pictures its exact tractions, those on the slave side.

    Its tangent (−n_y, n_x) is along x on the upper cylinder, whose traction is −q, and
    against it on the lower one: either way the shear is −q.
    """
    assert case.fields is not None
    solved = case.fields
    x = exact.a * np.linspace(-UNIFORM, UNIFORM, CURVE)
    curve = np.column_stack([x, exact.pressure(x), -shear(x)])

    def fields(s: Solution) -> Fields:
        found = solved(s)
        (side,) = found.contacts
        return replace(found, contacts=(replace(side, exact=curve),))

    return replace(case, fields=fields)


def _case(
    bodies: Bodies, rows: ContactRows, form: str, params: Mapping[str, Value],
    halves: Halves,
) -> Case:  # fmt: skip
    p: Any = params
    exact = halves.exact
    primal = primal_qp(bodies, rows)
    case = contact_case(
        bodies, primal, form,
        floating=lambda: floating(bodies), clamped=lambda: clamped(bodies),
        supported=lambda: supported(bodies),
        quantities=lambda s: quantities(bodies, primal, s)
        | pressure_quantities(bodies, primal, exact, s),
        torn=posed_on(params, lambda: subdivided(bodies, halves, p["feti"]), primal),
    )  # fmt: skip
    return _beside(case, exact)


def _on_axis(sides: Mapping[str, Nodes], prefix: str = "") -> Nodes:
    """List u_x of the middle of the arc and of the centre, which symmetry holds."""
    chains = [sides[prefix + name] for name in ("arc", "flat")]
    return dofs_of(np.array([chain[chain.size // 2] for chain in chains]), 2, 0)


def _compliance(material: Material, plane: Plane) -> float:
    return (1 - (material.nu**2 if plane == "strain" else 0.0)) / material.E
