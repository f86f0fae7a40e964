"""One problem, all answers to it: each against the truth, and each against each.

The truth is a reference point with a proven error (`harness.verify.references`), of no
solver under test. So a disagreement has a culprit that does not depend on what most
say: an answer is refuted by its own residuals, or by its distance to the truth, less
what is not known of that, where it is larger than what was claimed allows
(`harness.crossval.assessment`). Distances between answers need no reference; two that
are farther apart than both claims allow, neither refuted, are a disagreement without
one.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from pathlib import Path
from statistics import median
from typing import NamedTuple

from mortarbench.harness.crossval.assessment import (
    Assessment,
    Deviation,
    distances,
    energy_allowed,
)
from mortarbench.harness.crossval.ground_truth import (
    Given,
    GroundTruth,
    ground_truth_of,
    nan_last,
    residuals_of,
)
from mortarbench.harness.errors import some
from mortarbench.harness.plugin import Reference
from mortarbench.harness.record import Verdict
from mortarbench.harness.solution import Status
from mortarbench.harness.verify.kkt import allowed, verdict
from mortarbench.harness.verify.optimum import Proves, decided, proves
from mortarbench.harness.verify.verdicts import note_of

OUTLYING = 100  #: times the median of the other solvers, from where on one stands out
PEERS = 3  #: answers of others that make a median


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What one answer is worth; plain data."""

    run_id: str
    repeats: int
    solver: str
    case: str
    form: str
    tol: float
    claimed: str
    stored: Verdict  #: as the run judged it
    verdict: Verdict  #: as the stored point is judged now, at 10·tol
    residuals: Mapping[str, float]  #: the four of `harness.verify.kkt`
    optimum_error: (
        float | None
    )  #: decides instead of them, see `harness.verify.optimum`
    allowed: float  #: largest residual of a verified answer
    energy_allowed: float  #: largest error in the energy norm of one
    energy_bound: float | None  #: the certificate of the run
    doubt: float | None  #: the errors in `assessment` are known to ± this
    assessment: Assessment | None
    refuted: tuple[str, ...] = ()  #: why the claim is false; empty if it stands
    contradiction: str = ""  #: of the run's certificate by the reference: our fault
    remarks: tuple[str, ...] = ()

    @property
    def error(self) -> float | None:
        """Certified: neither displacement nor contact forces are farther off."""
        if self.assessment is None or self.doubt is None:
            return None
        found = self.assessment
        return max(found.error, found.equilibrium_error or 0.0) + self.doubt


class Pair(NamedTuple):
    """Two answers, relative to the size of the solution; None without contact."""

    a: int  #: numbers of answers
    b: int
    distance: float  #: ‖u − u'‖ in the energy norm
    equilibrium: float | None  #: ‖u_λ − u_λ'‖ = ‖Bᵀ(λ − λ')‖ in the dual norm
    energy: float  #: |J(u) − J(u')|
    allowed: float  #: the sum of what both claims allow


@dataclass(frozen=True, kw_only=True)
class Problem:
    """All answers to one problem, of every solver and form; plain data."""

    name: str  #: the case without its form
    truth: str  #: "reference", or whose answer stands for it; empty if nothing does
    doubt: float | None  #: bound of its relative error in the energy norm
    closed: int | None  #: rows that are closed in it
    answers: tuple[Answer, ...]
    pairs: tuple[Pair, ...]  #: of answers at one tolerance
    unresolved: tuple[Pair, ...]  #: too far apart, and neither is refuted
    note: str = ""  #: why there is no reference


def compared(
    name: str, given: Sequence[Given], solve: Reference, references: Path | None
) -> Problem:
    """Judge all answers to one problem.

    given : of one problem: equal ``mechanics.program``, or one QP without mechanics
    solve : the reference solve
    references : folder that keeps reference points
    """
    prove = proves(solve)
    truth = ground_truth_of(given, solve, references)
    if isinstance(truth, str):
        alone = tuple(_answer(g, None, None, prove) for g in given)
        return Problem(
            name=name, truth="", doubt=None, closed=None, answers=alone, pairs=(),
            unresolved=(), note=truth,
        )  # fmt: skip
    answers, deviations = [], []
    for g in given:
        try:
            assessment, deviation = truth.assess(g)
        except Exception as e:  # the family's code, of the way back
            g = replace(g, remarks=(*g.remarks, note_of("distance", e)))
            answers.append(_answer(g, None, None, prove))
            continue
        deviations.append((len(answers), deviation))
        answers.append(_answer(g, assessment, truth.doubt, prove))
    pairs = _pairs(answers, deviations, truth)
    unresolved = [
        p
        for p in pairs
        if max(p.distance, p.equilibrium or 0.0) > p.allowed
        and all(
            answers[i].claimed == Status.SOLVED and not answers[i].refuted
            for i in (p.a, p.b)
        )
    ]
    return Problem(
        name=name, truth=truth.name, doubt=truth.doubt, closed=truth.closed,
        answers=tuple(_outliers(answers)), pairs=tuple(pairs),
        unresolved=tuple(unresolved), note=truth.note,
    )  # fmt: skip


def _answer(
    g: Given, found: Assessment | None, doubt: float | None, prove: Proves
) -> Answer:
    """Put together what is known of an answer, and whether its claim stands."""
    r, residuals, tol = g.record, residuals_of(g), g.record.asked_tol
    error = decided(g.case.qp, g.solution, residuals, tol, prove)
    answer = Answer(
        run_id=r.run_id, repeats=g.repeats, solver=g.label, case=r.case, form=r.form,
        tol=tol, claimed=r.claimed or "", stored=r.verdict,
        verdict=verdict(g.solution.status, residuals, tol, error=error),
        residuals=residuals._asdict(), optimum_error=error, allowed=allowed(tol),
        energy_allowed=energy_allowed(tol), energy_bound=r.energy_bound,
        doubt=doubt, assessment=found, remarks=g.remarks,
    )  # fmt: skip
    refuted = tuple(_refutations(answer))
    twin = (f"the very point that it gave for {g.twin}",) if g.twin and refuted else ()
    return replace(
        answer,
        refuted=refuted,
        contradiction=_contradiction(answer),
        remarks=g.remarks + twin,
    )


def _contradiction(a: Answer) -> str:
    """Say so where an error is larger than the certificate of it allows.

    Of the point that the run certified, that is, which has the verdict that it had.
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
    """Say why a claim of success is false; nothing where it stands or was not made."""
    if a.claimed != Status.SOLVED:
        return
    if a.verdict is not Verdict.VERIFIED and a.optimum_error is not None:
        most = brief(a.allowed)
        yield f"off the proven optimum by {brief(a.optimum_error)} > {most}"
    elif a.verdict is not Verdict.VERIFIED:
        name = max(a.residuals, key=lambda n: nan_last(a.residuals[n]))
        yield f"{name} residual {brief(a.residuals[name])} > {brief(a.allowed)}"
    if a.assessment is None or a.doubt is None:
        return
    plain = a.assessment.equilibrium_error is None  # a QP without mechanics
    off = [
        f"{what} off by {brief(error)}"
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
        yield f"multipliers pull at rows {some(map(str, a.assessment.pulls))}"


def _outliers(answers: Sequence[Answer]) -> list[Answer]:
    """Remark on answers that are far less accurate than others, though as claimed."""
    groups: dict[tuple[str, float], list[tuple[str, float]]] = {}
    for a in answers:
        if not a.refuted and a.error is not None:
            groups.setdefault((a.case, a.tol), []).append((a.solver, a.error))
    marked = []
    for a in answers:
        others = [e for who, e in groups.get((a.case, a.tol), []) if who != a.solver]
        if a.refuted or a.error is None or len(others) < PEERS:
            marked.append(a)
            continue
        usual = median(others)
        if a.error - 2 * (a.doubt or 0.0) > max(OUTLYING * usual, a.tol):
            text = f"error {brief(a.error)}, the median of the others is {brief(usual)}"
            a = replace(a, remarks=(*a.remarks, text))
        marked.append(a)
    return marked


def _pairs(
    answers: Sequence[Answer],
    places: Sequence[tuple[int, Deviation]],
    truth: GroundTruth,
) -> list[Pair]:
    """Set each answer against each other one at its tolerance."""
    if not places:
        return []
    apart = partial(distances, truth.P, truth.kernel)
    u = apart([d.u for _, d in places])
    rest = [d.equilibrium for _, d in places if d.equilibrium is not None]
    lam = apart(rest) if rest else None
    found = []
    for (i, (p, _)), (j, (q, _)) in combinations(enumerate(places), 2):
        a, b = answers[p], answers[q]
        if a.tol != b.tol or a.assessment is None or b.assessment is None:
            continue
        found.append(
            Pair(
                a=p,
                b=q,
                distance=float(u[i, j]),
                equilibrium=None if lam is None else float(lam[i, j]),
                energy=abs(a.assessment.energy - b.assessment.energy),
                allowed=a.energy_allowed + b.energy_allowed,
            )
        )
    return found


def brief(value: float) -> str:
    """Print an order of magnitude with two digits: 3.2e-9, 1.0e0."""
    mantissa, _, exponent = f"{value:.1e}".partition("e")
    return f"{mantissa}e{int(exponent)}" if exponent else mantissa
