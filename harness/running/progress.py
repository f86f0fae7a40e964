"""How a run goes, on stderr: a bar on a terminal, else one line per measurement."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Protocol, TextIO

from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    TextColumn,
    TimeElapsedColumn,
)
from rich.progress import Progress as Bar

from harness.record import Record, Verdict

_REASON = 120  #: characters of why a solver declined


class Progress(Protocol):
    """Who is told how a run goes."""

    def start(self, total: int) -> None:
        """Begin; `total` cells, those that an earlier run measured included."""

    def say(self, text: str) -> None:
        """Show what happens now."""

    def warn(self, text: str) -> None:
        """Show what went wrong, in a line that stays."""

    def advance(self, record: Record | None) -> None:
        """Count one cell as done; None where nothing had to be measured."""


@contextmanager
def shown_on(stream: TextIO) -> Iterator[Progress]:
    """Give what a run reports its progress to."""
    if not stream.isatty():
        yield _Lines(stream)
        return
    columns = (
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.description}"),
    )
    with Bar(*columns, console=Console(file=stream)) as bar:
        yield _Bar(bar)


class _Bar:
    def __init__(self, bar: Bar) -> None:
        self._bar = bar
        self._task = bar.add_task("starting", total=None)

    def start(self, total: int) -> None:
        self._bar.update(self._task, total=total)

    def say(self, text: str) -> None:
        self._bar.update(self._task, description=escape(text))

    def warn(self, text: str) -> None:
        self._bar.console.print(escape(text), highlight=False, soft_wrap=True)

    def advance(self, record: Record | None) -> None:
        self._bar.advance(self._task)


class _Lines:
    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._done = self._total = 0

    def start(self, total: int) -> None:
        self._total = total
        self.warn(f"{total} measurement{'s' * (total != 1)}")

    def say(self, text: str) -> None:
        """Be silent: the line that follows says what was done."""

    def warn(self, text: str) -> None:
        with suppress(BrokenPipeError):  # nobody listens: no reason to stop measuring
            print(text, file=self._stream, flush=True)

    def advance(self, record: Record | None) -> None:
        self._done += 1
        if record is None:
            return
        seconds = record.total_seconds
        took = "" if seconds is None else f" in {seconds:.3g} s"
        if record.status is Verdict.DECLINED and record.message:
            took = f": {record.message[:_REASON]}"
        self.warn(
            f"{self._done}/{self._total} {record.solver} on {record.case}: "
            f"{record.status}{took}"
        )
