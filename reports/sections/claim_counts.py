"""Claims beside verdicts, counted: whom one may believe."""

from __future__ import annotations

from collections import Counter, defaultdict

from harness import Verdict
from reports.data.evidence import Evidence
from reports.document.formatting import ABSENT
from reports.document.layout import Cell, Section, Table, name_cell
from reports.statistics.profiles import share

#: (claimed to be solved, verified) and what that is called
KINDS = {
    (True, True): "claimed, verified",
    (True, False): "claimed, refuted",
    (False, True): "verified, not claimed",
    (False, False): "neither",
}


def claim_counts(evidence: Evidence) -> Section:
    """Count, for every solver, what it claimed and what was found."""
    count: dict[str, Counter[tuple[bool, bool]]] = defaultdict(Counter)
    for o in evidence.flat:
        if o.verdict is not Verdict.DECLINED:
            count[o.solver][o.claims == ("solved",), o.verified] += 1
    return Section(
        name="tally",
        title="Claims and verdicts, counted",
        prose=(
            "Answers, one per case and tolerance, by what the solver said of them and "
            "what we found; of several repeats, all have to be claimed to be solved, "
            "and all to be verified. Claims that hold: the share of such claims that "
            "were verified, with its 95 % interval (Clopper and Pearson).",
        ),
        tables=(
            Table(
                caption="Claims beside verdicts.",
                columns=("solver", *KINDS.values(), "claims that hold"),
                rows=tuple(_row(s, count[s]) for s in evidence.solvers),
            ),
        ),
    )


def _row(solver: str, count: Counter[tuple[bool, bool]]) -> tuple[Cell, ...]:
    cells = [
        Cell(
            text=str(count[kind]),
            value=count[kind],
            kind="over" if count[kind] and kind == (True, False) else "",
        )
        for kind in KINDS
    ]
    held, claimed = count[True, True], count[True, True] + count[True, False]
    if not claimed:
        return (name_cell(solver), *cells, Cell(text=ABSENT))
    value, low, high = (float(part) for part in share(held, claimed))
    text = f"{value:.2f} [{low:.2f}, {high:.2f}]"
    return (name_cell(solver), *cells, Cell(text=text, value=value))
