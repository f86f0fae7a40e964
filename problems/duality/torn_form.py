"""The dual of decomposed bodies on one process, beside the undivided bodies."""

from __future__ import annotations

from time import perf_counter

from mortarbench.problems.contact.stepping import Iterate
from mortarbench.problems.duality.decomposed import contact_of, decompose, subdivided
from mortarbench.problems.duality.dualisation import TornForm
from mortarbench.problems.duality.feti_dual import (
    decomposition_quantities,
    digest_of,
    feti_dual,
    feti_matrices,
)
from mortarbench.problems.duality.monolithic import (
    MonolithicLinearisation,
    MonolithicPath,
)
from mortarbench.problems.duality.problem import Choice, ContactProblem
from mortarbench.problems.feti.mechanics import torn_mechanics
from mortarbench.problems.feti.served import Served
from mortarbench.problems.feti.subdomains import TornBodies


def torn_form(
    problem: ContactProblem,
    path: MonolithicPath,
    choice: Choice,
    chosen: Iterate[MonolithicLinearisation],
) -> TornForm:
    """Return the dual in subdomains of the problem `chosen` of a load path."""
    served = _torn(problem, choice, path.last_of(choice.step), chosen)
    primal = chosen.problem.primal
    start = perf_counter()
    dual = feti_dual(served, primal, chosen.friction)
    seconds = perf_counter() - start
    others, first = path.before(choice.step, chosen), served
    if others:
        first = _torn(problem, choice, 0, path.problems(0)[0])
    return TornForm(
        transformed=dual,
        seconds=seconds,
        matrices=feti_matrices(served, dual.qp),
        quantities=decomposition_quantities(served, dual.qp),
        mechanics=torn_mechanics(served, primal.P),
        label=served.torn.problem.layout.label,
        digest=digest_of(served, first.torn, others),
    )


def _torn(
    problem: ContactProblem,
    choice: Choice,
    stage: int,
    linearised: Iterate[MonolithicLinearisation],
) -> Served:
    """Return the subdomains with the rows of a problem that was linearised.

    stage : number of the stage of the problem
    """
    elastic = problem.bodies
    contact = contact_of(linearised.problem.primal, linearised.friction)
    layout = subdivided(elastic.shape, choice.size)
    of_stage = problem.stages[stage]
    parts = decompose(elastic, layout, choice.glue, of_stage, contact)
    return Served(TornBodies(parts))
