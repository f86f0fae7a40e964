"""Measure the counts of products in docs/performance.md, and write them into the page.

    python tools/products.py [PATTERN]...     only cases that match a shell pattern

A table is measured if the heading of its first column is ``case``. A cell of this
column begins with a case name in backquotes, in which ``key=1..24`` denotes a sequence
of cases. The heading of a measured column begins with a solver in backquotes or with
``best preset``, followed by the tolerance. If the solver reuses earlier results
in a sequence, ``warm`` follows. Other columns are left unchanged.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from fnmatch import fnmatch
from functools import cache
from pathlib import Path

from mortarbench.case import build
from mortarbench.harness import Case, Solution
from mortarbench.harness.record import VERIFIED_FACTOR
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.solvers import SOLVERS

PAGE = Path(__file__).parents[1] / "docs" / "performance.md"
PRESETS = ("smalbe-permon", "smalbe-espreso")
HEAD = re.compile(r"(?:`([^`]+)`|best preset) (1e-\d+)(?: (warm))?")
CASE = re.compile(r"`([\w-]+/[^`]*)`")
SEQUENCE = re.compile(r"(\w+)=(\d+)\.\.(\d+)")


def main(patterns: list[str]) -> None:
    """Measure the cells of the page, and write each result into the page."""
    lines = PAGE.read_text("utf-8").splitlines()
    for index, case, column, head in cells(lines):
        if not patterns or any(fnmatch(case, pattern) for pattern in patterns):
            row = lines[index].split("|")
            row[column] = f" {products(case, head)} "
            lines[index] = "|".join(row)
            PAGE.write_text("\n".join(lines) + "\n", "utf-8")
            print(case, head, row[column], flush=True)


def cells(lines: list[str]) -> Iterator[tuple[int, str, int, str]]:
    """Yield line index, case, column index and heading of each cell to measure."""
    heads: list[str] = []
    for index, line in enumerate(lines):
        row = [cell.strip() for cell in line.split("|")]
        if not line.startswith("|"):
            heads = []
        elif not heads:
            heads = row if row[1] == "case" else [""]
        elif name := CASE.match(row[1] if len(row) > 1 else ""):
            for column, head in enumerate(heads):
                if HEAD.fullmatch(head) and row[column]:
                    yield index, name[1], column, head


def products(case: str, head: str) -> int:
    """Return the total number of products with P for a case or sequence.

    case : name of a case or of a sequence
    head : heading of a column

    Raises
    ------
    ValueError
        If an answer is not verified.

    """
    match = HEAD.fullmatch(head)
    assert match is not None
    tol, warm = float(match[2]), match[3] is not None
    names = [match[1]] if match[1] else PRESETS
    return min(_products(case, name, tol, warm) for name in names)


def _products(sequence: str, name: str, tol: float, warm: bool) -> int:
    solver, spent = SOLVERS[name], 0
    chain = solver.chain(tol) if warm else None
    for case in _cases(sequence):
        solve = chain(case.qp) if chain else solver.prepare(case.qp, tol)
        answer: Solution = solve()
        if not kkt_residuals(case.qp, answer).worst <= VERIFIED_FACTOR * tol:
            raise ValueError(f"{sequence}: {name} is not verified at {tol:g}")
        spent += answer.counts["P_products"]
    return spent


@cache
def _cases(sequence: str) -> tuple[Case, ...]:
    span = SEQUENCE.search(sequence)
    if span is None:
        return (build(sequence).family_case,)
    key, first, last = span.groups()
    names = (
        SEQUENCE.sub(f"{key}={k}", sequence) for k in range(int(first), int(last) + 1)
    )
    return tuple(build(name).family_case for name in names)


if __name__ == "__main__":
    main(sys.argv[1:])
