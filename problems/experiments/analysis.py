"""The whole analysis, mesh to displacement, timed part by part (Figure 6, Section 5).

Two ways through the same ten load steps, both with all Dirichlet rows in the dual:
``per-row``, the paper's, solves with the factor of K for each row of B in each step,
and its dual QPs by the textbook's SMALBE; ``condensed``, ours, gets K⁺ on the interface
once, each step costs one small product, and the dual QPs go to our SMALBE.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from mortarbench.harness import QP, Fields, Reference, Solution, Status, Vector
from mortarbench.problems.contact.bodies import Bodies, factorise_floating
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.node_to_segment import ContactRows
from mortarbench.problems.contact.results import fields
from mortarbench.problems.duality.dualisation import dualise
from mortarbench.problems.duality.monolithic import load_path
from mortarbench.problems.experiments.clock import Laps, Stopwatch, race
from mortarbench.problems.experiments.parts import Rows
from mortarbench.problems.experiments.plan import Plan
from mortarbench.problems.models.beam_ring import bodies as bodies_of

WAYS = {"per-row": False, "condensed": True}  #: condense?


@dataclass(frozen=True, eq=False)
class Analysis:
    """One analysis, done."""

    bodies: Bodies
    primal: QP  #: of the last step
    solution: Solution  #: of it
    dual: QP
    laps: Laps


def analyse(
    Nr: int, Nh: int, *, solve: Reference, condense: bool, steps: int, radial: int = 0
) -> Analysis:
    """Run all load steps; radial = 0 stands for 2·Nh layers of the ring."""
    watch = Stopwatch()
    bodies = bodies_of.__wrapped__(Nr, Nh, radial or 2 * Nh, "strain").assembled
    watch.lap("assembly")
    inverse = factorise_floating(bodies, condense=condense)
    watch.lap("factor")
    rows_of = linearisation(bodies, "nts", "dual")
    solved: list[tuple[QP, Solution]] = []

    def linearise(u: Vector) -> ContactRows:
        watch.lap("recovery")
        rows = rows_of(u)
        watch.lap("contact")
        return rows

    def solve_dual(qp: QP) -> Solution:
        watch.lap("dualisation")
        solution = solve(qp)
        watch.lap("qp")
        if solution.status is not Status.SOLVED:
            raise RuntimeError(f"the dual QP was not solved: {solution.message}")
        solved.append((qp, solution))
        return solution

    path = load_path(
        bodies, linearise, lambda: inverse, solve_dual, steps, transform=dualise
    )  # fmt: skip
    path.solution(steps)
    watch.lap("recovery")
    laps = dict(watch.laps)

    qp, solution = solved[-1]
    primal = path.primal(steps)
    return Analysis(
        bodies, primal, dualise(primal, inverse).recover(solution), qp, laps
    )


def scaling(plan: Plan, solve: Reference, baseline: Reference) -> Rows:
    """Time both ways at each size of the rectangle, Figure 6."""
    first = plan.scaling[0]
    for Nr in plan.scaling:
        run = partial(analyse, Nr, plan.Nh, steps=plan.steps)
        done = run(condense=True, solve=solve)
        contestants = {
            way: partial(
                _laps, partial(run, condense=c, solve=solve if c else baseline)
            )
            for way, c in WAYS.items()
        }
        size = {
            "Nr": Nr,
            "Nh": plan.Nh,
            "n": done.bodies.mesh.dofs,
            "m_E": done.primal.b.size,
            "m_I": done.primal.h.size,
        }
        # a warm round of the smallest is warm enough for those that take seconds
        for row in race(contestants, plan.scaling_rounds, warm=Nr == first):
            yield size | row


def _laps(run: partial[Analysis]) -> Laps:
    return run().laps


def states(plan: Plan, solve: Reference) -> dict[str, Fields]:
    """Solve the problems of Figure 2, with either rule for the ring, and Figure 7."""
    Nr, Nh = plan.example
    largest = plan.scaling[-1], plan.Nh, 2 * plan.Nh
    chosen = {
        "example-Nh": (Nr, Nh, Nh),
        "example-2Nh": (Nr, Nh, 2 * Nh),
        "largest": largest,
    }
    done = {
        name: analyse(Nr, Nh, solve=solve, condense=True, steps=plan.steps, radial=r)
        for name, (Nr, Nh, r) in chosen.items()
    }
    return {name: fields(a.bodies, a.primal, a.solution) for name, a in done.items()}
