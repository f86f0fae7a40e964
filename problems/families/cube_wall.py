"""Family `cube-wall`, a cube beside a wall; see `problems.models.solids.cube_wall`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from mortarbench.problems.families.declared import ContactFamily
from mortarbench.problems.ranges import (
    CONTACT_FORMS,
    DECOMPOSITION,
    check_memory,
    key,
    schema,
)

if TYPE_CHECKING:
    from mortarbench.harness import Value


class CubeWall(ContactFamily):
    """A three-dimensional elastic cube, pressed down next to a rigid wall (PERMON)."""

    name = "cube-wall"
    keys = schema(n=key(8, 1), **DECOMPOSITION)
    forms = CONTACT_FORMS
    problem = "solids.cube_wall.problem"

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless every key is in its range."""
        super().check(params)
        check_memory(self.name, 3 * int(params["n"]) ** 3)
