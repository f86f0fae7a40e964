"""Physical results of a contact problem from a solution of its primal QP; SI units."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import QP, Fields, Friction, Solution, Vector
from mortarbench.harness.mechanics import NO_FRICTION, contact_rows
from mortarbench.harness.plugin import SLIDING
from mortarbench.harness.sets.blocks import norms
from mortarbench.problems.contact.bodies import Bodies, UnassembledBodies
from mortarbench.problems.contact.rows import ContactRows
from mortarbench.problems.contact.sides import (
    ACTIVE_THRESHOLD,
    active,
    bodies_of,
    contact_sides,
    states,
    undetermined_friction,
)
from mortarbench.problems.fem.mesh import Mesh, Nodes, as_vectors
from mortarbench.problems.fem.stress import centre_stress, recover, von_mises

#: names of stress components in Voigt's notation
IN_PLANE = ("sxx", "syy", "sxy")
IN_SPACE = ("sxx", "syy", "szz", "syz", "sxz", "sxy")


def quantities(
    bodies: UnassembledBodies,
    primal: QP,
    s: Solution,
    rows: ContactRows,
    friction: Friction = NO_FRICTION,
    energy: float | None = None,
    largest: Vector | None = None,
    stresses: Mapping[str, Vector] | None = None,
) -> dict[str, Any]:
    """Return counts, energy, contact forces and stresses by name.

    `energy` is ½uᵀKu − fᵀu in J/m. `contact_force` is the total force −ΣBᵀλ of contact
    and friction on the body of the master (of the slave if the master is rigid) in N/m.
    With several pairs, `contact_force` is omitted, because the sum over pairs would be
    meaningless. In 3D, energies are in J and forces in N. `max_von_mises` is the
    largest patch-recovered von Mises stress of each body in Pa. `contacts` contains the
    results of each pair, see `pair_results`. With friction, the items of
    `friction_quantities` are added.

    Parameters
    ----------
    primal : with friction, the diagonal of P is used
    energy : nondimensional energy; by default the objective of `primal`
    largest : (bodies,) largest von Mises stresses, Pa; by default those of `stresses`
    stresses : nodal stresses (N,) by name; by default those of linear elasticity

    """
    l, nodes = bodies.length, len(bodies.mesh.points)
    if largest is None:
        owner = bodies.body_of_node
        if stresses is None:
            stresses, _, owner = _stresses(bodies, s.x * l)
        largest = np.zeros(len(bodies.names))
        np.maximum.at(largest, owner, stresses["von_mises"])
    energy = primal.objective(s.x) if energy is None else energy
    forces = contact_forces(bodies, primal, s, friction)
    normal = s.z[: primal.h.size]
    return {
        "nodes": nodes,
        "elements": len(bodies.mesh.cells),
        "dofs": bodies.mesh.dim * nodes,
        "equality_rows": primal.b.size,
        "contact_rows": primal.h.size,
        "active": int(active(normal).sum()),
        "energy": energy * bodies.force * l,
        **_contact_force(bodies, forces),
        "multiplier_sum": float(normal.sum() * bodies.force),
        "max_von_mises": {
            name: float(most) for name, most in zip(bodies.names, largest, strict=True)
        },
        "contacts": pair_results(bodies, primal, s, rows, friction),
    } | (
        friction_quantities(bodies, primal, s, friction) if friction.bound.size else {}
    )


def _contact_force(
    bodies: UnassembledBodies, forces: NDArray[np.float64]
) -> dict[str, list[float]]:
    """Return the total force on one body of a single pair; {} for several pairs."""
    if len(bodies.pairs) > 1:
        return {}
    if not bodies.pairs:
        return {"contact_force": [0.0] * bodies.mesh.dim}
    slave, master = bodies.pairs[0].sides
    # the contact forces on both bodies cancel, so only those on one side are summed
    loaded = np.unique(master if master.size else slave)
    return {"contact_force": forces[loaded].sum(axis=0).tolist()}


def friction_quantities(
    bodies: UnassembledBodies,
    primal: QP,
    s: Solution,
    friction: Friction,
) -> dict[str, Any]:
    """Return counts of friction states, the residual of Coulomb's law and dissipation.

    `open`, `stick` and `slip` are the numbers of frictional contact rows that are
    inactive, active and sticking, and active and slipping, see `states`.
    `undetermined_friction` is the number of dependent rows among those that stick, and
    is omitted if it is 0; friction forces are otherwise not unique.
    `sliding_without_contact` is the number of inactive rows with shear, which Tresca's
    law allows; these rows do not count as open. `shear_without_contact` is the fraction
    of Σ‖λ_t‖ that acts on these rows. `friction_residual` is ‖g − mu·λ_n‖/‖g‖ for
    Coulomb's law and 0 for Tresca's. `dissipation` is the work of friction, Σ g‖Tu −
    s‖, in J/m (J in 3D).
    """
    state = states(primal, s, friction)
    shear = norms(s.z[primal.h.size :][friction.vectors])
    without_contact = state == SLIDING
    shear_alone = float(shear[without_contact].sum() / (shear.sum() or 1.0))
    undetermined = undetermined_friction(primal, s, friction)
    return {
        **({"undetermined_friction": undetermined} if undetermined else {}),
        **{name: int((state == name).sum()) for name in ("open", "stick", "slip")},
        "sliding_without_contact": int(without_contact.sum()),
        "shear_without_contact": shear_alone,
        "friction_residual": friction.residual(s.z[: primal.h.size]),
        "dissipation": friction.work(s.x) * bodies.force * bodies.length,
    }


def pair_results(
    bodies: UnassembledBodies,
    primal: QP,
    s: Solution,
    rows: ContactRows,
    friction: Friction = NO_FRICTION,
) -> dict[str, dict[str, Any]]:
    """Return the results of each contact pair by its name.

    `force` is the force on each elastic body of the pair in N/m; `active` is the number
    of slave nodes under pressure; `largest_pressure` is the largest nodal pressure on
    the slave in Pa, and `mean_pressure` its mean over the part of the slave under
    pressure; `smallest_gap` in m is negative if bodies overlap, and None if no slave
    node has a row; `half_width` is half the undeformed length in m of the part under
    pressure (in 3D, `pressed_area` is its area in m²). With friction, `friction_force`
    is the contribution of friction to the force on the slave in N/m, and `stick` and
    `slip` are the numbers of sticking and slipping slave nodes.
    """
    results = {}
    sides = contact_sides(bodies, primal, s, rows, friction)
    for pair, side in zip(bodies.pairs, sides, strict=True):
        slave, master = bodies_of(bodies, pair)
        total = side.force.sum(axis=0)
        force = {slave: total.tolist()}
        if pair.master.size:
            # 0.0 − x avoids negative zeros
            force = {master: (0.0 - total).tolist()} | force
        largest = float(np.hypot.reduce(side.force, axis=1).max(initial=0.0))
        mask = side.pressed(ACTIVE_THRESHOLD * largest)
        pressed = float(side.length[mask].sum())
        push = float((side.pressure * side.length)[mask].sum())
        results[side.name] = {
            "force": force,
            "active": int(mask.sum()),
            "largest_pressure": float(side.pressure.max()),
            "mean_pressure": push / pressed if pressed else 0.0,
            "smallest_gap": (
                None if np.isnan(side.gap).all() else float(np.nanmin(side.gap))
            ),
            **(
                {"half_width": pressed / 2}
                if bodies.mesh.dim == 2
                else {"pressed_area": pressed}
            ),
        }
        if side.friction is not None and side.friction_force is not None:
            results[side.name] |= {
                "friction_force": side.friction_force.sum(axis=0).tolist(),
                "stick": int((side.friction == "stick").sum()),
                "slip": int((side.friction == "slip").sum()),
            }
    return results


def fields(
    bodies: Bodies,
    primal: QP,
    s: Solution,
    rows: ContactRows,
    friction: Friction = NO_FRICTION,
    stresses: Mapping[str, Vector] | None = None,
    subdomains: NDArray[np.int64] | None = None,
) -> Fields:
    """Return displacements, stresses and contact results for plots, in SI units.

    stresses : see `quantities`
    subdomains : (E,) subdomain of each cell, if the bodies are decomposed
    """
    u = s.x * bodies.length
    sides = [np.zeros(0, dtype=np.int64), *(p.slave_nodes for p in bodies.pairs)]
    slaves = np.concatenate(sides)
    return Fields(
        points=bodies.mesh.points,
        cells=bodies.mesh.cells,
        bodies=bodies.body,
        displacement=as_vectors(u, bodies.mesh.dim),
        nodal=stresses or nodal_stresses(bodies, u),
        contact_nodes=slaves,
        contact_forces=contact_forces(bodies, primal, s, friction)[slaves],
        contacts=contact_sides(bodies, primal, s, rows, friction),
        subdomains=subdomains,
    )


def contact_forces(
    bodies: UnassembledBodies,
    primal: QP,
    s: Solution,
    friction: Friction = NO_FRICTION,
) -> NDArray[np.float64]:
    """Return the forces −Bᵀλ of contact and friction on the nodes (N, dim).

    The unit is N/m (N in 3D).
    The sign is that of f − Bᵀλ in eq. (6) of the paper.
    """
    B, _ = contact_rows(primal, friction)
    return as_vectors(-(B.T @ s.z) * bodies.force, bodies.mesh.dim)


def nodal_stresses(bodies: Bodies, u: Vector) -> dict[str, Vector]:
    """Recover nodal stresses (N,) by name, Pa, from the displacement u (n,), m.

    The components are sxx, syy and sxy in 2D, with szz = ν(sxx + syy) in plane
    strain, and all six in 3D. `von_mises` is computed from the recovered components
    instead of being recovered itself, so that all values are consistent. At a common
    node of several bodies, the values of these bodies are averaged.
    """
    named, node, _ = _stresses(bodies, u)
    if bodies.piece is None:
        return named
    count = np.bincount(node)
    return {name: np.bincount(node, values) / count for name, values in named.items()}


def _stresses(
    bodies: UnassembledBodies, u: Vector
) -> tuple[dict[str, Vector], Nodes, Nodes]:
    """Return the stresses of each body at its nodes, these nodes, and their bodies.

    A common node of several bodies, where stresses may jump, occurs once for each body.
    """
    mesh, owner, node = bodies.mesh, bodies.body_of_node, np.arange(u.size)
    if bodies.piece is not None:
        size, corners = len(mesh.points), mesh.cells.shape[1]
        copies = bodies.body[:, None] * size + mesh.cells
        key, cells = np.unique(copies, return_inverse=True)
        owner, node = np.divmod(key, size)
        mesh = Mesh(mesh.points[node], cells.reshape(-1, corners), {})
        u = as_vectors(u, mesh.dim)[node].ravel()
    stress = recover(mesh, centre_stress(mesh, bodies.D, u))
    nu = np.array([m.nu for m in bodies.materials])[owner]
    names = IN_PLANE if bodies.plane else IN_SPACE
    nodal = dict(zip(names, stress.T, strict=True))
    if bodies.plane == "strain":
        nodal["szz"] = nu * (nodal["sxx"] + nodal["syy"])
    return nodal | {"von_mises": von_mises(stress, nu, bodies.plane)}, node, owner
