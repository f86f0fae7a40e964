"""Families of which ranks of MPI can emit the dual, each its own subdomains."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from mortarbench.harness import Family

if TYPE_CHECKING:
    from mortarbench.harness import ReferenceOverRanks, Value
    from mortarbench.harness.distributed.vectors import Emitted, Ranks
    from mortarbench.problems.feti.emission import ProblemInParts


class InSubdomains(Family):
    """A family of bodies in subdomains that ranks can make without the whole."""

    @abstractmethod
    def is_emitted_by_ranks(self, params: Mapping[str, Value]) -> bool:
        """Whether the dual has subdomains, and ranks can make all that it needs."""

    @abstractmethod
    def in_subdomains(self, params: Mapping[str, Value]) -> ProblemInParts:
        """Describe the dual that `build` emits; called where ranks emit it."""

    def emission(
        self, form: str, params: Mapping[str, Value]
    ) -> Callable[[Ranks, ReferenceOverRanks], Emitted] | None:
        """Return what has each rank make its share; None where one process must."""
        if form != "dual" or not self.is_emitted_by_ranks(params):
            return None

        def emit(ranks: Ranks, reference: ReferenceOverRanks) -> Emitted:
            from mortarbench.problems.feti.emission import emitted

            return emitted(self.in_subdomains(params), ranks, reference)

        return emit
