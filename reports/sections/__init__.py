"""Sections of a report, each registered with its position by a decorator.

A module NAME.py contains related sections, and NAME.j2 contains their sentences. To add
a section, write a generator of paragraphs, tables and pictures in any module of this
package, and decorate it with `@section`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from importlib import import_module
from pkgutil import iter_modules
from typing import NamedTuple

from mortarbench.reports.data.aggregation import Ranking, ranking_of
from mortarbench.reports.data.comparison_groups import (
    Answers,
    ComparisonGroup,
    all_groups,
    answers_of,
)
from mortarbench.reports.data.evidence import Evidence
from mortarbench.reports.data.fastest import FastestSolver, fastest_solvers
from mortarbench.reports.data.size_series import SizeSeries, size_series
from mortarbench.reports.data.ways import Ways, compare_ways
from mortarbench.reports.document.layout import Part, Section


class Analysis:
    """Evidence from one environment, and derived results that several sections use.

    pool_forms : compute means, rankings and profiles over the cases of all forms
        together
    """

    def __init__(self, evidence: Evidence, *, pool_forms: bool = False) -> None:
        self.evidence = evidence
        self.pool_forms = pool_forms

    @cached_property
    def sizes(self) -> list[SizeSeries]:
        """Series of cases that differ only in size."""
        return size_series(self.evidence)

    @cached_property
    def forms(self) -> tuple[ComparisonGroup, ...]:
        """Groups of cases whose times are compared; each group has one form."""
        return tuple(all_groups(self.evidence))

    @cached_property
    def pooled(self) -> tuple[ComparisonGroup, ...]:
        """Groups of cases whose times are compared, all forms pooled."""
        return tuple(all_groups(self.evidence, pool_forms=True))

    @property
    def groups(self) -> tuple[ComparisonGroup, ...]:
        """Groups of cases over which means, rankings and profiles are computed."""
        return self.pooled if self.pool_forms else self.forms

    @cached_property
    def ways(self) -> Ways:
        """Comparison of combinations of form and solver, see `reports.data.ways`."""
        return compare_ways(self.evidence)

    @cached_property
    def answers(self) -> Answers:
        """Answer of every solver to every case, by form, mode and accuracy."""
        return answers_of(self.evidence)

    @cached_property
    def fastest(self) -> tuple[FastestSolver, ...]:
        """Comparisons of solvers, one for each form, mode and accuracy."""
        return fastest_solvers(self.answers, self.forms)

    @cached_property
    def rankings(self) -> list[Ranking]:
        """Rankings of the groups that can be compared over cases."""
        return [ranking_of(group) for group in self.groups if group.comparable]


Write = Callable[[Analysis], Iterator[Part]]


class _Entry(NamedTuple):
    place: float
    compose: Callable[[Analysis], Section | None]
    needs: str


_ENTRIES: list[_Entry] = []
EVIDENCE = 10  #: sections at smaller positions contain conclusions
APPENDIX = 90  #: from this position on: conditions and definitions
COMMON = 94  #: from this position on: the same for all environments


def section(
    place: float, name: str, title: str | Callable[[Analysis], str], needs: str = ""
) -> Callable[[Write], Callable[[Analysis], Section | None]]:
    """Register a generator of a section; a section without contents is left out.

    place : sort key of the section; sections are in ascending order of `place`
    name : anchor, and stem of the section's files
    needs : title and required measurements, which reports without this section list; a
        section with empty `needs` is omitted silently
    """

    def register(write: Write) -> Callable[[Analysis], Section | None]:
        def compose(analysis: Analysis) -> Section | None:
            parts = write(analysis)
            shown = title if isinstance(title, str) else title(analysis)
            return Section.of(name, shown, parts)

        _ENTRIES.append(_Entry(place, compose, needs))
        return compose

    return register


def sections(*analyses: Analysis) -> Iterator[Section]:
    """Compose every section for the analysis of each environment.

    Sections with `needs` that no environment has are listed before the appendix.
    """
    missing: list[str] = []
    for entry in _entries():
        if entry.place >= APPENDIX and missing:
            prose = (
                "The following sections are omitted because measurements are missing.",
            )
            title = "Not in this report"
            yield Section(name="absent", title=title, prose=prose, points=(*missing,))
            missing = []
        composed = list(_composed(entry, analyses))
        yield from composed
        if entry.needs and not composed:
            missing.append(entry.needs)


def opening(analysis: Analysis) -> Iterator[Section]:
    """Compose the sections with conclusions, which precede the evidence."""
    for entry in _entries():
        if entry.place < EVIDENCE:
            yield from _composed(entry, [analysis])


def _composed(entry: _Entry, analyses: Sequence[Analysis]) -> Iterator[Section]:
    for analysis in analyses[:1] if entry.place >= COMMON else analyses:
        composed, place = entry.compose(analysis), analysis.evidence.place
        if composed is not None:
            yield composed.at(place) if place else composed


def _entries() -> list[_Entry]:
    for module in iter_modules(__path__):
        import_module(f"{__name__}.{module.name}")
    return sorted(_ENTRIES, key=lambda entry: entry.place)
