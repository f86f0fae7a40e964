"""Cases of one Newton iteration at finite strain, in primal or dual form."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from mortarbench.harness import Case, Fields, Reference, Solution, Vector
from mortarbench.problems.contact.bodies import Bodies
from mortarbench.problems.contact.linearise import (
    closest_segments,
    contact_stiffness,
    linearisation,
)
from mortarbench.problems.contact.results import fields, quantities
from mortarbench.problems.duality.case_forms import contact_case
from mortarbench.problems.duality.newton import (
    Gaps,
    Iteration,
    NewtonPath,
    sliding_inverse,
)
from mortarbench.problems.duality.problem import Linearise
from mortarbench.problems.fem.finite_strain import (
    Cells,
    InvertedCellError,
    cauchy_stress,
    cells_of,
    strain_energy,
)
from mortarbench.problems.fem.hyperelastic import hyperelastic
from mortarbench.problems.fem.stress import recover, von_mises_of


def newton_path(
    bodies: Bodies,
    linearise: Linearise,
    reference: Reference,
    *,
    material: str,
    contact: str = "",
    stiffness: str = "none",
    steps: int = 1,
) -> NewtonPath:
    """Return the load path of hyperelastic bodies; see `problems.keys`.

    linearise : function that linearises contact by the method `contact`
    """
    gaps = Gaps(linearise)
    if contact == "nts":
        gaps = _node_to_segment(bodies, linearise, stiffness)
    # nondimensional with the units l and F₀ of K
    l, F = bodies.length, bodies.force
    mesh = replace(bodies.mesh, points=bodies.mesh.points / l)
    laws = [hyperelastic(material, m, unit=F / l) for m in bodies.materials]
    cells = cells_of(mesh, laws, bodies.body)
    return NewtonPath(bodies, cells, gaps, reference, steps)


def _node_to_segment(bodies: Bodies, linearise: Linearise, stiffness: str) -> Gaps:
    """Return the gaps of slave nodes to segments.

    Second derivatives are included if `stiffness` is "geometric".
    """
    geometric = stiffness == "geometric"

    def keep_segments(u: Vector, pressing: NDArray[np.bool_]) -> Gaps:
        kept = np.where(pressing, closest_segments(bodies, u), -1)
        return Gaps(
            linearisation(bodies, "nts", None, fixed_segments=kept),
            contact_stiffness(bodies, kept) if geometric else None,
        )

    return Gaps(
        linearise, contact_stiffness(bodies) if geometric else None, keep_segments
    )


def newton_case(
    path: NewtonPath,
    form: str,
    step: int,
    newton: int,
    results: Callable[[Iteration, Solution], Mapping[str, Any]] = lambda _, s: {},
) -> Case:
    """Return the case of a Newton iteration in one of the FORMS of `case_forms`.

    The objective is the quadratic model of the potential Π at the iterate, whereas the
    quantity `energy` is Π itself. K, whose kernel consists of translations, is the same
    in all forms, so that all forms describe the same QP.

    Parameters
    ----------
    step, newton : see `NewtonPath.iteration`
    results : function that evaluates further quantities from a solution of the primal
        problem

    """
    at = path.iteration(step, newton)
    iterations = path.iterations(step)
    bodies, primal = at.tangent, at.primal
    unit = bodies.length * bodies.force
    step_quantities = {
        "newton": newton or len(iterations),
        "newton_iterations": len(iterations),
        "load_parts": path.parts(step),
        "kept_segments": at.gaps is not path.gaps,
        "clipped": at.clipped,
        "clipped_in_step": sum(i.clipped for i in iterations),
        "residuals": [i.residual for i in iterations],
        "step_lengths": [i.length for i in iterations],
    }

    def collected(s: Solution) -> Mapping[str, Any]:
        stresses = cauchy_stresses(path.cells, bodies, s.x)
        values = quantities(bodies, primal, s, at.rows, stresses=stresses)
        return values | path_state(path, at, s) | step_quantities | dict(results(at, s))

    case = contact_case(
        bodies,
        primal,
        at.rows,
        form,
        floating=sliding_inverse,
        quantities=collected,
    )
    assert case.mechanics is not None
    to_primal = case.mechanics.to_primal

    def deformed_fields(s: Solution) -> Fields:
        s = to_primal(s)
        stresses = cauchy_stresses(path.cells, bodies, s.x)
        return fields(bodies, primal, s, at.rows, stresses=stresses)

    return replace(
        case,
        fields=deformed_fields,
        constant=case.constant + at.constant * unit,
        mechanics=replace(case.mechanics, rigid=translations(bodies)),
    )


def path_state(path: NewtonPath, at: Iteration, s: Solution) -> dict[str, Any]:
    """Evaluate the nonlinear problem at a solution of its QP.

    The keys are `energy` (Π in J/m), `residual` (see `NewtonPath.residual`) and
    `penetration` (largest penetration in m). All values are NaN if a cell is inverted.
    """
    try:
        energy, residual, penetration = path.state(at, s)
    except InvertedCellError:
        energy = residual = penetration = np.nan
    bodies = at.tangent
    return {
        "energy": energy * bodies.length * bodies.force,
        "residual": residual,
        "penetration": penetration * bodies.length,
    }


def cauchy_stresses(cells: Cells, bodies: Bodies, u: Vector) -> dict[str, Vector]:
    """Recover the Cauchy stresses at the nodes (N,), Pa; NaN if a cell is inverted.

    u : (n,) nondimensional displacement
    """
    stress = cauchy_stress(cells, u) * (bodies.force / bodies.length)
    if not np.isfinite(strain_energy(cells, u)):
        stress[:] = np.nan
    nodal = recover(bodies.mesh, stress)
    named = dict(zip(("sxx", "syy", "sxy", "szz"), nodal.T, strict=True))
    return named | {"von_mises": von_mises_of(nodal)}


def translations(bodies: Bodies) -> Vector:
    """Return orthonormal translations of each body as columns, (n, 2·bodies)."""
    owner = bodies.body_of_node
    sizes = np.bincount(owner, minlength=len(bodies.names))
    return np.asarray(
        block_diag(*(np.tile(np.eye(2), (size, 1)) / np.sqrt(size) for size in sizes))
    )
