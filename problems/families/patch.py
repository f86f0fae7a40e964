"""Family `contact-patch`: the patch test; see `problems.models.patch`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from mortarbench.harness import InputError
from mortarbench.problems.families.declared import ContactFamily
from mortarbench.problems.ranges import (
    DECOMPOSITION,
    DIMENSION,
    FRICTION,
    KINEMATICS,
    METHODS,
    MIN_STRETCH,
    PLANES,
    check_memory,
    choice,
    key,
    schema,
    size,
)

if TYPE_CHECKING:
    from mortarbench.harness import Value

#: largest shift of a node, in cell sizes; shifts of half a cell could invert cells
MAX_DISTORTION = 0.35


class ContactPatch(ContactFamily):
    """Contact patch test: two stacked blocks under uniform pressure."""

    name = "contact-patch"
    keys = schema(
        lower=key(6, 1),
        upper=key(4, 1),
        slave=choice("lower", "upper").with_default("upper"),
        ratio=size(1.0),
        contact=METHODS["contact"].with_default("mortar"),
        basis=METHODS["basis"],
        **PLANES,
        **FRICTION,
        **DECOMPOSITION,
        **KINEMATICS,
        stretch=key(1.0),
        **DIMENSION,
        distort=key(0.0),
    )
    forms = ("primal", "dual")
    problem = "patch.problem"
    model = "patch.newton_step"

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless every key is in its range and is used."""
        super().check(params)
        cells = (int(params["lower"]), int(params["upper"]))
        dim = int(params["dim"])
        check_memory(self.name, dim * sum(n**dim for n in cells) // 2)
        distort = float(params["distort"])
        if not 0 <= distort <= MAX_DISTORTION * (dim - 2):
            raise InputError(
                f"{self.name}: distort={distort:g} is not supported with dim={dim}; "
                f"expected 0, or with dim=3 at most {MAX_DISTORTION:g} of a cell"
            )
        stretch = float(params["stretch"])
        if stretch == self.defaults["stretch"]:
            return
        if params["kinematics"] == "linear":
            raise InputError(
                f"{self.name}: stretch={stretch:g} is not used by kinematics=linear; "
                "expected no stretch, or kinematics=finite"
            )
        if not MIN_STRETCH <= stretch < 1:
            raise InputError(
                f"{self.name}: stretch={stretch:g} must be at least {MIN_STRETCH:g} "
                "and below 1: stacked blocks can only be compressed"
            )
