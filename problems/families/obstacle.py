"""The family of obstacle problems; see `problems.models.obstacle`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING

from mortarbench.harness import InputError
from mortarbench.problems.families.in_subdomains import InSubdomains
from mortarbench.problems.ranges import (
    DECOMPOSITION,
    at_least,
    divided,
    doubled,
    fits,
    one_of,
    torn_by,
)

if TYPE_CHECKING:
    from mortarbench.harness import Case, Reference, ReferenceOverRanks, Value
    from mortarbench.harness.distributed.vectors import Emitted, Ranks


@dataclass(frozen=True)
class Obstacle(InSubdomains):
    """A string or membrane over an obstacle, with known exact solution."""

    name: str = "obstacle"
    defaults: Mapping[str, Value] = field(
        default_factory=lambda: MappingProxyType(
            {"dim": 2, "n": 20, "shape": "flat", **DECOMPOSITION}
        ),
        hash=False,
    )
    forms: tuple[str, ...] = ("primal", "dual", "dual-bounds")

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless every key is in its range."""
        one_of(self.name, params, {"dim": (1, 2), "shape": ("flat", "hemisphere")})
        if params["shape"] == "hemisphere" and params["dim"] != 2:
            raise InputError(f"{self.name}: shape=hemisphere needs dim=2")
        at_least(2, self.name, params, ("n",))
        torn_by(self.name, params)
        fits(self.name, int(params["n"]) ** int(params["dim"]))

    def refined(self, params: Mapping[str, Value]) -> Mapping[str, Value]:
        """Return the case with every cell halved."""
        return {**params, **doubled(params, "n")}

    def is_divided(self, params: Mapping[str, Value]) -> bool:
        """Whether it is a membrane in subdomains."""
        return params["dim"] == 2 and divided(params)

    def emitted(
        self, params: Mapping[str, Value], ranks: Ranks, reference: ReferenceOverRanks
    ) -> Emitted:
        """Make this rank's share of the dual; called by all ranks."""
        from mortarbench.problems.feti.emission import dual_on, emitted
        from mortarbench.problems.models.obstacle import in_subdomains, results

        del reference
        dual = dual_on(in_subdomains(params), ranks)
        return emitted(dual, results(params, dual))

    def build(
        self, form: str, params: Mapping[str, Value], reference: Reference
    ) -> Case:
        """Emit the QP in one form."""
        from mortarbench.problems.models.obstacle import over_obstacle

        del reference
        params = self.complete(params)
        self.check(params)
        return over_obstacle(form, params)
