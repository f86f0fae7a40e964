"""Family `half-space`, point contact; see `problems.models.half_space`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from mortarbench.harness import InputError
from mortarbench.harness.limits import CASE_VARIABLE, case_limit_mib
from mortarbench.problems.families.declared import DeclaredFamily
from mortarbench.problems.ranges import (
    LAW_KEYS,
    MAX_SIZE,
    MIN_SIZE,
    choice,
    key,
    schema,
    size,
)

if TYPE_CHECKING:
    from mortarbench.harness import Value

#: bytes per cell of the grid, for vectors and for Fourier transforms on four times as
#: many cells
_CELL_BYTES = 600
#: largest number of cells per side for which the reference solver solves the normal
#: problem; the solve takes 6 s of processor time with 48 cells, and 31 s with 64
MAX_SOLVED = 48
#: smallest number of cells per side of a rough surface; the shortest wavelength is 1/32
#: of the side
MIN_ROUGH = 64


class HalfSpace(DeclaredFamily):
    """Point contact without a mesh: Hertz, rough spheres, and friction on discs."""

    name = "half-space"
    keys = schema(
        n=key(64, 4, 8192),
        law=choice("hertz", "mindlin", "rough"),
        nu=key(0.3),
        Q=key(0.5),
        mu=size(0.3),
        seed=key(0, 0),
        hurst=key(0.8),
        roughness=key(0.05),
        friction=LAW_KEYS["friction"],
        bound=LAW_KEYS["bound"],
    )
    forms = ("dual",)
    model = "half_space.cases.half_space_case"
    conditions = {}  # noqa: RUF012  # `check` has its own conditions for friction

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless every key is in its range and used by the law."""
        super().check(params)
        p: Any = params
        for name, low, high in (("nu", 0, 0.5), ("hurst", 0, 1), ("roughness", 0, 1)):
            if not low <= p[name] <= high:
                raise InputError(
                    f"{self.name}: {name}={p[name]} must be between {low} and {high}"
                )
        if not 0 < p["Q"] < 1:
            raise InputError(
                f"{self.name}: Q={p['Q']} must be between 0 and 1, a fraction of the "
                "limit of friction"
            )
        self._check_law(p)
        needed, limit = _CELL_BYTES * p["n"] ** 2 / 2**20, case_limit_mib()
        if needed > limit:
            raise InputError(
                f"{self.name}: a grid of {p['n']} × {p['n']} cells takes {needed:.2g} "
                f"MiB of memory; expected a grid that fits into {limit:.0f} MiB, or "
                f"{CASE_VARIABLE} set to the memory available"
            )

    def _check_law(self, p: Mapping[str, Any]) -> None:
        """Raise InputError if law, friction and their parameters are incompatible."""
        law, friction = p["law"], p["friction"]
        if law == "mindlin" and friction != "none":
            raise InputError(
                f"{self.name}: friction={friction} is not used by law=mindlin, "
                "Coulomb's law with the exact pressure; expected no friction, or "
                "law=hertz"
            )
        if law == "rough" and friction != "none":
            raise InputError(
                f"{self.name}: friction={friction} with law=rough is not built; "
                "expected no friction, or law=hertz"
            )
        if law == "rough" and p["n"] < MIN_ROUGH:
            raise InputError(
                f"{self.name}: n={p['n']} must be at least {MIN_ROUGH} for law=rough, "
                "two cells per shortest wavelength"
            )
        coulomb = law == "mindlin" or friction == "coulomb"
        users = {
            **dict.fromkeys(
                ("seed", "hurst", "roughness"), (law == "rough", "law=rough")
            ),
            "Q": (coulomb or friction == "tresca", "law=mindlin or friction=coulomb"),
            "mu": (coulomb, "law=mindlin or friction=coulomb"),
            "bound": (friction == "tresca", "friction=tresca"),
        }
        for name, (is_used, user) in users.items():
            if not is_used and p[name] != self.defaults[name]:
                raise InputError(
                    f"{self.name}: {name}={p[name]} is not used by law={law} with "
                    f"friction={friction}; expected no {name}, or {user}"
                )
        bound = p["bound"]
        if friction == "tresca" and not MIN_SIZE <= bound <= MAX_SIZE:
            given = "" if bound == self.defaults["bound"] else f", got {bound:g}"
            raise InputError(
                f"{self.name}: friction=tresca needs bound, a traction between "
                f"{MIN_SIZE:g} and {MAX_SIZE:g} Pa{given}"
            )
        if friction == "coulomb" and p["n"] > MAX_SOLVED:
            raise InputError(
                f"{self.name}: friction=coulomb with n={p['n']} is not built: its "
                "normal problem would need a full matrix; expected "
                f"n={MAX_SOLVED} or less, or law=mindlin"
            )
