"""Variational inequalities with bounds; see `problems.models.variational`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING

from mortarbench.harness import Family, InputError
from mortarbench.problems.ranges import at_least, fits, positive

if TYPE_CHECKING:
    from mortarbench.harness import Case, Reference, Value


@dataclass(frozen=True)
class String(Family):
    """A string over a sine-shaped obstacle: PERMON's first tutorial."""

    name: str = "string"
    defaults: Mapping[str, Value] = field(
        default_factory=lambda: MappingProxyType({"n": 100}), hash=False
    )
    forms: tuple[str, ...] = ("primal",)

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless there are three points or more."""
        at_least(3, self.name, params, ("n",))
        fits(self.name, int(params["n"]))

    def build(
        self, form: str, params: Mapping[str, Value], reference: Reference
    ) -> Case:
        """Emit the QP."""
        from mortarbench.problems.models.variational import string

        del form, reference
        self.check(params)
        return string(int(params["n"]))


@dataclass(frozen=True)
class JournalBearing(Family):
    """The pressure in a journal bearing, not negative: MINPACK-2."""

    name: str = "journal-bearing"
    defaults: Mapping[str, Value] = field(
        default_factory=lambda: MappingProxyType({"n": 50, "eccentricity": 0.1}),
        hash=False,
    )
    forms: tuple[str, ...] = ("primal",)

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless the shaft turns inside of the bearing."""
        at_least(2, self.name, params, ("n",))
        positive(self.name, params, ("eccentricity",))
        if float(params["eccentricity"]) >= 1:
            raise InputError(
                f"{self.name}: eccentricity={params['eccentricity']} must be below 1"
            )
        fits(self.name, int(params["n"]) ** 2)

    def build(
        self, form: str, params: Mapping[str, Value], reference: Reference
    ) -> Case:
        """Emit the QP."""
        from mortarbench.problems.models.variational import journal_bearing

        del form, reference
        self.check(params)
        return journal_bearing(int(params["n"]), float(params["eccentricity"]))


@dataclass(frozen=True)
class Torsion(Family):
    """Elastic-plastic torsion of a square bar, bounds on both sides: MINPACK-2."""

    name: str = "torsion"
    defaults: Mapping[str, Value] = field(
        default_factory=lambda: MappingProxyType({"n": 50, "twist": 5.0}), hash=False
    )
    forms: tuple[str, ...] = ("primal",)

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless there are two nodes a side and a twist."""
        at_least(2, self.name, params, ("n",))
        positive(self.name, params, ("twist",))
        fits(self.name, int(params["n"]) ** 2)

    def build(
        self, form: str, params: Mapping[str, Value], reference: Reference
    ) -> Case:
        """Emit the QP."""
        from mortarbench.problems.models.variational import torsion

        del form, reference
        self.check(params)
        return torsion(int(params["n"]), float(params["twist"]))
