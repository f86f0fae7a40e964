"""Comparison of the answers to one problem with a reference solution.

Let u and λ be the displacement and the multipliers of an answer, and u* and λ* those of
the reference: the answer of a solver that is not under test, corrected to an admissible
pair and certified by `harness.verify.certificate`. Let ‖·‖ be the energy norm, and u_λ
the displacement in equilibrium with the load and the contact forces −Bᵀλ. An answer is
verified at tolerance t if its KKT residuals are at most 10t. The residual of the
duality gap g is g/E with an energy E; here, E is taken to be ‖u*‖². By the identity of
Prager and Synge (`harness.verify.certificate`, (2)),

    ‖u − u*‖² + ‖u_λ − u*‖² ≤ 2g ≤ 20t‖u*‖²,

so that a verified answer has errors ‖u − u*‖ and ‖u_λ − u*‖ of at most √(20t)‖u*‖. The
error ‖u_λ − u*‖ equals the error ‖Bᵀ(λ − λ*)‖ of the contact forces in the dual norm.
It is used instead of the error of λ, since the multipliers need not be unique.

A claim of success is refuted if a residual exceeds 10t, or if an error, minus the error
bound of the reference, exceeds √(20t)‖u*‖. Agreement of several answers is not used as
evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np

from mortarbench.harness.mechanics import Extended, Mechanics, Real
from mortarbench.harness.plugin import Case, Reference
from mortarbench.harness.qp import QP, Vector
from mortarbench.harness.record import Record
from mortarbench.harness.solution import Solution, Status
from mortarbench.harness.verify.certificate import certify
from mortarbench.harness.verify.kkt import allowed, kkt_residuals
from mortarbench.harness.verify.verdicts import note_of

#: Largest KKT residual of a reference of a QP without mechanics.
MAX_REFERENCE_RESIDUAL = 1e-3


class Outcome(StrEnum):
    """Result of the cross-validation of one answer."""

    AGREES = "agrees"
    REFUTED = "refuted"  #: the claim of the solver is false
    UNANSWERED = "unanswered"  #: the solver does not claim to have a point
    NOT_VALIDATED = "not validated"  #: the answer cannot be judged


@dataclass(frozen=True, kw_only=True)
class Answer:
    """An answer with its outcome and its errors; unknown values are None.

    Errors are in the energy norm, relative to ‖u*‖; see the docstring of this module.
    For a QP without mechanics, errors are in the seminorm of P.
    """

    run_id: str  #: `Record.identity`
    solver: str  #: label; for a step of a sequence, the label includes the mode
    case: str
    form: str
    tol: float
    claimed: str
    outcome: Outcome
    text: str = ""  #: reasons for the outcome
    residual: float | None = None  #: largest KKT residual of the stored point
    error: float | None = None  #: ‖u − u*‖
    force_error: float | None = None  #: ‖u_λ − u*‖
    reference_error: float | None = None  #: bound on the error of the reference
    #: largest distance ‖u − u'‖ from earlier answers u' of this solver, of which one is
    #: to the primal form and the other to a dual form
    primal_dual: float | None = None

    @property
    def bound(self) -> float | None:
        """Bound on the errors of displacement and contact forces, or None."""
        if self.error is None or self.reference_error is None:
            return None
        return max(self.error, self.force_error or 0.0) + self.reference_error


@dataclass(frozen=True, eq=False, kw_only=True)
class StoredAnswer:
    """A stored point, with the case that was rebuilt for it."""

    record: Record
    case: Case
    solution: Solution


@dataclass(frozen=True, eq=False, kw_only=True)
class _Reference:
    """A reference solution, the norm of its problem, and the errors of answers."""

    bound: float  #: bound on its relative error
    norm: Callable[[Any], float]  #: energy norm of a difference of displacements
    length: float  #: ‖u*‖
    #: returns u − u* and, with mechanics, u_λ − u* of an answer
    deviations: Callable[[StoredAnswer], tuple[Extended | Vector, ...]]

    def relative(self, v: Any) -> float:
        """Return ‖v‖/‖u*‖ with 0/0 = 0; inf instead of NaN after an overflow."""
        size = self.norm(v)
        ratio = size / self.length if size and self.length else size and np.inf
        return float(np.inf if np.isnan(ratio) else ratio)


def answer_of(r: Record, outcome: Outcome, text: str, **errors: float | None) -> Answer:
    """Return the answer of a measurement; its other fields are `errors`."""
    return Answer(
        run_id=r.identity,
        solver=r.solver,
        case=r.case,
        form=r.form,
        tol=r.tol,
        claimed=r.claimed or "",
        outcome=outcome,
        text=text,
        **errors,
    )


def energy_allowed(tol: float) -> float:
    """Return √(20 tol), a bound on the relative error of answers verified at `tol`."""
    return float(np.sqrt(2 * allowed(tol)))


@np.errstate(all="ignore")  # components of a point may be as large as 1e300
def compare_answers(answers: Sequence[StoredAnswer], solve: Reference) -> list[Answer]:
    """Judge all answers to one problem.

    Without a reference, answers are judged by their residuals alone.

    answers : answers to cases with equal ``mechanics.program``, or to a single QP
        without mechanics
    solve : function that solves a QP accurately
    """
    try:  # the smallest form of the problem is solved
        smallest = min((g.case for g in answers), key=lambda case: case.qp.q.size)
        reference = _reference(smallest, solve)
    except Exception as e:  # also raised by code of the family
        return [_judged(g, note_of("reference", e)) for g in answers]
    judged: list[Answer] = []
    deviations: list[tuple[Record, Any]] = []
    for g in answers:
        try:
            off, *force_off = reference.deviations(g)
        except Exception as e:  # raised by code of the family
            judged.append(_judged(g, note_of("distance", e)))
            continue
        r = g.record
        others = [
            reference.relative(off - v)
            for other, v in deviations
            if (other.solver, other.tol) == (r.solver, r.tol)
            and (other.form == "primal") != (r.form == "primal")
        ]
        deviations.append((r, off))
        judged.append(
            _judged(
                g,
                error=reference.relative(off),
                force_error=reference.relative(force_off[0]) if force_off else None,
                reference_error=reference.bound,
                primal_dual=max(others, default=None),
            )
        )
    return judged


def _reference(case: Case, solve: Reference) -> _Reference:
    """Return the certified solution of an elastic problem."""
    if case.mechanics is None:
        return _plain_reference(case.qp, solve)
    mechanics = case.mechanics.whole
    point, exact = (
        certify(mechanics, mechanics.to_primal(solve(case.qp))),
        mechanics.exact,
    )

    def deviations(g: StoredAnswer) -> tuple[Extended, Extended]:
        assert g.case.mechanics is not None
        s = g.case.mechanics.to_primal(g.solution)
        force = exact.f - exact.B.T @ mechanics.multipliers(s).astype(Real)
        at_rest = _equilibrium(mechanics, force)
        return s.x.astype(Real) - point.u, at_rest - point.equilibrium

    return _Reference(
        bound=point.bound,
        norm=mechanics.norm,
        length=point.norm,
        deviations=deviations,
    )


def _equilibrium(mechanics: Mechanics, force: Extended) -> Extended:
    """Solve K u = force with u = 0 on fixed components.

    u (n,) is in extended precision and has no rigid motion. The part of `force` along
    rigid motions is disregarded.
    """
    K, fixed = mechanics.stiffness, mechanics.exact.fixed
    u = np.zeros(force.size, dtype=Real)
    for _ in range(2):
        r = force - K @ u
        r[fixed] = 0
        u = u + mechanics.apply_inverse(mechanics.motions.without(r))
    return u


def _plain_reference(qp: QP, solve: Reference) -> _Reference:
    """Return the solution of a QP without mechanics.

    Errors do not depend on the choice of the solution, since Px is equal for all
    solutions. The assumed bound on the error of the reference is √(2r), where r is its
    largest KKT residual. For verified answers, the same formula holds with the largest
    permitted r. The scale of errors is √max(x*ᵀPx*, |qᵀx*|).

    Raises
    ------
    ArithmeticError
        If r exceeds `MAX_REFERENCE_RESIDUAL`.

    """
    truth = solve(qp)
    worst = kkt_residuals(qp, truth).worst
    if not worst <= MAX_REFERENCE_RESIDUAL:
        raise ArithmeticError(f"the reference solve left a KKT residual of {worst:.1e}")
    return _Reference(
        bound=float(np.sqrt(2 * worst)),
        norm=lambda v: float(np.sqrt(max(v @ (qp.P @ v), 0.0))),
        length=float(np.sqrt(max(truth.x @ (qp.P @ truth.x), abs(qp.q @ truth.x)))),
        deviations=lambda g: (g.solution.x - truth.x,),
    )


def _judged(g: StoredAnswer, unassessed: str = "", **errors: float | None) -> Answer:
    """Return an answer with its outcome.

    unassessed : reason why the errors are unknown
    errors : fields of the answer
    """
    worst = kkt_residuals(g.case.qp, g.solution).worst
    answer = answer_of(g.record, Outcome.AGREES, "", residual=worst, **errors)
    reasons = list(_refutations(answer)) if answer.claimed == Status.SOLVED else []
    if reasons:
        return replace(answer, outcome=Outcome.REFUTED, text="; ".join(reasons))
    if unassessed:
        return replace(answer, outcome=Outcome.NOT_VALIDATED, text=unassessed)
    return answer


def _refutations(a: Answer) -> Iterator[str]:
    """Yield the reasons why a claim of success is false."""
    assert a.residual is not None
    if not a.residual <= allowed(a.tol):
        yield f"KKT residual {brief(a.residual)} > {brief(allowed(a.tol))}"
    if a.reference_error is None:
        return
    most = energy_allowed(a.tol)
    for what, error in (
        ("x" if a.force_error is None else "displacement", a.error),
        ("contact forces", a.force_error),
    ):
        if error is not None and not error - a.reference_error <= most:
            yield f"error of {what} {brief(error)} > {brief(most)} in the energy norm"


def brief(value: float) -> str:
    """Format a number with two significant digits, such as 3.2e-9."""
    mantissa, _, exponent = f"{value:.1e}".partition("e")
    return f"{mantissa}e{int(exponent)}" if exponent else mantissa
