"""Generation of docs/weaknesses.md, on effects of equivalent formulations."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from mortarbench.harness.conformance.conformance import (
    DEGENERATE,
    INVARIANCE_PREFIX,
    Grade,
    Result,
)
from mortarbench.harness.conformance.equivalence import (
    CHANGES,
    TOL,
    UNCHANGED,
    UNITS,
    changes_of,
)
from mortarbench.harness.conformance.manufactured import FORMS

MIN_LISTED_WORK_RATIO = 2.0  #: least ratio of iterations that the table shows

Results = Mapping[str, Result]  #: results of one solver, by name of the check

HEAD = f"""\
# Effects of equivalent formulations

**Does the answer of a solver change if the same QP is written in another way?** `make
weaknesses` runs these tests with the versions in `constraints.txt`, and writes this
page. `mortarbench test-solver NAME` runs them for one solver.

The test problem consists of two strings in contact
(`harness.conformance.manufactured.strings`). It has three forms: the primal QP with 42
unknowns, 4 equality and 23 inequality rows, its dual, and its dual with bounds only.
Each form is first solved at tolerance {TOL:g} in non-dimensional form. It is then
solved in equivalent formulations: in other units, in another order, with rows scaled by
powers of two from 2⁻¹⁰ to 2¹⁰ or duplicated, and with unknowns shifted or of the
opposite sign. In exact arithmetic, the QPs are equivalent
(`harness.conformance.metamorphic`), so neither verdict nor answer should change.

A change of units multiplies the non-dimensional quantities by the factors in the next
table. The factors are the load and the length of the paper's benchmark, expressed in
the new units and rounded to powers of two, and their products and quotients:

"""

KEY = """
The entries of the next table have these meanings:

- "·": verdict and answer do not change in any form that the solver solves;
- ×k: in the worst form, the solver takes k times as many iterations (for k ≥ 2);
- **form**: verdict or answer change in this form; see the section *Evidence*;
- (form): the solver declines the changed QP of this form;
- blank: the change does not apply to any form that the solver solves.
"""


DEGENERATE_HEAD = """\
## The degenerate cone

min ½‖x‖² − 4x₁ − 4x₂ over ‖(x₂, x₃)‖ ≤ x₁ has the solution (4, 4, 0) with multiplier
zero. The error in x of a verified answer may be of the order of the square root of the
error in complementarity.

| solver | largest error in x |
| --- | --- |
"""


def weaknesses_page(results: Mapping[str, Results]) -> str:
    """Return a Markdown page on the results of the checks of equivalent formulations.

    results : results of all checks by solver
    """
    heads = [change for change in CHANGES if change != UNCHANGED]
    lines = [
        *_units(),
        KEY,
        f"| solver | solves | {' | '.join(heads)} |",
        f"| --- | --- |{' --- |' * len(heads)}",
    ]
    for name, checks in results.items():
        solved = [f for f in FORMS if _grade(checks, f, UNCHANGED) is Grade.PASS]
        cells = [
            ", ".join(solved),
            *(_cell(checks, solved, change) for change in heads),
        ]
        lines.append(f"| `{name}` | {' | '.join(cells)} |")
    entries = [*_weaknesses(results), "", *_degenerate(results)]
    return HEAD + "\n".join([*lines, "", "## Evidence", "", *entries]) + "\n"


def line_of(name: str, form: str, change: str) -> str:
    """Return the beginning of the line that describes a weakness of a solver."""
    return f"- `{name}`, {form}, {change}: "


def _degenerate(results: Mapping[str, Results]) -> Iterator[str]:
    """Yield the lines of the section on the degenerate cone."""
    yield from DEGENERATE_HEAD.splitlines()
    for name, checks in results.items():
        result = checks.get(DEGENERATE)
        if result is not None and result.grade is not Grade.DECLINE:
            yield f"| `{name}` | {result.message} |"


def _units() -> Iterator[str]:
    yield "| units | K | displacement | force λ | energy |"
    yield "| --- | --- | --- | --- | --- |"
    for name, (force, length) in UNITS.items():
        factors = (force / length, length, force, force * length)
        yield f"| {name} | {' | '.join(f'{factor:.3g}' for factor in factors)} |"


def _grade(checks: Results, form: str, change: str) -> Grade | None:
    check = checks.get(f"{INVARIANCE_PREFIX}: {form}, {change}")
    return check.grade if check else None


def _cell(checks: Results, solved: list[str], change: str) -> str:
    marks = {Grade.WEAK: "**{}**", Grade.DECLINE: "({})"}
    grades = {f: _grade(checks, f, change) for f in solved if change in changes_of(f)}
    if not grades:
        return ""
    entries = [marks[g].format(f) for f, g in grades.items() if g in marks]
    work = max(
        checks[f"{INVARIANCE_PREFIX}: {f}, {change}"].work or 1.0 for f in grades
    )
    if work >= MIN_LISTED_WORK_RATIO:
        entries.append(f"×{work:.2g}")
    return ", ".join(entries) or "·"


def _weaknesses(results: Mapping[str, Results]) -> Iterator[str]:
    """Yield a line for every weakness, with its evidence."""
    for name, checks in results.items():
        for form in FORMS:
            for change in changes_of(form):
                if _grade(checks, form, change) is Grade.WEAK:
                    message = checks[f"{INVARIANCE_PREFIX}: {form}, {change}"].message
                    yield f"{line_of(name, form, change)}{message}."
