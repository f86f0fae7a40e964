"""Measure the counts of products in docs/performance.md, and write them into the page.

    python tools/products.py [PATTERN]...     only cases that match a shell pattern

A table is measured if the heading of its first column is ``case``. A cell of this
column begins with a case name in backquotes, in which ``key=1..24`` denotes a sequence
of cases. With several keys of this type, the last key varies fastest. The heading of a
measured column begins with a solver in backquotes (possibly with options ``key=value``)
or with ``best preset``, followed by the tolerance. If the solver reuses earlier results
in a sequence, ``warm`` follows. Other columns are left unchanged.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from dataclasses import replace
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
    solver, tol, mode = match[1], float(match[2]), match[3] or ""
    if solver:
        return _spent(case, solver, tol, mode)
    return min(_spent(case, preset, tol, mode) for preset in PRESETS)


def _spent(sequence: str, text: str, tol: float, mode: str) -> int:
    name, *pairs = text.split()
    options = dict(pair.split("=", 1) for pair in pairs)
    flags = {"true": True, "false": False}
    solver = replace(SOLVERS[name], **{k: flags.get(v, v) for k, v in options.items()})
    chain = solver.chain(tol) if mode else None
    spent = 0
    for case in _cases(sequence):
        solve = chain(case.qp) if chain else solver.prepare(case.qp, tol)
        answer: Solution = solve()
        if not kkt_residuals(case.qp, answer).worst <= VERIFIED_FACTOR * tol:
            raise ValueError(f"{sequence}: {text} is not verified at {tol:g}")
        spent += answer.counts["P_products"]
    return spent


@cache
def _cases(sequence: str) -> tuple[Case, ...]:
    names = [sequence]
    while span := SEQUENCE.search(names[0]):
        values = range(int(span[2]), int(span[3]) + 1)
        names = [
            SEQUENCE.sub(rf"\g<1>={k}", name, count=1) for name in names for k in values
        ]
    return tuple(build(name).family_case for name in names)


if __name__ == "__main__":
    main(sys.argv[1:])
