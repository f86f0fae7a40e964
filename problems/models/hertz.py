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

What no mesh removes: the bodies are finite (0.1 %), and a/R is not zero. Two cylinders
are in contact as linearised at the undeformed state, along normals that differ from the
vertical by up to a/R; the difference from Hertz is of order a²/R² ∝ P, 1 % at P = 10.
Their load is therefore smaller unless it is set.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from harness import QP, Case, Solution, Value, Vector
from problems.contact.bodies import (
    Bodies,
    ContactPair,
    assemble,
    clamped,
    floating,
    supported,
)
from problems.contact.linearise import linearisation
from problems.contact.node_to_segment import ContactRows
from problems.contact.results import contact_forces, quantities
from problems.contact.rigid_plane import above_plane
from problems.duality.case_forms import contact_case
from problems.duality.stepping import primal_qp
from problems.fem.elasticity import Material, Plane
from problems.fem.mesh import Mesh, Nodes, half_disc, join, nodal_lengths, prefixed
from problems.models.line_contact import LineContact

RADIUS = 8e-3  #: m
MATERIAL = Material(E=200e9, nu=0.3)
UNIT_LOAD = 1e6  #: of the key `load`, N/m

GROWTH = 1.15  #: of neighbouring cells away from the contact
UNIFORM = 1.5  #: half width of the evenly meshed part of the arc, in a


def cylinder_on_plane(form: str, params: Mapping[str, Value]) -> Case:
    """Emit the QP in one form."""
    p: Any = params
    exact = LineContact(
        p["load"] * UNIT_LOAD, RADIUS, 1 / _compliance(MATERIAL, p["plane"])
    )
    mesh = lower_half(exact.a / p["n"], exact.a, p["halvings"])
    bodies = assemble(
        mesh, np.zeros(len(mesh.cells), dtype=np.int64), names=("cylinder",),
        materials=(MATERIAL,), plane=p["plane"], units=(RADIUS, exact.P),
        fixed=2 * _on_axis(mesh),
        load=pressed(mesh, mesh.boundaries["flat"], exact.P),
        pairs=(ContactPair(mesh.boundaries["arc"], np.zeros(0, dtype=np.int64)),),
    )  # fmt: skip
    return _case(bodies, above_plane(mesh, mesh.boundaries["arc"]), form, exact)


def cylinder_on_cylinder(form: str, params: Mapping[str, Value]) -> Case:
    """Emit the QP, with contact linearised at the undeformed state, in one form."""
    bodies, exact = two_cylinders(params)
    p: Any = params
    linearise = linearisation(bodies, p["contact"], p["basis"])
    return _case(bodies, linearise(np.zeros(bodies.mesh.dofs)), form, exact)


def two_cylinders(params: Mapping[str, Value]) -> tuple[Bodies, LineContact]:
    """Mesh and assemble the cylinders, n cells per a on the upper and m on the lower.

    The upper one has R = 8 mm, E = 200 GPa, the lower one `radius` and `ratio` times
    that.
    """
    p: Any = params
    below = Material(p["ratio"] * MATERIAL.E, MATERIAL.nu)
    radius = p["radius"] * RADIUS
    compliance = _compliance(MATERIAL, p["plane"]) + _compliance(below, p["plane"])
    exact = LineContact(
        p["load"] * UNIT_LOAD, 1 / (1 / RADIUS + 1 / radius), 1 / compliance
    )
    halves = (
        lower_half(exact.a / p["n"], exact.a, p["halvings"]),
        upper_half(exact.a / p["m"], exact.a, radius, p["halvings"]),
    )
    mesh, body = join((prefixed(halves[0], "upper_"), prefixed(halves[1], "lower_")))
    sides = mesh.boundaries
    upper, lower = sides["upper_arc"], sides["lower_arc"]
    fixed = np.concatenate([
        2 * _on_axis(mesh, "upper_"), 2 * _on_axis(mesh, "lower_"),
        2 * sides["lower_flat"] + 1,
    ])  # fmt: skip
    bodies = assemble(
        mesh, body, names=("upper", "lower"), materials=(MATERIAL, below),
        plane=p["plane"], units=(RADIUS, exact.P),
        fixed=fixed, load=pressed(mesh, sides["upper_flat"], exact.P),
        pairs=(ContactPair(upper, lower) if p["slave"] == "upper"
               else ContactPair(lower, upper),),
    )  # fmt: skip
    return bodies, exact


def lower_half(h: float, a: float, halvings: int) -> Mesh:
    """Mesh the lower half of the cylinder above (0, 0), with cells of size h there."""
    return half_disc((0.0, RADIUS), *_polar(h, a, RADIUS, -np.pi / 2, halvings))


def upper_half(h: float, a: float, radius: float, halvings: int) -> Mesh:
    """Mesh the upper half of a cylinder below (0, 0), with cells of size h there."""
    return half_disc((0.0, -radius), *_polar(h, a, radius, np.pi / 2, halvings))


def _polar(
    h: float, a: float, radius: float, towards: float, halvings: int
) -> tuple[Vector, Vector]:
    """Grade angles about `towards` and radii from the arc, geometrically; halve all."""
    arc = halved(graded(h, UNIFORM * a, radius * np.pi / 2), halvings) / radius
    angles = towards + np.concatenate([-arc[:0:-1], arc])
    return angles, radius - halved(graded(h, 0.0, radius), halvings)[:-1]


def graded(h: float, uniform: float, total: float) -> Vector:
    """Divide [0, total]: cells of size h up to `uniform`, then growing by GROWTH."""
    even = h * np.arange(np.ceil(uniform / h) + 1)
    rest = total - even[-1]
    count = np.ceil(np.log1p(rest * (GROWTH - 1) / (GROWTH * h)) / np.log(GROWTH))
    sizes = GROWTH ** np.arange(1, count + 1)
    return np.append(even, even[-1] + rest * np.cumsum(sizes) / sizes.sum())


def halved(x: Vector, times: int) -> Vector:
    """Insert the midpoints of an increasing sequence, so many times."""
    places = np.arange(x.size)
    return np.interp(np.linspace(0, x.size - 1, (x.size - 1) * 2**times + 1), places, x)


def pressed(mesh: Mesh, flat: Nodes, P: float) -> Vector:
    """Return the nodal forces (2N,) of P spread evenly over the flat side, N/m."""
    share = nodal_lengths(mesh.points[flat])
    load = np.zeros(mesh.dofs)
    load[2 * flat + 1] = -P * share / share.sum()
    return load


def pressure_quantities(
    bodies: Bodies, primal: QP, exact: LineContact, s: Solution
) -> dict[str, Any]:
    """Compare the pressure on the slave side with Hertz's.

    Nodal pressure: vertical contact force on the node / ∫N_j dx. Errors are relative;
    that of the half width is of √(4∫px² dx/P), as the last active node is ±h off.
    """
    slave = bodies.pairs[0].slave
    x = bodies.mesh.points[slave, 0]
    width = nodal_lengths(x[:, None])
    force = np.abs(contact_forces(bodies, primal, s)[slave, 1])
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


def _case(bodies: Bodies, rows: ContactRows, form: str, exact: LineContact) -> Case:
    primal = primal_qp(bodies, rows)
    return contact_case(
        bodies, primal, form,
        floating=lambda: floating(bodies), clamped=lambda: clamped(bodies),
        supported=lambda: supported(bodies),
        quantities=lambda s: quantities(bodies, primal, s)
        | pressure_quantities(bodies, primal, exact, s),
    )  # fmt: skip


def _on_axis(mesh: Mesh, prefix: str = "") -> Nodes:
    """Find the middle of the arc and the centre, which symmetry keeps at u_x = 0."""
    sides = [mesh.boundaries[prefix + name] for name in ("arc", "flat")]
    return np.array([side[side.size // 2] for side in sides])


def _compliance(material: Material, plane: Plane) -> float:
    return (1 - (material.nu**2 if plane == "strain" else 0.0)) / material.E
