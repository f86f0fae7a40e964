"""Formats of numbers and names in reports: plain text, escaped by the renderers."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Sequence
from functools import lru_cache

from mortarbench.harness import Verdict
from mortarbench.harness.files.csvfile import inert
from mortarbench.reports.statistics.intervals import Interval, PowerLaw

ABSENT = "–"  #: text for a value that was not or cannot be measured

#: definition of the times, stated wherever times are shown
TIMED = (
    "Times are solver times, which start with the assembled QP: assembly, "
    "linearisation and, for dual forms, dualisation are not included."
)

#: Symbol and words of every verdict. Colours alone would exclude colour-blind readers.
VERDICTS = {
    Verdict.VERIFIED: ("✓", "verified"),
    Verdict.VERIFIED_INFEASIBLE: ("✓", "verified infeasible"),
    Verdict.VERIFIED_UNBOUNDED: ("✓", "verified unbounded"),
    Verdict.INACCURATE: ("△", "inaccurate"),
    Verdict.WRONG: ("✗", "wrong"),
    Verdict.INFEASIBLE_CLAIM: ("∅", "infeasible claim"),
    Verdict.UNBOUNDED_CLAIM: ("∅", "unbounded claim"),
    Verdict.ITERATION_LIMIT: ("↻", "iteration limit"),
    Verdict.TIME_LIMIT: ("↻", "time limit"),
    Verdict.MEMORY_LIMIT: ("↻", "memory limit"),
    Verdict.CRASHED: ("†", "crashed"),
    Verdict.FAILED: ("†", "failed"),
    Verdict.DECLINED: ("○", "declined"),
}

#: Verb phrases whose subject is a solver without a verified answer.
ENDINGS = {
    Verdict.INACCURATE: "claimed success but was inaccurate",
    Verdict.WRONG: "claimed success but was wrong",
    Verdict.INFEASIBLE_CLAIM: "claimed infeasibility",
    Verdict.UNBOUNDED_CLAIM: "claimed an unbounded objective",
    Verdict.ITERATION_LIMIT: "reached the iteration limit",
    Verdict.TIME_LIMIT: "reached the time limit",
    Verdict.MEMORY_LIMIT: "reached the memory limit",
    Verdict.CRASHED: "crashed",
    Verdict.FAILED: "failed",
}

_ACCENT = (
    "[\u0300-\u036f\u0483-\u0489\u1ab0-\u1aff\u1dc0-\u1dff\u20d0-\u20ff\ufe20-\ufe2f]"
)
_PILED = re.compile(f"({_ACCENT}{{2}}){_ACCENT}+")

_UNITS = ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs"))


@lru_cache(1 << 16)
def clean(text: str, limit: int = 96) -> str:
    """Sanitise untrusted text for a table: one line of at most `limit` characters.

    Control characters are replaced. Long texts are abbreviated in the middle, since
    names differ at their ends. A letter keeps at most two accents; an accent at the
    start of the text is set on a circle. Text that a spreadsheet would evaluate as a
    formula is prefixed with an apostrophe.
    """
    line = inert(" ".join(text.split()))
    if not line.isascii() or not line.isprintable():
        hidden = {"Cc", "Cf", "Cs", "Co"}  # controls, overrides, lone surrogates
        kinds = map(unicodedata.category, line)
        visible = "".join(
            "\ufffd" if kind in hidden else c
            for c, kind in zip(line, kinds, strict=True)
        )
        line = _PILED.sub(r"\1", unicodedata.normalize("NFC", visible))
    if len(line) > limit:
        tail = limit // 3
        line = f"{line[: limit - tail - 1]}…{line[-tail:]}"
    return f"◌{line[: limit - 1]}" if line and unicodedata.combining(line[0]) else line


def plain_value(value: object, limit: int = 96) -> str:
    """Return a number as unrounded text, and any other value as sanitised text."""
    return str(value) if isinstance(value, int | float) else clean(str(value), limit)


def significant(value: float | None, digits: int = 3) -> str:
    """Format a number with `digits` significant digits, with an exponent if needed."""
    if value is None or not math.isfinite(value):
        return ABSENT
    if value == 0:
        return "0"
    exponent = math.floor(math.log10(abs(value)))
    if -3 <= exponent < digits:  # trailing zeros would look significant
        return f"{value:.{max(digits - 1 - exponent, 0)}f}"
    return _short(f"{value:.{digits - 1}e}")


def power(value: float | None) -> str:
    """Format a number with two significant digits: 3.2e-9, 1.4, 0.25."""
    if value is None or not math.isfinite(value):
        return ABSENT
    if 0.095 <= abs(value) < 9.95:
        return significant(value, 2)
    return "0" if value == 0 else _short(f"{value:.1e}")


def _short(text: str) -> str:
    """Remove leading zeros of an exponent: 1e-08 becomes 1e-8."""
    mantissa, _, exponent = text.partition("e")
    return f"{mantissa}e{int(exponent)}"


def tolerance(value: float) -> str:
    """Format a tolerance in short form: 1e-8."""
    mantissa, _, exponent = f"{value:.6e}".partition("e")
    return _short(f"{float(mantissa):g}e{exponent}")


def seconds(interval: Interval | None) -> str:
    """Format a time with its uncertainty: "12.3 ms [11.9, 14.0]".

    The median and both ends have equally many decimals: enough to show three digits of
    the median and to distinguish the ends. For a single run, "1 run" replaces the ends.
    """
    if interval is None:
        return ABSENT
    unit, name = next((u for u in _UNITS if interval.value >= u[0]), _UNITS[-1])
    scaled = interval.value / unit
    exponent = math.floor(math.log10(scaled)) if scaled > 0 else 0
    low, high = interval.low / unit, interval.high / unit
    decimals = _distinguishing_decimals(low, high, max(2 - exponent, 0))
    ends = f"{low:.{decimals}f}, {high:.{decimals}f}"
    shown = ends if interval.samples > 1 else "1 run"
    return f"{scaled:.{decimals}f} {name} [{shown}]"


def _distinguishing_decimals(low: float, high: float, decimals: int) -> int:
    """Return the fewest decimals, from `decimals` on, that distinguish two numbers."""
    further = range(decimals, decimals + 7)
    return next((d for d in further if f"{low:.{d}f}" != f"{high:.{d}f}"), decimals)


def exponent(fit: PowerLaw) -> str:
    """Format the exponent of a power law with its 95 % interval."""
    d = _distinguishing_decimals(fit.low, fit.high, 2)
    p, low, high = (round(v, d) + 0.0 for v in (fit.exponent, fit.low, fit.high))
    return f"{p:.{d}f} [{low:.{d}f}, {high:.{d}f}]"


def bracketed(value: float, low: float, high: float) -> str:
    """Format a number and its interval, three digits each: "1.43 [0.890, 2.57]"."""
    return f"{significant(value)} [{significant(low)}, {significant(high)}]"


def estimate(of: Sequence[float]) -> str:
    """Format an estimate and its interval, which are the first three items of `of`."""
    return bracketed(*of[:3])


def fixed(of: Sequence[float], digits: int = 3) -> str:
    """Format a value and its interval (first three items) with `digits` decimals."""
    value, low, high = (f"{v + 0.0:.{digits}f}" for v in of[:3])
    return f"{value} [{low}, {high}]"


def span(least_most: tuple[int, int] | None) -> str:
    """Format a count, or its range if the two values differ."""
    if least_most is None:
        return ABSENT
    least, most = least_most
    return str(least) if least == most else f"{least}–{most}"


def listing(names: Sequence[str], limit: int = 3) -> str:
    """Enumerate the first `limit` names and count the others."""
    shown = ", ".join(clean(n) for n in names[:limit])
    more = len(names) - limit
    return f"{shown} and {more} more" if more > 0 else shown


def plural(count: int, noun: str) -> str:
    """Count a noun: "1 case", "3 cases"."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
