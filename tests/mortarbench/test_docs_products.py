"""Numbers of products in the documents agree with runs."""

import re
import sys

import pytest

from tests.support import ROOT

sys.path.append(str(ROOT / "tools"))
import products  # tools/products.py, which writes the tables

LINES = products.PAGE.read_text("utf-8").splitlines()
#: cases that take a fraction of a second
SHORT = re.compile(
    r"beam-ring/Nr=4/.*step=\d+/|greco/n=16/|membranes/S=[12]/n=[48]/|string/n=100/"
)
CELLS = [
    pytest.param(
        case, head, int(LINES[index].split("|")[column]),
        id=f"{case} {head}", marks=() if SHORT.match(case) else pytest.mark.slow,
    )
    for index, case, column, head in products.cells(LINES)
]  # fmt: skip


def test_the_page_has_measured_tables_of_every_kind():
    modes = {products.HEAD.fullmatch(cell.values[1])[3] for cell in CELLS}

    assert modes == {None, "warm"}
    assert len(CELLS) >= 60
    assert sum(not cell.marks for cell in CELLS) >= 15


@pytest.mark.parametrize(("case", "head", "shown"), CELLS)
def test_a_count_is_the_one_shown(case, head, shown):
    """Rounding changes counts of `smalbe` by one, and those of the presets by a half,
    as the page states.
    """
    count = products.products(case, head)

    if head.startswith("`smalbe`"):
        assert abs(count - shown) <= 1
    else:
        assert shown / 1.5 <= count <= 1.5 * shown


def test_smalbe_needs_fewer_products_than_permon_on_the_benchmark():
    """The sentence above the first table agrees with the table."""
    rows = [line.split("|") for line in LINES if line.startswith("| `beam-ring/")][:10]

    assert len(rows) == 10
    for row in rows:
        permon, smalbe = (int(row[2]), int(row[5])), (int(row[3]), int(row[6]))
        assert smalbe[0] <= 0.52 * permon[0]
        assert smalbe[1] <= 0.52 * permon[1]
