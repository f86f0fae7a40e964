"""The family of plates in subdomains; see `problems.models.plate`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from mortarbench.harness import InputError
from mortarbench.problems.families.in_subdomains import InSubdomains
from mortarbench.problems.ranges import (
    GLUES,
    PLANES,
    at_least,
    doubled,
    fits,
    one_of,
    positive,
)

if TYPE_CHECKING:
    from mortarbench.harness import Case, Reference, ReferenceOverRanks, Value
    from mortarbench.harness.distributed.vectors import Emitted, Ranks


@dataclass(frozen=True)
class Plate(InSubdomains):
    """A clamped plate in subdomains, with jumps of E: linear, to measure FETI on."""

    name: str = "plate"
    defaults: Mapping[str, Value] = field(
        default_factory=lambda: MappingProxyType({
            "Sx": 4, "Sy": 4, "n": 4, "ny": 0, "width": 0.0, "height": 0.0,
            "pattern": "uniform", "jump": 1.0, "load": "edge", "plane": "strain",
            "supports": "rows", "glue": "orthonormal",
        }),
        hash=False,
    )  # fmt: skip
    forms: tuple[str, ...] = ("primal", "dual")

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless every key is in its range."""
        p: Any = params
        at_least(1, self.name, p, ("Sx", "Sy", "n"))
        at_least(0, self.name, p, ("ny",))
        fits(self.name, 2 * p["Sx"] * p["Sy"] * p["n"] * (p["ny"] or p["n"]))
        positive(self.name, p, ("jump", *(k for k in ("width", "height") if p[k])))
        one_of(self.name, p, {
            "pattern": ("uniform", "checkerboard", "column"),
            "load": ("point", "edge", "nodal"), "supports": ("rows", "eliminated"),
            **GLUES, **PLANES,
        })  # fmt: skip
        if p["pattern"] == "uniform" and p["jump"] != 1:
            raise InputError(
                f"{self.name}: jump={p['jump']} is not used by pattern=uniform; "
                "expected no jump, or pattern=checkerboard or pattern=column"
            )
        if p["supports"] == "eliminated" and p["Sx"] * p["Sy"] == 1:
            raise InputError(
                f"{self.name}: supports=eliminated leaves a single subdomain without "
                "any row; expected more subdomains, or supports=rows"
            )

    def refined(self, params: Mapping[str, Value]) -> Mapping[str, Value]:
        """Return the case with every cell halved, in the same subdomains."""
        return {**params, **doubled(params, "n", "ny")}

    def is_divided(self, params: Mapping[str, Value]) -> bool:
        """Say that there are always subdomains."""
        return True

    def emitted(
        self, params: Mapping[str, Value], ranks: Ranks, reference: ReferenceOverRanks
    ) -> Emitted:
        """Make this rank's share of the dual; called by all ranks."""
        from mortarbench.problems.feti.emission import dual_on, emitted
        from mortarbench.problems.models.plate import in_subdomains, results

        del reference
        dual = dual_on(in_subdomains(params), ranks)
        return emitted(dual, results(params, dual))

    def build(
        self, form: str, params: Mapping[str, Value], reference: Reference
    ) -> Case:
        """Emit the QP in one form."""
        from mortarbench.problems.models.plate import clamped_plate

        del reference
        self.check(params)
        return clamped_plate(form, params)
