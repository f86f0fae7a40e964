"""Reference point with which the answers to one problem are compared.

The reference point is computed by the reference solve. If this solve fails, the answer
with the smallest certified error (for a QP without mechanics, with the smallest KKT
residual) replaces the reference point, and the report states this. Agreement of several
answers is not used as evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mortarbench.harness.crossval.assessment import (
    Assessment,
    assess,
    assess_point,
)
from mortarbench.harness.crossval.references import (
    ReferencePoint,
    UnsolvedError,
    reference_point,
)
from mortarbench.harness.mechanics import Mechanics, Real
from mortarbench.harness.plugin import Case, Reference
from mortarbench.harness.qp import Vector
from mortarbench.harness.record import Record
from mortarbench.harness.solution import Solution
from mortarbench.harness.verify.active_set_refinement import suggested
from mortarbench.harness.verify.certificate import UncertifiableError, certify
from mortarbench.harness.verify.kkt import Residuals, kkt_residuals
from mortarbench.harness.verify.verdicts import note_of

#: Largest KKT residual of an answer that may replace a missing reference.
MAX_REFERENCE_RESIDUAL = 1e-3


@dataclass(frozen=True, eq=False, kw_only=True)
class StoredAnswer:
    """A stored answer, with the case that was rebuilt for it."""

    record: Record
    label: str  #: label of the solver; for a sequence, the label contains the mode
    repeats: int  #: number of measurements that returned exactly this point
    case: Case
    solution: Solution
    remarks: tuple[str, ...] = ()  #: anomalies of the stored point


class GroundTruth(NamedTuple):
    """A reference point, and the norm in which errors are measured."""

    #: origin of the point: "reference", or the solver and form of an answer
    name: str
    doubt: float  #: bound on the relative error of the point in the energy norm
    closed: int | None  #: number of closed contact rows; None without mechanics
    #: computes the errors of an answer, and its difference from this point
    assess: Callable[[StoredAnswer], tuple[Assessment, Vector]]
    #: energy norm of a difference of two displacements; None without mechanics
    norm: Callable[[Vector], float] | None
    note: str = ""  #: reason why an answer replaces the reference solution


def ground_truth_of(
    answers: Sequence[StoredAnswer], solve: Reference
) -> GroundTruth | str:
    """Return the reference point, or the reason why it is missing.

    answers : all answers to the problem; the best answer may replace a missing
        reference
    solve : function that solves a QP accurately
    """
    mechanics = answers[0].case.mechanics
    if mechanics is None:
        return _plain_truth(answers, solve)
    mechanics = mechanics.whole
    try:
        truth = _elastic_truth(mechanics, answers, solve)
    except Exception as e:  # raised by the factorisation, which is code of the family
        return note_of("reference", e)
    if isinstance(truth, str):
        return truth
    point, name, why = truth

    def assessed(g: StoredAnswer) -> tuple[Assessment, Vector]:
        assert g.case.mechanics is not None
        at = g.case.mechanics.to_primal(g.solution)
        return assess(mechanics, point, at, g.record.tol)

    exact = mechanics.exact
    contact = exact.contact
    closed = (point.multipliers * exact.compliance > -exact.motion(point.u))[contact]

    def norm(v: Vector) -> float:
        return mechanics.norm(v.astype(Real))

    return GroundTruth(name, point.bound, int(closed.sum()), assessed, norm, why)


def _elastic_truth(
    mechanics: Mechanics,
    answers: Sequence[StoredAnswer],
    solve: Reference,
) -> tuple[ReferencePoint, str, str] | str:
    """Return the reference point, its origin, and a note if the point is an answer.

    Without a reference point, return a message with the reason instead.
    """
    try:
        return reference_point(mechanics, solve), "reference", ""
    except UnsolvedError as e:
        best = _best_certified(mechanics, answers)
        return (
            f"{e}, and no answer can be certified" if best is None else (*best, f"{e}")
        )


def _best_certified(
    mechanics: Mechanics, answers: Sequence[StoredAnswer]
) -> tuple[ReferencePoint, str] | None:
    """Return the answer with the smallest certified error, and its origin.

    The result is None if no answer can be certified.
    """
    certified = []
    for g in answers:
        try:
            assert g.case.mechanics is not None
            certified.append(
                (certify(mechanics, g.case.mechanics.to_primal(g.solution)), g)
            )
        except UncertifiableError:
            continue
    if not certified:
        return None
    c, g = min(certified, key=lambda pair: pair[0].bound)
    point = ReferencePoint(
        u=c.u,
        multipliers=c.multipliers,
        equilibrium=c.equilibrium,
        states=suggested(mechanics.exact, c.u, c.multipliers).states,
        norm=c.norm,
        bound=c.bound,
    )
    return point, _origin(g)


def _plain_truth(
    answers: Sequence[StoredAnswer], solve: Reference
) -> GroundTruth | str:
    """Return the reference point of a QP without mechanics, or why it is missing.

    The assumed bound on the error of the point is √(2r), where r is its largest KKT
    residual. For verified answers, the same formula holds with the largest permitted r.
    """
    qp, why = answers[0].case.qp, ""
    try:
        s, name = solve(qp), "reference"
        left = kkt_residuals(qp, s).worst
        if not left <= MAX_REFERENCE_RESIDUAL:
            raise ArithmeticError(
                f"the reference solve left a KKT residual of {left:.1e}"
            )
    except (ArithmeticError, ValueError, np.linalg.LinAlgError) as e:
        why = str(e)
        best = min(answers, key=lambda g: nan_last(residuals_of(g).worst))
        s, name = best.solution, _origin(best)
    worst = kkt_residuals(qp, s).worst
    if not worst <= MAX_REFERENCE_RESIDUAL:
        return f"{why}, and no answer satisfies the KKT conditions"

    def assessed(g: StoredAnswer) -> tuple[Assessment, Vector]:
        return assess_point(qp, s, g.solution)

    return GroundTruth(name, float(np.sqrt(2 * worst)), None, assessed, None, why)


@np.errstate(all="ignore")  # components of a point may be as large as 1e300
def residuals_of(g: StoredAnswer) -> Residuals:
    """Compute the KKT residuals of a stored answer."""
    return kkt_residuals(g.case.qp, g.solution)


def _origin(g: StoredAnswer) -> str:
    return f"{g.label} on {g.record.form}"


def nan_last(value: float) -> float:
    """Return the value as a sort key that orders NaN above every number."""
    return np.inf if np.isnan(value) else value
