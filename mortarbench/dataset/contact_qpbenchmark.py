"""Test sets of qpbenchmark, read from the npz files beside this file.

``qpbenchmark contact_qpbenchmark.py run --author NAME`` runs the core. The files
``contact_every.py``, ``contact_dense.py``, ``contact_strictly_convex.py`` are further
test sets. Problems with discs, and those without a solution, are left out, because
qpbenchmark cannot state them.
"""

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from qpbenchmark import Problem, TestSet
from scipy.sparse import csc_matrix

FOLDER = Path(__file__).parent


class ContactQpbenchmark(TestSet):
    """The core of the set. Problems are loaded one by one."""

    title = "Contact problems"
    description = "Elastic contact problems with proven optima, of order one."
    sparse_only = False

    def accepts(self, row: dict[str, str]) -> bool:
        """Return True if a problem, a line of the catalogue, is in this set."""
        return row["core"] == "yes"

    def __iter__(self) -> Iterator[Problem]:
        """Yield the problems in the order of the catalogue."""
        with (FOLDER / "catalogue.csv").open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        for row in rows:
            single = row["kind"] == "optimal" and not int(row["discs"] or 0)
            if single and not row["sequence"] and self.accepts(row):
                yield load(FOLDER / row["path"], row["name"])


class ContactEvery(ContactQpbenchmark):
    """All single problems."""

    def accepts(self, row: dict[str, str]) -> bool:
        """Return True."""
        return True


class ContactDense(ContactEvery):
    """Problems with a dense P, which are the duals."""

    def accepts(self, row: dict[str, str]) -> bool:
        """Return True if P is dense."""
        return row["dense"] == "yes"


class ContactStrictlyConvex(ContactEvery):
    """Problems whose P has no eigenvalue that is small by comparison."""

    def accepts(self, row: dict[str, str]) -> bool:
        """Return True if P has full rank."""
        return row["strictly_convex"] == "yes"


def load(path: Path, name: str) -> Problem:
    """Read a problem; absent rows are None, as qpsolvers expects."""
    with np.load(path) as data:
        P, G, A = (
            csc_matrix(
                (data[f"{M}_data"], data[f"{M}_indices"], data[f"{M}_indptr"]),
                shape=data[f"{M}_shape"],
            )
            for M in "PGA"
        )
        q, h, b, lb, ub = (data[v] for v in ("q", "h", "b", "lb", "ub"))
    return Problem(
        P, q, G if h.size else None, h if h.size else None,
        A if b.size else None, b if b.size else None, lb, ub, name,
    )  # fmt: skip
