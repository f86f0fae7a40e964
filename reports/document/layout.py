"""Pages as data: sections of prose, tables and figures, which renderers format."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
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

_RUN = "run "  #: prefix of the identities in the title of a cell


@dataclass(frozen=True, kw_only=True)
class Cell:
    """Entry of a table: plain text without markup, with attributes for renderers."""

    text: str = ABSENT
    symbol: str = ""  #: symbol before the text, if the format supports it
    after: str = ""  #: small print after the text
    #: a verdict, "best", "tied", "over" (emphasised), "void" (not comparable), "quiet",
    #: "none", "words" or "total"; empty for a plain entry
    kind: str = ""
    title: str = ""  #: hover text; identities in the format of `sources` become links
    value: float | None = None  #: sort key; None to sort by text

    @classmethod
    def name(cls, name: str) -> Cell:
        """Return a cell with a name; a long name is shown in full on hovering."""
        shown = clean(name)
        return cls(text=shown, title="" if shown == name else clean(name, 2000))

    @classmethod
    def label(cls, text: str, limit: int = 40, title: str = "") -> Cell:
        """Return a one-line cell of sanitised text, at most `limit` characters long."""
        return cls(text=clean(text, limit), title=title)

    @classmethod
    def words(cls, text: str, title: str = "") -> Cell:
        """Return a left-aligned cell of words."""
        return cls(text=text, kind="words", title=title)

    @classmethod
    def number(cls, value: Any, show: Callable[[Any], str] = str, **more: Any) -> Cell:
        """Return a cell with a number or an estimate; its text is "–" for None.

        show : formatter, such as those of `reports.document.formatting`
        """
        text = ABSENT if value is None else show(value)
        return cls(text=text, value=getattr(value, "value", value), **more)

    @classmethod
    def time(cls, interval: Interval | None, **more: str) -> Cell:
        """Return a cell with a time and its interval."""
        return cls.number(interval, seconds, **more)

    @classmethod
    def ratio(cls, ratio: Any, **more: str) -> Cell:
        """Return a cell with an estimate and its interval."""
        return cls.number(ratio, estimate, **more)

    @classmethod
    def power(cls, value: float | None, **more: str) -> Cell:
        """Return a cell with a number, printed with two significant digits."""
        return cls.number(value, power, **more)

    @classmethod
    def tolerance(cls, tol: float) -> Cell:
        """Return a cell with a tolerance, printed in short form."""
        return cls.number(tol, tolerance)


Column = tuple[str, Callable[[Any], Cell]]  #: heading, and function from item to cell


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table with caption, headings, rows and notes."""

    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    text_columns: int = 1  #: number of leading columns with names instead of numbers
    notes: tuple[str, ...] = ()  #: explanations, printed after the caption
    solver: str = ""  #: name of the solver, for tables that are hidden with it

    @classmethod
    def of(
        cls, caption: str, items: Iterable[Any], columns: Iterable[Column], **more: Any
    ) -> Table:
        """Return a table with one row per item."""
        heads, cells = zip(*columns, strict=True)
        rows = tuple(tuple(cell(item) for cell in cells) for item in items)
        return cls(caption=caption, columns=heads, rows=rows, **more)

    def wordy(self, column: int) -> bool:
        """Return whether a column contains words, which are aligned to the left."""
        first = self.rows[0][column].kind if self.rows else ""
        return column < self.text_columns or first == "words"

    @property
    def legend(self) -> str:
        """Caption and notes in one paragraph."""
        return " ".join((self.caption, *self.notes))


@dataclass(frozen=True, eq=False, kw_only=True)
class Picture:
    """A figure with its caption and the stem of its files.

    The script of the page draws figures of curves, with zoom; figures of bodies are
    embedded as drawings.
    """

    name: str  #: stem of the files
    caption: str
    figure: Figure | FieldFigure


@dataclass(frozen=True, kw_only=True)
class Statement:
    """Conclusions on one subject in complete sentences, printed before the evidence."""

    subject: str
    claims: tuple[str, ...]
    remarks: tuple[str, ...] = ()  #: qualifications
    evidence: tuple[str, ...] = ()  #: names of the sections that support the claims

    @property
    def lines(self) -> list[str]:
        """All sentences as plain text, one per line, with the subject."""
        return [f"{self.subject}: {text}" for text in (*self.claims, *self.remarks)]


class Point(str):
    """An entry of a list; other strings are paragraphs."""

    __slots__ = ()


Part = Statement | str | Point | Table | Picture


@dataclass(frozen=True, eq=False, kw_only=True)
class Section:
    """One section of the report; `name` is its anchor and the stem of its files."""

    name: str
    title: str
    statements: tuple[Statement, ...] = ()
    prose: tuple[str, ...] = ()
    points: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()

    @classmethod
    def of(cls, name: str, title: str, parts: Iterable[Part]) -> Section | None:
        """Return a section that contains the parts, or None if there are no parts."""
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
            name=name,
            title=title,
            statements=statements,
            prose=prose,
            points=points,
            tables=tables,
            pictures=pictures,
        )

    def at(self, place: str) -> Section:
        """Return the section with every name, title and caption extended by a place.

        place : name of an environment, see `reports.data.environment.by_environment`
        """
        mark = "-" + place.rpartition("@")[2]
        note = f"Measured on the {place}."
        return replace(
            self,
            name=self.name + mark,
            title=f"{self.title} ({place})",
            statements=tuple(
                replace(
                    s,
                    subject=f"{s.subject} ({place})",
                    evidence=tuple(name + mark for name in s.evidence),
                )
                for s in self.statements
            ),
            tables=tuple(replace(t, notes=(note, *t.notes)) for t in self.tables),
            pictures=tuple(
                replace(p, name=p.name + mark, caption=f"{p.caption} {note}")
                for p in self.pictures
            ),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Page:
    """Contents of a page, and the records behind its numbers."""

    title: str
    dateline: str
    sections: tuple[Section, ...]
    footer: str = ""  #: location of the data; empty for the standard text
    records: tuple[Record, ...] = ()  #: measurements behind the numbers
    solvers: tuple[str, ...] = ()  #: labels; the position determines colour and marker

    def sections_of(self, statement: Statement) -> list[Section]:
        """Return the sections of the page that support a statement."""
        return [s for s in self.sections if s.name in statement.evidence]


def sources(records: Iterable[Record]) -> str:
    """Return hover text with the identities of records; empty if there are none."""
    names = ", ".join(short(r.identity) for r in records)
    return _RUN + names if names else ""


def named(title: str) -> list[str]:
    """Return the identities in a hover text, as printed by `short` (see `sources`)."""
    before, run, names = title.rpartition(_RUN)
    at_end = run and (not before or before.endswith(" "))
    return names.split(", ") if at_end else []


def short(identity: str) -> str:
    """Return an identity, sanitised unless it is short, alphanumeric and ASCII."""
    is_safe = len(identity) <= 40 and identity.isascii() and identity.isalnum()
    return identity if is_safe else clean(identity, 40)
