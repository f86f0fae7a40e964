"""Two membranes torn into subdomains; see `problems.models.membranes`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING

from mortarbench.problems.families.in_subdomains import InSubdomains
from mortarbench.problems.ranges import GLUES, at_least, doubled, fits, one_of

if TYPE_CHECKING:
    from mortarbench.harness import Case, Reference, ReferenceOverRanks, Value
    from mortarbench.harness.distributed.vectors import Emitted, Ranks


@dataclass(frozen=True)
class Membranes(InSubdomains):
    """Two membranes in contact along an edge, the right one floating."""

    name: str = "membranes"
    defaults: Mapping[str, Value] = field(
        default_factory=lambda: MappingProxyType(
            {"S": 2, "n": 8, "glue": "orthonormal"}
        ),
        hash=False,
    )
    forms: tuple[str, ...] = ("primal", "dual")

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless every key is in its range."""
        at_least(1, self.name, params, ("S", "n"))
        one_of(self.name, params, GLUES)
        side = int(params["S"]) * int(params["n"])
        fits(self.name, 2 * (side + 1) ** 2)

    def refined(self, params: Mapping[str, Value]) -> Mapping[str, Value]:
        """Return the case with every cell halved."""
        return {**params, **doubled(params, "n")}

    def is_divided(self, params: Mapping[str, Value]) -> bool:
        """Whether ranks can emit it: always."""
        return True

    def emitted(
        self, params: Mapping[str, Value], ranks: Ranks, reference: ReferenceOverRanks
    ) -> Emitted:
        """Make this rank's share of the dual; called by all ranks."""
        from mortarbench.problems.feti.emission import dual_on, emitted
        from mortarbench.problems.models.membranes import in_subdomains, results

        del reference
        dual = dual_on(in_subdomains(params), ranks)
        return emitted(dual, results(params, dual))

    def build(
        self, form: str, params: Mapping[str, Value], reference: Reference
    ) -> Case:
        """Emit the QP in one form."""
        from mortarbench.problems.models.membranes import membranes

        del reference
        params = self.complete(params)
        self.check(params)
        return membranes(form, params)
