"""What a reader came for: per form, who was fastest and by how much, and who failed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from harness import Verdict
from reports.data.comparison_groups import CASES
from reports.data.environment import busy_with
from reports.data.evidence import Evidence, Outcome
from reports.data.fastest import (
    Answers,
    Competitor,
    FastestSolver,
    Finding,
    Unverified,
    unverified,
)
from reports.data.time_at_accuracy import time_at_accuracy
from reports.document.formatting import (
    ENDINGS,
    bracketed,
    clean,
    listing,
    plural,
    power,
    seconds,
    tolerance,
)
from reports.document.layout import Picture, Section, Statement
from reports.figures.fastest import PANELS, SOLVERS, fastest_figure
from reports.sections.sweeps import ERRORS, Sweeps, places

ACCURACIES = 3  #: per form that have a sentence; of more, the ends and the middle
FAILURES = 3  #: per form that are told one by one


def answer(
    evidence: Evidence,
    found: Sequence[FastestSolver],
    answers: Answers,
    certified: Sweeps,
) -> Section:
    """Say who was fastest, with a figure of all; everything else is evidence."""
    statements = answer_statements(found, answers, certified)
    figure = fastest_figure(shown(found), evidence.solvers)
    pictures = () if figure is None else (
        Picture(name="answer", caption=_caption(shown(found)), figure=figure),
    )  # fmt: skip
    return Section(
        name="answer",
        title="Who was fastest",
        statements=statements,
        prose=_cautions(evidence),
        pictures=pictures,
    )


def answer_statements(
    found: Sequence[FastestSolver], answers: Answers, certified: Sweeps
) -> tuple[Statement, ...]:
    """Make a statement for every form, cold solves and sequences apart."""
    return tuple(
        _statement(subject, mine, answers, certified)
        for subject, mine in _by_subject(found).items()
    )


def shown(found: Sequence[FastestSolver]) -> list[FastestSolver]:
    """Choose what is drawn: of every form the tightest accuracy, the first few."""
    return [mine[-1] for mine in _by_subject(found).values()][:PANELS]


def _by_subject(found: Sequence[FastestSolver]) -> dict[str, list[FastestSolver]]:
    """Group by form and mode, cold solves first; loosest accuracy first."""
    order = sorted(found, key=lambda f: (f.kind.mode != "cold", f.kind.mode))
    grouped: dict[str, list[FastestSolver]] = {}
    for f in order:
        grouped.setdefault(f.kind.subject or "all forms", []).append(f)
    return {s: sorted(fs, key=lambda f: -f.kind.at) for s, fs in grouped.items()}


def _statement(
    subject: str, found: list[FastestSolver], answers: Answers, certified: Sweeps
) -> Statement:
    told = found
    if len(found) > ACCURACIES:
        told = [found[0], found[len(found) // 2], found[-1]]
    rows = [row for f in found for row in answers[f.kind].values()]
    cases = {case for f in found for case in answers[f.kind]}
    at_error = _at_error({c: row for c, row in certified.items() if c in cases})
    remarks = [
        *_faster_elsewhere(found[-1]),
        *_failed(unverified(rows), one_accuracy=len(found) == 1),
        *_declined(unverified(rows)),
        *_reservations(found),
    ]
    if len(told) < len(found):
        remarks.append(f"{len(found) - len(told)} more tolerances are in the evidence.")
    evidence = {"verdicts", "accuracy"} if at_error else {"verdicts"}
    for f in found:
        evidence |= {"accuracy"} if f.kind.sweep else set()
        evidence |= {"means", "ranking"} if f.over_cases else {"times", "ratios"}
    return Statement(
        subject=subject,
        claims=(*at_error, *map(claim, told)),
        remarks=tuple(remarks),
        evidence=tuple(sorted(evidence)),
    )


def claim(f: FastestSolver) -> str:
    """Say in one sentence who was fastest, or why no one is named."""
    where = _where(f)
    match f.finding:
        case Finding.FASTEST:
            time = _only_time(f)
            return f"{_name(f.first)} was the fastest {where}{time}{_following(f)}."
        case Finding.TIE:
            names = _joined([_name(c) for c in (f.first, *f.tied)])
            ratios = "; ".join(_tied(c, f) for c in f.tied[:2])
            return (
                f"A tie {where}: {names} are not told apart ({ratios}){_following(f)}."
            )
        case Finding.DIVIDED:
            return f"No solver was the fastest {where}: {_shared(f)}."
        case Finding.ALONE:
            only = _name((*f.competitors, *f.others)[0])
            return f"Only {only} was measured {where}: nothing to compare with."
        case Finding.NONE_VERIFIED:
            return f"No answer was verified at {f.kind.accuracy}."
        case Finding.UNFINISHED:
            return f"No case was measured with all solvers at {f.kind.accuracy}."
        case _:
            return f"Nobody is named {where}: {_hindrance(f)}."


def _hindrance(f: FastestSolver) -> str:
    """Say why no solver is named though there are verified answers."""
    match f.finding:
        case Finding.ONE_BLOCK:
            return (
                f"{_name(f.first)} had the smallest time, but fewer than two blocks of "
                "repeats give no interval; more repeats will"
            )
        case Finding.ENVIRONMENTS:
            return (
                "the solvers were measured in different environments, whose times are "
                "not comparable"
            )
        case Finding.ONE_COMPLETE:
            all_ = " on all of them" * (len(f.cases) > 1)
            return f"only {_name(f.first)} was verified{all_}, and no other competes"
        case _:
            best = f.others[0]
            return (
                f"no solver was verified on all of them; {_name(best)} was on most, "
                f"{len(best.verified)}"
            )


def _name(c: Competitor) -> str:
    return clean(c.solver, 40)


def _joined(names: Sequence[str]) -> str:
    """Enumerate names as a sentence does, the first four of them."""
    if len(names) > 4:
        return listing(names, 4)
    *rest, last = names
    return f"{', '.join(rest)} and {last}" if rest else last


def _where(f: FastestSolver) -> str:
    """Name the cases of a comparison, and the accuracy."""
    at = f"at {f.kind.accuracy}"
    if len(f.cases) == 1:
        return f"on the only case {at}"
    return f"{'over' if f.over_cases else 'on each of'} {len(f.cases)} cases {at}"


def _only_time(f: FastestSolver) -> str:
    if len(f.cases) > 1:
        return ""
    return f", {seconds(f.first.outcomes[f.cases[0]].seconds('total'))}"


def _following(f: FastestSolver) -> str:
    """Say how far the next is behind; over a few cases, how far at least."""
    behind = [(r, c) for c in f.competitors if c.slower and (r := c.closest)]
    if not behind:
        return ""
    r, following = min(behind, key=lambda each: each[0].value)
    least = "" if following.ratio else "at least "
    return (
        f"; the next, {_name(following)}, took {least}"
        f"{bracketed(r.value, r.low, r.high)} times as long"
    )


def _tied(c: Competitor, f: FastestSolver) -> str:
    """Say how near a tie is, and why it is one if the interval does not tell."""
    ratios = [c.ratio] if c.ratio else sorted(c.by_case.values(), key=lambda r: r.value)
    ends = [bracketed(r.value, r.low, r.high) for r in (ratios[0], ratios[-1])]
    text = f"{_name(c)} took {' to '.join(dict.fromkeys(ends))} times as long"
    if c.ratio and c.ratio.low > 1 and f.over_cases:
        return f"{text}, but a test of all pairs at once does not tell them apart"
    return text


def _faster_elsewhere(f: FastestSolver) -> list[str]:
    """Name who was faster than the first, but was not verified on every case."""
    faster = [
        f"{_name(c)} ({len(c.verified)} of {plural(len(f.cases), 'case')}, "
        f"{bracketed(r.value, r.low, r.high)} times as long)"
        for c in f.others
        if (r := c.ratio) and r.high < 1
    ]
    if not faster:
        return []
    told = "; ".join(faster[:FAILURES])
    return [f"Faster where verified, at {f.kind.accuracy}: {told}."]


def _shared(f: FastestSolver) -> str:
    """Count on how many cases each solver was fastest."""
    count = Counter(f.fastest_on().values())
    ties = count.pop(None, 0)
    parts = [f"{clean(s or '', 40)} on {n}" for s, n in count.most_common(4)]
    return ", ".join([*parts, *[f"a tie on {ties}"] * bool(ties)])


def _at_error(swept: Sweeps) -> tuple[str, ...]:
    """Say who was fastest at equal certified errors, over the cases of a form."""
    found = {error: _best_at(swept, error) for error in ERRORS}
    parts = [f"at {tolerance(error)} {text}" for error, text in found.items() if text]
    if not parts:
        return ()
    cases = plural(len(swept), "case")
    return (f"At equal certified error ({cases}) the fastest was: {'; '.join(parts)}.",)


def _best_at(swept: Sweeps, error: float) -> str:
    """Count on how many cases each solver is the fastest at one certified error."""
    count: Counter[str] = Counter()
    for row in swept.values():
        times = {
            solver: time_at_accuracy(outcomes, error)
            for solver, outcomes in row.items()
            if not outcomes[0].first.role
        }
        kinds = places(times)
        best = [s for s, kind in kinds.items() if kind == "best"]
        rivals = sum(found.time is not None for found in times.values())
        if len(best) == 1 and rivals > 1:
            tied = "tied" in kinds.values()
            count["a tie" if tied else clean(best[0], 40)] += 1
    return ", ".join(f"{who} on {n}" for who, n in count.most_common(4))


def _failed(found: Sequence[Unverified], *, one_accuracy: bool) -> list[str]:
    """Say who was not verified, how often and why, in one sentence."""
    failed = [one for one in found if one.verdict is not Verdict.DECLINED]
    if not failed:
        return []
    what = "case" if one_accuracy else "answer"
    told = [_failure(one, what) for one in failed[:FAILURES]]
    others = [*dict.fromkeys(clean(one.solver, 40) for one in failed[FAILURES:])]
    more = f"; also {listing(others, 4)}" if others else ""
    return [f"Failed: {'; '.join(told)}{more}."]


def _failure(one: Unverified, what: str) -> str:
    """Name a solver, what became of its answers, and on how many."""
    of = f"{len(one.answers)} of {plural(one.of, what)}"
    text = f"{clean(one.solver, 40)} {ENDINGS[one.verdict]} on {of}"
    why = _reason(one.answers, one.verdict)
    return f"{text} ({why})" if why else text


def _reason(outcomes: Sequence[Outcome], verdict: Verdict) -> str:
    """Give what refutes the claim and what is allowed, or else the solver's words."""
    if verdict in (Verdict.CRASHED, Verdict.FAILED):
        return clean(outcomes[0].first.message, 60)
    if verdict not in (Verdict.INACCURATE, Verdict.WRONG):
        return ""
    off = [(e, o) for o in outcomes if (e := o.largest("optimum_error")) is not None]
    residuals = [(e, o) for o in outcomes if (e := o.worst) is not None]
    known = off or residuals
    if not known:
        return ""
    error, worst = max(known, key=lambda each: each[0])
    what = "off the proven optimum by" if off else "residual"
    return f"{what} {power(error)}, allowed {power(worst.allowed)}"


def _declined(found: Sequence[Unverified]) -> list[str]:
    """Say who declined, and why in its own words."""
    declined = [one for one in found if one.verdict is Verdict.DECLINED]
    told = []
    for one in declined[:FAILURES]:
        some = "" if len(one.answers) == one.of else f" {len(one.answers)} of {one.of}"
        message = clean(one.answers[0].first.message, 90)
        why = f" ({message})" if message else ""
        told.append(f"{clean(one.solver, 40)}{some}{why}")
    others = [clean(one.solver, 40) for one in declined[FAILURES:]]
    more = f"; also {listing(others, 4)}" if others else ""
    return [f"Declined: {'; '.join(told)}{more}."] if told else []


def _reservations(found: Sequence[FastestSolver]) -> list[str]:
    """Say what the claims of one form do not cover."""
    named = (Finding.FASTEST, Finding.TIE, Finding.DIVIDED)
    few = any(f.finding in named and not f.over_cases for f in found)
    unsolved = max((f.unsolved for f in found if f.cases), default=0)
    said = [f"Nobody solved {plural(unsolved, 'further case')}."] * bool(unsolved)
    said += dict.fromkeys(note for f in found for note in f.notes)
    if few:
        said.append(f"Fewer than {CASES} cases: nothing is said of other cases.")
    return said


def _cautions(evidence: Evidence) -> tuple[str, ...]:
    """Warn of what makes times doubtful; the summary says more."""
    busy = busy_with(evidence) is not None
    machines = len({r.environment for r in evidence.records})
    parts = [f"{machines} different environments"] * (machines > 1)
    parts += ["a machine that was not idle"] * busy
    return (f"Caution: times of {' and '.join(parts)}; see the summary.",) * bool(parts)


def _caption(found: Sequence[FastestSolver]) -> str:
    """Say what the figure shows."""
    over = any(f.over_cases for f in found)
    blocks = any(not f.over_cases for f in found)
    means = (
        " Small: one case each; large: geometric mean of the ratios and its interval "
        "over the cases."
    ) * over
    dots = " Bars: interval within the blocks of one case." * blocks
    more = max((len(f.competitors) + len(f.others) for f in found), default=0) > SOLVERS
    rest = f" The first {SOLVERS} solvers." * more
    return (
        "Total time over that of the uppermost solver, at the tightest accuracy of "
        "each form. Only answers verified at the same accuracy compete, and only "
        "solvers that were verified on every case that anybody solved; at the right, "
        f"what was not verified.{means}{dots} Intervals and brackets: 95 %.{rest}"
    )
