"""Conclusions of a comparison of two result folders, in sentences."""

from __future__ import annotations

from mortarbench.harness.record import VERIFIED_FACTOR
from mortarbench.harness.running.pairs import Ratio
from mortarbench.reports.compare.changes import (
    ALIKE,
    Comparison,
    Mean,
    Pair,
    mean_ratio,
    relative_ratio,
    resolved,
    side,
)
from mortarbench.reports.compare.conditions import environments, machines_differ
from mortarbench.reports.compare.regressions import regressions
from mortarbench.reports.data.environment import busy_with, dateline
from mortarbench.reports.document.formatting import VERDICTS, fixed, plural
from mortarbench.reports.document.templates import Sentences
from mortarbench.reports.statistics.intervals import COVERAGE

NAMED = 8  #: largest number of changes named in the text; the tables list all
WORDS = ("slower", "faster", "no change seen", "not resolved")


_CONDITIONS = ("same_folder", "conditions", "busy")


def verdict_lines(c: Comparison) -> list[str]:
    """Return the conclusions as a few lines of plain text."""
    if not c.pairs:
        return [TEXT("nothing", c)]
    by_name = _named_sentences(c)
    means = [(solver, mean_ratio(c.of(solver))) for solver in c.solvers]
    lines = [*(by_name[name] for name in (*_CONDITIONS, "times", "slower"))]
    lines += [
        f"  {solver}: {ratio_text(mean)} over {plural(mean.cells, 'cell')}, "
        f"{change_word(mean)}"
        for solver, mean in means
        if mean is not None
    ]
    lines += [by_name["shared"], by_name["verdicts"], by_name["others"]]
    return [*filter(None, lines), *(f"  {point}" for point in named(c))]


def headline(c: Comparison) -> str:
    """Return the conclusions as one paragraph, for use beside a table of ratios."""
    if not c.pairs:
        return TEXT("nothing", c)
    by_name = _named_sentences(c)
    order = ("same_folder", "slower", "shared", "verdicts", "others", *_CONDITIONS[1:])
    return " ".join(by_name[name] for name in order if by_name[name])


def sentences(c: Comparison) -> tuple[str, ...]:
    """Return sentences about conditions, times and numbers of changes."""
    if not c.pairs:
        return (TEXT("nothing", c),)
    by_name = _named_sentences(c)
    lines = [by_name[name] for name in (*_CONDITIONS, "times", "slower", "shared")]
    return (*filter(None, lines), f"{by_name['verdicts']} {by_name['others']}")


def _named_sentences(c: Comparison) -> dict[str, str]:
    """Return all sentences by name; a sentence that does not apply is empty."""
    keys = [key for key, *_ in environments(c.before, c.after)]
    loads = [
        f"{load:.2f} {when}"
        for when, e in (("before", c.before), ("after", c.after))
        if (load := busy_with(e)) is not None
    ]
    everything = mean_ratio(c.pairs)
    relative = [relative_ratio(c, s) for s in c.solvers]
    apart = None in relative or any(map(side, relative))
    alike = everything is not None and side(everything) and not apart
    same = c.before.directory.resolve() == c.after.directory.resolve()
    return {
        "same_folder": TEXT("same_folder") if same else "",
        "conditions": TEXT("conditions", c, keys, machines_differ(c.before, c.after)),
        "busy": TEXT("busy", loads) if loads else "",
        "times": TEXT("times", [change_word(p.ratio) for p in c.timed if p.ratio]),
        "slower": TEXT("slower", regressions(c)),
        "shared": TEXT("shared", everything) if alike else "",
        "verdicts": TEXT("verdicts", c),
        "others": TEXT("others", c),
    }


def dates(c: Comparison) -> str:
    """Return dates and machines of both folders; name a common machine only once."""
    (then, there), (now, here) = (
        dateline(e).split(" · ", 1) for e in (c.before, c.after)
    )
    if there == here:
        return f"before: {then}, after: {now} · {here}"
    return f"before: {then} · {there}, after: {now} · {here}"


def change_word(interval: Ratio | Mean) -> str:
    """Return a change in words: one of `WORDS`.

    "No change seen" means that a change by the factor `ALIKE` would be visible.
    """
    if way := side(interval):
        return "slower" if way > 0 else "faster"
    return "no change seen" if resolved(interval) else "not resolved"


def named(c: Comparison) -> list[str]:
    """List changes for the worse: verdicts, answers, then times, slowest first."""
    slower = [(p.ratio.low, p) for p in c.timed if p.ratio and p.change > 0]
    slower.sort(key=lambda each: each[0], reverse=True)
    worse = [("worse", p) for p in c.worse]
    worse += [("apart", p) for p in c.pairs if p.other_answer]
    worse += [("longer", p) for _, p in slower]
    points = [TEXT(macro, p) for macro, p in worse[:NAMED]]
    rest = len(worse) - NAMED
    return [*points, f"and {rest} more (see the tables)"] if rest > 0 else points


def cell_name(pair: Pair) -> str:
    """Return solver, case and tolerance of a cell as text."""
    return TEXT("cell", pair.after)


def ratio_text(ratio: Ratio | Mean) -> str:
    """Format a ratio, with its interval if known."""
    if ratio.low == 0:
        return f"{ratio.value:.3f} [too few cells]"
    return fixed(ratio)


TEXT = Sentences(
    __name__,
    ALIKE=ALIKE,
    FACTOR=VERIFIED_FACTOR,
    MISS=1 - COVERAGE,
    NAMED=NAMED,
    VERDICTS=VERDICTS,
    WORDS=WORDS,
    ratio_text=ratio_text,
)
