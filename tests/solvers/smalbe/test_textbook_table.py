"""The table of the book's steps in docs/smalbe.md names functions and lines of code."""

import re

import pytest

from tests.support import ROOT

SOURCES = ROOT / "solvers" / "smalbe"
CELL = re.compile(r"`(\w+)` `([\w.]+):(\d+)`")
#: first line of a function in Python or Cython
FUNCTION = re.compile(r"\s*(?:def|cp?def\s[^=(]*?)\s*\b(\w+)\(")
PAGE = (ROOT / "docs" / "smalbe.md").read_text("utf-8")
ROWS = [
    (row.split("`")[1], *place)
    for row in PAGE.partition("| step or constant |")[2].splitlines()
    for place in CELL.findall(row)
]


@pytest.mark.parametrize("files", [("textbook.py",), ("outer.pxi", "mprgp.pxi")])
def test_the_table_contains_every_step(files):
    steps = [marker for marker, *_, file, _ in ROWS if file in files]
    steps = [marker for marker in steps if marker.startswith("Step")]

    assert steps == [f"Step {k}" for k in (*range(5), *range(6))]


@pytest.mark.parametrize(("marker", "function", "file", "line"), ROWS)
def test_a_line_contains_its_step(marker, function, file, line):
    lines = (SOURCES / file).read_text("utf-8").splitlines()
    before = filter(None, map(FUNCTION.match, lines[: int(line)]))

    assert [name[1] for name in before][-1] == function
    assert marker in lines[int(line) - 1], [
        k for k, text in enumerate(lines, 1) if marker in text
    ]
