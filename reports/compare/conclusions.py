"""What a comparison of two result folders comes to, in sentences."""

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
from mortarbench.reports.compare.regressions import Slower, regressions
from mortarbench.reports.data.environment import busy_with, dateline
from mortarbench.reports.document.formatting import (
    VERDICTS,
    clean,
    plural,
    power,
    tolerance,
)
from mortarbench.reports.statistics.intervals import COVERAGE

NAMED = 8  #: changes that are named; tables have all
WORDS = ("slower", "faster", "no change seen", "not resolved")


def verdict_lines(c: Comparison) -> list[str]:
    """Say in a few lines of plain text how the comparison ended."""
    if not c.pairs:
        return [_nothing(c)]
    first = (_same(c), _environments(c), _residuals(c), _busy(c))
    lines = [*filter(None, first), _counted_times(c), _slower(c)]
    means = [(s, mean_ratio(c.of(s))) for s in c.solvers]
    lines += [
        f"  {s}: {ratio_text(mean)} over {plural(mean.cells, 'cell')}, "
        f"{change_word(mean)}"
        for s, mean in means
        if mean is not None
    ]
    lines += [*filter(None, [_shared(c)]), _counted_verdicts(c), _counted_others(c)]
    return lines + [f"  {point}" for point in named(c)]


def headline(c: Comparison) -> str:
    """Say how the comparison ended in whole sentences, beside a table of ratios."""
    if not c.pairs:
        return _nothing(c)
    said = (
        _same(c),
        _slower(c),
        _shared(c),
        _counted_verdicts(c),
        _counted_others(c),
        _environments(c),
        _residuals(c),
        _busy(c),
    )
    return " ".join(filter(None, said))


def dates(c: Comparison) -> str:
    """Say when and on which machine, which is named once if it is the same."""
    (then, there), (now, here) = (
        dateline(e).split(" · ", 1) for e in (c.before, c.after)
    )
    if there == here:
        return f"before: {then}, after: {now} · {here}"
    return f"before: {then} · {there}, after: {now} · {here}"


def sentences(c: Comparison) -> tuple[str, ...]:
    """Say how the conditions compare, and count what changed."""
    if not c.pairs:
        return (_nothing(c),)
    counted = f"{_counted_verdicts(c)} {_counted_others(c)}"
    said = (
        _same(c),
        _environments(c),
        _residuals(c),
        _busy(c),
        _counted_times(c),
        _slower(c),
        _shared(c),
        counted,
    )
    return tuple(filter(None, said))


def _same(c: Comparison) -> str:
    """Tell who compares a folder with itself that this says nothing."""
    if c.before.directory.resolve() != c.after.directory.resolve():
        return ""
    return "Before and after are the same folder: nothing in it can have changed."


def _nothing(c: Comparison) -> str:
    """Say that there is nothing to compare."""
    return (
        "No cell is in both folders (a solver on a case at a tolerance), so there is "
        f"nothing to compare: {plural(len(c.only_before), 'cell')} before, "
        f"{len(c.only_after)} after."
    )


def change_word(interval: Ratio | Mean) -> str:
    """Say what an interval tells; "no change" only if it could have told one."""
    if way := side(interval):
        return "slower" if way > 0 else "faster"
    return "no change seen" if resolved(interval) else "not resolved"


def _environments(c: Comparison) -> str:
    """Say whether the conditions were equal, and so what times may tell."""
    keys = [key for key, *_ in environments(c.before, c.after)]
    named = ", ".join(clean(k, 40) for k in keys[:6]) + (" …" if keys[6:] else "")
    if machines_differ(c.before, c.after):
        kept = sum(p.same_machine for p in c.pairs)
        what = f" ({named})" if named else ""
        return (
            f"Environments differ{what}: not all was measured on equal machines. "
            f"Times of {kept} of {plural(len(c.pairs), 'cell')} are compared, those "
            "whose machine, threads and BLAS were the same before and after."
        )
    if keys:
        return (
            f"The machine is the same; what differs is {named}. A change below may be "
            "due to that, or to the run."
        )
    return "The environments are the same: machine, versions and code."


def _counted_times(c: Comparison) -> str:
    timed = c.timed
    if not timed:
        return "Times: no cell has two verified repeats in both folders to compare."
    words = [change_word(p.ratio) for p in timed if p.ratio is not None]
    counted = ", ".join(f"{words.count(word)} {word}" for word in WORDS)
    chance = (1 - COVERAGE) * len(timed)
    return (
        f"Times: {counted}, of {plural(len(timed), 'cell')}; not resolved: the "
        f"interval holds 1, and a factor of {ALIKE:g} or its inverse as well. Of "
        f"intervals that hold {COVERAGE:.0%}, {chance:.1f} would show a change by "
        "chance."
    )


def _slower(c: Comparison) -> str:
    """Say what is slower by intervals that hold all together."""
    found = regressions(c)
    if found.why_not:
        return f"Slower, beyond chance and the machine: not judged, {found.why_not}."
    named = [slower_text(one) for one in found.slower[:NAMED]]
    rest = len(found.slower) - len(named)
    more = [f"and {rest} more"] * (rest > 0)
    told = "; ".join([*named, *more]) or "none"
    judged = f"{plural(found.solvers, 'solver')} and {plural(found.cells, 'cell')}"
    return (
        f"Slower, beyond chance and the machine: {told} ({judged} judged, all "
        f"intervals together at {COVERAGE:.0%})."
        + "".join(f" {clean(text, 400)}." for text in found.unverified)
    )


def slower_text(one: Slower) -> str:
    """Name what is slower, with its ratio and that relative to the other solvers."""
    name = clean(one.solver, 40)
    if one.case and one.tol is not None:
        name += f" on {clean(one.case)} at {tolerance(one.tol)}"
    return (
        f"{name} {ratio_text(one.ratio)} times as long, relative to the others "
        f"{ratio_text(one.relative)}"
    )


def _busy(c: Comparison) -> str:
    """Warn of a machine that other programs used when one of the runs began."""
    loads = [busy_with(e) for e in (c.before, c.after)]
    named = [
        f"{load:.2f} {when}"
        for load, when in zip(loads, ("before", "after"), strict=True)
        if load is not None
    ]
    if not named:
        return ""
    return (
        f"Warning: the machine was not idle when measuring began (load average "
        f"{', '.join(named)}): a change below may be its own."
    )


def _shared(c: Comparison) -> str:
    """Warn of a change that no solver has more of than the others."""
    everything = mean_ratio(c.pairs)
    relative = [relative_ratio(c, s) for s in c.solvers]
    apart = None in relative or any(map(side, relative))
    if everything is None or not side(everything) or apart:
        return ""
    return (
        f"All solvers changed alike, together {ratio_text(everything)}: rather the "
        "machine than a solver."
    )


def _residuals(c: Comparison) -> str:
    """Say so where the two folders hold residuals of different definitions."""
    then, now = ({r.schema for r in e.records} for e in (c.before, c.after))
    if then == now and len(now) == 1:
        return ""
    before, after = (" and ".join(map(str, sorted(s))) for s in (then, now))
    return (
        f"Residuals are defined differently: journal schema {before} before, {after} "
        "after. A verdict may have changed with the definition, not with the answer."
    )


def _counted_verdicts(c: Comparison) -> str:
    worse, better = (sum(p.turn == way for p in c.pairs) for way in (1, -1))
    factor = c.after.factor
    at = "" if factor == VERIFIED_FACTOR else f" at {factor:g} × tolerance"
    return f"Verdicts{at}: {worse} worse, {better} better, of {len(c.pairs)}."


def _counted_others(c: Comparison) -> str:
    iterations = sum(p.other_iterations for p in c.pairs)
    answers = sum(p.other_answer for p in c.pairs)
    return (
        f"Iterations: {iterations} changed. Answers: {answers} differ. In one folder "
        f"only: {plural(len(c.only_before), 'cell')} before, {len(c.only_after)} after."
    )


def named(c: Comparison) -> list[str]:
    """Name what became worse: verdicts, answers, then times, the largest first."""
    worse = [
        f"{cell_name(p)}: {VERDICTS[p.before.verdict][1]} before, "
        f"{VERDICTS[p.after.verdict][1]} after"
        for p in c.worse
    ]
    worse += [
        f"{cell_name(p)}: another answer, {power(p.answers[2])} apart"
        for p in c.pairs
        if p.other_answer and p.answers is not None
    ]
    slower = [(p, p.ratio) for p in c.timed if p.ratio and p.change > 0]
    slower.sort(key=lambda each: each[1].low, reverse=True)
    worse += [f"{cell_name(p)}: {ratio_text(r)} times as long" for p, r in slower]
    rest = len(worse) - NAMED
    return [*worse[:NAMED], f"and {rest} more, see the tables"] if rest > 0 else worse


def cell_name(pair: Pair) -> str:
    """Name solver, case and tolerance."""
    o = pair.after
    return f"{clean(o.solver, 40)} on {clean(o.case)} at {tolerance(o.tol)}"


def ratio_text(ratio: Ratio | Mean) -> str:
    """Print a ratio with its interval, or without one where there is none."""
    if ratio.low == 0:
        return f"{ratio.value:.3f} [too few cells]"
    return f"{ratio.value:.3f} [{ratio.low:.3f}, {ratio.high:.3f}]"
