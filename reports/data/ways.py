"""Ways from the mesh to a verified answer: a form of the problem and a solver for it.

The primal and the dual QP of one problem are two problems to a solver, but one to a
reader who has a mesh. Ways are compared by the seconds of dualising, which only dual
forms need, plus those of preparing and solving; assembling is the same for all.
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

PRIMAL = "primal"  #: the form that nothing has to be dualised for


class Way(NamedTuple):
    """A solver on one form."""

    solver: str
    form: str

    @property
    def label(self) -> str:
        """Name both; no two ways share a label."""
        return f"{self.solver} on the {self.form} form"


@dataclass(frozen=True, kw_only=True)
class Ways:
    """The comparison of all ways, at each accuracy."""

    found: tuple[FastestSolver, ...] = ()  #: tightest accuracy first, cold solves first
    uncharged: int = 0  #: problems left out: their dual forms lack `dualise_seconds`


def compare_ways(evidence: Evidence) -> Ways:
    """Compare the ways to the same problems, dualising charged.

    A problem takes part if it was measured in several forms, or if dualising is charged
    to its only one; elsewhere a way is a solver, and the comparison of solvers says
    the same.
    """
    problems: dict[str, list[Record]] = {}
    for r in evidence.records:
        if not r.role:
            problems.setdefault(r.case.removesuffix(f"/{r.form}"), []).append(r)
    differing = {
        name: records
        for name, records in problems.items()
        if len({r.form for r in records}) > 1 or any(r.dualise_seconds for r in records)
    }
    known = {
        name: records
        for name, records in differing.items()
        if all(map(_is_charged, records))
    }
    ways = {
        Way(r.solver, r.form).label: Way(r.solver, r.form)
        for records in known.values()
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
            for name, records in known.items()
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

    def named(competitors: Iterable[Competitor]) -> tuple[Competitor, ...]:
        return tuple(replace(c, **ways[c.solver]._asdict()) for c in competitors)

    found = [
        replace(f, competitors=named(f.competitors), others=named(f.others))
        for f in fastest_solvers(answers, groups)
        if f.finding is not Finding.ALONE
    ]
    found.sort(key=lambda f: (f.kind.mode != "cold", f.kind.mode, f.kind.at))
    return Ways(found=tuple(found), uncharged=len(differing) - len(known))


def _is_charged(r: Record) -> bool:
    """Return whether the seconds from the mesh to the answer are known, or not needed.

    Journals of older versions and cases emitted by ranks lack those of dualising.
    """
    return r.form == PRIMAL or r.total_seconds is None or r.dualise_seconds is not None
