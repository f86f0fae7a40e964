"""Cross-validation of a result folder, case by case.

No quantity that the run computed from the answers is used as evidence. Cases are
rebuilt, and residuals, errors and distances are computed from the stored points.
Answers that cannot be assessed are listed with the reason.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from time import monotonic
from typing import NamedTuple

from mortarbench.harness.crossval.comparison import (
    Problem,
    brief,
    compare_answers,
)
from mortarbench.harness.crossval.ground_truth import StoredAnswer
from mortarbench.harness.errors import InputError
from mortarbench.harness.files.qpfile import qp_digest
from mortarbench.harness.files.store import (
    digest_of,
    is_stored,
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


@dataclass(frozen=True, kw_only=True)
class Listed:
    """A measurement with a remark."""

    run_id: str  #: `Record.identity`
    solver: str
    case: str
    tol: float
    text: str


@dataclass(frozen=True, kw_only=True)
class Validation:
    """Result of a cross-validation."""

    problems: tuple[Problem, ...]
    solvers: tuple[str, ...]  #: labels of all solvers with a record
    #: false claims without a point, which are not in `problems`
    false_claims: tuple[Listed, ...]
    #: measurements that ended without a claim of success, such as crashes and limits;
    #: without declined QPs, verified points, proven claims of infeasibility, and
    #: `false_claims`
    unanswered: tuple[Listed, ...]
    #: stored points and claims of infeasibility that could not be assessed
    not_validated: tuple[Listed, ...]
    declined: int  #: number of measurements that the solver declined
    proven: int = 0  #: number of claims of infeasibility that a certificate proves

    @property
    def agreed(self) -> bool:
        """True if no claim is refuted and no certificate contradicts a reference."""
        return not self.false_claims and not any(
            a.refuted or a.contradiction for p in self.problems for a in p.answers
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class _Folder:
    """A result folder, with the families and reference solve for its validation."""

    path: Path
    families: Mapping[str, Family]
    reference: Reference


class _Part(NamedTuple):
    """Result of the cross-validation of one physical case, in all its forms."""

    problems: list[Problem]
    lost: list[Listed]  #: points and claims of infeasibility that were not assessed
    false: list[Listed]  #: false claims without a point
    proven: int  #: number of proven claims of infeasibility


def validate_folder(
    path: Path,
    families: Mapping[str, Family],
    reference: Reference,
    tell: Callable[[str], None],
    budget: float = inf,
) -> Validation:
    """Assess all answers of a result folder.

    reference : function that solves a QP accurately, independent of the solvers under
        test
    budget : time in s after which no further case is begun
    tell : progress callback, called with the name and the number of each case before
        the case is assessed

    Raises
    ------
    InputError
        If the folder or its journal is missing, or if the folder contains neither a
        stored point nor a proven claim of infeasibility.

    """
    records = [_apart(r) for r in read_journal(path)]
    if not any(
        (r.vectors and is_stored(path, r.vectors)) or _is_proven(r) for r in records
    ):
        raise InputError(f"{path}: {_pointless(records)}")
    folder = _Folder(path=path, families=families, reference=reference)
    parts: list[_Part] = []
    groups, begun = _groups(records), monotonic()
    for number, (name, group) in enumerate(groups.items(), 1):
        if parts and monotonic() - begun > budget:
            text = f"not begun within the budget of {budget:g} s"
            parts.append(_Part([], [_listed(r, text) for r in group], [], 0))
            continue
        tell(f"{name} ({number} of {len(groups)})")
        parts.append(_group(folder, name, group))
    false_claims = [claim for part in parts for claim in part.false]
    return Validation(
        problems=tuple(p for part in parts for p in part.problems),
        solvers=tuple(sorted({r.solver for r in records})),
        false_claims=tuple(false_claims),
        unanswered=tuple(
            _listed(r, ": ".join(filter(None, (r.verdict.words, r.message))))
            for r in records
            if r.claimed != Status.SOLVED
            and not (r.verdict.is_verified or r.verdict is Verdict.DECLINED)
            and r.identity not in {x.run_id for x in false_claims}
        ),
        not_validated=tuple(x for part in parts for x in part.lost),
        declined=sum(r.verdict is Verdict.DECLINED for r in records),
        proven=sum(part.proven for part in parts),
    )


def _groups(records: Iterable[Record]) -> dict[str, list[Record]]:
    """Group records by physical case, sorted by name; omit declined QPs."""
    groups: dict[str, list[Record]] = {}
    for r in sorted(records, key=lambda r: (r.case, -r.tol, r.solver, r.repeat)):
        if r.verdict is not Verdict.DECLINED:
            groups.setdefault(r.case.removesuffix(f"/{r.form}"), []).append(r)
    return groups


def _group(folder: _Folder, name: str, records: Sequence[Record]) -> _Part:
    """Assess the answers to one physical case, and claims of its infeasibility."""
    cases, records, lost = _built(folder, records)
    answers, damaged = _stored_answers(folder, records, cases)
    lost += damaged
    claims = list(filter(_is_proven, records))
    contradictory = set()
    # the run did not store the certificate of the solver: search for a new one
    for r in claims:
        qp = cases[r.case].qp
        claim = Solution.without_point(qp, Status(r.claimed or "infeasible"))
        if certificate_of(qp, claim, r.judged_at)[0]:
            contradictory.add(r.identity)
    lost += [
        _listed(r, "the certificate could not be computed again")
        for r in claims
        if r.identity not in contradictory
    ]
    # forms with equal mechanics belong to one problem; without mechanics, each form is
    # a separate problem
    by_numbers: dict[str, list[StoredAnswer]] = {}
    for g in answers:
        of = g.case.mechanics
        key = g.record.case if of is None else qp_digest(of.program)
        by_numbers.setdefault(key, []).append(g)
    problems: list[Problem] = []
    for same in by_numbers.values():
        forms = ", ".join(dict.fromkeys(g.record.form for g in same))
        called = name if len(by_numbers) == 1 else f"{name} ({forms})"
        problems.append(compare_answers(called, same, folder.reference))
    proven = [
        p for p in problems if p.doubt is not None and p.doubt < MAX_SOLUTION_ERROR
    ]
    solvable = {a.case: p for p in proven for a in p.answers}
    # a solution of the elastic problem refutes claims in every form
    elastic = next((p for p in proven if p.closed is not None), None)
    false = [
        _listed(r, text)
        for r in records
        if r.identity not in contradictory
        and (text := _falsehood(r, solvable.get(r.case, elastic)))
    ]
    return _Part(problems, lost, false, len(contradictory))


def _pointless(records: Sequence[Record]) -> str:
    """Return the reason why a folder has no answers that could be assessed."""
    if any(r.vectors for r in records):
        return "its stored points are missing; expected the vectors/*.npz of the run"
    statuses = Counter(r.verdict.words for r in records)
    ends = ", ".join(f"{n} {status}" for status, n in statuses.items())
    return f"no solver returned a point ({ends}); expected a solver that solves a case"


def _built(
    folder: _Folder, records: Iterable[Record]
) -> tuple[dict[str, Case], list[Record], list[Listed]]:
    """Rebuild the cases of answers.

    Returns
    -------
    the cases by name, the records that can be assessed, and the others with the reason:
    the case of an answer cannot be rebuilt, or the QP of the record is another one

    """
    cases: dict[str, Case] = {}
    same: list[Record] = []
    lost: list[Listed] = []
    by_case: dict[str, list[Record]] = {}
    for r in records:
        by_case.setdefault(r.case, []).append(r)
    for name, mine in by_case.items():
        answered = [r for r in mine if r.vectors or _is_proven(r)]
        known: tuple[str | None, ...] = ()
        try:
            if answered:
                cases[name] = rebuild(
                    answered[0], folder.path, folder.families, folder.reference
                )
                built = cases[name]
                now = built.digest or qp_digest(built.qp, serialised=True)
                known = None, now
        except InputError as e:
            lost += [_listed(r, str(e)) for r in answered]
            mine = [r for r in mine if not (r.vectors or _is_proven(r))]
        for r in mine:
            if not known or r.qp in known:
                same.append(r)
            else:
                text = (
                    f"its QP has the digest {known[1]} now, {r.qp} when it was "
                    "measured; expected the same version of the code, of its libraries "
                    "and of plug-ins"
                )
                lost.append(_listed(r, text))
    return cases, same, lost


def _stored_answers(
    folder: _Folder, records: Iterable[Record], cases: Mapping[str, Case]
) -> tuple[list[StoredAnswer], list[Listed]]:
    """Read the stored points of claims of success, and other verified points.

    Equal points of a solver for the same case and tolerance are read once. The second
    result lists the points that cannot be read, with the reasons.
    """
    answers: dict[tuple[str, str, float, str], StoredAnswer] = {}
    lost: list[Listed] = []
    for r in records:
        if not r.vectors or not (
            r.claimed == Status.SOLVED or r.verdict is Verdict.VERIFIED
        ):
            continue
        key = (r.solver, r.case, r.tol, r.vectors)
        if key in answers:
            repeats = answers[key].repeats + 1
            answers[key] = replace(answers[key], repeats=repeats)
            continue
        case = cases[r.case]
        try:
            s = load_solution(folder.path, r.vectors, Status(r.claimed or "failed"))
            if (wrong := s.mismatch(case.qp)) or not has_point(s):
                file = folder.path / "vectors" / f"{r.vectors}.npz"
                raise InputError(f"{file}: {wrong or 'NaN or inf'}")
        except InputError as e:
            lost.append(_listed(r, str(e)))
            continue
        answers[key] = StoredAnswer(
            record=r,
            label=r.solver,
            repeats=1,
            case=case,
            solution=s,
            remarks=() if digest_of(point_arrays(s)) == r.vectors else (_CHANGED,),
        )
    return list(answers.values()), lost


def _is_proven(r: Record) -> bool:
    """Return True if the run proved the claim that the QP has no solution."""
    return r.verdict.is_verified and r.verdict is not Verdict.VERIFIED


def _falsehood(r: Record, solved: Problem | None) -> str:
    """Return the reason why the claim of a record is false, or "".

    Only claims of success without a point, and claims of infeasibility, are considered.

    solved : the problem if it has a reference point, else None
    """
    if r.claimed == Status.SOLVED and not r.vectors:
        return "claims success without a finite point"
    if r.claimed in NO_SOLUTION and solved is not None:
        return (
            f"claims that there is no solution; the {solved.truth} is one, with an "
            f"error of at most {brief(solved.doubt or 0.0)}"
        )
    return ""


def _apart(r: Record) -> Record:
    """Return the record; for a step of a sequence, the label includes the mode."""
    return r if r.mode == "cold" else r.replace(solver=f"{r.solver} ({r.mode})")


def _listed(r: Record, text: str) -> Listed:
    return Listed(run_id=r.identity, solver=r.solver, case=r.case, tol=r.tol, text=text)
