"""Test sets of qpbenchmark, read from the npz files beside this file.

``qpbenchmark contact_qpbenchmark.py run --author NAME`` runs the core, and
``contact_every.py`` all problems. Problems with discs, and those without a solution,
are left out, because qpbenchmark cannot state them.
"""

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from qpbenchmark import Problem, TestSet
from scipy.sparse import csc_matrix

FOLDER = Path(__file__).parent
PARTS = ("data", "indices", "indptr")  #: arrays of a sparse matrix


class ContactQpbenchmark(TestSet):
    """The core of the set. Problems are loaded one by one."""

    title = "Contact problems"
    description = "Elastic contact problems with proven optima, of order one."
    sparse_only = False
    #: entries of members in the column ``core`` of the catalogue
    members: tuple[str, ...] = ("yes",)

    def __iter__(self) -> Iterator[Problem]:
        """Yield the problems in the order of the catalogue."""
        with (FOLDER / "catalogue.csv").open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        for row in rows:
            has_optimum = row["kind"] == "optimal" and row["discs"] == "0"
            if has_optimum and row["core"] in self.members and not row["sequence"]:
                yield load(FOLDER / row["path"], row["name"])


class ContactEvery(ContactQpbenchmark):
    """All single problems."""

    members = ("yes", "no")


def load(path: Path, name: str) -> Problem:
    """Read a problem; absent rows are None, as qpsolvers expects."""
    with np.load(path) as data:
        P, G, A = (
            csc_matrix(tuple(data[f"{M}_{k}"] for k in PARTS), shape=data[f"{M}_shape"])
            for M in "PGA"
        )
        q, h, b, lb, ub = (data[v] for v in ("q", "h", "b", "lb", "ub"))
    rows = [v if h.size else None for v in (G, h)]
    rows += [v if b.size else None for v in (A, b)]
    return Problem(P, q, *rows, lb, ub, name)
