"""Tables, pictures and text of a report, and their form as Markdown, CSV and LaTeX."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import zip_longest
from typing import TYPE_CHECKING

import pandas as pd

from mortarbench.harness.files.csvfile import csv_text, inert

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from mortarbench.reports.intervals import Interval, Pooled, PowerLaw

ABSENT = "–"  #: text for a value that was not measured
_UNITS = ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs"))


@dataclass(frozen=True, eq=False, kw_only=True)
class Table:
    """A table whose cells are plain text, with its numbers as a data frame.

    Line breaks in a cell begin further lines, which are set in small type.
    """

    name: str  #: stem of its files
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str
    data: pd.DataFrame | None = None  #: the numbers; None: the text of the cells
    texts: int = 1  #: number of columns at the left that contain text

    def compact(self) -> Table:
        """Return the table without columns of numbers whose cells are all empty."""
        kept = [
            k
            for k in range(len(self.head))
            if k < self.texts or any(row[k] not in ("", ABSENT) for row in self.rows)
        ]
        head, *rows = (tuple(row[k] for k in kept) for row in (self.head, *self.rows))
        return replace(self, head=head, rows=tuple(rows))

    def csv(self) -> str:
        """Return the numbers as CSV."""
        if self.data is None:
            return csv_text(self.head, self.rows)
        rows = self.data.astype(object).where(self.data.notna(), None)
        return csv_text([*map(str, rows.columns)], rows.itertuples(index=False))


@dataclass(frozen=True, eq=False, kw_only=True)
class Picture:
    """A figure, drawn on demand."""

    name: str  #: stem of its files
    caption: str
    draw: Callable[[], Figure]


Item = str | Table | Picture


@dataclass(frozen=True, eq=False, kw_only=True)
class Section:
    """A section of a report: paragraphs, tables and pictures in their order."""

    name: str
    title: str
    items: tuple[Item, ...]

    @property
    def tables(self) -> tuple[Table, ...]:
        """The tables of the section."""
        return tuple(item for item in self.items if isinstance(item, Table))

    @property
    def pictures(self) -> tuple[Picture, ...]:
        """The pictures of the section."""
        return tuple(item for item in self.items if isinstance(item, Picture))


@dataclass(frozen=True, eq=False, kw_only=True)
class Document:
    """A report: a title, a line on its origin, and sections."""

    title: str
    dateline: str
    sections: tuple[Section, ...]
    solvers: tuple[str, ...] = field(default=())  #: solvers that a page can hide
    footer: str = (
        "Tables: tables/*.csv and tables/*.tex; all measurements: records.parquet and "
        "tables/measurements.csv."
    )


# Numbers and names as text


@lru_cache(1 << 16)
def clean(text: str, limit: int = 96) -> str:
    """Sanitise untrusted text: one line of at most `limit` characters.

    Control characters are replaced, accents are limited to two per letter, long texts
    are abbreviated in the middle, and spreadsheet formulas become text.
    """
    line = inert(" ".join(text.split()))
    if not line.isascii() or not line.isprintable():
        hidden = {"Cc", "Cf", "Cs", "Co"}
        line = "".join(
            "\ufffd" if unicodedata.category(c) in hidden else c
            for c in unicodedata.normalize("NFC", line)
        )
        line = re.sub(r"([\u0300-\u036f]{2})[\u0300-\u036f]+", r"\1", line)
    if len(line) > limit:
        tail = limit // 3
        line = f"{line[: limit - tail - 1]}…{line[-tail:]}"
    return f"◌{line[: limit - 1]}" if line and unicodedata.combining(line[0]) else line


def short_name(text: str) -> str:
    """Sanitise the name of a solver or a form, with at most 40 characters."""
    return clean(text, 40)


def stem(text: str) -> str:
    """Return the stem of a file name: letters, digits and hyphens of a text."""
    return re.sub(r"\W+", "-", clean(text, 40), flags=re.ASCII).strip("-")


def number(value: float | None, digits: int = 3) -> str:
    """Return a number with `digits` significant digits, as 12.3 or 1.2e-9."""
    if value is None or not math.isfinite(value):
        return ABSENT
    if value == 0:
        return "0"
    exponent = math.floor(math.log10(abs(value)))
    if -3 <= exponent <= max(digits, 3):
        return f"{value:.{max(digits - 1 - exponent, 0)}f}"
    mantissa, _, power = f"{value:.{digits - 1}e}".partition("e")
    return f"{mantissa}e{int(power)}"


def tolerance(value: float) -> str:
    """Return a tolerance in short form: 1e-8."""
    mantissa, _, power = f"{value:.6e}".partition("e")
    return f"{float(mantissa):g}e{int(power)}"


def accuracy_text(value: float, *, by_error: bool) -> str:
    """Return an accuracy in words: "error 1e-6" or "tol 1e-8"."""
    return f"{'error' if by_error else 'tol'} {tolerance(value)}"


def seconds(time: float | None) -> str:
    """Return a time with three digits and its unit: 12.3 ms."""
    if time is None or not math.isfinite(time):
        return ABSENT
    unit, name = next((u for u in _UNITS if time >= u[0]), _UNITS[-1])
    return f"{number(time / unit)} {name}"


def interval(of: Interval, digits: int = 2) -> str:
    """Return an interval in brackets, or "" if there is none."""
    if not of.is_known:
        return ""
    return f"[{number(of.low, digits)}, {number(of.high, digits)}]"


def short(time: Pooled | None) -> str:
    """Return a ratio of times with its interval: "3.6 × [2.1, 6.2]"."""
    if time is None:
        return ABSENT
    return f"{number(time.ratio.value, 2)} × {interval(time.ratio)}".strip()


def law(fit: PowerLaw | None) -> str:
    """Return an exponent with its interval: "1.21 [1.10, 1.32]"."""
    if fit is None:
        return ABSENT
    p = fit.exponent
    ends = f" [{p.low:.2f}, {p.high:.2f}]" if p.is_known else ""
    return f"{p.value:.2f}{ends}"


def plural(count: int, noun: str) -> str:
    """Count a noun: "1 case", "3 cases"."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


# Markdown

_MARKUP = re.compile(r"([\\`*_\[\]|~])")
_LINKS = re.compile(r"(?<=\w)(?=://|@\w)|(?<=www)(?=\.)")  # become links unasked


def markdown(document: Document) -> str:
    """Return a document as Markdown, with the pictures in figures/."""
    parts = [f"# {_md(document.title)}", _md(document.dateline)]
    for section in document.sections:
        parts.append(f"## {_md(section.title)}")
        for item in section.items:
            match item:
                case str():
                    parts.append(_md(item))
                case Table():
                    parts += [_md_table(item), f"*{_md(item.caption)}*"]
                case Picture():
                    parts.append(f"![{item.name}](figures/{item.name}.png)")
                    parts.append(f"*{_md(item.caption)}*")
    return "\n\n".join(parts) + "\n"


def _md(text: str) -> str:
    safe = text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    safe = _LINKS.sub(r"\\", _MARKUP.sub(r"\\\1", safe))
    return re.sub(r"^(\s*\d*)([-+#.)])(?=\s)", r"\1\\\2", safe)


def _md_table(table: Table) -> str:
    rule = [":--" if i < table.texts else "--:" for i in range(len(table.head))]
    rows = [
        [_md(c).replace("\n", "<br>") for c in row] for row in (table.head, *table.rows)
    ]
    return "\n".join(f"| {' | '.join(row)} |" for row in (rows[0], rule, *rows[1:]))


# LaTeX

_TEX = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&",
    "#": r"\#", "%": r"\%", "_": r"\_", "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}", "<": "$<$", ">": "$>$", "|": "$|$", '"': "''",
    "–": "--", "×": r"$\times$", "·": r"$\cdot$", "≤": r"$\leq$", "≥": r"$\geq$",
    "±": r"$\pm$", "κ": r"$\kappa$", "λ": r"$\lambda$", "µ": r"$\mu$", "ρ": r"$\rho$",
    "√": r"$\surd$", "∝": r"$\propto$", "ᵖ": "$^p$", "†": r"\dag{}", "…": r"\dots{}",
    "✓": r"$\surd$", "✗": r"$\times$", "′": "$'$", "↻": r"$\circ$", "−": "$-$",
}  # fmt: skip


def latex(tables: Sequence[Table], *, intervals: bool = True) -> str:
    r"""Return tables in 9 pt for a column of 12 cm, for ``\input`` in an article.

    No packages are needed.

    intervals : False to omit the further lines of the cells
    """
    return "\n".join(_tex_table(table, intervals) for table in tables)


#: invisible line of 9 pt type that keeps a row away from the rule above it
_STRUT = r"\rule{0pt}{2.5ex}"


def _tex_table(table: Table, intervals: bool) -> str:
    lines = []
    for row in table.rows:
        above, *below = zip_longest(*(cell.split("\n") for cell in row), fillvalue="")
        lines.append(" & ".join(map(_tex, above)) + r" \\")
        for parts in below if intervals else ():
            small = [rf"{{\scriptsize {_tex(b)}}}" if b else "" for b in parts]
            lines.append(" & ".join(small) + r" \\")
        lines[-1] += "[2pt]"
    head = " & ".join(map(_tex, table.head)) + r" \\[2pt]"
    columns = "l" * table.texts + "r" * (len(table.head) - table.texts)
    return "\n".join(
        [
            r"\begin{table}",
            r"  \centering\small\setlength{\tabcolsep}{3pt}",
            rf"  \caption{{{_tex(table.caption)}}}\label{{tab:{table.name}}}",
            r"  \par\smallskip",
            rf"  \begin{{tabular}}{{@{{}}{columns}@{{}}}}",
            r"    \hline",
            f"    {_STRUT}{head}",
            r"    \hline",
            *(f"    {_STRUT * (k == 0)}{line}" for k, line in enumerate(lines)),
            r"    \hline",
            r"  \end{tabular}",
            r"\end{table}",
            "",
        ]
    )


def _tex(text: str) -> str:
    """Escape text; ^ and characters that OT1 lacks become formulas or code points."""
    text = re.sub(r"(\w)\^(-?[\d.]+)", lambda m: f"\0{m[1]}\1{m[2]}\0", text)
    text = re.sub(r"(\d(?:\.\d+)?)e(-?\d+)", "\\1\2\\2\3", text)
    safe = "".join(
        _TEX.get(c) or (c if c.isascii() or "¡" <= c <= "ÿ" else f"U+{ord(c):04X}")
        for c in text
    )
    safe = re.sub("\0(.)\1([^\0]*)\0", r"$\1^{\2}$", safe)
    safe = re.sub("(?<![\\d.])1\2([^\3]*)\3", r"$10^{\1}$", safe)
    safe = re.sub("\2([^\3]*)\3", r"$\\cdot10^{\1}$", safe)
    return f"{{}}{safe}" if safe.startswith(("[", "*")) else safe
