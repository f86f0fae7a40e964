"""Family `hertz-sphere`: point contact; see `problems.models.solids.hertz_sphere`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from mortarbench.harness import InputError
from mortarbench.problems.families.declared import ContactFamily
from mortarbench.problems.ranges import (
    DECOMPOSITION,
    METHODS,
    check_memory,
    choice,
    key,
    schema,
    size,
)

if TYPE_CHECKING:
    from mortarbench.harness import Value


class HertzSphere(ContactFamily):
    """Hertzian point contact: an elastic sphere on a rigid plane or an equal sphere."""

    name = "hertz-sphere"
    keys = schema(
        n=key(8, 1),
        against=choice("plane", "sphere"),
        R=size(8.0),
        E=size(200.0),
        nu=key(0.3),
        load=size(10.0),
        Q=key(0.0),
        mu=size(0.3),
        contact=METHODS["contact"].with_default("mortar"),
        basis=METHODS["basis"],
        **DECOMPOSITION,
    )
    forms = ("primal", "dual")
    problem = "solids.hertz_sphere.problem"

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless every key is in its range."""
        super().check(params)
        check_memory(self.name, 3 * int(params["n"]) ** 3)
        if params["against"] == "plane":
            for name in ("contact", "basis"):
                if params[name] != self.defaults[name]:
                    raise InputError(
                        f"{self.name}: {name}={params[name]} is not used by "
                        f"against=plane; expected against=sphere, or no {name}"
                    )
        if not 0 <= float(params["Q"]) < 1:
            raise InputError(
                f"{self.name}: Q={params['Q']} must be at least 0 and below 1, a "
                "fraction of μP"
            )
        if params["Q"] and params["against"] == "plane":
            raise InputError(
                f"{self.name}: Q={params['Q']} is not supported with against=plane; "
                "expected against=sphere, for which the exact solution is known"
            )
        if params["mu"] != self.defaults["mu"] and not params["Q"]:
            raise InputError(
                f"{self.name}: mu={params['mu']} is not used without a tangential "
                "force; expected Q, or no mu"
            )
        if not -1 < float(params["nu"]) < 0.5:
            raise InputError(
                f"{self.name}: nu={params['nu']} must be between -1 and 0.5"
            )
