"""What a reader came for: per form, who was fastest and by how much, and who failed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from mortarbench.harness import Verdict
from mortarbench.reports.data.comparison_groups import CASES, Answers, time_of
from mortarbench.reports.data.environment import busy_with
from mortarbench.reports.data.evidence import Evidence, Outcome
from mortarbench.reports.data.fastest import (
    Competitor,
    FastestSolver,
    Finding,
    Unverified,
    unverified,
)
from mortarbench.reports.data.time_at_accuracy import time_at_accuracy
from mortarbench.reports.data.ways import Ways
from mortarbench.reports.document.formatting import (
    ENDINGS,
    TIMED,
    bracketed,
    clean,
    listing,
    plural,
    power,
    seconds,
    significant,
    tolerance,
)
from mortarbench.reports.document.layout import Picture, Section, Statement
from mortarbench.reports.figures.fastest import PANELS, SOLVERS, fastest_figure
from mortarbench.reports.sections.scaling import OwnResults
from mortarbench.reports.sections.sweeps import ERRORS, Sweeps, places

ACCURACIES = 3  #: per form that have a sentence; of more, the ends and the middle
FAILURES = 3  #: per form that are told one by one
FIRST_ROWS = 8  #: of the first figure, which a phone shows below the first sentence
REPEATS = 9  #: that are recommended where fewer left a tie
_FROM_MESH = "From the mesh to a verified answer, dualising charged: "


def opening(
    evidence: Evidence,
    ways: Ways,
    found: Sequence[FastestSolver],
    answers: Answers,
    certified: Sweeps,
    own: OwnResults,
) -> list[Section]:
    """Return the sections that answer the reader's question; the rest is evidence.

    Where ways from the mesh were compared, they come first, and the solvers of each
    form, without dualising, follow.

    own : results of the only solver, where nothing is compared
    """
    forms = form_statements(found, answers, certified)
    if own.statements:
        alone = {f.kind.subject for f in found if f.finding is Finding.ALONE}
        told = (s for s in forms if s.subject not in alone or s.remarks)
        forms = (*own.statements, *told)
    if not ways.found:
        section = Section(
            name="answer",
            title="What was found" if own.statements else "Who was fastest",
            statements=forms,
            prose=_cautions(evidence, ways),
            pictures=own.pictures
            or _pictures("answer", shown(found), evidence, FIRST_ROWS),
        )
        return [section]
    tightest = [mine[0] for mine in _by_subject(ways.found).values()]
    return [
        Section(
            name="answer",
            title="From mesh to answer",
            statements=way_statements(ways),
            prose=_cautions(evidence, ways),
            pictures=_pictures("answer", tightest[:1], evidence, FIRST_ROWS),
        ),
        Section(
            name="forms",
            title="Form by form: the solver alone",
            statements=forms,
            prose=(TIMED,),
            pictures=_pictures("forms", shown(found), evidence),
        ),
    ]


def _pictures(
    name: str, found: Sequence[FastestSolver], evidence: Evidence, rows: int = SOLVERS
) -> tuple[Picture, ...]:
    figure = fastest_figure(found, evidence.solvers, rows)
    if figure is None:
        return ()
    return (Picture(name=name, caption=_caption(found, rows), figure=figure),)


def way_statements(ways: Ways) -> tuple[Statement, ...]:
    """Return what is said of all forms together, the tightest accuracy first."""
    return tuple(
        Statement(
            subject=subject,
            claims=tuple(_from_mesh(f) for f in _selected(found)),
            remarks=(
                *(text for f in found[:1] for text in _faster_elsewhere(f)),
                *_reservations(found),
            ),
            evidence=("forms", "verdicts", "times"),
        )
        for subject, found in _by_subject(ways.found).items()
    )


def _from_mesh(f: FastestSolver) -> str:
    """Write one sentence on the fastest way."""
    text = claim(f)
    if f.finding not in (Finding.FASTEST, Finding.ONE_BLOCK):  # these begin with a name
        text = text[0].lower() + text[1:]
    return _FROM_MESH + text


def form_statements(
    found: Sequence[FastestSolver], answers: Answers, certified: Sweeps
) -> tuple[Statement, ...]:
    """Make a statement for every form, cold solves and sequences apart."""
    return tuple(
        _statement(subject, mine, answers, certified)
        for subject, mine in _by_subject(found).items()
    )


def shown(found: Sequence[FastestSolver]) -> list[FastestSolver]:
    """Choose what is drawn: of every form the tightest accuracy, the first few."""
    return [mine[0] for mine in _by_subject(found).values()][:PANELS]


def _by_subject(found: Sequence[FastestSolver]) -> dict[str, list[FastestSolver]]:
    """Group by form and mode, cold solves first; tightest accuracy first."""
    order = sorted(found, key=lambda f: (f.kind.mode != "cold", f.kind.mode))
    grouped: dict[str, list[FastestSolver]] = {}
    for f in order:
        grouped.setdefault(f.kind.subject or "all forms", []).append(f)
    return {s: sorted(fs, key=lambda f: f.kind.at) for s, fs in grouped.items()}


def _selected(found: list[FastestSolver]) -> list[FastestSolver]:
    """Choose the ends and the middle of many accuracies."""
    if len(found) <= ACCURACIES:
        return found
    return [found[0], found[len(found) // 2], found[-1]]


def _statement(
    subject: str, found: list[FastestSolver], answers: Answers, certified: Sweeps
) -> Statement:
    told = _selected(found)
    rows = [row for f in found for row in answers[f.kind].values()]
    cases = {case for f in found for case in answers[f.kind]}
    at_error = _at_error({c: row for c, row in certified.items() if c in cases})
    remarks = [
        *_faster_elsewhere(found[0]),
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
            return f"{_name(f.first)} was the fastest {where}{time}{_behind(f)}."
        case Finding.TIE:
            names = _joined([_name(c) for c in (f.first, *f.tied)])
            ratios = "; ".join(_tied(c) for c in f.tied[:2])
            return (
                f"A tie {where}: {names} are not told apart ({ratios}); "
                f"{_remedy(f)}{_behind(f)}."
            )
        case Finding.DIVIDED:
            least = f"; {_name(f.first)} took least in the mean" * bool(_forms(f))
            return f"No {_entrant(f)} was the fastest {where}: {_shared(f)}{least}."
        case Finding.ALONE:
            only = _name((*f.competitors, *f.others)[0])
            return f"Only {only} was measured {where}: nothing to compare with."
        case Finding.NONE_VERIFIED:
            return f"No answer was verified at {f.kind.accuracy}."
        case Finding.UNFINISHED:
            all_ = f"all {_entrant(f)}s at {f.kind.accuracy}"
            return f"No {_noun(f)} was measured with {all_}."
        case Finding.ONE_BLOCK:
            if len(f.cases) > 1:
                where = (
                    f"in the mean of {len(f.cases)} {_noun(f)}s at {f.kind.accuracy}"
                )
            return (
                f"{_name(f.first)} had the smallest time {where}{_roughly(f)}, but "
                "nobody is named: fewer than two blocks of repeats give no interval; "
                f"more repeats will ({_repeats(f)})."
            )
        case _:
            return f"Nobody is named {where}: {_hindrance(f)}."


def _hindrance(f: FastestSolver) -> str:
    """Say why no solver is named though there are verified answers."""
    match f.finding:
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
                f"no {_entrant(f)} was verified on all of them; {_name(best)} was on "
                f"most, {len(best.verified)}"
            )


def _name(c: Competitor) -> str:
    on = f" on the {clean(c.form, 24)} form" * bool(c.form)
    return f"{clean(c.solver, 40)}{on}"


def _joined(names: Sequence[str], most: int = 4) -> str:
    """Enumerate names as a sentence does, the first few of them."""
    if len(names) > most:
        return listing(names, most)
    *rest, last = names
    return f"{', '.join(rest)} and {last}" if rest else last


def _forms(f: FastestSolver) -> list[str]:
    """List the forms that compete; empty where solvers of one form do."""
    every = (*f.competitors, *f.others)
    return list(dict.fromkeys(c.form for c in every if c.form))


def _noun(f: FastestSolver) -> str:
    return "problem" if _forms(f) else "case"


def _entrant(f: FastestSolver) -> str:
    return "way" if _forms(f) else "solver"


def _where(f: FastestSolver) -> str:
    """Name the cases of a comparison, and the accuracy."""
    at = f"at {f.kind.accuracy}"
    if len(f.cases) == 1:
        return f"on the only {_noun(f)} {at}"
    preposition = "over" if f.over_cases else "on each of"
    return f"{preposition} {len(f.cases)} {_noun(f)}s {at}"


def _only_time(f: FastestSolver) -> str:
    if len(f.cases) > 1:
        return ""
    return f", {seconds(f.first.outcomes[f.cases[0]].seconds('total'))}"


def _behind(f: FastestSolver) -> str:
    """Write how far the next is behind, and the best of every other form."""
    slower = [c for c in f.competitors[1:] if c.slower and c.closest]
    following = slower[:1]
    said = [f"the next, {_name(c)}, took {_longer(c)} times as long" for c in following]
    named = {c.form for c in (f.first, *f.tied, *following)}
    for form in _forms(f):
        if form in named:
            continue
        best = next((c for c in slower if c.form == form), None)
        on = f"on the {clean(form, 24)} form"
        said.append(
            f"nobody {on} was verified on all" if best is None
            else f"the best {on}, {clean(best.solver, 40)}, took {_longer(best)}"
        )  # fmt: skip
    return "".join(f"; {text}" for text in said)


def _longer(c: Competitor) -> str:
    """Print the ratio to the first; over a few cases, the least of theirs."""
    r = c.closest
    assert r is not None
    return "at least " * (c.ratio is None) + bracketed(r.value, r.low, r.high)


def _tied(c: Competitor) -> str:
    """Write the interval of a tie."""
    if c.apart:
        return f"{_name(c)} was measured in another session"
    ratios = [c.ratio] if c.ratio else sorted(c.by_case.values(), key=lambda r: r.value)
    ends = [bracketed(r.value, r.low, r.high) for r in (ratios[0], ratios[-1])]
    return f"{_name(c)} took {' to '.join(dict.fromkeys(ends))} times as long"


def _remedy(f: FastestSolver) -> str:
    """Name what decides a tie: more repeats, unless it depends on the case."""
    turns = [c for c in f.tied if _turns(c)]
    if turns and len(turns) == len(f.tied):
        return "which is faster depends on the case, and more repeats will not tell"
    return f"more repeats may tell them apart ({_repeats(f)})"


def _turns(c: Competitor) -> bool:
    """Return whether the first is faster on one case, and slower on another."""
    known = c.by_case.values()
    return any(r.low > 1 for r in known) and any(r.high < 1 for r in known)


def _repeats(f: FastestSolver) -> str:
    """Name the option of `run` that narrows the intervals of a comparison."""
    made = max(len(o.records) for o in f.first.outcomes.values())
    return f"--repeats {max(REPEATS, 3 * made)}"


def _roughly(f: FastestSolver) -> str:
    """Compare with the next, and the best of other forms, where intervals lack."""

    def ratio(c: Competitor) -> str:
        logs = [
            np.log(time_of(c.outcomes[case]) or np.inf)
            - np.log(time_of(f.first.outcomes[case]) or np.inf)
            for case in f.cases
        ]
        return significant(float(np.exp(np.mean(logs))), 2)

    following = f.competitors[1]
    said = [f"next is {_name(following)}, about {ratio(following)} times as long"]
    for form in _forms(f):
        best = next((c for c in f.competitors if c.form == form), None)
        if best is not None and best not in (f.first, following):
            name = f"the best on the {clean(form, 24)} form, {clean(best.solver, 40)}"
            said.append(f"{name}, about {ratio(best)}")
    return f" ({'; '.join(said)})"


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
    """Count on how many cases each solver was fastest, and which ones tie."""
    fronts = [tuple(map(_name, front)) for front in f.fronts().values()]
    count = Counter(
        names[0] if len(names) == 1 else f"a tie of {_joined(names, 2)}"
        for names in fronts
    )
    parts = [f"{name} on {n}" for name, n in count.most_common(4)]
    ties = any(len(names) > 1 for names in fronts)
    remedy = f"; more repeats may decide ties ({_repeats(f)})" * ties
    return f"{', '.join(parts)}{remedy}"


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


def _cautions(evidence: Evidence, ways: Ways) -> tuple[str, ...]:
    """Warn of what makes times doubtful; the summary says more."""
    uncharged = (
        f"Forms are not compared on {plural(ways.uncharged, 'problem')}: the records "
        "do not hold the time of dualising.",
    ) * bool(ways.uncharged)
    busy = busy_with(evidence) is not None
    machines = len({r.environment for r in evidence.records})
    parts = [f"{machines} different environments"] * (machines > 1)
    parts += ["a machine that was not idle"] * busy
    doubtful = (f"Caution: times of {' and '.join(parts)}; see the summary.",)
    return uncharged + doubtful * bool(parts)


def _caption(found: Sequence[FastestSolver], rows: int) -> str:
    """Say what the figure shows."""
    over = any(f.over_cases for f in found)
    blocks = any(not f.over_cases for f in found)
    forms = any(_forms(f) for f in found)
    time = (
        "Seconds of dualising (dual forms), preparing and solving together, relative "
        "to the uppermost way. Assembling, the same for all forms, is not counted."
        if forms
        else "Time of preparing and solving relative to the uppermost solver, at the "
        "tightest accuracy of each form."
    )
    means = (
        " Small: one case each; large: geometric mean of the ratios and its interval "
        "over the cases."
    ) * over
    dots = " Bars: interval within the blocks of one case." * blocks
    once = (
        " Dualising is measured once for each build of a case, so its own scatter is "
        f"not in {'intervals within blocks' if over else 'these intervals'}."
    ) * (forms and blocks)
    more = max((len(f.competitors) + len(f.others) for f in found), default=0) > rows
    rest = (
        f" The first {rows} ways, and the best of every form."
        if forms
        else f" The first {rows} solvers."
    ) * more
    return (
        f"{time} Only answers verified at the same accuracy compete, and only those "
        f"who were verified on every {'problem' if forms else 'case'} that anybody "
        f"solved; at the right, what was not verified.{means}{dots}{once} Intervals "
        f"and brackets: 95 %.{rest}"
    )
