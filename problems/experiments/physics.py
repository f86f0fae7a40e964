"""Experiments beyond the paper: accuracy of load stepping and of contact rows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mortarbench.harness import Reference, Value
from mortarbench.problems.contact.bodies import Bodies, factorise_clamped
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.results import quantities
from mortarbench.problems.contact.stepping import Iterate, forces_of, load_steps
from mortarbench.problems.duality.monolithic import (
    MonolithicLinearisation,
    MonolithicPath,
    load_path,
    recovered,
)
from mortarbench.problems.duality.problem import Linearise
from mortarbench.problems.experiments.parts import Rows
from mortarbench.problems.experiments.plan import Plan
from mortarbench.problems.families.hertz import HertzCylinder
from mortarbench.problems.families.patch import ContactPatch
from mortarbench.problems.fem.inverse import GeneralisedInverse
from mortarbench.problems.fem.mesh import dofs_of, nodal_lengths
from mortarbench.problems.models.beam_ring import LENGTH, model

#: numbers of load steps and of linearisations per step for which the result is
#: converged: larger numbers do not change the result
CONVERGED = (2, 8)

#: mapping from the name of a contact method in figures to the keys of its case
ROWS: Mapping[str, Mapping[str, Value]] = {
    "nts": {"contact": "nts"},
    "mortar": {"contact": "mortar", "basis": "dual"},
    "mortar-standard": {"contact": "mortar", "basis": "standard"},
}


def stepping(plan: Plan, solve: Reference) -> Rows:
    """Yield results at the full load for several numbers of steps and linearisations.

    A row contains steps, relin (linearisations per step), the displacement tip_x, tip_y
    of the loaded corner in m, the energy in J/m, and the contact force force_x, force_y
    on the rectangle in N/m. The last row is the converged result, with contact
    linearised at the solution itself; the other rows approach this result as steps or
    relin increase.
    """
    bodies = model(*plan.stepped, 2 * plan.stepped[1], "strain")
    inverse, linearise = factorise_clamped(bodies), linearisation(bodies, "nts", "dual")
    variants = [(s, r) for r in plan.relin for s in plan.stepping]
    for steps, relin in (*variants, CONVERGED):
        path = _path(bodies, linearise, inverse, solve, steps, relin)
        yield {"steps": steps, "relin": relin} | _results(bodies, path.problem(steps))


def _path(
    bodies: Bodies,
    linearise: Linearise,
    inverse: GeneralisedInverse,
    solve: Reference,
    steps: int,
    relin: int = 1,
) -> MonolithicPath:
    stages = load_steps(steps, relin, forces_of(bodies.f), bodies.B_D.indices)
    return load_path(bodies, stages, lambda _: linearise, lambda _: inverse, solve)


def _results(
    bodies: Bodies, chosen: Iterate[MonolithicLinearisation]
) -> dict[str, Value]:
    s, linearised = recovered(chosen), chosen.problem
    values = quantities(bodies, linearised.primal, s, linearised.rows)
    sides = bodies.mesh.boundaries
    tip = s.x[dofs_of(np.intersect1d(sides["top"], sides["right"]), 2)] * LENGTH
    force = values["contact_force"]
    return {
        "tip_x": float(tip[0]),
        "tip_y": float(tip[1]),
        "energy": values["energy"],
        "force_x": force[0],
        "force_y": force[1],
    }


def pressures(plan: Plan, solve: Reference) -> Rows:
    """Yield contact pressures along the arc for each load step and contact method.

    A row contains contact, step, node, angle in degrees, length in m, force in N/m and
    pressure in Pa of one slave node j. The angle is the polar angle of the undeformed
    node about the centre of the ring, measured from the right foot. The length is ∫N_j
    ds over the arc, the force is the magnitude ‖(Bᵀλ)_j‖ of the contact force on the
    node, and the pressure is force per length.
    """
    bodies = model(plan.scaling[-1], plan.Nh, 2 * plan.Nh, "strain")
    inverse = factorise_clamped(bodies)
    slave = bodies.pairs[0].slave
    points = bodies.mesh.points[slave]
    angles = np.degrees(np.arctan2(points[:, 1], points[:, 0] - 1.0))
    lengths = nodal_lengths(points)
    for contact in ("nts", "mortar"):
        linearise = linearisation(bodies, contact, "dual")
        path = _path(bodies, linearise, inverse, solve, plan.steps)
        for step in range(1, plan.steps + 1):
            chosen = path.problem(step)
            pushed = chosen.problem.primal.G.T @ recovered(chosen).z
            on_nodes = pushed.reshape(-1, 2)[slave]
            forces = np.hypot(*on_nodes.T) * bodies.force
            columns = zip(angles, lengths, forces, strict=True)
            for node, (angle, length, force) in enumerate(columns):
                yield {
                    "contact": contact,
                    "step": step,
                    "node": node,
                    "angle": float(angle),
                    "length": float(length),
                    "force": float(force),
                    "pressure": float(force / length),
                }


def verification(plan: Plan, solve: Reference) -> Rows:
    """Yield errors against exact solutions: the patch test and Hertz's pressure.

    A row contains problem, contact, n and error for one mesh. For the patch test, n is
    the number of elements along the upper block, and the error is max|σ_y + p|/p, with
    the applied pressure p. For Hertz's pressure, n is the number of elements per half
    width of the contact, and the error is the relative L2 error of the pressure.
    """
    for contact, keys in ROWS.items():
        for upper in plan.patch:
            params = {"upper": upper, "lower": upper + upper // 2, **keys}
            error = _error(ContactPatch(), params, "stress_error", solve)
            yield {"problem": "patch", "contact": contact, "n": upper, "error": error}
        for n in plan.hertz:
            params = {"n": n, "m": max(3 * n // 4, 1), **keys}
            error = _error(HertzCylinder(), params, "pressure_l2_error", solve)
            yield {"problem": "hertz", "contact": contact, "n": n, "error": error}


def _error(
    family: ContactPatch | HertzCylinder,
    keys: Mapping[str, Value],
    name: str,
    solve: Reference,
) -> float:
    params: dict[str, Any] = {**family.defaults, **keys}
    case = family.build("dual", params, solve)
    return float(case.quantities(solve(case.qp))[name])
