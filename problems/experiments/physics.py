"""Experiments beyond the paper: accuracy of load stepping and of contact rows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mortarbench.harness import Reference
from mortarbench.harness.plugin import Family
from mortarbench.problems.experiments.parts import Rows
from mortarbench.problems.experiments.plan import Plan
from mortarbench.problems.families.beam_ring import BeamRing
from mortarbench.problems.families.hertz import HertzCylinder
from mortarbench.problems.families.patch import ContactPatch
from mortarbench.problems.fem.mesh import nodal_lengths

#: numbers of load steps and of linearisations per step for which the result is
#: converged: larger numbers do not change the result
CONVERGED = (2, 8)

#: mapping from the name of a contact method in figures to the keys of its case
ROWS: Mapping[str, Mapping[str, Any]] = {
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
    Nr, Nh = plan.stepped
    variants = [(s, r) for r in plan.relin for s in plan.stepping]
    for steps, relin in (*variants, CONVERGED):
        family = BeamRing(Nr=Nr, Nh=Nh, steps=steps, relin=relin)
        values = _quantities(family, solve, "dual-bounds")
        yield {
            "steps": steps,
            "relin": relin,
            **dict(zip(("tip_x", "tip_y"), values["tip"], strict=True)),
            "energy": values["energy"],
            **dict(zip(("force_x", "force_y"), values["contact_force"], strict=True)),
        }


def pressures(plan: Plan, solve: Reference) -> Rows:
    """Yield contact pressures along the arc for each load step and contact method.

    A row contains contact, step, node, angle in degrees, length in m, force in N/m and
    pressure in Pa of one slave node j. The angle is the polar angle of the undeformed
    node about the centre of the ring, measured from the right foot. The length is ∫N_j
    ds over the arc, the force is the magnitude ‖(Bᵀλ)_j‖ of the contact force on the
    node, and the pressure is force per length.
    """
    family = BeamRing(Nr=plan.scaling[-1], Nh=plan.Nh, steps=plan.steps)
    for contact in ("nts", "mortar"):
        for step in range(1, plan.steps + 1):
            keys = {**family.params, "step": step, "contact": contact}
            case = family.with_keys(**keys).build("dual-bounds", solve)
            assert case.fields is not None
            fields = case.fields(solve(case.qp))
            (side,) = fields.contacts
            points = fields.points[side.nodes]
            angles = np.degrees(np.arctan2(points[:, 1], points[:, 0] - 1.0))
            forces = np.hypot(*side.force.T)
            columns = zip(angles, nodal_lengths(points), forces, strict=True)
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
            blocks = ContactPatch(upper=upper, lower=upper + upper // 2, **keys)
            error = _quantities(blocks, solve)["stress_error"]
            yield {"problem": "patch", "contact": contact, "n": upper, "error": error}
        for n in plan.hertz:
            cylinders = HertzCylinder(n=n, m=max(3 * n // 4, 1), **keys)
            error = _quantities(cylinders, solve)["pressure_l2_error"]
            yield {"problem": "hertz", "contact": contact, "n": n, "error": error}


def _quantities(
    family: Family, solve: Reference, form: str = "dual"
) -> Mapping[str, Any]:
    case = family.build(form, solve)
    return case.quantities(solve(case.qp))
