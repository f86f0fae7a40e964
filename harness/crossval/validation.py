"""Cross-validation of a result folder, case by case.

No quantity that the run computed from the answers is used as evidence. Cases are
rebuilt, and residuals, errors and distances are computed from the stored points.
Answers that cannot be judged are listed with the reason.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from math import inf
from pathlib import Path
from time import monotonic

from mortarbench.harness.crossval.comparison import (
    Answer,
    Outcome,
    StoredAnswer,
    answer_of,
    brief,
    compare_answers,
)
from mortarbench.harness.errors import InputError
from mortarbench.harness.files.qpfile import qp_digest
from mortarbench.harness.files.store import (
    digest_of,
    load_solution,
    point_arrays,
)
from mortarbench.harness.plugin import Case, Family, Reference
from mortarbench.harness.record import Record, Verdict
from mortarbench.harness.results.journal import read_journal
from mortarbench.harness.results.stored_run import rebuild
from mortarbench.harness.solution import NO_SOLUTION, Solution, Status
from mortarbench.harness.verify.infeasibility import certificate_of
from mortarbench.harness.verify.verdicts import has_point

_CHANGED = "the file of the stored point was changed after the measurement"
#: Largest error bound of a reference point that refutes a claim of infeasibility.
MAX_SOLUTION_ERROR = 1e-2
Build = Callable[[Record], Case]  #: builds the case of a record again


def validate_folder(
    path: Path,
    families: Mapping[str, Family],
    reference: Reference,
    tell: Callable[[str], None],
    budget: float = inf,
) -> list[Answer]:
    """Judge all distinct answers of a result folder, and measurements without one.

    Declined QPs are omitted.

    reference : function that solves a QP accurately, independent of the solvers under
        test
    budget : time in s after which no further case is begun
    tell : progress callback, called with the name and the number of each case before
        the case is assessed

    Raises
    ------
    InputError
        If the folder or its journal is missing, or if no answer can be judged.

    """
    build = partial(rebuild, folder=path, families=families, reference=reference)
    answers: list[Answer] = []
    groups, begun = _groups(map(_apart, read_journal(path))), monotonic()
    for number, (name, group) in enumerate(groups.items(), 1):
        if answers and monotonic() - begun > budget:
            late = f"not begun within the budget of {budget:g} s"
            answers += [answer_of(r, Outcome.NOT_VALIDATED, late) for r in group]
            continue
        tell(f"{name} ({number} of {len(groups)})")
        answers += _group(path, group, build, reference)
    if all(a.outcome in (Outcome.UNANSWERED, Outcome.NOT_VALIDATED) for a in answers):
        why = answers[0].text if answers else "all solvers decline"
        raise InputError(f"{path}: no stored answer can be judged: {why}")
    return answers


def _groups(records: Iterable[Record]) -> dict[str, list[Record]]:
    """Group records by physical case, sorted by name; omit declined QPs."""
    groups: dict[str, list[Record]] = {}
    for r in sorted(records, key=lambda r: (r.case, -r.tol, r.solver, r.repeat)):
        if r.status is not Verdict.DECLINED:
            groups.setdefault(r.case.removesuffix(f"/{r.form}"), []).append(r)
    return groups


def _group(
    path: Path, records: Sequence[Record], build: Build, reference: Reference
) -> list[Answer]:
    """Judge the answers to one physical case in all its forms.

    Forms with equal mechanics are one problem. Without mechanics, each form is one.
    """
    cases, judged = _built(records, build)
    lost = {a.run_id for a in judged}
    seen: set[tuple[str, str, float, str]] = set()
    by_problem: dict[str, list[StoredAnswer]] = {}
    pointless = []
    for r in records:
        if r.identity in lost:
            continue
        if not r.vectors or not (
            r.claimed == Status.SOLVED or r.status is Verdict.VERIFIED
        ):
            pointless.append(r)
            continue
        key = (r.solver, r.case, r.tol, r.vectors)
        if key in seen:  # the point of an earlier repeat
            continue
        seen.add(key)
        case = cases[r.case]
        try:
            g = _stored_answer(path, r, case)
        except InputError as e:
            judged.append(answer_of(r, Outcome.NOT_VALIDATED, str(e)))
            continue
        elastic = case.mechanics
        problem = r.case if elastic is None else qp_digest(elastic.program)
        by_problem.setdefault(problem, []).append(g)
    solved: dict[str, float] = {}  # error bounds of the references by case
    for problem, answers in by_problem.items():
        compared = compare_answers(answers, reference)
        judged += compared
        # a solution of the elastic problem refutes claims in every form
        names = [problem] if problem in cases else [r.case for r in records]
        bounds = [b for a in compared if (b := a.reference_error) is not None]
        solved |= dict.fromkeys(names, min(bounds, default=inf))
    return judged + [
        _without_point(r, cases, solved.get(r.case, inf)) for r in pointless
    ]


def _without_point(r: Record, cases: Mapping[str, Case], solved: float) -> Answer:
    """Judge a measurement without a point.

    solved : error bound of a solution of the problem; inf if there is none
    """
    if r.claimed == Status.SOLVED:
        text = "claims success without a finite point"
        return answer_of(r, Outcome.REFUTED, text)
    if _is_proven(r):
        # the run did not store the certificate of the solver: search for a new one
        qp = cases[r.case].qp
        claim = Solution.without_point(qp, Status(r.claimed or "infeasible"))
        holds, why = certificate_of(qp, claim, r.judged_at)
        if holds:
            return answer_of(r, Outcome.PROVEN, why)
    if r.claimed in NO_SOLUTION and solved < MAX_SOLUTION_ERROR:
        text = (
            "claims that there is no solution; the reference is one, with an error of "
            f"at most {brief(solved)}"
        )
        return answer_of(r, Outcome.REFUTED, text)
    if _is_proven(r):
        text = "the certificate could not be computed again"
        return answer_of(r, Outcome.NOT_VALIDATED, text)
    text = ": ".join(filter(None, (r.status.words, r.message)))
    return answer_of(r, Outcome.UNANSWERED, text)


def _built(
    records: Iterable[Record], build: Build
) -> tuple[dict[str, Case], list[Answer]]:
    """Rebuild the cases of the answers.

    Returns the cases by name, and the answers that cannot be judged: their case cannot
    be rebuilt, or their QP is another one.
    """
    cases: dict[str, Case] = {}
    digests: dict[str, str] = {}
    faults: dict[str, str] = {}
    lost = []
    for r in records:
        if not (r.vectors or _is_proven(r)):
            continue
        if r.case not in cases and r.case not in faults:
            try:
                case = build(r)
            except InputError as e:
                faults[r.case] = str(e)
            else:
                cases[r.case] = case
                digests[r.case] = case.digest or qp_digest(case.qp, serialised=True)
        fault = faults.get(r.case)
        if fault is None and r.qp not in (None, now := digests[r.case]):
            fault = (
                f"its QP has the digest {now} now, {r.qp} when it was measured; "
                "expected the same version of the code, of its libraries and of "
                "plug-ins"
            )
        if fault is not None:
            lost.append(answer_of(r, Outcome.NOT_VALIDATED, fault))
    return cases, lost


def _stored_answer(path: Path, r: Record, case: Case) -> StoredAnswer:
    """Read the stored point of a record; raise InputError if it is unusable."""
    assert r.vectors is not None
    s = load_solution(path, r.vectors, Status(r.claimed or "failed"))
    if (wrong := s.mismatch(case.qp)) or not has_point(s):
        file = path / "vectors" / f"{r.vectors}.npz"
        raise InputError(f"{file}: {wrong or 'NaN or inf'}")
    changed = digest_of(point_arrays(s)) != r.vectors
    return StoredAnswer(
        record=r, case=case, solution=s, remark=_CHANGED if changed else ""
    )


def _is_proven(r: Record) -> bool:
    """Return True if the run proved the claim that the QP has no solution."""
    return r.status.is_verified and r.status is not Verdict.VERIFIED


def _apart(r: Record) -> Record:
    """Return the record; for a step of a sequence, the label includes the mode."""
    return r if r.mode == "cold" else r.replace(solver=f"{r.solver} ({r.mode})")
