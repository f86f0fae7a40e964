"""Iteration histories shown in a report, and quantities derived from them."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import InputError, Record, Vector
from mortarbench.harness.files.store import load_history
from mortarbench.harness.solution import History
from mortarbench.reports.data.evidence import Evidence, Outcome

MOST = 4  #: maximum number of cases that are drawn

#: description of the selection rule of `chosen`, printed in reports
RULE = (
    "For each family and form, the largest case with a stored history is drawn, at "
    "its last load step and tightest tolerance, with all solvers that stored a "
    f"history; at most the {MOST} largest of these cases are shown."
)


@dataclass(frozen=True, eq=False, kw_only=True)
class SolverRun:
    """History that one solver reported on one case, as columns of equal length."""

    outcome: Outcome
    record: Record  #: the repeat with this history
    history: History  #: history with at least one row

    @property
    def rows(self) -> int:
        """Number of rows."""
        return int(next(iter(self.history.values())).size)

    def numbers(self, name: str) -> Vector | None:
        """Return a column (rows,), NaN where not finite; None if no value is finite."""
        values = self.history.get(name, np.zeros(0))
        if values.dtype.kind not in "if" or not np.isfinite(values).any():
            return None
        return np.where(np.isfinite(values), values, np.nan)

    @cached_property
    def products(self) -> Vector | None:
        """(rows,) cumulative number of products with P; None unless all are known."""
        values = self.numbers("products")
        return values if values is not None and np.isfinite(values).all() else None

    @cached_property
    def gradient(self) -> Vector | None:
        """(rows,) norm of the projected gradient relative to its first positive value.

        The norm is √(‖φ‖² + ‖β‖²), with the free gradient φ and the chopped gradient β.
        None if the gradients are not recorded or always zero.
        """
        phi, beta = self.numbers("free_gradient"), self.numbers("chopped_gradient")
        if phi is None or beta is None:
            return None
        norm = np.hypot(phi, beta)
        positive = norm[norm > 0]
        return norm / positive[0] if positive.size else None

    @cached_property
    def infeasibility(self) -> Vector | None:
        """(rows,) relative norm of Ax − b; None if it is missing or never positive."""
        values = self.numbers("infeasibility")
        return values if values is not None and (values > 0).any() else None

    @property
    def two_sided(self) -> Vector | None:
        """(rows,) number of active components with two bounds; None if not recorded.

        In a dual with friction, this is the number of slipping rows.
        """
        return self.numbers("two_sided")

    def steps(self, kind: str) -> NDArray[np.bool_]:
        """Return a mask (rows,) of the steps of one type."""
        kinds = self.history.get("step", np.full(self.rows, ""))
        return np.asarray(kinds.astype(str) == kind, dtype=bool)

    @cached_property
    def outer_ends(self) -> NDArray[np.bool_]:
        """(rows,) True where an outer iteration ends; False if there is only one."""
        outer = self.numbers("outer")
        if outer is None or np.all(outer == outer[0]):
            return np.zeros(self.rows, dtype=bool)
        return np.append(outer[1:] != outer[:-1], True)


@dataclass(frozen=True, eq=False, kw_only=True)
class CaseHistories:
    """Histories on one case at one tolerance, with a common measure of work."""

    runs: tuple[SolverRun, ...]  #: runs in the order of the suite; at least one
    solvers: tuple[str, ...]  #: all solvers of the report, which fixes their colours

    @property
    def counted(self) -> bool:
        """True if work is counted in products with P; False if in iterations."""
        return all(c.products is not None for c in self.runs)

    def work(self, run: SolverRun) -> Vector:
        """Return the work (rows,): products with P, or iterations counted from one."""
        products = run.products if self.counted else None
        return np.arange(1.0, run.rows + 1) if products is None else products

    def taken(self, kind: str) -> bool:
        """Return whether any run contains a step of this type."""
        return any(c.steps(kind).any() for c in self.runs)


def chosen(evidence: Evidence) -> list[CaseHistories]:
    """Select the cases to draw by `RULE`."""
    ordered = sorted(evidence.outcomes.values(), key=_importance, reverse=True)
    selected: dict[tuple[str, str], CaseHistories] = {}
    for row in ordered:
        one = next(iter(row.values())).first
        key = (one.family, one.form)
        if len(selected) == MOST:
            break
        if key not in selected and (runs := tuple(_runs(evidence, row))):
            selected[key] = CaseHistories(runs=runs, solvers=evidence.solvers)
    return list(selected.values())


def unread(evidence: Evidence) -> list[str]:
    """Return error messages for stored histories that cannot be read."""
    lost = []
    for outcome in evidence.flat:
        for record in outcome.records:
            if record.vectors and record.options.get("history") is True:
                try:
                    load_history(evidence.directory, record.vectors)
                except InputError as e:
                    lost.append(str(e).removeprefix(f"{evidence.directory}{os.sep}"))
    return lost


def _runs(evidence: Evidence, row: Mapping[str, Outcome]) -> Iterator[SolverRun]:
    """Yield the first readable history of each solver."""
    for outcome in row.values():
        for record in outcome.records:
            history: History = {}
            if record.vectors is not None:
                with suppress(
                    InputError
                ):  # vectors/ may be missing: a report needs only the journal
                    history = load_history(evidence.directory, record.vectors)
            if history and next(iter(history.values())).size:
                yield SolverRun(outcome=outcome, record=record, history=history)
                break


def _importance(row: Mapping[str, Outcome]) -> tuple[float, float, float, str]:
    """Return a sort key: size, then load step, then accuracy; names break ties."""
    one = next(iter(row.values())).first
    step = one.params.get("step", 0)
    size = max(float(o.first.sizes.get("variables", 0)) for o in row.values())
    last = float(step) if isinstance(step, int | float) else 0.0
    return (size, last, -one.tol, one.case)
