"""Family `plate`: Total FETI without contact; see `problems.models.plate`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from mortarbench.harness import InputError
from mortarbench.problems.families.declared import DeclaredFamily
from mortarbench.problems.ranges import (
    DIMENSION,
    GLUES,
    PLANES,
    check_memory,
    choice,
    key,
    positive,
    schema,
    size,
)

if TYPE_CHECKING:
    from mortarbench.harness import Value


class Plate(DeclaredFamily):
    """A clamped plate or box of subdomains with jumps of E, for studies of FETI."""

    name = "plate"
    keys = schema(
        Sx=key(4, 1),
        Sy=key(4, 1),
        n=key(4, 1),
        ny=key(0, 0),
        width=key(0.0),
        height=key(0.0),
        pattern=choice("uniform", "checkerboard", "column"),
        jump=size(1.0),
        load=choice("point", "edge", "nodal").with_default("edge"),
        **PLANES,
        supports=choice("rows", "eliminated"),
        **GLUES,
        **DIMENSION,
        Sz=key(1, 1),
    )
    forms = ("primal", "dual")
    model = "plate.clamped_plate"

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless every key is in its range."""
        super().check(params)
        p: Any = params
        dim, in_plane = p["dim"], p["Sx"] * p["Sy"] * p["n"] * (p["ny"] or p["n"])
        check_memory(self.name, dim * in_plane * (p["Sz"] * p["n"]) ** (dim - 2))
        positive(self.name, p, (name for name in ("width", "height") if p[name]))
        if p["pattern"] == "uniform" and p["jump"] != 1:
            raise InputError(
                f"{self.name}: jump={p['jump']} is not used by pattern=uniform; "
                "expected no jump, or pattern=checkerboard or pattern=column"
            )
        if dim == 2 and p["Sz"] != 1:
            raise InputError(
                f"{self.name}: Sz={p['Sz']} is not used by dim=2; expected no Sz, or "
                "dim=3"
            )
        if p["supports"] == "eliminated" and p["Sx"] * p["Sy"] * p["Sz"] == 1:
            raise InputError(
                f"{self.name}: supports=eliminated leaves a single subdomain without "
                "any row of constraints; expected more subdomains, or supports=rows"
            )

    def is_divided(self, params: Mapping[str, Value]) -> bool:
        """Return True: the plate is always decomposed."""
        return True
