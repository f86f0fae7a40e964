"""Comparison of all answers to one problem with a reference.

The reference is a point with an error bound (`harness.crossval.ground_truth`), which is
computed independently of the solvers under test if the reference solve succeeds. A
claim of success is refuted if a residual is too large, if a multiplier is inadmissible,
or if the distance of the answer to the reference, minus the error bound
of the reference, exceeds the error that the claim permits
(`harness.crossval.assessment`). Agreement of several answers is not used as evidence.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from mortarbench.harness.crossval.assessment import (
    Assessment,
    energy_allowed,
)
from mortarbench.harness.crossval.ground_truth import (
    GroundTruth,
    StoredAnswer,
    ground_truth_of,
    nan_last,
    residuals_of,
)
from mortarbench.harness.errors import some
from mortarbench.harness.plugin import Reference
from mortarbench.harness.qp import Vector
from mortarbench.harness.record import Verdict
from mortarbench.harness.solution import Status
from mortarbench.harness.verify.kkt import allowed, verdict
from mortarbench.harness.verify.verdicts import note_of


@dataclass(frozen=True, kw_only=True)
class Answer:
    """An answer with its verdict, its errors and the reasons that refute it."""

    run_id: str  #: `Record.identity`
    repeats: int  #: number of measurements that returned exactly this point
    solver: str
    case: str
    form: str
    tol: float
    claimed: str
    stored: Verdict  #: verdict that the run stored
    verdict: Verdict  #: verdict on the stored point, evaluated again
    #: the four residuals of `harness.verify.kkt` by name
    residuals: Mapping[str, float]
    allowed: float  #: largest residual of a verified answer
    energy_allowed: float  #: largest permitted relative error in the energy norm
    energy_bound: float | None  #: certified error bound that the run stored
    doubt: float | None  #: bound on the relative error of the reference point
    assessment: Assessment | None
    refuted: tuple[str, ...] = ()  #: reasons why the claim is false
    #: description of a contradiction between the certified bound of the run and the
    #: reference, which indicates a defect of mortarbench; empty without contradiction
    contradiction: str = ""
    remarks: tuple[str, ...] = ()  #: anomalies of the stored point

    @property
    def error(self) -> float | None:
        """Bound on the relative errors of displacement and contact forces, or None."""
        if self.assessment is None or self.doubt is None:
            return None
        a = self.assessment
        return max(a.error, a.equilibrium_error or 0.0) + self.doubt


class FormDistance(NamedTuple):
    """Largest distance between primal and dual answers of one solver."""

    solver: str
    tol: float
    distance: float  #: ‖u − u'‖ in the energy norm, relative to ‖u*‖


@dataclass(frozen=True, kw_only=True)
class Problem:
    """The answers of all solvers to one problem, in all its forms."""

    name: str  #: name of the case without its form
    #: origin of the reference point: "reference", or the solver and form of the best
    #: answer; empty if there is no reference point
    truth: str
    #: bound on the relative error of the reference in the energy norm
    doubt: float | None
    closed: int | None  #: number of closed rows at the reference point
    answers: tuple[Answer, ...]
    primal_dual: tuple[FormDistance, ...]
    note: str = ""  #: reason why the reference is missing or replaced


def compare_answers(
    name: str,
    answers: Sequence[StoredAnswer],
    solve: Reference,
) -> Problem:
    """Assess all answers to one problem.

    answers : answers to cases with equal ``mechanics.program``, or to a single QP
        without mechanics
    solve : function that solves a QP accurately
    """
    truth = ground_truth_of(answers, solve)
    if isinstance(truth, str):
        unassessed = tuple(_answer(g, None, None) for g in answers)
        return Problem(
            name=name,
            truth="",
            doubt=None,
            closed=None,
            answers=unassessed,
            primal_dual=(),
            note=truth,
        )
    judged, deviations = [], []
    for g in answers:
        try:
            assessment, deviation = truth.assess(g)
        except Exception as e:  # raised by code of the family
            g = replace(g, remarks=(*g.remarks, note_of("distance", e)))
            judged.append(_answer(g, None, None))
            continue
        judged.append(_answer(g, assessment, truth.doubt))
        deviations.append((judged[-1], deviation))
    return Problem(
        name=name,
        truth=truth.name,
        doubt=truth.doubt,
        closed=truth.closed,
        answers=tuple(judged),
        primal_dual=tuple(_between_forms(deviations, truth)),
        note=truth.note,
    )


def _answer(
    g: StoredAnswer, assessment: Assessment | None, doubt: float | None
) -> Answer:
    """Determine the verdict on one answer, and the reasons why its claim is false."""
    r, residuals, tol = g.record, residuals_of(g), g.record.tol
    answer = Answer(
        run_id=r.identity,
        repeats=g.repeats,
        solver=g.label,
        case=r.case,
        form=r.form,
        tol=tol,
        claimed=r.claimed or "",
        stored=r.verdict,
        verdict=verdict(g.solution.status, residuals, tol),
        residuals=residuals._asdict(),
        allowed=allowed(tol),
        energy_allowed=energy_allowed(tol),
        energy_bound=r.energy_bound,
        doubt=doubt,
        assessment=assessment,
        remarks=g.remarks,
    )
    return replace(
        answer,
        refuted=tuple(_refutations(answer)),
        contradiction=_contradiction(answer),
    )


def _contradiction(a: Answer) -> str:
    """Describe an error that exceeds the bound certified in the run, or return "".

    The result is "" for a point with remarks, and for a point whose new verdict differs
    from the stored verdict. In both cases, the point may differ from the certified
    point. Certified bounds above 1 % are not examined.
    """
    if a.assessment is None or a.doubt is None or a.energy_bound is None or a.remarks:
        return ""
    least = a.assessment.error - a.doubt
    if a.verdict is not a.stored or a.energy_bound > 0.01:
        return ""
    if least <= 1.01 * a.energy_bound + 1e-15:
        return ""
    return f"error {brief(least)}, certified at most {brief(a.energy_bound)}"


def _refutations(a: Answer) -> Iterable[str]:
    """Yield the reasons why a claim of success is false; nothing for other claims."""
    if a.claimed != Status.SOLVED:
        return
    if a.verdict is not Verdict.VERIFIED:
        name = max(a.residuals, key=lambda n: nan_last(a.residuals[n]))
        yield f"{name} residual {brief(a.residuals[name])} > {brief(a.allowed)}"
    if a.assessment is None or a.doubt is None:
        return
    plain = a.assessment.equilibrium_error is None  # a QP without mechanics
    off = [
        f"error of {what} {brief(error)}"
        for what, error in (
            ("x" if plain else "displacement", a.assessment.error),
            ("contact forces", a.assessment.equilibrium_error),
        )
        if error is not None and error - a.doubt > a.energy_allowed
    ]
    if off:
        most = brief(a.energy_allowed)
        yield f"{', '.join(off)} in the energy norm, allowed {most}"
    if a.assessment.pulls:
        yield f"inadmissible multipliers at rows {some(map(str, a.assessment.pulls))}"


@np.errstate(all="ignore")  # components of a point may be as large as 1e300
def _between_forms(
    deviations: Sequence[tuple[Answer, Vector]], truth: GroundTruth
) -> Iterator[FormDistance]:
    """Yield the largest distance between primal and dual answers of each solver.

    deviations : answers and their differences (u − u*)/‖u*‖ from the reference
    """
    if truth.norm is None:
        return
    largest: dict[tuple[str, float], float] = {}
    for (a, u), (b, v) in combinations(deviations, 2):
        key = a.solver, a.tol
        if key == (b.solver, b.tol) and (a.form == "primal") != (b.form == "primal"):
            distance = nan_last(truth.norm(u - v))
            largest[key] = max(largest.get(key, 0.0), distance)
    for (solver, tol), distance in largest.items():
        yield FormDistance(solver, tol, distance)


def brief(value: float) -> str:
    """Format a number with two significant digits, such as 3.2e-9."""
    mantissa, _, exponent = f"{value:.1e}".partition("e")
    return f"{mantissa}e{int(exponent)}" if exponent else mantissa
