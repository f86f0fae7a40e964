"""Physical results of a contact problem from a solution of its primal QP; SI units."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from harness import QP, Fields, Solution, Vector
from problems.bodies import Bodies
from problems.elasticity import elasticity_matrix
from problems.mesh import as_vectors
from problems.stress import centre_stress, recover, von_mises

ACTIVE = 1e-6  #: a contact row is active where λ_i > ACTIVE·max λ


def quantities(bodies: Bodies, primal: QP, s: Solution) -> dict[str, Any]:
    """Report counts, energy, contact forces and stresses.

    energy: ½uᵀKu − fᵀu, J/m. contact_force: on the body of the first pair's master,
    −ΣBᵀλ, N/m. max_von_mises: per body, of the patch-recovered stress, Pa.
    """
    l, F = bodies.length, bodies.force
    held = bodies.body_of_node == bodies.body_of_node[bodies.pairs[0].master[0]]
    forces = contact_forces(bodies, primal, s)
    stress = nodal_von_mises(bodies, s.x * l)
    return {
        "nodes": len(bodies.mesh.points),
        "elements": len(bodies.mesh.cells),
        "dofs": bodies.mesh.dofs,
        "equality_rows": primal.b.size,
        "contact_rows": primal.h.size,
        "active": int((s.z > ACTIVE * s.z.max(initial=0.0)).sum()),
        "energy": primal.objective(s.x) * F * l,
        "contact_force": forces[held].sum(axis=0).tolist(),
        "multiplier_sum": float(s.z.sum() * F),
        "max_von_mises": {
            name: float(stress[bodies.body_of_node == b].max())
            for b, name in enumerate(bodies.names)
        },
    }


def fields(bodies: Bodies, primal: QP, s: Solution) -> Fields:
    """Collect the deformed state for pictures."""
    u = s.x * bodies.length
    slaves = np.concatenate([pair.slave for pair in bodies.pairs])
    return Fields(
        points=bodies.mesh.points,
        cells=bodies.mesh.cells,
        bodies=bodies.body,
        displacement=as_vectors(u),
        nodal={"von_mises": nodal_von_mises(bodies, u)},
        contact_nodes=slaves,
        contact_forces=contact_forces(bodies, primal, s)[slaves],
    )


def contact_forces(bodies: Bodies, primal: QP, s: Solution) -> NDArray[np.float64]:
    """Return the contact forces −Bᵀλ on the nodes (N, 2), N/m."""
    return as_vectors(-(primal.G.T @ s.z) * bodies.force)


def nodal_von_mises(bodies: Bodies, u: Vector) -> NDArray[np.float64]:
    """Recover σ_vM at the nodes (N,) from the displacement in m, Pa."""
    matrices = [elasticity_matrix(m, bodies.plane) for m in bodies.materials]
    D = np.stack(matrices)[bodies.body]
    stress = recover(bodies.mesh, centre_stress(bodies.mesh, D, u))
    nu = np.array([m.nu for m in bodies.materials])[bodies.body_of_node]
    return von_mises(stress, nu, bodies.plane)
