"""Opening of the report: the fastest solver of each form, its lead, and the failures.

If the suite has only one solver, the report opens with the growth of the solver's
iterations, with condition numbers, and with the speed-up on ranks.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from mortarbench.harness import Verdict
from mortarbench.reports.data.comparison_groups import CASES, time_of
from mortarbench.reports.data.environment import busy_with
from mortarbench.reports.data.fastest import (
    Competitor,
    FastestSolver,
    Finding,
    Unverified,
    unverified,
)
from mortarbench.reports.data.rank_series import strong_series
from mortarbench.reports.data.size_series import SizeSeries, sweeps
from mortarbench.reports.data.time_at_accuracy import time_at_accuracy
from mortarbench.reports.document.formatting import (
    ENDINGS,
    TIMED,
    clean,
    listing,
    plural,
    power,
    significant,
    tolerance,
)
from mortarbench.reports.document.layout import Part, Picture, Statement
from mortarbench.reports.document.templates import Sentences
from mortarbench.reports.figures.fastest import PANELS, SOLVERS, fastest_figure
from mortarbench.reports.figures.scaling import condition_numbers, iterations_figure
from mortarbench.reports.sections import Analysis, section
from mortarbench.reports.sections.scaling import iteration_growth, per_decade
from mortarbench.reports.sections.sweeps import ERRORS, Sweeps, certified_sweeps, places
from mortarbench.reports.statistics.growth import Trend

ACCURACIES = (
    3  #: maximum number of accuracies per form: the tightest, a middle one, the loosest
)
FAILURES = 3  #: largest number of solvers in a list of failures that are described
FIRST_ROWS = 8  #: maximum number of rows of the first figure, to fit on a phone screen
REPEATS = 9  #: minimum number of repeats recommended to resolve a tie
MOST_SERIES = 4  #: largest number of size series that are described by a sentence each
_FROM_MESH = "From the mesh to a verified answer, including dualisation: "
_TRENDS = {
    Trend.FLAT: "stays flat",
    Trend.GROWS: "grows",
    Trend.FALLS: "falls",
    Trend.UNDECIDED: "shows no clear trend",
}


def _title(a: Analysis) -> str:
    if a.ways.comparisons:
        return "From mesh to answer"
    return "Results" if any(own_results(a)) else "Fastest solver"


@section(1, "answer", _title)
def answer(a: Analysis) -> Iterator[Part]:
    """Name the fastest combination of solver and form, or of each form."""
    if a.ways.comparisons:
        comparisons = _by_subject(a.ways.comparisons)
        for subject, mine in comparisons.items():
            remarks = (*_faster_elsewhere(mine[0]), *_reservations(mine))
            yield Statement(
                subject=subject,
                claims=tuple(
                    _FROM_MESH + _within(claim(f), f) for f in _selected(mine)
                ),
                remarks=remarks,
                evidence=("forms", "verdicts", "times"),
            )
        yield from _picture(
            "answer", [mine[0] for mine in comparisons.values()][:1], a, FIRST_ROWS
        )
    else:
        yield from _form_statements(a)
        own = [part for part in own_results(a) if isinstance(part, Picture)]
        yield from own or _picture("answer", shown(a.fastest), a, FIRST_ROWS)
    others = () if a.evidence.place else tuple(a.evidence.places.values())
    busy = busy_with(a.evidence) is not None
    yield from TEXT.parts("cautions", a.ways.uncharged, others, busy)


@section(2, "forms", "Solver times for each form")
def forms(a: Analysis) -> Iterator[Part]:
    """Compare solvers within each form, unless the first section contains this."""
    if a.ways.comparisons:
        yield from _form_statements(a)
        yield TIMED
        yield from _picture("forms", shown(a.fastest), a, SOLVERS)
    del a.ways  # frees the copies of all records


def _within(text: str, f: FastestSolver) -> str:
    """Return a sentence for use after a colon; only an initial name keeps its case."""
    named = f.finding in (Finding.FASTEST, Finding.ONE_BLOCK)
    return text if named else text[0].lower() + text[1:]


def shown(found: Sequence[FastestSolver]) -> list[FastestSolver]:
    """Select the first few forms to draw, each at its tightest accuracy."""
    return [mine[0] for mine in _by_subject(found).values()][:PANELS]


def _picture(
    name: str, found: Sequence[FastestSolver], a: Analysis, rows: int
) -> Iterator[Picture]:
    figure = fastest_figure(found, a.evidence.solvers, rows)
    if figure is not None:
        caption = TEXT(
            "drawn",
            any(_forms(f) for f in found),
            any(f.over_cases for f in found),
            any(not f.over_cases for f in found),
            rows,
            max(len(f.competitors) + len(f.others) for f in found),
        )
        yield Picture(name=name, caption=caption, figure=figure)


def _by_subject(found: Sequence[FastestSolver]) -> dict[str, list[FastestSolver]]:
    """Group comparisons by form and mode: cold solves and tight accuracies first."""
    order = sorted(found, key=lambda f: (f.key.mode != "cold", f.key.mode))
    grouped: dict[str, list[FastestSolver]] = {}
    for f in order:
        grouped.setdefault(f.key.subject or "all forms", []).append(f)
    return {s: sorted(fs, key=lambda f: f.key.at) for s, fs in grouped.items()}


def _selected(found: list[FastestSolver]) -> list[FastestSolver]:
    """Select the tightest, a middle one and the loosest of many accuracies."""
    if len(found) <= ACCURACIES:
        return found
    return [found[0], found[len(found) // 2], found[-1]]


def _form_statements(a: Analysis) -> Iterator[Statement]:
    """Yield a statement for every form, cold solves and sequences separately.

    Results of a single solver come first and replace the statement that there is no
    other solver to compare with.
    """
    own = [part for part in own_results(a) if isinstance(part, Statement)]
    yield from own
    alone = {f.key.subject for f in a.fastest if f.finding is Finding.ALONE}
    certified = certified_sweeps(a.evidence)
    for subject, found in _by_subject(a.fastest).items():
        statement = _statement(subject, found, a, certified)
        if statement.remarks or not own or subject not in alone:
            yield statement


def _statement(
    subject: str, found: list[FastestSolver], a: Analysis, certified: Sweeps
) -> Statement:
    selected = _selected(found)
    answers = [a.answers[f.key] for f in found]
    ended = unverified(row for of in answers for row in of.values())
    failed = [one for one in ended if one.verdict is not Verdict.DECLINED]
    declined = [one for one in ended if one.verdict is Verdict.DECLINED]
    swept = {
        case: row
        for case, row in certified.items()
        if any(case in of for of in answers)
    }
    at_error = [
        f"at {tolerance(error)} {text}"
        for error in ERRORS
        if (text := _best_at(swept, error))
    ]
    evidence = {"verdicts", *["accuracy"] * bool(at_error)}
    for f in found:
        evidence |= {"accuracy"} if f.key.sweep else set()
        evidence |= {"means", "ranking"} if f.over_cases else {"times", "ratios"}
    counted = "case" if len(found) == 1 else "answer"
    remarks = (
        *_faster_elsewhere(found[0]),
        TEXT("failed", failed, counted),
        TEXT("declined", declined, counted),
        *_reservations(found),
        f"{plural(more, 'more tolerance')} {'is' if more == 1 else 'are'} in the "
        "sections below."
        if (more := len(found) - len(selected))
        else "",
    )
    return Statement(
        subject=subject,
        claims=(
            *[TEXT("at_error", len(swept), at_error)] * bool(at_error),
            *map(claim, selected),
        ),
        remarks=tuple(filter(None, remarks)),
        evidence=tuple(sorted(evidence)),
    )


def claim(f: FastestSolver) -> str:
    """Return a sentence that names the fastest solver, or states why none is named."""
    return TEXT("claim", f)


def _name(c: Competitor) -> str:
    on = f" on the {clean(c.form, 24)} form" * bool(c.form)
    return f"{clean(c.solver, 40)}{on}"


def _named(competitors: Iterable[Competitor], most: int = 4) -> str:
    """Enumerate at most `most` names and count the others."""
    names = list(map(_name, competitors))
    if len(names) > most:
        return listing(names, most)
    return " and ".join([*[", ".join(names[:-1])] * (len(names) > 1), names[-1]])


def _forms(f: FastestSolver) -> list[str]:
    """Return the forms that compete; empty in a comparison of solvers of one form."""
    every = (*f.competitors, *f.others)
    return list(dict.fromkeys(c.form for c in every if c.form))


def _next_behind(
    f: FastestSolver,
) -> tuple[Competitor | None, list[tuple[str, Competitor | None]]]:
    """Return the next significantly slower competitor, and the best of further forms.

    A form is further if it differs from the forms of the first, the tied and the next
    competitors. Its best is None if no solver competes on it.
    """
    slower = [c for c in f.competitors[1:] if c.slower and c.closest]
    following = slower[0] if slower else None
    named = {c.form for c in (f.first, *f.tied, *slower[:1])}
    best = [
        (form, next((c for c in slower if c.form == form), None))
        for form in _forms(f)
        if form not in named
    ]
    return following, best


def _depends_on_case(f: FastestSolver) -> bool:
    """Return whether all tied solvers are faster on some case and slower on another.

    Only differences from the first solver that are significant on the case count.
    """
    known = [c.by_case.values() for c in f.tied]
    return bool(known) and all(
        any(r.low > 1 for r in of) and any(r.high < 1 for r in of) for of in known
    )


def _repeats(f: FastestSolver) -> str:
    """Return the option of `run` that narrows the intervals of a comparison."""
    made = max(len(o.records) for o in f.first.outcomes.values())
    return f"--repeats {max(REPEATS, 3 * made)}"


def _roughly(f: FastestSolver) -> str:
    """Return ratios to the first solver in words, for times without intervals."""

    def ratio(c: Competitor) -> str:
        logs = [
            np.log(time_of(c.outcomes[case]) or np.inf)
            - np.log(time_of(f.first.outcomes[case]) or np.inf)
            for case in f.cases
        ]
        return significant(float(np.exp(np.mean(logs))), 2)

    following = f.competitors[1]
    ratios = [f"next: {_name(following)}, about {ratio(following)} times as long"]
    for form in _forms(f):
        best = next((c for c in f.competitors if c.form == form), None)
        if best is not None and best not in (f.first, following):
            name = f"the best on the {clean(form, 24)} form, {clean(best.solver, 40)}"
            ratios.append(f"{name}, about {ratio(best)} times as long")
    return f"({'; '.join(ratios)})"


def _faster_elsewhere(f: FastestSolver) -> list[str]:
    """Name significantly faster solvers that were not verified on every case."""
    candidates = (c for c in f.others if not c.remembers)
    faster = [c for c in candidates if c.ratio and c.ratio.high < 1]
    return TEXT.parts("faster_elsewhere", f, faster)


def _shared(f: FastestSolver) -> str:
    """Count the cases on which each solver was fastest, and ties; at most 4 counts."""
    count = Counter(
        _name(front[0]) if len(front) == 1 else f"a tie of {_named(front, 2)}"
        for front in f.fronts().values()
    )
    return ", ".join(f"{name} on {n}" for name, n in count.most_common(4))


def _best_at(swept: Sweeps, error: float) -> str:
    """Count the cases on which each solver is the fastest at one certified error.

    Ties are counted together. Cases on which fewer than two solvers reach the error, or
    on which a time is only bounded, do not count.
    """
    count: Counter[str] = Counter()
    for row in swept.values():
        times = {
            solver: time_at_accuracy(outcomes, error)
            for solver, outcomes in row.items()
            if not outcomes[0].first.arm
        }
        kinds = places(times)
        best = [s for s, kind in kinds.items() if kind == "best"]
        rivals = sum(found.time is not None for found in times.values())
        if len(best) == 1 and rivals > 1:
            tied = "tied" in kinds.values()
            count["a tie" if tied else clean(best[0], 40)] += 1
    return ", ".join(f"{name} on {n}" for name, n in count.most_common(4))


def _reason(one: Unverified) -> str:
    """Return the refuting residual and its limit, or the message of a failed solver.

    The text is empty for all other verdicts.
    """
    if one.verdict in (Verdict.CRASHED, Verdict.FAILED):
        return clean(one.answers[0].first.message, 60)
    if one.verdict not in (Verdict.INACCURATE, Verdict.WRONG):
        return ""
    errors = [(e, o) for o in one.answers if (e := o.worst) is not None]
    if not errors:
        return ""
    error, worst = max(errors, key=lambda each: each[0])
    return f"residual {power(error)}, allowed {power(worst.allowed)}"


def _reservations(found: Sequence[FastestSolver]) -> list[str]:
    """List the limitations of the claims about one form."""
    named = (Finding.FASTEST, Finding.TIE, Finding.DIVIDED)
    few = any(f.finding in named and not f.over_cases for f in found)
    unsolved = max((f.unsolved for f in found if f.cases), default=0)
    return [
        *[TEXT("unsolved", unsolved)] * bool(unsolved),
        *TEXT.parts(
            "remembering", dict.fromkeys(_name(c) for f in found for c in f.remembering)
        ),
        *dict.fromkeys(note for f in found for note in f.notes),
        *[TEXT("few")] * few,
    ]


def own_results(a: Analysis) -> Iterator[Statement | Picture]:
    """Summarise how iterations grow, the condition numbers, and the speed-up on ranks.

    Yield nothing unless exactly one solver (null arms aside) was run on one rank.
    """
    firsts = (o.first for o in a.evidence.flat)
    cold = {r.solver for r in firsts if not r.arm and r.ranks == 1}
    if len(cold) != 1:
        return
    (solver,) = cold
    claims = tuple(_own_claims(solver, a))
    if not claims:
        return
    yield Statement(
        subject=clean(solver, 40),
        claims=claims,
        evidence=("growth", "scaling", "steps", "ranks", "verdicts"),
    )
    if (figure := iterations_figure(a.sizes, solver)) is not None:
        yield Picture(name="answer", caption=TEXT("iterations"), figure=figure)


def _growth(solver: str, sizes: Sequence[SizeSeries]) -> Iterator[str]:
    """Yield a sentence on the growth of iterations in all series.

    If there are several series, a sentence on each of the first `MOST_SERIES` follows.
    """
    fits = [(s, fit) for s in sizes if (fit := iteration_growth(s, solver))]
    if not fits:
        return
    trends = []
    for trend, words in _TRENDS.items():
        those = sorted(
            (fit for _, fit in fits if fit.trend is trend), key=lambda fit: fit.exponent
        )
        if those:
            where = f" in {len(those)} of {len(fits)} series" * (len(fits) > 1)
            ends = dict.fromkeys(per_decade(fit) for fit in (those[0], those[-1]))
            trends.append(f"{words}{where} ({' to '.join(ends)} per decade)")
    curves = [s.curve(solver) for s, _ in fits]
    counts = [[i for _, o in curve for i in o.iterations or ()] for curve in curves]
    reach = [n for curve in curves for n, _ in curve]
    yield TEXT("growth", solver, reach, [i for of in counts for i in of], trends)
    if len(fits) > 1:
        described = [*zip(fits, curves, counts, strict=True)][:MOST_SERIES]
        for (s, fit), curve, its in described:
            yield TEXT("growth_of", s.title, curve, its, per_decade(fit))


def _own_claims(solver: str, a: Analysis) -> Iterator[str]:
    """Yield sentences on growth, condition numbers, effect of H/h, and speed-up."""
    yield from _growth(solver, a.sizes)
    for series in a.sizes:
        curve = [(float(n), o) for n, o in series.curve(solver)]
        if ranges := condition_numbers(curve):
            yield TEXT("condition", series.title, ranges)
    for sweep in sweeps(a.evidence, "feti"):
        ends_of = sweep.answers[0], sweep.answers[-1]
        if all(o.iterations for _, o in ends_of):
            yield TEXT("subdomains", sweep, ends_of)
    for strong in strong_series(a.evidence):
        free = [n for n in strong.several if not strong.crowded(n)]
        ratio = strong.speed_up(free[-1], "solve") if free else None
        if ratio is not None:
            yield TEXT("speed_up", strong, free[-1], ratio)


TEXT = Sentences(
    __name__,
    CASES=CASES,
    ENDINGS=ENDINGS,
    FAILURES=FAILURES,
    name=_name,
    named=_named,
    forms=_forms,
    next_behind=_next_behind,
    depends_on_case=_depends_on_case,
    repeats=_repeats,
    roughly=_roughly,
    shared=_shared,
    reason=_reason,
    noun=lambda f: "problem" if _forms(f) else "case",
    has_ties=lambda f: any(len(front) > 1 for front in f.fronts().values()),
)
