"""Times of the whole analysis and of its parts (paper, Figure 6 and Section 5).

An analysis computes the displacement at every load step from the mesh. Two variants are
compared, both with all Dirichlet conditions as rows of B. The variant ``per-row`` of
the paper solves with the factor of K for each row of B in each step, and uses the
textbook SMALBE for the dual QPs. The variant ``condensed`` computes K⁺ on the interface
once, after which each step requires one small product, and uses the SMALBE of this
project.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from mortarbench.harness import QP, Fields, Reference, Solution, Status, Vector
from mortarbench.problems.contact.bodies import Bodies, factorise_floating
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.results import fields
from mortarbench.problems.contact.rows import ContactRows
from mortarbench.problems.contact.stepping import load_steps
from mortarbench.problems.duality.dualisation import dualise
from mortarbench.problems.duality.monolithic import load_path, recovered
from mortarbench.problems.experiments.clock import Laps, Stopwatch, race
from mortarbench.problems.experiments.parts import Rows
from mortarbench.problems.experiments.plan import Plan
from mortarbench.problems.families.beam_ring import bodies as bodies_of

#: mapping from the name of a variant to True if the variant condenses K⁺ onto the
#: interface
VARIANTS = {
    "per-row": False,
    "condensed": True,
}


@dataclass(frozen=True, eq=False)
class Analysis:
    """Result of one analysis."""

    bodies: Bodies
    primal: QP  #: primal QP of the last step
    rows: ContactRows  #: contact rows of `primal`
    solution: Solution  #: solution of the last step
    dual: QP  #: dual QP of the last step
    laps: Laps  #: mapping from each part to its time in s, summed over all steps


def analyse(
    Nr: int, Nh: int, *, solve: Reference, condense: bool, steps: int, radial: int = 0
) -> Analysis:
    """Run and time all load steps; radial = 0 selects 2·Nh layers of the ring.

    Raises
    ------
    RuntimeError
        If `solve` fails to solve a dual QP.

    """
    watch = Stopwatch()
    bodies = bodies_of.__wrapped__(Nr, Nh, radial or 2 * Nh, "strain").assembled
    watch.lap("assembly")
    inverse = factorise_floating(bodies, condense=condense)
    watch.lap("factor")
    rows_of = linearisation(bodies, "nts", "dual")
    duals: list[QP] = []

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
        duals.append(qp)
        return solution

    stages = load_steps(steps, 1, bodies.f, bodies.fixed)
    path = load_path(
        bodies, stages, lambda _: linearise, lambda _: inverse, solve_dual, dualise
    )
    answer = recovered(path.problem(steps))
    watch.lap("recovery")
    last = path.problem(steps).problem
    return Analysis(bodies, last.primal, last.rows, answer, duals[-1], watch.laps)


def scaling(plan: Plan, solve: Reference, baseline: Reference) -> Rows:
    """Time both variants for each mesh of the rectangle (Figure 6)."""
    first = plan.scaling[0]
    for Nr in plan.scaling:
        run = partial(analyse, Nr, plan.Nh, steps=plan.steps)
        analysis = run(condense=True, solve=solve)
        contestants = {
            way: partial(
                _laps, partial(run, condense=c, solve=solve if c else baseline)
            )
            for way, c in VARIANTS.items()
        }
        size = {
            "Nr": Nr,
            "Nh": plan.Nh,
            "n": analysis.bodies.mesh.dofs,
            "m_E": analysis.primal.b.size,
            "m_I": analysis.primal.h.size,
        }
        # one warm-up at the smallest size suffices, because larger runs take seconds
        for row in race(contestants, plan.scaling_rounds, warm=Nr == first):
            yield size | row


def _laps(run: partial[Analysis]) -> Laps:
    return run().laps


def states(plan: Plan, solve: Reference) -> dict[str, Fields]:
    """Return the fields of Figure 2 (for two ring meshes) and Figure 7, by name."""
    Nr, Nh = plan.example
    largest = plan.scaling[-1], plan.Nh, 2 * plan.Nh
    problems = {
        "example-Nh": (Nr, Nh, Nh),
        "example-2Nh": (Nr, Nh, 2 * Nh),
        "largest": largest,
    }
    analyses = {
        name: analyse(Nr, Nh, solve=solve, condense=True, steps=plan.steps, radial=r)
        for name, (Nr, Nh, r) in problems.items()
    }
    return {
        name: fields(a.bodies, a.primal, a.solution, a.rows)
        for name, a in analyses.items()
    }
