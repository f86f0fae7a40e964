"""Who is told how a run goes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    from mortarbench.harness.record import Record


@runtime_checkable
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
