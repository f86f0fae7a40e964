"""Families of variational inequalities with bounds: `problems.models.variational`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from mortarbench.harness import InputError
from mortarbench.problems.families.declared import DeclaredFamily
from mortarbench.problems.ranges import check_memory, key, schema, size

if TYPE_CHECKING:
    from mortarbench.harness import Value


class String(DeclaredFamily):
    """A string over a sine-shaped obstacle: PERMON's first tutorial."""

    name = "string"
    keys = schema(n=key(100, 3))
    forms = ("primal",)
    model = "variational.string"

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless there are at least three points."""
        super().check(params)
        check_memory(self.name, int(params["n"]))


class JournalBearing(DeclaredFamily):
    """The non-negative pressure in a journal bearing: MINPACK-2."""

    name = "journal-bearing"
    keys = schema(n=key(50, 2), eccentricity=size(0.1))
    forms = ("primal",)
    model = "variational.journal_bearing"

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless the eccentricity is below 1 (surfaces touch at 1)."""
        super().check(params)
        if float(params["eccentricity"]) >= 1:
            raise InputError(
                f"{self.name}: eccentricity={params['eccentricity']} must be below 1"
            )
        check_memory(self.name, int(params["n"]) ** 2)


class Torsion(DeclaredFamily):
    """Elastic-plastic torsion of a square bar, with two-sided bounds: MINPACK-2."""

    name = "torsion"
    keys = schema(n=key(50, 2), twist=size(5.0))
    forms = ("primal",)
    model = "variational.torsion"

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless n is at least 2 and the twist is positive."""
        super().check(params)
        check_memory(self.name, int(params["n"]) ** 2)
