"""Family `half-plane`, line contact; see `problems.models.half_plane`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from mortarbench.harness import InputError
from mortarbench.problems.families.declared import DeclaredFamily
from mortarbench.problems.ranges import (
    check_dense_memory,
    check_tangential,
    choice,
    key,
    schema,
)

if TYPE_CHECKING:
    from mortarbench.harness import Value


class HalfPlane(DeclaredFamily):
    """Line contact without a mesh: Hertz, or Cattaneo and Mindlin with friction."""

    name = "half-plane"
    keys = schema(
        n=key(100, 2),
        law=choice("hertz", "cattaneo"),
        Q=key(0.0),
        peak=key(0.0),
    )
    forms = ("dual",)
    model = "half_plane.half_plane_case"

    def complete(self, given: Mapping[str, Value]) -> Mapping[str, Value]:
        """Return all keys; `peak` defaults to `Q`, which means no unloading."""
        return {**self.defaults, "peak": given.get("Q", 0.0), **given}

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless the law admits Q and peak without sliding."""
        super().check(params)
        check_dense_memory(self.name, int(params["n"]))
        if params["law"] == "cattaneo":
            check_tangential(self.name, params)
        elif key := next((key for key in ("Q", "peak") if params[key]), ""):
            raise InputError(
                f"{self.name}: {key}={params[key]} needs law=cattaneo; law=hertz has "
                "no tangential force"
            )
