"""Family `membranes`: two membranes in subdomains; see `problems.models.membranes`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from mortarbench.problems.families.declared import DeclaredFamily
from mortarbench.problems.ranges import (
    GLUES,
    check_memory,
    key,
    schema,
)

if TYPE_CHECKING:
    from mortarbench.harness import Value


class Membranes(DeclaredFamily):
    """Two membranes in contact along an edge; the right one floats."""

    name = "membranes"
    keys = schema(S=key(2, 1), n=key(8, 1), **GLUES)
    forms = ("primal", "dual")
    model = "membranes.membranes"

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless every key is in its range."""
        super().check(params)
        side = int(params["S"]) * int(params["n"])
        check_memory(self.name, 2 * (side + 1) ** 2)

    def is_divided(self, params: Mapping[str, Value]) -> bool:
        """Return True: the membranes are always decomposed."""
        return True
