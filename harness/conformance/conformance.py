"""Checks of the contract of solvers, run by ``mortarbench test-solver``.

The name of each check is a statement about the solver. A check passes, or it fails with
a description of the violation, which may be an exception. If the solver declines the
QP, the check counts as declined, and the result contains the reason that the solver
states. If the answer changes under an equivalent formulation of the QP, the check
reports a weakness. Such a change is not a failure, since many otherwise correct solvers
would fail.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from enum import StrEnum
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.sparse.linalg import aslinearoperator

from mortarbench.harness.conformance.manufactured import (
    SET_SHAPES,
    SHAPES,
    infeasible,
    manufactured,
    manufactured_over_sets,
    membrane,
    one_of_each,
    unbounded,
)
from mortarbench.harness.conformance.metamorphic import CHANGES, shift_unknowns
from mortarbench.harness.plugin import Solver
from mortarbench.harness.qp import QP, Vector
from mortarbench.harness.record import VERIFIED_FACTOR
from mortarbench.harness.solution import Solution, Status
from mortarbench.harness.verify.kkt import diagnosis, kkt_residuals
from mortarbench.harness.verify.measure import (
    DeclinedError,
    Prepare,
    SolverError,
    measure,
    solve_once,
)

#: beginning of the names of checks that compare the answer with a planted solution
SOLUTION_PREFIX = "finds the planted solution"
#: beginning of the names of checks that compare equivalent formulations
INVARIANCE_PREFIX = "keeps its answer"
#: shapes for checks of a property that does not depend on the constraints: QPs with
#: lower bounds alone, which every solver should accept, and QPs with all constraints
ACCEPTED_BY_MOST = ("bounds", "everything")
#: shapes of the QPs that are formulated in equivalent ways, with their kinds of rows;
#: the constraints of the last two are those of duals of contact problems
INVARIANT_SHAPES = {
    "everything": ("rows", "equality", "inequality"),
    "some bounds": ("rows", "equality"),
    "bounds": (),
}
#: Largest permitted difference in x between repeats. The order of summation, and hence
#: rounding, may depend on the alignment of arrays in memory.
REPEAT_ROUNDING = 1e-12
#: Seed of a QP in which all bounds and right-hand sides exceed 0.3. Violations are
#: judged relative to these sizes, but most solvers compare them with the largest size.
MODERATE_SEED = 31
#: Number of variables of the QP of the check of remembered answers. Solvers take
#: milliseconds, so that a cache is noticed in the times.
TIMED_VARIABLES = 300


class Grade(StrEnum):
    """Outcome of a check."""

    PASS = "pass"
    DECLINE = "decline"  #: the solver declines the QP
    WEAK = "weak"  #: a weakness, which does not violate the contract
    FAIL = "fail"


class Result(NamedTuple):
    """Result of a check: the grade, and a reason or a remark."""

    grade: Grade
    message: str = ""


class ContractError(Exception):
    """Violation of the contract by a solver."""


#: Function that checks a solver. If the check passes, the function returns a result, or
#: None if there is no remark. Otherwise, the function raises ContractError or
#: DeclinedError.
Check = Callable[[Solver], Result | None]


def run_check(name: str, solver: Solver) -> Result:
    """Run the check with this name in `CHECKS`, and return its result."""
    try:
        return CHECKS[name](solver) or Result(Grade.PASS)
    except (ContractError, SolverError) as e:
        return Result(Grade.FAIL, str(e))
    except DeclinedError as e:
        return Result(Grade.DECLINE, str(e))


def _solve(solver: Solver, qp: QP, tol: float) -> Solution:
    """Solve as in a measurement; raise if the solver declines or fails without x."""
    s, _ = solve_once(solver, qp, tol)
    if s.status is Status.FAILED and np.isnan(s.x).any():
        raise ContractError(f"ended as {s.status}: {s.message or 'no message'}")
    return s


def _solved(solver: Solver, qp: QP, tol: float, factor: float) -> Solution:
    """Solve, and require a claim of success with residuals of at most `factor`·tol."""
    s = _solve(solver, qp, tol)
    _judge(qp, s, factor * tol)
    return s


def _judge(qp: QP, s: Solution, allowed: float) -> None:
    if s.status is not Status.SOLVED:
        raise ContractError(f"ended as {s.status}: {s.message or 'no message'}")
    residuals = kkt_residuals(qp, s)
    if not residuals.worst <= allowed:
        values = ", ".join(f"{k} {v:.1e}" for k, v in residuals._asdict().items())
        raise ContractError(
            f"claimed solved, but {diagnosis(qp, s, allowed / VERIFIED_FACTOR)} "
            f"(residuals: {values}; expected at most {allowed:g})"
        )


def _finds_the_planted_solution(shape: str, solver: Solver) -> None:
    qp, expected = manufactured(shape)
    # judged at 1e-8: a bound may be far smaller than the norms in a solver's own test
    s = _solved(solver, qp, 1e-9, 10 * VERIFIED_FACTOR)
    objective = qp.objective(expected.x)
    _near("objective", qp.objective(s.x), objective, 1e-6 * abs(objective))
    if shape != "singular":
        _near("x", s.x, expected.x, 1e-6)


def _solves_over_sets(shape: str, solver: Solver) -> Result:
    """Require a relative error of at most 1e-8 in the objective; report the error in x.

    The eigenvalues of P exceed 0.1, so that an error δ in x increases the objective f
    by at least 0.05 δ². The permitted error in f therefore permits an error in x of up
    to √(20·1e-8·|f|). Errors of this size occur with interior-point methods.
    """
    qp, expected = manufactured_over_sets(shape)
    s = _solved(solver, qp, 1e-9, VERIFIED_FACTOR)
    objective = qp.objective(expected.x)
    allowed = 1e-8 * abs(objective)
    _near("objective", qp.objective(s.x), objective, allowed)
    _near("x", s.x, expected.x, np.sqrt(20 * allowed))
    return Result(Grade.PASS, f"error in x {np.abs(s.x - expected.x).max():.0e}")


def _reaches_the_tolerance(shape: str, solver: Solver) -> None:
    for tol in (1e-3, 1e-6):
        qp, _ = manufactured(shape, seed=MODERATE_SEED)
        _solved(solver, qp, tol, VERIFIED_FACTOR)


def _multipliers_have_our_signs(solver: Solver) -> None:
    qp, expected = one_of_each()
    s = _solve(solver, qp, 1e-9)
    for name, value in expected.items():
        _near(name, getattr(s, name), value, 1e-6)


def _repeats_are_cold_and_alike(solver: Solver) -> None:
    qp, _ = manufactured("bounds", seed=MODERATE_SEED)
    first, *others = (_solved(solver, qp, 1e-6, VERIFIED_FACTOR) for _ in range(3))
    for s in others:
        if s.iterations != first.iterations:
            raise ContractError(f"iterations: {first.iterations}, then {s.iterations}")
        _near("x of a repeat", s.x, first.x, REPEAT_ROUNDING)


def _dense_matrices_are_taken(shape: str, solver: Solver) -> None:
    qp, _ = manufactured(shape, seed=MODERATE_SEED, dense=True)
    _solved(solver, qp, 1e-6, VERIFIED_FACTOR)


def _a_misspelt_option_is_refused(solver: Solver) -> None:
    try:
        type(solver)(**{"no_such_option": 1})
    except TypeError:
        return
    raise ContractError("accepts any option; expected TypeError for no_such_option")


def _claims_no_success(problem: Callable[[], QP], solver: Solver) -> Result:
    s, _ = solve_once(solver, problem(), 1e-9)
    if s.status is Status.SOLVED:
        raise ContractError("claims to have solved a QP without a solution")
    if not s.message:
        raise ContractError(f"ended as {s.status} without a message; expected a reason")
    return Result(Grade.PASS, f"ended as {s.status}: {s.message}")


def _an_operator_is_taken_or_declined(solver: Solver) -> None:
    qp, _ = manufactured("bounds")
    _solved(solver, replace(qp, P=aslinearoperator(qp.P)), 1e-6, VERIFIED_FACTOR)


def _many_bounds_and_no_rows(solver: Solver) -> None:
    """Require a correct solution of a QP without rows, which has only bounds.

    Some solvers claim that their first iterate is optimal if a QP has no rows.
    """
    _solved(solver, membrane(20), 1e-6, VERIFIED_FACTOR)


def _a_sequence_is_solved(solver: Solver) -> None:
    """Require correct solutions of the QPs of `_sequence`, solved as a sequence."""
    chain = getattr(solver, "chain", None)
    if chain is None:
        raise DeclinedError("has no chain()")
    prepare: Prepare = chain(1e-6)
    for i, qp in enumerate(_sequence()):
        try:
            s, _ = solve_once(solver, qp, 1e-6, prepare)
            _judge(qp, s, VERIFIED_FACTOR * 1e-6)
        except (ContractError, SolverError) as e:
            raise ContractError(f"QP {i + 1} of the sequence: {e}") from None


def _remembers_no_answer(solver: Solver) -> None:
    qp, _ = manufactured("bounds", n=TIMED_VARIABLES)
    timed = measure(solver, qp, 1e-6)
    status, message = timed.solution.status, timed.solution.message
    if status is Status.DECLINED:
        raise DeclinedError(message)
    if status is not Status.SOLVED:
        raise ContractError(f"ended as {status}: {message}")
    if timed.cost.get("remembered"):
        raise ContractError(
            "solves of a QP are much faster than solves of a slightly different one, "
            "or have the same answer; expected no results of earlier solves"
        )


def _sequence() -> list[QP]:
    qp, point = manufactured("everything", seed=MODERATE_SEED)
    # a translation of the solution and of all constraints does not change the active
    # set
    shift = 0.1 * np.cos(np.arange(qp.q.size))
    moved = shift_unknowns(qp, -shift)
    softer = replace(qp, P=qp.P * 0.5, q=qp.q + 0.5 * (qp.P @ point.x))
    smaller, _ = manufactured("bounds", n=12)
    return [qp, moved, softer, smaller]


def _keeps_its_answer(shape: str, change: str, solver: Solver) -> Result:
    """Require verified answers to a QP and to an equivalent QP.

    The residuals of a verified answer bound its error, so the answers are equal, too.
    """
    qp, _ = manufactured(shape, seed=MODERATE_SEED)
    try:
        before = _solved(solver, qp, 1e-8, VERIFIED_FACTOR)
    except ContractError as e:
        raise DeclinedError(f"not solved without the change: {e}") from None
    try:
        after = _solved(solver, CHANGES[change](qp), 1e-8, VERIFIED_FACTOR)
    except ContractError as e:
        return Result(Grade.WEAK, str(e))
    counts = after.iterations, before.iterations
    return Result(Grade.PASS, "{} iterations, {} without the change".format(*counts))


def _near(
    name: str, value: Vector | float, expected: Vector | float, tol: float
) -> None:
    """Require ‖value − expected‖∞ ≤ tol; a value of NaN does not pass."""
    error = float(np.max(np.abs(np.subtract(value, expected)), initial=0.0))
    if not error <= tol:
        raise ContractError(
            f"{name} differs from the expected value by {error:.1e}; expected at most "
            f"{tol:.1e}"
        )


#: The properties of a solver, by name.
CHECKS: Mapping[str, Check] = {
    **{
        f"{SOLUTION_PREFIX}: {shape}": partial(_finds_the_planted_solution, shape)
        for shape in SHAPES
    },
    **{
        f"solves over {shape}": partial(_solves_over_sets, shape)
        for shape in SET_SHAPES
    },
    **{
        f"{name}: {shape}": partial(check, shape)
        for name, check in (
            ("reaches the tolerance", _reaches_the_tolerance),
            ("takes dense matrices", _dense_matrices_are_taken),
        )
        for shape in ACCEPTED_BY_MOST
    },
    "finds where a membrane of 400 nodes touches": _many_bounds_and_no_rows,
    "gives multipliers our signs": _multipliers_have_our_signs,
    "starts every repeat cold, same answer": _repeats_are_cold_and_alike,
    "remembers no answer": _remembers_no_answer,
    "refuses a misspelt option": _a_misspelt_option_is_refused,
    "claims no success: infeasible": partial(_claims_no_success, infeasible),
    "claims no success: unbounded": partial(_claims_no_success, unbounded),
    "takes or declines an operator": _an_operator_is_taken_or_declined,
    "solves a sequence": _a_sequence_is_solved,
    **{
        f"{INVARIANCE_PREFIX}: {shape}, {change}": partial(
            _keeps_its_answer, shape, change
        )
        for shape, rows in INVARIANT_SHAPES.items()
        for change in CHANGES
        if "rows" not in change or change.partition(" ")[0] in rows
    },
}
