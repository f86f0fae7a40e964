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
from mortarbench.harness.files.store import load_solution
from mortarbench.harness.plugin import Case, Family, Reference
from mortarbench.harness.record import Record, Verdict
from mortarbench.harness.results.journal import read_journal
from mortarbench.harness.results.stored_run import rebuild
from mortarbench.harness.solution import NO_SOLUTION, Status
from mortarbench.harness.verify.verdicts import has_point

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
    groups, begun = _groups(read_journal(path)), monotonic()
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
    """Group records by physical case, sorted by name; omit declined QPs.

    For a step of a sequence, the label of the solver includes the mode.
    """
    groups: dict[str, list[Record]] = {}
    for r in sorted(records, key=lambda r: (r.case, -r.tol, r.solver, r.repeat)):
        if r.mode != "cold":
            r = r.replace(solver=f"{r.solver} ({r.mode})")
        if r.status is not Verdict.DECLINED:
            groups.setdefault(r.case.removesuffix(f"/{r.form}"), []).append(r)
    return groups


def _group(
    path: Path, records: Sequence[Record], build: Build, reference: Reference
) -> list[Answer]:
    """Judge the answers to one physical case in all its forms.

    Forms with equal mechanics are one problem. Without mechanics, each form is one.
    """
    cases: dict[str, Case | InputError] = {}
    judged: list[Answer] = []
    pointless: list[Record] = []
    seen: set[tuple[str, str, float, str]] = set()
    by_problem: dict[str, list[StoredAnswer]] = {}
    for r in records:
        claims_point = r.claimed == Status.SOLVED or r.status is Verdict.VERIFIED
        key = (r.solver, r.case, r.tol, r.vectors or r.identity)
        if key in seen:  # the point of an earlier repeat
            continue
        seen.add(key)
        if not r.vectors or not claims_point:
            pointless.append(r)
            continue
        try:
            case = _case(r, cases, build)
            elastic = case.mechanics
            problem = r.case if elastic is None else qp_digest(elastic.program)
            answer = _stored_answer(path, r, case)
        except InputError as e:
            judged.append(answer_of(r, Outcome.NOT_VALIDATED, str(e)))
            continue
        by_problem.setdefault(problem, []).append(answer)
    solved: dict[str, float] = {}  # error bounds of the references by case
    for problem, answers in by_problem.items():
        compared = compare_answers(answers, reference)
        judged += compared
        # a solution of the elastic problem refutes claims in every form
        names = [problem] if problem in cases else [r.case for r in records]
        bounds = [b for a in compared if (b := a.reference_error) is not None]
        solved |= dict.fromkeys(names, min(bounds, default=inf))
    return judged + [_without_point(r, solved.get(r.case, inf)) for r in pointless]


def _without_point(r: Record, solved: float) -> Answer:
    """Judge a measurement without a point.

    solved : error bound of a solution of the problem; inf if there is none
    """
    if r.claimed == Status.SOLVED:
        text = "claims success without a finite point"
        return answer_of(r, Outcome.REFUTED, text)
    if r.claimed in NO_SOLUTION and solved < MAX_SOLUTION_ERROR:
        text = (
            "claims that there is no solution; the reference is one, with an error of "
            f"at most {brief(solved)}"
        )
        return answer_of(r, Outcome.REFUTED, text)
    text = ": ".join(filter(None, (r.status.words, r.message)))
    return answer_of(r, Outcome.UNANSWERED, text)


def _case(r: Record, cases: dict[str, Case | InputError], build: Build) -> Case:
    """Return the rebuilt case of a record; raise InputError if its QP is another one.

    cases : cases built so far by name, or the reason why they cannot be built
    """
    if r.case not in cases:
        try:
            cases[r.case] = build(r)
        except InputError as e:
            cases[r.case] = e
    case = cases[r.case]
    if isinstance(case, InputError):
        raise case
    now = case.digest or qp_digest(case.qp, serialised=True)
    if r.qp not in (None, now):
        raise InputError(
            f"its QP has the digest {now} now, {r.qp} when it was measured; expected "
            "the same version of the code, of its libraries and of plug-ins"
        )
    return case


def _stored_answer(path: Path, r: Record, case: Case) -> StoredAnswer:
    """Read the stored point of a record; raise InputError if it is unusable."""
    assert r.vectors is not None
    s = load_solution(path, r.vectors, Status(r.claimed or "failed"))
    if (wrong := s.mismatch(case.qp)) or not has_point(s):
        file = path / "vectors" / f"{r.vectors}.npz"
        raise InputError(f"{file}: {wrong or 'NaN or inf'}")
    return StoredAnswer(record=r, case=case, solution=s)
