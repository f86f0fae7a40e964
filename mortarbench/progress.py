"""How a run goes: told to a function, or shown as a bar or as lines.

A run tells a `Progress` (see `harness.running.progress`) what it does. Here are those
that show it: a bar on a terminal, a bar in a notebook, a line per measurement where
there is neither, and events for a function of the user.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from html import escape as html_escape
from time import monotonic
from typing import Any, TextIO

from mortarbench.harness.errors import InputError
from mortarbench.harness.errors import shown as repeated
from mortarbench.harness.record import Record, Verdict
from mortarbench.harness.running.progress import Progress

_REASON = 120  #: characters of why a solver declined
_WIDE = 60  #: columns of a terminal that has room for a bar beside its numbers
_BETWEEN = 0.2  #: s, between two pictures of a bar in a notebook


@dataclass(frozen=True, kw_only=True)
class Event:
    """What a run tells at one moment."""

    done: int  #: measurements, those of an earlier run included
    total: int
    now: str = ""  #: what happens now
    warning: str = ""  #: what went wrong, if something did
    record: Record | None = None  #: the measurement that was just made, if one was


Callback = Callable[[Event], object]


class _State:
    """Counts what a run has done, for those who show it."""

    def __init__(self) -> None:
        self.done = self.total = self.measured = 0  # the last: by this run alone
        self.began = monotonic()
        self.now = ""

    def start(self, total: int) -> None:
        self.total, self.began = total, monotonic()
        self.changed()

    def say(self, text: str) -> None:
        self.now = text
        self.changed()

    def warn(self, text: str) -> None:
        """Show what went wrong, in a line that stays."""

    def advance(self, record: Record | None) -> None:
        self.count(record)
        self.changed()

    def count(self, record: Record | None) -> None:
        """Count what was done, and apart what was measured for it."""
        self.done += 1
        self.measured += record is not None

    def left(self) -> str:
        """Say how long the rest may take; empty before the first measurement."""
        seconds = monotonic() - self.began
        return remaining(self.measured, self.total - self.done, seconds)

    def changed(self) -> None:
        """Show the new state."""


class _Silent(_State):
    """Shows nothing."""


class _Told(_State):
    """Hands every change to a function."""

    def __init__(self, callback: Callback) -> None:
        super().__init__()
        self._callback = callback

    def _tell(self, **what: Any) -> None:
        self._callback(
            Event(done=self.done, total=self.total, **{"now": self.now, **what})
        )

    def changed(self) -> None:
        self._tell()

    def warn(self, text: str) -> None:
        self._tell(warning=text)

    def advance(self, record: Record | None) -> None:
        self.count(record)
        self._tell(record=record)


class _Warnings(_State):
    """Writes what went wrong, and nothing else."""

    def __init__(self, stream: TextIO) -> None:
        super().__init__()
        self._stream = stream

    def warn(self, text: str) -> None:
        with suppress(BrokenPipeError):  # nobody listens: no reason to stop measuring
            print(text, file=self._stream, flush=True)


class _Lines(_Warnings):
    """Writes a line per measurement."""

    def start(self, total: int) -> None:
        super().start(total)
        self.warn(f"{total} measurement{'s' * (total != 1)}")

    def advance(self, record: Record | None) -> None:
        super().advance(record)
        if record is not None:
            self.warn(f"{self.done}/{self.total} {in_words(record)}")


def in_words(record: Record) -> str:
    """Say in a line what came of a measurement."""
    seconds = record.total_seconds
    took = "" if seconds is None else f" in {seconds:.3g} s"
    if record.verdict is Verdict.DECLINED and record.message:
        took = f": {record.message[:_REASON]}"
    return f"{record.solver} on {record.case}: {record.verdict.words}{took}"


def stands_out(record: Record) -> bool:
    """Whether a measurement is worth a line above a bar: it was not verified."""
    return not record.verdict.is_verified and record.verdict is not Verdict.DECLINED


class _Bar(_State):
    """A bar of `rich`, above it what was not verified."""

    def __init__(self, bar: Any) -> None:
        super().__init__()
        self._bar = bar
        self._task = bar.add_task("starting", total=None, left=self.left)

    def start(self, total: int) -> None:
        super().start(total)
        self._bar.update(self._task, total=total)

    def say(self, text: str) -> None:
        from rich.markup import escape

        self._bar.update(self._task, description=escape(text))

    def warn(self, text: str) -> None:
        from rich.markup import escape

        self._bar.console.print(escape(text), highlight=False, soft_wrap=True)

    def advance(self, record: Record | None) -> None:
        super().advance(record)
        self._bar.advance(self._task)
        if record is not None and stands_out(record):
            self.warn(in_words(record))


class _Notebook(_State):
    """A bar in a notebook, above it what was not verified."""

    def __init__(self) -> None:
        super().__init__()
        from IPython.display import display

        self._lines: list[str] = []
        self._shown = -_BETWEEN
        self._handle = display(_Html(""), display_id=True)

    def warn(self, text: str) -> None:
        self._lines.append(text)
        self.changed()

    def advance(self, record: Record | None) -> None:
        if record is not None and stands_out(record):
            self._lines.append(in_words(record))
        super().advance(record)

    def changed(self) -> None:
        if monotonic() - self._shown < _BETWEEN and self.done < self.total:
            return
        self._shown = monotonic()
        above = "".join(f"<div>{html_escape(line)}</div>" for line in self._lines)
        self._handle.update(
            _Html(
                f"{above}<progress value='{self.done}' max='{self.total or 1}'>"
                f"</progress> {self.done}/{self.total} {self.left()} "
                f"{html_escape(self.now)}"
            )
        )


class _Html:
    def __init__(self, text: str) -> None:
        self._text = text

    def _repr_html_(self) -> str:
        return self._text


def remaining(measured: int, to_do: int, seconds: float) -> str:
    """Say how long what is to do takes if it goes on as before; empty if unknown.

    measured : how many measurements took the `seconds`; those of an earlier run, which
        took none, do not count
    """
    if measured <= 0 or to_do <= 0:
        return ""
    minutes, rest = divmod(round(seconds / measured * to_do), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02} left"


def in_notebook() -> bool:
    """Whether this Python is the kernel of a notebook."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return shell is not None and "IPKernelApp" in getattr(shell, "config", {})


@contextmanager
def shown_on(stream: TextIO) -> Iterator[Progress]:
    """Show a run on a stream: a bar on a terminal, else a line per measurement."""
    if not stream.isatty():
        yield _Lines(stream)
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        ProgressColumn,
        Task,
        TextColumn,
    )
    from rich.progress import Progress as Bars
    from rich.table import Column
    from rich.text import Text

    class TimeLeft(ProgressColumn):
        """rich's own looks back half a minute: a long measurement leaves it nothing."""

        def render(self, task: Task) -> Text:
            return Text(task.fields["left"](), style="progress.remaining")

    now = Column(no_wrap=True, overflow="ellipsis", ratio=1)
    columns: list[ProgressColumn] = [
        MofNCompleteColumn(table_column=Column(no_wrap=True)),
        TimeLeft(table_column=Column(no_wrap=True)),
        TextColumn("{task.description}", table_column=now),
    ]
    console = Console(file=stream)
    if console.width >= _WIDE:
        columns.insert(0, BarColumn(bar_width=20))
    with Bars(*columns, console=console, expand=True) as bar:
        yield _Bar(bar)


@contextmanager
def quiet_on(stream: TextIO) -> Iterator[Progress]:
    """Show on a stream what goes wrong in a run, and nothing else."""
    yield _Warnings(stream)


@contextmanager
def shown(progress: bool | Callback | Progress | None) -> Iterator[Progress]:
    """Show a run as the user asks: see `mortarbench.run`."""
    if progress is None and in_notebook():
        yield _Notebook()
    elif progress is True:
        if in_notebook():
            yield _Notebook()
        else:
            with shown_on(sys.stderr) as bar:
                yield bar
    elif isinstance(progress, Progress):
        yield progress
    elif callable(progress):
        yield _Told(progress)
    elif progress in (None, False):
        yield _Silent()
    else:
        raise InputError(
            f"progress = {repeated(progress)}; expected True, False, None or a function"
        )


def ignore(text: str) -> None:
    """Take no notice."""
