"""Bodies decomposed into subdomains by labels of their cells, for tests."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import QP, Friction
from mortarbench.harness.mechanics import (
    NO_FRICTION,
    DecomposedMechanics,
    contact_rows,
)
from mortarbench.harness.names import parse
from mortarbench.problems import PROBLEMS
from mortarbench.problems.contact.bodies import Bodies
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.stepping import load_steps
from mortarbench.problems.duality.decomposed import decompose, subdivided
from mortarbench.problems.duality.monolithic import monolithic_path, primal_qp
from mortarbench.problems.families.beam_ring import model
from mortarbench.problems.families.contact import ContactFamily
from mortarbench.problems.families.feti_models import DecomposedFamily
from mortarbench.problems.feti.mechanics import torn_mechanics
from mortarbench.problems.feti.served import Served
from mortarbench.problems.feti.subdivision import Subdivision
from mortarbench.problems.feti.subdomains import Contact, DecomposedProblem, TornBodies
from mortarbench.solvers.reference.solve import reference_solution


def labelled(bodies: Bodies, label: NDArray[np.int64]) -> Subdivision:
    """Return a subdivision by cell labels (E,)."""
    return Subdivision(bodies.mesh, label, bodies.body)


def decompose_by_labels(
    bodies: Bodies,
    layout: Subdivision,
    primal: QP,
    friction: Friction = NO_FRICTION,
    rows: str = "orthonormal",
) -> Served:
    """Decompose bodies, their QP and its friction into subdomains."""
    return Served(TornBodies(parts_by(bodies, layout, primal, friction, rows)))


def mechanics_of(problem: DecomposedProblem) -> DecomposedMechanics:
    """Return the data for certificates on one process, without an assembled K."""
    served = Served(TornBodies(problem))
    return torn_mechanics(served)()


def parts_by(
    bodies: Bodies,
    layout: Subdivision,
    primal: QP,
    friction: Friction = NO_FRICTION,
    rows: str = "orthonormal",
) -> DecomposedProblem:
    """Return the QP of the bodies and its friction on the subdomains."""
    (stage,) = load_steps(1, 1, -primal.q, bodies.fixed)
    return decompose(bodies, layout, rows, stage, contact_of(primal, friction))


def contact_of(primal: QP, friction: Friction) -> Contact:
    """Return the contact and friction rows of undivided bodies."""
    rows, c = contact_rows(primal, friction)
    return Contact(rows, c, friction.bound, friction.tangents)


def parts_of(name: str) -> DecomposedProblem:
    """Return the decomposed dual of a case, after solving the earlier load steps."""
    case = parse(name, PROBLEMS)
    if isinstance(case.family, ContactFamily):
        problem, choice = case.family.contact_problem(), case.family.choice("dual")
        path = monolithic_path(problem, reference_solution)
        whole, friction, _ = path.problem(choice.step)
        of, stage = problem.bodies, problem.stages[path.last_of(choice.step)]
        contact = contact_of(whole.primal, friction)
        layout = subdivided(of.shape, choice.size)
        return decompose(of, layout, choice.glue, stage, contact)
    assert isinstance(case.family, DecomposedFamily)
    return case.family.in_subdomains()


def decomposed_pair(
    rows: str = "orthonormal", most: int = 2
) -> tuple[Bodies, Any, Served]:
    """Return bodies of 32 × 4 and 36 × 6 cells, their QP, and the decomposed bodies."""
    geometry = (4, 3, 6, "strain")
    bodies = model(*geometry)
    contact = linearisation(bodies, "mortar", "dual")(np.zeros(bodies.mesh.dofs))
    primal = primal_qp(bodies, contact)
    label = subdivided(bodies.shape, most).label
    return (
        bodies,
        primal,
        decompose_by_labels(bodies, labelled(bodies, label), primal, rows=rows),
    )
