"""Progress callbacks of a run."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from mortarbench.harness.record import Record


class Progress(Protocol):
    """Progress callbacks.

    A run calls `start` once, `say` before each block of measurements, `advance` after
    each cell (one measurement of one solver), and `warn` at any time.
    """

    def start(self, total: int) -> None:
        """Begin a run of `total` cells, including cells measured by earlier runs."""

    def say(self, text: str) -> None:
        """Show the current activity."""

    def warn(self, text: str) -> None:
        """Show a warning in a line that stays visible."""

    def advance(self, record: Record | None) -> None:
        """Count a cell as done; `record` is None if the cell was not measured."""
