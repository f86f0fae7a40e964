"""The report as data: sections of prose, tables and figures; renderers do the rest."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from mortarbench.harness import Record
from mortarbench.reports.document.fields import FieldFigure
from mortarbench.reports.document.figure import Figure
from mortarbench.reports.document.formatting import (
    ABSENT,
    clean,
    estimate,
    power,
    seconds,
    tolerance,
)
from mortarbench.reports.statistics.intervals import Interval

_RUN = "run "  #: before the run_ids in a title


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One entry of a table: plain text and what it means, never markup."""

    text: str = ABSENT
    symbol: str = ""  #: before the text, where the medium has it
    after: str = ""  #: small print behind the text
    kind: str = ""  #: a verdict, "best", "tied", "void" (not to be compared) or "total"
    title: str = ""  #: shown when pointed at; run_ids as `source` names them are links
    value: float | None = None  #: what to sort by; the text, if None

    @classmethod
    def name(cls, name: str) -> Cell:
        """Show a name that may be long; all of it appears when pointed at."""
        shown = clean(name)
        return cls(text=shown, title="" if shown == name else clean(name, 2000))

    @classmethod
    def label(cls, text: str, limit: int = 40, title: str = "") -> Cell:
        """Show foreign text in one line of at most `limit` characters."""
        return cls(text=clean(text, limit), title=title)

    @classmethod
    def words(cls, text: str, title: str = "") -> Cell:
        """Show words in a column of words."""
        return cls(text=text, kind="words", title=title)

    @classmethod
    def number(cls, value: Any, show: Callable[[Any], str] = str, **more: Any) -> Cell:
        """Show a number, or an interval by its value; "–" for None.

        show : formats it, as the functions of `reports.document.formatting` do
        """
        text = ABSENT if value is None else show(value)
        return cls(text=text, value=getattr(value, "value", value), **more)

    @classmethod
    def time(cls, interval: Interval | None, **more: str) -> Cell:
        """Show a time with its uncertainty."""
        return cls.number(interval, seconds, **more)

    @classmethod
    def ratio(cls, ratio: Any, **more: str) -> Cell:
        """Show an estimate with its interval."""
        return cls.number(ratio, estimate, **more)

    @classmethod
    def power(cls, value: float | None, **more: str) -> Cell:
        """Show an order of magnitude."""
        return cls.number(value, power, **more)

    @classmethod
    def tolerance(cls, tol: float) -> Cell:
        """Show a tolerance."""
        return cls.number(tol, tolerance)


Column = tuple[str, Callable[[Any], Cell]]  #: its head, and the cell of an item


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table in the booktabs manner."""

    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    text_columns: int = 1  #: how many columns from the left hold names, not numbers
    notes: tuple[str, ...] = ()  #: what must be known to read it; after the caption
    solver: str = ""  #: the only one that it is about: a reader may hide both

    @classmethod
    def of(
        cls, caption: str, items: Iterable[Any], columns: Iterable[Column], **more: Any
    ) -> Table:
        """Make a row of every item."""
        heads, cells = zip(*columns, strict=True)
        rows = tuple(tuple(cell(item) for cell in cells) for item in items)
        return cls(caption=caption, columns=heads, rows=rows, **more)

    def wordy(self, column: int) -> bool:
        """Whether a column holds words, which begin at the left, not numbers."""
        first = self.rows[0][column].kind if self.rows else ""
        return column < self.text_columns or first == "words"

    @property
    def legend(self) -> str:
        """Caption and notes in one paragraph."""
        return " ".join((self.caption, *self.notes))


@dataclass(frozen=True, eq=False, kw_only=True)
class Picture:
    """A figure, its file name without ending, and its caption.

    The page draws curves so that one can zoom; bodies it shows as the file does.
    """

    name: str
    caption: str
    figure: Figure | FieldFigure


@dataclass(frozen=True, kw_only=True)
class Statement:
    """What is said of one subject before all evidence, in whole sentences."""

    subject: str
    claims: tuple[str, ...]
    remarks: tuple[str, ...] = ()  #: what must be known besides
    evidence: tuple[str, ...] = ()  #: names of the sections that the claims rest on

    @property
    def lines(self) -> list[str]:
        """Subject and sentences as plain text, a line each."""
        return [f"{self.subject}: {text}" for text in (*self.claims, *self.remarks)]


class Point(str):
    """An entry of a list, where other strings are paragraphs."""

    __slots__ = ()


Part = Statement | str | Point | Table | Picture


@dataclass(frozen=True, eq=False, kw_only=True)
class Section:
    """One part of the report; `name` is its anchor and the stem of its files."""

    name: str
    title: str
    statements: tuple[Statement, ...] = ()
    prose: tuple[str, ...] = ()
    points: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()

    @classmethod
    def of(cls, name: str, title: str, parts: Iterable[Part]) -> Section | None:
        """Sort parts by their type; None where there are no parts."""
        kinds: dict[type, list[Any]] = {}
        for part in parts:
            kinds.setdefault(type(part), []).append(part)
        if not kinds:
            return None
        fields = (Statement, str, Point, Table, Picture)
        statements, prose, points, tables, pictures = (
            tuple(kinds.get(kind, ())) for kind in fields
        )
        return cls(
            name=name, title=title, statements=statements, prose=prose, points=points,
            tables=tables, pictures=pictures,
        )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class Page:
    """The whole report, what a reader came for first."""

    title: str
    dateline: str
    sections: tuple[Section, ...]
    footer: str = ""  #: where the numbers are, if not in a result folder
    records: tuple[Record, ...] = ()  #: the measurements that its numbers come from
    solvers: tuple[str, ...] = ()  #: of these, in the order of their looks in figures

    def sections_of(self, statement: Statement) -> list[Section]:
        """List the sections that a statement rests on, as far as the page has them."""
        return [s for s in self.sections if s.name in statement.evidence]


def sources(records: Iterable[Record]) -> str:
    """Name measurements one by one; empty if there are none."""
    names = ", ".join(short(r.run_id) for r in records)
    return _RUN + names if names else ""


def named(title: str) -> list[str]:
    """List the run_ids, as `short` prints them, that `source` put into a title."""
    before, run, names = title.rpartition(_RUN)
    at_end = run and (not before or before.endswith(" "))
    return names.split(", ") if at_end else []


def short(run_id: str) -> str:
    """Print a run_id; ours are short, those of a foreign journal may not be."""
    is_ours = len(run_id) <= 40 and run_id.isascii() and run_id.isalnum()
    return run_id if is_ours else clean(run_id, 40)
