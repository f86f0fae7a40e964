"""The family of the cantilever at finite strain; see `problems.models.cantilever`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from mortarbench.harness import Family, InputError
from mortarbench.problems.ranges import (
    FINITE,
    MOST_STEPS,
    at_least,
    at_most,
    fits,
    one_of,
    positive,
)

if TYPE_CHECKING:
    from mortarbench.harness import Case, Reference, Value

THICKEST = 2.0  #: smallest length of the beam over its thickness
LEAST_LOAD, MOST_LOAD = 1e-3, 1e3  #: PL²/EI; the elastica loses digits beyond
MOST_NU = 0.4999  #: beyond, the factor of the tangent has few digits left


@dataclass(frozen=True)
class Cantilever(Family):
    """A slender cantilever under an end load at finite strain: the elastica."""

    name: str = "cantilever"
    defaults: Mapping[str, Value] = field(
        default_factory=lambda: MappingProxyType({
            "slenderness": 20.0, "load": 1.0, "nx": 0, "ny": 10, "nu": 0.3,
            "material": "neo-hooke", "steps": 1, "step": 0, "newton": 0,
        }),
        hash=False,
    )  # fmt: skip
    forms: tuple[str, ...] = ("primal", "dual")

    def complete(self, given: Mapping[str, Value]) -> Mapping[str, Value]:
        """Fill in the keys left out; nx makes cells half as long as thick."""
        params: dict[str, Any] = {**self.defaults, **given}
        cells = min(max(2 * params["ny"] * params["slenderness"], 1), 1e9)
        derived = {"nx": round(cells), "step": params["steps"]}
        return params | {k: v for k, v in derived.items() if k not in given}

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless every key is in its range."""
        p: Any = params
        positive(self.name, p, ("slenderness", "load"))
        if not LEAST_LOAD <= p["load"] <= MOST_LOAD:
            raise InputError(
                f"{self.name}: load={p['load']:g} must be between {LEAST_LOAD:g} and "
                f"{MOST_LOAD:g}: it is PL²/EI"
            )
        if p["slenderness"] < THICKEST:
            raise InputError(
                f"{self.name}: slenderness={p['slenderness']:g} must be at least "
                f"{THICKEST:g}: it is the length over the thickness"
            )
        if not 0 <= p["nu"] <= MOST_NU:
            raise InputError(
                f"{self.name}: nu={p['nu']:g} must be between 0 and {MOST_NU:g}"
            )
        at_least(1, self.name, p, ("nx", "ny", "steps", "step"))
        at_least(0, self.name, p, ("newton",))
        at_most(MOST_STEPS, self.name, p, ("steps",))
        fits(self.name, 2 * (p["nx"] + 1) * (p["ny"] + 1))
        if p["step"] > p["steps"]:
            raise InputError(
                f"{self.name}: step={p['step']} must be in 1..steps={p['steps']}"
            )
        one_of(self.name, p, {"material": FINITE["material"]})

    def build(
        self, form: str, params: Mapping[str, Value], reference: Reference
    ) -> Case:
        """Emit the QP of one Newton iteration of one load step in one form."""
        from mortarbench.problems.models.cantilever import newton_step

        self.check(params)
        return newton_step(form, params, reference)
