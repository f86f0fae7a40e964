"""Family `cantilever`, at finite strain; see `problems.models.cantilever`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from mortarbench.harness import InputError
from mortarbench.problems.families.declared import DeclaredFamily
from mortarbench.problems.ranges import (
    KINEMATICS,
    STEPS,
    check_memory,
    key,
    schema,
    size,
)

if TYPE_CHECKING:
    from mortarbench.harness import Value

MIN_SLENDERNESS = 2.0  #: smallest ratio of length to thickness
#: smallest and largest PL²/EI; outside this range, the formula of the elastica loses
#: digits
MIN_LOAD, MAX_LOAD = 1e-3, 1e3
#: largest Poisson's ratio; closer to ½, the Cholesky factor of the tangent loses nearly
#: all digits
MAX_NU = 0.4999


class Cantilever(DeclaredFamily):
    """A slender cantilever under an end load at finite strain: the elastica."""

    name = "cantilever"
    keys = schema(
        slenderness=size(20.0),
        load=size(1.0),
        nx=key(0, 1),
        ny=key(10, 1),
        nu=key(0.3),
        material=KINEMATICS["material"],
        steps=STEPS.with_default(1),
        step=key(0, 1),
        newton=KINEMATICS["newton"],
    )
    forms = ("primal", "dual")
    model = "cantilever.newton_step"

    def complete(self, given: Mapping[str, Value]) -> Mapping[str, Value]:
        """Return all keys; by default, nx = 2·ny·slenderness and step = steps."""
        params: dict[str, Any] = {**self.defaults, **given}
        # limit the number before rounding it, because slenderness may be up to 1e30
        cells = min(max(2 * params["ny"] * params["slenderness"], 1), 1e9)
        derived = {"nx": round(cells), "step": params["steps"]}
        return params | {k: v for k, v in derived.items() if k not in given}

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless every key is in its range."""
        super().check(params)
        p: Any = params
        if not MIN_LOAD <= p["load"] <= MAX_LOAD:
            raise InputError(
                f"{self.name}: load={p['load']:g} must be between {MIN_LOAD:g} and "
                f"{MAX_LOAD:g} (the load is PL²/EI)"
            )
        if p["slenderness"] < MIN_SLENDERNESS:
            raise InputError(
                f"{self.name}: slenderness={p['slenderness']:g} must be at least "
                f"{MIN_SLENDERNESS:g} (ratio of length to thickness)"
            )
        if not 0 <= p["nu"] <= MAX_NU:
            raise InputError(
                f"{self.name}: nu={p['nu']:g} must be between 0 and {MAX_NU:g}"
            )
        check_memory(self.name, 2 * (p["nx"] + 1) * (p["ny"] + 1))
