"""Combinations of form and solver, compared from the mesh to a verified answer.

The primal and the dual QP of one problem are different problems for a solver, but a
user with a mesh may choose either. The compared time is the sum of dualisation (dual
forms only), preparation and solve; assembly is the same for all combinations.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

from mortarbench.harness import Record
from mortarbench.reports.data.comparison_groups import all_groups, answers_of
from mortarbench.reports.data.evidence import Evidence, arrange
from mortarbench.reports.data.fastest import (
    Competitor,
    FastestSolver,
    Finding,
    fastest_solvers,
)

PRIMAL = "primal"  #: the form without dualisation


class Way(NamedTuple):
    """A combination of a form and a solver."""

    solver: str
    form: str

    @property
    def label(self) -> str:
        """Solver and form; unique among combinations."""
        return f"{self.solver} on the {self.form} form"


@dataclass(frozen=True, kw_only=True)
class Ways:
    """Comparison of all combinations of form and solver at each accuracy."""

    #: cold solves first, then by mode; tight accuracies first within a mode
    comparisons: tuple[FastestSolver, ...] = ()
    uncharged: int = 0  #: number of problems left out for lack of `dualise_seconds`


def compare_ways(evidence: Evidence) -> Ways:
    """Compare combinations of form and solver on the same problems, with dualisation.

    A problem is included if it was measured in several forms, or if its only form has a
    time of dualisation. For other problems, the comparison of solvers suffices.
    """
    problems: dict[str, list[Record]] = {}
    for r in evidence.records:
        if not r.arm:
            problems.setdefault(r.case.removesuffix(f"/{r.form}"), []).append(r)
    differing = {
        name: records
        for name, records in problems.items()
        if len({r.form for r in records}) > 1 or any(r.dualise_seconds for r in records)
    }
    timed = {
        name: records
        for name, records in differing.items()
        if all(map(_has_all_times, records))
    }
    ways = {
        Way(r.solver, r.form).label: Way(r.solver, r.form)
        for records in timed.values()
        for r in records
    }
    charged = replace(
        evidence,
        records=arrange(
            r.replace(
                case=name,
                solver=Way(r.solver, r.form).label,
                total_seconds=None
                if r.total_seconds is None
                else r.total_seconds + (r.dualise_seconds or 0.0),
            )
            for name, records in timed.items()
            for r in records
        ),
        suite={
            **evidence.suite,
            "solvers": sorted(
                ways, key=lambda label: evidence.solvers.index(ways[label].solver)
            ),
        },
    )
    groups = all_groups(charged, pool_forms=True)
    answers = answers_of(charged, pool_forms=True)

    def with_forms(competitors: Iterable[Competitor]) -> tuple[Competitor, ...]:
        return tuple(replace(c, **ways[c.solver]._asdict()) for c in competitors)

    comparisons = [
        replace(f, competitors=with_forms(f.competitors), others=with_forms(f.others))
        for f in fastest_solvers(answers, groups)
        if f.finding is not Finding.ALONE
    ]
    comparisons.sort(key=lambda f: (f.key.mode != "cold", f.key.mode, f.key.at))
    return Ways(comparisons=tuple(comparisons), uncharged=len(differing) - len(timed))


def _has_all_times(r: Record) -> bool:
    """Return whether a record contains the time of dualisation or does not need it.

    Primal forms and records without a total time do not need it. Journals of older
    versions and cases built by several processes lack it.
    """
    return r.form == PRIMAL or r.total_seconds is None or r.dualise_seconds is not None
