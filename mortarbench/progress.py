"""Displays of the progress of a run.

A run reports its progress to a `Progress` (see `harness.running.progress`). The classes
of this module implement `Progress`: they show a bar on a terminal or in a notebook,
print one line per measurement elsewhere, or call a function of the user.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from html import escape
from threading import Event as Signal
from threading import Thread
from time import monotonic
from typing import Any, TextIO

from mortarbench.harness.errors import InputError, say
from mortarbench.harness.errors import shown as repeated
from mortarbench.harness.record import Record, Verdict
from mortarbench.harness.running.progress import Progress

_REASON_LENGTH = 120  #: maximum displayed length of the reason for declining a QP
_BAR_WIDTH = 60  #: smallest width of a terminal, in columns, at which a bar is shown
WAIT_SECONDS = 10.0  #: time between two lines of `waiting`
_UPDATE_SECONDS = 0.2  #: shortest time between two updates of a bar in a notebook


@dataclass(frozen=True, kw_only=True)
class Event:
    """State of a run, passed to the function `progress` of `mortarbench.run`."""

    #: number of measurements that are completed, also by earlier runs, or are left out
    done: int
    total: int  #: largest possible number of measurements of the run
    now: str = ""  #: current activity
    warning: str = ""  #: warning that caused this event; empty if there is no warning
    record: Record | None = None  #: measurement that was just completed, or None


Callback = Callable[[Event], object]


class _Silent:
    """Counters of completed measurements, which subclasses display."""

    def __init__(self) -> None:
        self.done = self.total = 0
        self.measured = 0  # number of measurements of this run, unlike `done`
        self.began = monotonic()
        self.now = ""

    def start(self, total: int) -> None:
        self.total, self.began = total, monotonic()
        self.changed()

    def say(self, text: str) -> None:
        self.now = text
        self.changed()

    def warn(self, text: str) -> None:
        """Show a warning in a line that is not overwritten."""

    def advance(self, record: Record | None) -> None:
        self.done += 1
        self.measured += record is not None
        self.changed(record)

    def left(self) -> str:
        """Return the estimated remaining time; empty before the first measurement."""
        seconds = monotonic() - self.began
        return remaining(self.measured, self.total - self.done, seconds)

    def changed(self, record: Record | None = None) -> None:
        """Update the display; `record` is the measurement that was just completed."""


class _Events(_Silent):
    """Display that calls a function of the user at every change."""

    def __init__(self, callback: Callback) -> None:
        super().__init__()
        self._callback = callback

    def changed(self, record: Record | None = None) -> None:
        self._callback(
            Event(done=self.done, total=self.total, now=self.now, record=record)
        )

    def warn(self, text: str) -> None:
        self._callback(
            Event(done=self.done, total=self.total, now=self.now, warning=text)
        )


class Warnings(_Silent):
    """Display that writes only warnings."""

    def __init__(self, stream: TextIO) -> None:
        super().__init__()
        self._stream = stream

    def warn(self, text: str) -> None:
        """Write a warning."""
        # The run must continue if the program that reads its output closes the pipe.
        with suppress(BrokenPipeError):
            print(text, file=self._stream, flush=True)


class _Lines(Warnings):
    """Display that writes one line per measurement."""

    def start(self, total: int) -> None:
        super().start(total)
        self.warn(f"{total} measurement{'s' * (total != 1)}")

    def changed(self, record: Record | None = None) -> None:
        if record is not None:
            self.warn(f"{self.done}/{self.total} {_line(record)}")


def _line(record: Record) -> str:
    """Return the result of a measurement in one line."""
    seconds = record.total_seconds
    detail = "" if seconds is None else f" in {seconds:.3g} s"
    if record.status is Verdict.DECLINED and record.message:
        detail = f": {record.message[:_REASON_LENGTH]}"
    return f"{record.solver} on {record.case}: {record.status.words}{detail}"


class _Bar(_Silent):
    """Bar with a list of the measurements that are neither verified nor declined."""

    def changed(self, record: Record | None = None) -> None:
        if record is None or record.status.is_verified:
            return
        if record.status is not Verdict.DECLINED:
            self.warn(_line(record))


class _Terminal(_Bar):
    """Bar of `rich` on a terminal."""

    def __init__(self, bar: Any) -> None:
        super().__init__()
        self._bar = bar
        self._task = bar.add_task("starting", total=None, left=self.left)

    def warn(self, text: str) -> None:
        self._bar.console.print(text, markup=False, highlight=False, soft_wrap=True)

    def changed(self, record: Record | None = None) -> None:
        from rich.markup import escape

        state = {"total": self.total or None, "completed": self.done}
        self._bar.update(self._task, description=escape(self.now), **state)
        super().changed(record)


class _Notebook(_Bar):
    """Bar in a notebook."""

    def __init__(self) -> None:
        super().__init__()
        from IPython.display import HTML, display

        self._html = HTML
        self._updated = -_UPDATE_SECONDS
        self._handle = display(HTML(""), display_id=True)

    def warn(self, text: str) -> None:
        print(text)

    def changed(self, record: Record | None = None) -> None:
        super().changed(record)
        if monotonic() - self._updated < _UPDATE_SECONDS and self.done < self.total:
            return
        self._updated = monotonic()
        bar = f"<progress value='{self.done}' max='{self.total or 1}'></progress>"
        text = escape(f"{self.done}/{self.total} {self.left()} {self.now}")
        self._handle.update(self._html(f"{bar} {text}"))


def remaining(measured: int, to_do: int, seconds: float) -> str:
    """Return the remaining time at the present rate, as "H:MM:SS left"; "" if unknown.

    measured : number of measurements of this run, which took `seconds`
    to_do : number of remaining measurements
    """
    if measured <= 0 or to_do <= 0:
        return ""
    left = timedelta(seconds=round(seconds / measured * to_do))
    return f"{left} left"


def in_notebook() -> bool:
    """Return True if this process is the kernel of a notebook."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return shell is not None and "IPKernelApp" in getattr(shell, "config", {})


@contextmanager
def display_on(stream: TextIO) -> Iterator[Progress]:
    """Show progress on a stream: a bar on a terminal, else one line per measurement."""
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
        """Remaining time, estimated from all measurements of the run.

        The corresponding column of rich uses only the last 30 s, in which possibly no
        measurement has been completed.
        """

        def render(self, task: Task) -> Text:
            return Text(task.fields["left"](), style="progress.remaining")

    now = Column(no_wrap=True, overflow="ellipsis", ratio=1)
    columns: list[ProgressColumn] = [
        MofNCompleteColumn(table_column=Column(no_wrap=True)),
        TimeLeft(table_column=Column(no_wrap=True)),
        TextColumn("{task.description}", table_column=now),
    ]
    console = Console(file=stream)
    if console.width >= _BAR_WIDTH:
        columns.insert(0, BarColumn(bar_width=20))
    with Bars(*columns, console=console, expand=True) as bar:
        yield _Terminal(bar)


@contextmanager
def shown(progress: bool | Callback | Progress | None) -> Iterator[Progress]:
    """Provide the display for the argument `progress` of `mortarbench.run`."""
    if progress in (True, None) and in_notebook():
        yield _Notebook()
    elif progress is True:
        with display_on(sys.stderr) as bar:
            yield bar
    elif isinstance(progress, Progress):
        yield progress
    elif callable(progress):
        yield _Events(progress)
    elif progress in (None, False):
        yield _Silent()
    else:
        raise InputError(
            f"progress = {repeated(progress)}; expected True, False, None or a function"
        )


def ignore(text: str) -> None:
    """Discard a message."""


@contextmanager
def waiting() -> Iterator[Callable[[str], None]]:
    """Print a line on stderr every `WAIT_SECONDS`, with the current activity.

    Yields a function that sets the activity.
    """
    began, now, ended = monotonic(), [""], Signal()

    def tick() -> None:
        while not ended.wait(WAIT_SECONDS):
            say(f"{now[0]} ({monotonic() - began:.0f} s since the start)")

    thread = Thread(target=tick, daemon=True)
    thread.start()
    try:
        yield lambda text: now.__setitem__(0, text)
    finally:
        ended.set()
        thread.join()
