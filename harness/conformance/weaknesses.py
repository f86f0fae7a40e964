"""Table of the effects of equivalent formulations on the answers of solvers."""

from __future__ import annotations

from collections.abc import Mapping

from mortarbench.harness.conformance.conformance import (
    INVARIANCE_PREFIX,
    Grade,
    Result,
)
from mortarbench.harness.conformance.equivalence import (
    CHANGES,
    CHANGES_OF,
    UNCHANGED,
)

MIN_LISTED_WORK_RATIO = 2.0  #: least ratio of iterations that the table shows

HEAD = """\
# Effects of equivalent formulations

**Does the answer of a solver change if the same QP is written in another way?**
`harness.conformance.equivalence` describes the problem and the formulations. Entries:
"·": neither verdict nor answer change; ×k: k times as many iterations in the worst form
(k ≥ 2); **form**: verdict or answer change in this form; (form): the changed QP is
declined; blank: the change applies to no form that the solver solves.

"""


def weaknesses_page(results: Mapping[str, Mapping[str, Result]]) -> str:
    """Return a Markdown page on the results of the checks of equivalent formulations.

    results : results of all checks, by solver and by name of the check
    """
    heads = [change for change in CHANGES if change != UNCHANGED]
    table = [
        f"| solver | solves | {' | '.join(heads)} |",
        f"| --- | --- |{' --- |' * len(heads)}",
    ]
    evidence = []
    for name, checks in results.items():
        by_form = {
            form: {c: checks[f"{INVARIANCE_PREFIX}: {form}, {c}"] for c in changes}
            for form, changes in CHANGES_OF.items()
        }
        evidence += [
            f"- `{name}`, {form}, {change}: {result.message}."
            for form, changes in by_form.items()
            for change, result in changes.items()
            if result.grade is Grade.WEAK
        ]
        solved = {
            form: changes
            for form, changes in by_form.items()
            if changes[UNCHANGED].grade is Grade.PASS
        }
        cells = [
            _cell({form: r[change] for form, r in solved.items() if change in r})
            for change in heads
        ]
        table.append(f"| `{name}` | {', '.join(solved)} | {' | '.join(cells)} |")
    return HEAD + "\n".join([*table, "", "## Evidence", "", *evidence]) + "\n"


def _cell(results: Mapping[str, Result]) -> str:
    """Return the entry for one change; results by form."""
    if not results:
        return ""
    marks = {Grade.WEAK: "**{}**", Grade.DECLINE: "({})"}
    entries = [marks[r.grade].format(f) for f, r in results.items() if r.grade in marks]
    work = max(r.work or 1.0 for r in results.values())
    if work >= MIN_LISTED_WORK_RATIO:
        entries.append(f"×{work:.2g}")
    return ", ".join(entries) or "·"
