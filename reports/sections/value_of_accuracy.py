"""Cost of accuracy: solver errors compared with discretisation errors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from statistics import median

from mortarbench.harness.crossval.discretisation import (
    Discretisation,
    read_discretisation,
)
from mortarbench.harness.running.pairs import ratio_of
from mortarbench.reports.data.cells import solver_columns, source
from mortarbench.reports.data.evidence import Outcome
from mortarbench.reports.data.time_at_accuracy import counts
from mortarbench.reports.document.formatting import ABSENT, TIMED, power
from mortarbench.reports.document.layout import Cell, Part, Table
from mortarbench.reports.document.mesh_errors import mesh_table
from mortarbench.reports.document.templates import Sentences
from mortarbench.reports.figures.sweeps import SHARE
from mortarbench.reports.sections import Analysis, section
from mortarbench.reports.sections.sweeps import by_solver

TEXT = Sentences(__name__)
_KNOWN = ("limit", "change")  #: kinds of discretisation errors with a value

Meshes = Mapping[str, Discretisation]


@section(
    48,
    "worth",
    "How much accuracy is worth paying for",
    "How much accuracy is worth paying for: the discretisation errors are unknown. "
    '"mortarbench validate DIR" computes them for later reports.',
)
def value_of_accuracy(a: Analysis) -> Iterator[Part]:
    """Tabulate certified errors relative to discretisation errors, if known."""
    known = read_discretisation(a.evidence.directory)
    physical = dict.fromkeys(o.physical for o in a.evidence.flat)
    meshes = {name: known[name] for name in physical if name in known}
    if not meshes:
        return
    shared = [o for o in a.evidence.flat if share_of(o, meshes) is not None]
    priced = by_solver(shared, lambda o: o.case)
    answers = {(o.case, o.tol, o.solver): o for o in shared}
    ends = {
        (case, s): pair
        for case, row in priced.items()
        for s, outcomes in row.items()
        if (pair := _ends(outcomes, meshes)) is not None
    }
    times = {key: [o.seconds("total") for o in pair] for key, pair in ends.items()}
    factors = [
        most.value / least.value for least, most in times.values() if least and most
    ]
    extremes = (median(factors), min(factors), max(factors)) if factors else ()
    yield from TEXT.parts("prose", len(factors), extremes)
    yield mesh_table(list(meshes.values()))
    if not priced:
        return
    present = [
        s for s in a.evidence.solvers if any(s in row for row in priced.values())
    ]

    def fraction(solver: str, at: tuple[str, float]) -> Cell:
        if (outcome := answers.get((*at, solver))) is None:
            return Cell()
        share = share_of(outcome, meshes) or 0.0
        text = power(share) if counts(outcome) else f"({power(share)})"
        kind = "over" if share > SHARE else ""
        return Cell(text=text, kind=kind, value=share, title=source(outcome))

    def price(solver: str, case: str) -> Cell:
        if (case, solver) not in ends:
            text = "never accurate enough" if solver in priced[case] else ABSENT
            return Cell(text=text, kind="quiet")
        enough, tightest = ends[case, solver]
        ratio = ratio_of(tightest.by_block, enough.by_block)
        after = TEXT("further", enough, tightest, ratio, *times[case, solver])
        return Cell.time(times[case, solver][0], after=after, title=source(enough))

    yield Table.of(
        "Certified error of the solver relative to the discretisation error.",
        [
            (case, tol)
            for case, row in priced.items()
            for tol in sorted({o.tol for of in row.values() for o in of}, reverse=True)
        ],
        (
            ("case", lambda at: Cell.name(at[0])),
            ("tol", lambda at: Cell.tolerance(at[1])),
            *solver_columns(present, fraction),
        ),
        notes=(TEXT("shares_note"),),
    )
    yield Table.of(
        TEXT("prices_caption"),
        priced,
        (("case", Cell.name), *solver_columns(present, price)),
        notes=(TEXT("prices_note"), TIMED),
    )


def share_of(outcome: Outcome, meshes: Meshes) -> float | None:
    """Return certified error divided by discretisation error; None if unknown."""
    bound, mesh = outcome.largest("energy_bound"), meshes.get(outcome.physical)
    if bound is None or mesh is None or mesh.kind not in _KNOWN or not mesh.error:
        return None
    return bound / mesh.error


def _ends(
    outcomes: Sequence[Outcome], meshes: Meshes
) -> tuple[Outcome, Outcome] | None:
    """Select the loosest tolerance that is accurate enough, and the tightest one."""
    reached = [o for o in outcomes if counts(o)]
    enough = [o for o in reached if (share_of(o, meshes) or 0.0) <= SHARE]
    if not enough:
        return None
    return max(enough, key=lambda o: o.tol), min(reached, key=lambda o: o.tol)
