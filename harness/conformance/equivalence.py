"""Invariance of a solver's answer under equivalent formulations of a contact problem.

The problem of two strings in contact (`harness.conformance.manufactured.strings`) is
solved in each form. The QP is solved unchanged and after each of the `CHANGES`, which
yield equivalent QPs. The verdicts must be equal. Verified answers are then equal as
well: their residuals bound the energy ½‖x − x₀‖²_P of the difference, where x is the
answer to the changed QP, mapped to the unchanged QP with the answer x₀.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np

from mortarbench.harness.conformance.manufactured import FORMS, strings
from mortarbench.harness.conformance.metamorphic import (
    Equivalent,
    Order,
    change_units,
    duplicate_rows,
    mirror,
    permute_rows,
    permute_unknowns,
    scale_rows,
    shift_unknowns,
)
from mortarbench.harness.plugin import Solver
from mortarbench.harness.qp import QP
from mortarbench.harness.record import Verdict
from mortarbench.harness.solution import Solution, Status
from mortarbench.harness.verify.kkt import kkt_residuals, verdict
from mortarbench.harness.verify.measure import DeclinedError, solve_once

TOL = 1e-8  #: tolerance of all solves of the strings

#: Load (10⁸ N/m) and length (2 m) of beam-ring, expressed in each system of units and
#: rounded to powers of two. Forces are per unit thickness, so that the unit of
#: stiffness is Pa, MPa or GPa.
UNITS: Mapping[str, tuple[float, float]] = {
    "N, m": (2.0**27, 2.0**1),
    "N, mm": (2.0**17, 2.0**11),
    "GN, m": (2.0**-3, 2.0**1),
}


class WeaknessError(Exception):
    """Error for a verdict that changes under an equivalent formulation."""


def same_verdict(
    form: str, change: str, solver: Solver
) -> tuple[int | None, int | None]:
    """Solve the unchanged and the changed string problem, and compare the verdicts.

    change : a key of `CHANGES`

    Returns
    -------
    numbers of iterations of both solves, each None if the solver does not report it

    Raises
    ------
    DeclinedError
        If the solver declines one of the QPs, or, for a change other than `UNCHANGED`,
        if its answer to the unchanged QP is not verified.
    SolverError
        If the solver raises an exception.
    WeaknessError
        If the answer to the changed QP is not verified.

    """
    qp = strings(form)
    old, _ = solve_once(solver, qp, TOL)
    before = _fault(qp, old)
    if before and change != UNCHANGED:
        raise DeclinedError(f"not solved without the change: {before}")
    new = CHANGES[change](qp, form)
    s = old if change == UNCHANGED else solve_once(solver, new.qp, TOL)[0]
    if after := _fault(new.qp, s):
        raise WeaknessError(after)
    return old.iterations, s.iterations


def _fault(qp: QP, s: Solution) -> str:
    """Return the reason why an answer is not a verified claim of success, or ""."""
    residuals = kkt_residuals(qp, s)
    judged = verdict(s.status, residuals, TOL)
    if s.status is Status.SOLVED and judged is Verdict.VERIFIED:
        return ""
    end = f"ended as {s.status}" + (f" ({s.message})" if s.message else "")
    if np.isnan(residuals.worst):
        return end
    name, worst = max(residuals._asdict().items(), key=lambda item: item[1])
    return f"{end}, {judged}: {name} residual {worst:.1e} at tol {TOL:g}"


def _units(name: str, qp: QP, form: str) -> Equivalent:
    force, length = UNITS[name]
    # x is a displacement in the primal form and a force in dual forms
    unit = length if form == "primal" else force
    return change_units(qp, unknown=1 / unit, objective=force * length)


def _order(count: int) -> Order:
    return np.random.default_rng(141421).permutation(count)


def _rows_scaled(qp: QP, form: str) -> Equivalent:
    """Scale each row by a random power of two between 2⁻¹⁰ and 2¹⁰."""
    exponents = np.random.default_rng(173205).integers(-10, 11, qp.b.size + qp.h.size)
    return scale_rows(qp, *np.split(2.0**exponents, [qp.b.size]))


#: Shift of the unknowns in each form, about half of the largest deflection or force.
_SHIFTS = {"primal": 2.0**-5, "dual": 2.0**-7, "dual-bounds": 2.0**-7}

#: Function that maps the QP of the strings and its form to an equivalent QP.
Change = Callable[[QP, str], Equivalent]

UNCHANGED = "as it is"

CHANGES: Mapping[str, Change] = {
    UNCHANGED: lambda qp, form: Equivalent(qp, lambda s: s),
    **{f"units {name}": partial(_units, name) for name in UNITS},
    "unknowns permuted": lambda qp, _: permute_unknowns(qp, _order(qp.q.size)),
    "rows permuted": lambda qp, _: permute_rows(
        qp, _order(qp.b.size)[::-1], _order(qp.h.size)
    ),
    "rows scaled": _rows_scaled,
    "equality rows twice": lambda qp, _: duplicate_rows(
        qp, np.arange(qp.b.size), np.arange(0)
    ),
    "inequality rows twice": lambda qp, _: duplicate_rows(
        qp, np.arange(0), np.arange(qp.h.size)
    ),
    "unknowns shifted": lambda qp, form: shift_unknowns(
        qp, np.full(qp.q.size, _SHIFTS[form])
    ),
    # reverse the signs of all unknowns: the load acts upwards, and λ ≥ 0 becomes λ ≤ 0
    "mirrored": lambda qp, _: mirror(qp, np.arange(qp.q.size)),
}

_ROWS = {
    "primal": ("rows", "equality rows", "inequality rows"),
    "dual": ("rows", "equality rows"),
    "dual-bounds": (),
}
#: Names of the changes that apply to each form, `UNCHANGED` first: a change of equality
#: or inequality rows applies only to forms with such rows.
CHANGES_OF: Mapping[str, list[str]] = {
    form: [
        name
        for name in CHANGES
        if "rows" not in name or any(name.startswith(f"{r} ") for r in _ROWS[form])
    ]
    for form in FORMS
}
