"""What a solver makes of equivalent formulations of one contact problem.

Two strings pressed together, in each form of
`harness.conformance.manufactured.strings`, are solved as they are and as every change
of `CHANGES` leaves them. Verdict and answer must be the same: of two verified points of
one QP, the objectives differ by what the residuals may be, relative to the energies,
and so does the energy ½‖x − x₀‖²_P of their difference.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np

from mortarbench.harness.conformance.manufactured import strings
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
from mortarbench.harness.qp import QP, Vector
from mortarbench.harness.record import VERIFIED_FACTOR, Verdict
from mortarbench.harness.solution import Solution, Status
from mortarbench.harness.verify.kkt import kkt_residuals, verdict
from mortarbench.harness.verify.measure import measure

TOL = 1e-8
#: of the energies; 10 for what adds up over rows
MAX_ENERGY_CHANGE = 10 * VERIFIED_FACTOR * TOL

#: the beam-ring's load and length, 10⁸ N/m and 2 m, as powers of two: forces are per
#: thickness, so that stiffness is measured in Pa, MPa and GPa
UNITS: Mapping[str, tuple[float, float]] = {
    "N, m": (2.0**27, 2.0**1),
    "N, mm": (2.0**17, 2.0**11),
    "GN, m": (2.0**-3, 2.0**1),
}


class WeaknessError(Exception):
    """What an equivalent formulation changed."""


class DeclinedError(Exception):
    """Why a solver cannot take a QP."""


def same_answer(
    form: str, change: str, solver: Solver, old: Solution | None = None
) -> tuple[int | None, int | None]:
    """Solve the strings in `form` as they are, then as a change leaves them.

    Return the iterations of both, where the solver tells.

    change : a key of `CHANGES`
    old : the answer as they are, where it is known

    Raises
    ------
    DeclinedError
        When the solver declines either, or does not solve them as they are.
    WeaknessError
        When verdict or answer are not the same; with no change: when it fails.

    """
    qp = strings(form)
    old = old or answer(solver, qp)
    before = _fault(qp, old)
    if before and change != UNCHANGED:
        raise DeclinedError(f"not solved as it is: {before}")
    new = CHANGES[change](qp, form)
    s = old if change == UNCHANGED else answer(solver, new.qp)
    if after := _fault(new.qp, s):
        raise WeaknessError(after)
    back = new.recover(s)
    energy = max(_energy(qp, old.x), new.scale * _energy(new.qp, s.x))
    by = back.x - old.x
    _compare("objective", abs(qp.objective(back.x) - qp.objective(old.x)) / energy)
    _compare("½‖x − x₀‖²_P", 0.5 * float(by @ (qp.P @ by)) / energy)
    return old.iterations, s.iterations


def answer(solver: Solver, qp: QP) -> Solution:
    """Solve; DeclinedError where that is declined."""
    s = measure(solver, qp, TOL).solution
    if s.status is Status.DECLINED:
        raise DeclinedError(s.message)
    return s


def _fault(qp: QP, s: Solution) -> str:
    """Say, with the evidence, what is not as good as claimed; empty: nothing."""
    residuals = kkt_residuals(qp, s)
    judged = verdict(s.status, residuals, TOL)
    if s.status is Status.SOLVED and judged is Verdict.VERIFIED:
        return ""
    words = f" ({s.message})" if s.message else ""
    if np.isnan(residuals.worst):
        return f"ended as {s.status}{words}"
    name, worst = max(residuals._asdict().items(), key=lambda item: item[1])
    ended = f"ended as {s.status}{words}"
    return f"{ended}, {judged}: {name} residual {worst:.1e} at tol {TOL:g}"


def _energy(qp: QP, x: Vector) -> float:
    return float(max(abs(x @ (qp.P @ x)), abs(qp.q @ x)))


def _compare(what: str, by: float) -> None:
    if not by <= MAX_ENERGY_CHANGE:
        raise WeaknessError(
            f"verified, but {what} changed by {by:.1e} of the energy; "
            f"{MAX_ENERGY_CHANGE:g} is ok"
        )


def _units(name: str, qp: QP, form: str) -> Equivalent:
    force, length = UNITS[name]
    unit = length if form == "primal" else force  # of x, a displacement or a force
    return change_units(qp, unknown=1 / unit, objective=force * length)


def _order(count: int) -> Order:
    return np.random.default_rng(141421).permutation(count)


def _rows_scaled(qp: QP, form: str) -> Equivalent:
    """By factors from a thousandth to a thousand."""
    exponents = np.random.default_rng(173205).integers(-10, 11, qp.b.size + qp.h.size)
    return scale_rows(qp, *np.split(2.0**exponents, [qp.b.size]))


#: of a shift: half of what the largest contact force, or deflection, is about
_SHIFTS = {"primal": 2.0**-5, "dual": 2.0**-7, "dual-bounds": 2.0**-7}

Change = Callable[[QP, str], Equivalent]  #: of the strings in a form

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
    # what was pushed down is pushed up, and λ ≥ 0 becomes λ ≤ 0
    "mirrored": lambda qp, _: mirror(qp, np.arange(qp.q.size)),
}

_ROWS = {
    "primal": ("rows", "equality rows", "inequality rows"),
    "dual": ("rows", "equality rows"),
    "dual-bounds": (),
}


def changes_of(form: str) -> list[str]:
    """Name the changes that are any in this form; one without rows has none to scale.

    The first is none.
    """
    return [
        name for name in CHANGES
        if "rows" not in name or any(name.startswith(f"{r} ") for r in _ROWS[form])
    ]  # fmt: skip
