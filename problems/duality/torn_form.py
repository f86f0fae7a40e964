"""The dual of decomposed bodies on one process, beside the undivided bodies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from time import perf_counter

from mortarbench.harness import Case
from mortarbench.problems.contact.stepping import Iterate
from mortarbench.problems.duality.decomposed import contact_of, decompose, subdivided
from mortarbench.problems.duality.feti_dual import feti_dual, with_decomposition
from mortarbench.problems.duality.monolithic import (
    MonolithicLinearisation,
    MonolithicPath,
)
from mortarbench.problems.duality.problem import Choice, ContactProblem
from mortarbench.problems.feti.mechanics import torn_mechanics
from mortarbench.problems.feti.served import Served
from mortarbench.problems.feti.subdomains import TornBodies


def torn_case(
    problem: ContactProblem,
    path: MonolithicPath,
    choice: Choice,
    chosen: Iterate[MonolithicLinearisation],
    case_of_dual: Callable[..., Case],
) -> Case:
    """Return the case of the dual in subdomains of the problem `chosen` of a load path.

    case_of_dual : function that returns the case of a dual of the undivided bodies, see
        `problems.duality.case_forms.contact_case`
    """
    served = _torn(problem, choice, path.last_of(choice.step), chosen)
    primal = chosen.problem.primal
    start = perf_counter()
    dual = feti_dual(served, primal, chosen.friction)
    seconds = perf_counter() - start
    others, first = path.before(choice.step, chosen), served
    if others:
        first = _torn(problem, choice, 0, path.problems(0)[0])
    case = case_of_dual(dual, subdomains=served.torn.problem.layout.label)
    case = with_decomposition(case, served, first.torn, others)
    mechanics = case.mechanics
    assert mechanics is not None
    if not (primal.A.T @ primal.b).any():  # subdomains need supports with u = 0
        bodies = torn_mechanics(served, primal.P)
        mechanics = replace(mechanics, subdomains=bodies)
    return replace(case, dualise_seconds=seconds, mechanics=mechanics)


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
