"""Ways from the mesh to a verified answer: a form of the problem and a solver for it.

The primal and the dual QP of one problem are two problems to a solver, but one to a
reader who has a mesh. Ways are compared by the seconds of dualising, which only dual
forms need, plus those of preparing and solving; assembling is the same for all.
"""

from __future__ import annotations

from collections.abc import Mapping
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
            problems.setdefault(problem_of(r), []).append(r)
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
    charged = _charged(evidence, known, ways)
    groups = all_groups(charged, pool_forms=True)
    answers = answers_of(charged, pool_forms=True)
    found = [
        _named(one, ways)
        for one in fastest_solvers(answers, groups)
        if one.finding is not Finding.ALONE
    ]
    found.sort(key=lambda f: (f.kind.mode != "cold", f.kind.mode, f.kind.at))
    return Ways(found=tuple(found), uncharged=len(differing) - len(known))


def problem_of(r: Record) -> str:
    """Return the case name without its form."""
    return r.case.removesuffix(f"/{r.form}")


def _is_charged(r: Record) -> bool:
    """Return whether the seconds from the mesh to the answer are known, or not needed.

    Journals of older versions and cases emitted by ranks lack those of dualising.
    """
    return r.form == PRIMAL or r.total_seconds is None or r.dualise_seconds is not None


def _charged(
    evidence: Evidence,
    problems: Mapping[str, list[Record]],
    ways: Mapping[str, Way],
) -> Evidence:
    """Replace cases by problems, solvers by ways, and charge dualising."""
    records = arrange(
        r.but(
            case=name,
            solver=Way(r.solver, r.form).label,
            total_seconds=None
            if r.total_seconds is None
            else r.total_seconds + (r.dualise_seconds or 0.0),
        )
        for name, of in problems.items()
        for r in of
    )
    ordered = sorted(ways, key=lambda label: evidence.solvers.index(ways[label].solver))
    return replace(
        evidence, records=records, suite={**evidence.suite, "solvers": ordered}
    )


def _named(found: FastestSolver, ways: Mapping[str, Way]) -> FastestSolver:
    """Replace the labels of ways by solver and form."""

    def split(c: Competitor) -> Competitor:
        way = ways[c.solver]
        return replace(c, solver=way.solver, form=way.form)

    return replace(
        found,
        competitors=tuple(map(split, found.competitors)),
        others=tuple(map(split, found.others)),
    )
