"""Solves on several ranks: speed-up, weak scaling."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from mortarbench.reports.data.rank_series import (
    PHASES,
    StrongSeries,
    WeakSeries,
)
from mortarbench.reports.document.figure import (
    Axis,
    Figure,
    Key,
    Look,
    Mark,
    Panel,
    Series,
    in_rows,
)
from mortarbench.reports.figures.style import (
    GUIDE,
    curve,
    legible,
    log,
    look,
    with_legend,
)
from mortarbench.reports.statistics.intervals import Interval

_LONG = 72  #: largest number of characters of a name in a legend of one column
_BEYOND = 1.5  #: largest factor by which intervals extend an axis beyond the values
_ONE = Interval(1.0, 1.0, 1.0, 1.0, 1)  #: speed-up on one rank


def strong_figure(series: Sequence[StrongSeries]) -> Figure:
    """Plot speed-ups against the number of ranks, by phase."""
    shown = sorted({n for s in series for n in s.answers})
    panels, keys = [], []
    for phase in PHASES:
        marks: list[Mark] = [_ideal(shown)]
        for i, s in enumerate(series):
            marks += _speed_ups(s, phase, look(i))
        panels.append(
            Panel(
                x=_ranks_axis(shown),
                y=_times_axis("speed-up", marks),
                title=phase,
                marks=tuple(marks),
            )
        )
    for i, s in enumerate(series):
        label = legible(s.title, _LONG)
        keys.append(Key(label=label, look=_line(look(i)), solver=s.solver))
    if any(s.crowded(n) for s in series for n in s.several):
        crowded = replace(look(0), dash=None, fill="none")
        keys.append(Key(label="more ranks than CPUs (CPUs shared)", look=crowded))
    keys.append(Key(label="ideal speed-up", look=GUIDE))
    return _figure(panels, keys, 1)


def _speed_ups(s: StrongSeries, phase: str, style: Look) -> list[Series]:
    first = (1, _ONE, s.answers[1])
    measured = [first, *((n, s.speed_up(n, phase), s.answers[n]) for n in s.several)]
    hollow = replace(style, dash=None, fill="none")
    return [
        *curve((p for p in measured if not s.crowded(p[0])), _line(style), s.solver),
        *curve((p for p in measured if s.crowded(p[0])), hollow, s.solver),
    ]


def weak_figure(series: Sequence[WeakSeries]) -> Figure:
    """Plot time against ranks at constant size per rank, with one panel per phase."""
    shown = sorted({m.ranks for s in series for m in s.members})
    panels = []
    for phase in PHASES:
        marks: list[Mark] = []
        for i, s in enumerate(series):
            answers = {m.ranks: m.answer for m in s.members}
            timed = ((n, o.seconds(phase), o) for n, o in answers.items())
            marks += curve(timed, _line(look(i)), s.solver)
        panels.append(
            Panel(
                x=_ranks_axis(shown),
                y=log("time in s"),
                title=phase,
                marks=tuple(marks),
            )
        )
    keys = [
        Key(
            label=f"{legible(s.title, _LONG)}: {s.members[0].dofs} dofs per rank",
            look=_line(look(i)),
            solver=s.solver,
        )
        for i, s in enumerate(series)
    ]
    return _figure(panels, keys, 1)


def _ideal(ranks: Sequence[int]) -> Series:
    ends = float(min(ranks)), float(max(ranks))
    return Series(x=ends, y=ends, look=GUIDE)


def _ranks_axis(ranks: Sequence[int]) -> Axis:
    low, high = float(min(ranks)), float(max(ranks))
    return Axis(
        label="ranks $N$",
        log=True,
        low=low / 1.15,
        high=high * 1.15,
        ticks=tuple((float(n), str(n)) for n in sorted(set(ranks))),
    )


def _times_axis(label: str, marks: Sequence[Mark]) -> Axis:
    """Return a logarithmic axis with powers of two as ticks.

    The axis contains all values, but wide intervals are clipped.
    """
    curves = [m for m in marks if isinstance(m, Series)]
    shown = [v for m in curves for v in m.y]
    least, most = min(shown) / _BEYOND, max(shown) * _BEYOND
    ends = [
        v for m in curves if m.intervals for v in (*m.intervals.low, *m.intervals.high)
    ]
    shown += [min(max(v, least), most) for v in ends]
    low, high = min([0.9, *shown]), max([2.0, *shown])
    ticks = [2.0**k for k in range(-6, 13) if low <= 2.0**k <= 1.1 * high]
    return Axis(
        label=label,
        log=True,
        low=low / 1.1,
        high=high * 1.15,
        ticks=tuple((v, f"{v:g}") for v in ticks),
    )


def _line(style: Look) -> Look:
    return replace(style, dash=())


def _figure(panels: Sequence[Panel], keys: Sequence[Key], columns: int) -> Figure:
    rows = in_rows(panels, 2)
    return with_legend(rows, keys, columns, 0.4 + 2.5 * len(rows))
