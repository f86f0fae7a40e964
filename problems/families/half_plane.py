"""The family of line contact of half planes; see `problems.models.half_plane`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING

from mortarbench.harness import Family, InputError
from mortarbench.problems.ranges import at_least, fits_dense, one_of, tangential

if TYPE_CHECKING:
    from mortarbench.harness import Case, Reference, Value


@dataclass(frozen=True)
class HalfPlane(Family):
    """Line contact without a mesh: Hertz, or Cattaneo and Mindlin with friction."""

    name: str = "half-plane"
    defaults: Mapping[str, Value] = field(
        default_factory=lambda: MappingProxyType({
            "n": 100, "law": "hertz", "Q": 0.0, "peak": 0.0,
        }),
        hash=False,
    )  # fmt: skip
    forms: tuple[str, ...] = ("dual",)

    def complete(self, given: Mapping[str, Value]) -> Mapping[str, Value]:
        """Let the tangential force never have been larger than it is."""
        return {**self.defaults, "peak": given.get("Q", 0.0), **given}

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless the law has these forces, and they do not slide."""
        at_least(2, self.name, params, ("n",))
        fits_dense(self.name, int(params["n"]))
        one_of(self.name, params, {"law": ("hertz", "cattaneo")})
        if params["law"] == "cattaneo":
            tangential(self.name, params)
        elif key := next((key for key in ("Q", "peak") if params[key]), ""):
            raise InputError(
                f"{self.name}: {key}={params[key]} needs law=cattaneo; law=hertz has "
                "no tangential force"
            )

    def build(
        self, form: str, params: Mapping[str, Value], reference: Reference
    ) -> Case:
        """Emit the QP."""
        from mortarbench.problems.models.half_plane import half_planes

        del form, reference
        self.check(params)
        return half_planes(params)
