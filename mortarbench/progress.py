"""Displays of the progress of a run.

A run reports its progress to a `Progress` (see `harness.running.progress`). `Display`
turns each report into an `Event`, for a function of the user, or for a function of this
module: a bar on a terminal or in a notebook, or one line per measurement elsewhere.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
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
WAIT_SECONDS = 10.0  #: time between two lines of `waiting`
_UPDATE_SECONDS = 0.2  #: shortest time between two updates of a bar in a notebook


@dataclass(frozen=True, kw_only=True)
class Event:
    """State of a run, passed to the function `progress` of `mortarbench.run`."""

    #: number of measurements that are completed, also by earlier runs, or are left out
    done: int
    total: int  #: largest possible number of measurements of the run
    now: str = ""  #: current activity
    left: str = ""  #: remaining time, such as "0:02:30 left"; empty if it is unknown
    warning: str = ""  #: warning that caused this event; empty if there is no warning
    record: Record | None = None  #: measurement that was just completed, or None


Callback = Callable[[Event], object]


class Display:
    """Progress of a run that calls a function at every change."""

    def __init__(self, callback: Callback) -> None:
        self._callback = callback
        self._done = self._total = 0
        self._measured = 0  # number of measurements of this run, unlike `_done`
        self._began = monotonic()
        self._now = ""

    def start(self, total: int) -> None:
        """Begin a run of `total` cells."""
        self._total, self._began = total, monotonic()
        self._call()

    def say(self, text: str) -> None:
        """Change the current activity."""
        self._now = text
        self._call()

    def warn(self, text: str) -> None:
        """Pass on a warning."""
        self._call(warning=text)

    def advance(self, record: Record | None) -> None:
        """Count a cell as done."""
        self._done += 1
        self._measured += record is not None
        self._call(record=record)

    def _call(self, **more: Any) -> None:
        seconds, to_do = monotonic() - self._began, self._total - self._done
        left = ""
        if self._measured and to_do > 0:
            left = f"{timedelta(seconds=round(seconds / self._measured * to_do))} left"
        state = Event(done=self._done, total=self._total, now=self._now, left=left)
        self._callback(replace(state, **more))


def warnings_on(stream: TextIO) -> Callback:
    """Return a function that writes only warnings."""

    def show(event: Event) -> None:
        if event.warning:
            # the run must continue if the program that reads its output closes the pipe
            with suppress(BrokenPipeError):
                print(event.warning, file=stream, flush=True)

    return show


def lines_on(stream: TextIO) -> Callback:
    """Return a function that writes warnings, and one line per measurement."""
    write = warnings_on(stream)

    def show(event: Event) -> None:
        if event.record is not None:
            line = f"{event.done}/{event.total} {_line(event.record)}"
            event = replace(event, warning=line)
        write(event)

    return show


def _line(record: Record) -> str:
    """Return the result of a measurement in one line."""
    seconds = record.total_seconds
    detail = "" if seconds is None else f" in {seconds:.3g} s"
    if record.status is Verdict.DECLINED and record.message:
        detail = f": {record.message[:_REASON_LENGTH]}"
    return f"{record.solver} on {record.case}: {record.status.words}{detail}"


def _remark(event: Event) -> str:
    """Return a warning, or a line on a result that is neither verified nor declined."""
    r = event.record
    if r is None or r.status.is_verified or r.status is Verdict.DECLINED:
        return event.warning
    return _line(r)


def _in_notebook() -> bool:
    """Return True if this process is the kernel of a notebook."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return shell is not None and "IPKernelApp" in getattr(shell, "config", {})


def _notebook() -> Callback:
    """Return a function that updates a bar in a notebook, and prints remarks."""
    from IPython.display import HTML, display

    handle, updated = display(HTML(""), display_id=True), [-_UPDATE_SECONDS]

    def show(event: Event) -> None:
        if remark := _remark(event):
            print(remark)
        if monotonic() - updated[0] >= _UPDATE_SECONDS or event.done >= event.total:
            updated[0] = monotonic()
            bar = f"<progress value='{event.done}' max='{event.total or 1}'></progress>"
            text = escape(f"{event.done}/{event.total} {event.left} {event.now}")
            handle.update(HTML(f"{bar} {text}"))

    return show


@contextmanager
def display_on(stream: TextIO) -> Iterator[Progress]:
    """Show progress on a stream: a bar on a terminal, else one line per measurement."""
    if not stream.isatty():
        yield Display(lines_on(stream))
        return
    from rich.console import Console
    from rich.markup import escape as literal
    from rich.progress import BarColumn, MofNCompleteColumn, ProgressColumn, TextColumn
    from rich.progress import Progress as Bars
    from rich.table import Column

    text = Column(no_wrap=True, overflow="ellipsis", ratio=1)
    columns: list[ProgressColumn] = [
        BarColumn(bar_width=20),
        MofNCompleteColumn(),
        TextColumn("{task.fields[left]}"),
        TextColumn("{task.description}", table_column=text),
    ]
    console = Console(file=stream)
    with Bars(*columns, console=console, expand=True) as bar:
        task = bar.add_task("starting", total=None, left="")

        def show(event: Event) -> None:
            bar.update(
                task,
                description=literal(event.now),
                total=event.total or None,
                completed=event.done,
                left=event.left,
            )
            if remark := _remark(event):
                console.print(remark, markup=False, highlight=False, soft_wrap=True)

        yield Display(show)


@contextmanager
def shown(progress: bool | Callback | None) -> Iterator[Progress]:
    """Provide the display for the argument `progress` of `mortarbench.run`."""
    if progress in (True, None) and _in_notebook():
        yield Display(_notebook())
    elif progress is True:
        with display_on(sys.stderr) as bar:
            yield bar
    elif callable(progress):
        yield Display(progress)
    elif progress in (None, False):
        yield Display(ignore)
    else:
        raise InputError(
            f"progress = {repeated(progress)}; expected True, False, None or a function"
        )


def ignore(_: object) -> None:
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
