"""What the answers to one problem are set against: never a majority of them.

A reference point where the reference solve finds one; else the answer with the smallest
certified error, and the page says so.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness.crossval.assessment import (
    Assessment,
    Deviation,
    assess,
    assess_point,
)
from mortarbench.harness.mechanics import Mechanics
from mortarbench.harness.plugin import Case, Reference
from mortarbench.harness.qp import Matrix
from mortarbench.harness.record import Record
from mortarbench.harness.solution import Solution
from mortarbench.harness.verify.active_set_refinement import suggested
from mortarbench.harness.verify.certificate import UncertifiableError, certify
from mortarbench.harness.verify.kkt import Residuals, kkt_residuals
from mortarbench.harness.verify.references import (
    ReferencePoint,
    UnsolvedError,
    reference_point,
)
from mortarbench.harness.verify.verdicts import note_of

#: KKT residual up to which the best answer may stand for a reference
GOOD_ENOUGH = 1e-3


@dataclass(frozen=True, eq=False, kw_only=True)
class Given:
    """A stored answer, with the case that was built anew to judge it."""

    record: Record
    label: str  #: of the solver, sequences apart
    repeats: int  #: measurements that gave this very point
    case: Case
    solution: Solution
    remarks: tuple[str, ...] = ()  #: what is odd about the point itself
    twin: str = ""  #: another case to which it gave the very same point


class GroundTruth(NamedTuple):
    """What answers are set against, and the norm of distances."""

    name: str
    doubt: float
    closed: int | None
    assess: Callable[[Given], tuple[Assessment, Deviation]]
    P: Matrix
    kernel: NDArray[np.float64]
    note: str = ""


def ground_truth_of(
    given: Sequence[Given], solve: Reference, references: Path | None
) -> GroundTruth | str:
    """Find the reference, or else the best answer; or say why there is neither."""
    mechanics = given[0].case.mechanics
    if mechanics is None:
        return _plain_truth(given, solve)
    mechanics = mechanics.whole
    try:
        found = _elastic_truth(mechanics, given, solve, references)
    except Exception as e:  # the family's code, of the factorisation
        return note_of("reference", e)
    if isinstance(found, str):
        return found
    point, name, why = found

    def assessed(g: Given) -> tuple[Assessment, Deviation]:
        assert g.case.mechanics is not None
        at = g.case.mechanics.to_primal(g.solution)
        return assess(mechanics, point, at, g.record.asked_tol)

    exact = mechanics.exact
    contact = exact.contact
    closed = (point.multipliers * exact.compliance > -exact.motion(point.u))[contact]
    kernel = mechanics.inverse.kernel
    P = mechanics.primal.P
    return GroundTruth(name, point.bound, int(closed.sum()), assessed, P, kernel, why)


def _elastic_truth(
    mechanics: Mechanics, given: Sequence[Given], solve: Reference,
    references: Path | None,
) -> tuple[ReferencePoint, str, str] | str:  # fmt: skip
    """Find a point, its name, and why it is not the reference, if it is not."""
    try:
        return reference_point(mechanics, solve, references), "reference", ""
    except UnsolvedError as e:
        best = _best_certified(mechanics, given)
        return (
            f"{e}, and no answer can be certified" if best is None else (*best, f"{e}")
        )


def _best_certified(
    mechanics: Mechanics, given: Sequence[Given]
) -> tuple[ReferencePoint, str] | None:
    """Take the answer with the smallest certified error, and whose it is."""
    found = []
    for g in given:
        try:
            assert g.case.mechanics is not None
            found.append(
                (certify(mechanics, g.case.mechanics.to_primal(g.solution)), g)
            )
        except UncertifiableError:
            continue
    if not found:
        return None
    c, g = min(found, key=lambda pair: pair[0].bound)
    point = ReferencePoint(
        u=c.u, multipliers=c.multipliers, equilibrium=c.equilibrium,
        states=suggested(mechanics.exact, c.u, c.multipliers),
        norm=c.norm, bound=c.bound,
    )  # fmt: skip
    return point, _who(g)


def _plain_truth(given: Sequence[Given], solve: Reference) -> GroundTruth | str:
    """Do so for a QP alone: what its residuals prove is a bound as for claims."""
    qp, why = given[0].case.qp, ""
    try:
        s, name = solve(qp), "reference"
    except (ArithmeticError, ValueError, np.linalg.LinAlgError) as e:
        why = str(e)
        best = min(given, key=lambda g: nan_last(residuals_of(g).worst))
        s, name = best.solution, _who(best)
    worst = kkt_residuals(qp, s).worst
    if not worst <= GOOD_ENOUGH:
        return f"{why}, and no answer satisfies the KKT conditions"
    nothing = np.zeros((qp.q.size, 0))

    def assessed(g: Given) -> tuple[Assessment, Deviation]:
        return assess_point(qp, s, g.solution)

    return GroundTruth(
        name, float(np.sqrt(2 * worst)), None, assessed, qp.P, nothing, why
    )


@np.errstate(all="ignore")  # a point may hold 1e300
def residuals_of(g: Given) -> Residuals:
    """Measure the KKT residuals of a stored point anew."""
    return kkt_residuals(g.case.qp, g.solution)


def _who(g: Given) -> str:
    return f"{g.label} on {g.record.form}"


def nan_last(value: float) -> float:
    """Order NaN above every number."""
    return np.inf if np.isnan(value) else value
