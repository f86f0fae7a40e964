"""Laws of friction, and the rows of one problem with a given bound.

On a side that slips the tangential traction is as large as the law allows, against the
slip; on one that sticks it is smaller, and there is no slip:

    |q| ≤ bound + mu·p

with a given bound (Tresca) or the pressure p (Coulomb). A row of the discretisation
carries a force: its bound is that of the traction times the share of the side, ∫N_j,
that it stands for, and mu times the multiplier of its contact row.

Coulomb's law has no potential. It is solved as a sequence of Tresca's, each with the
bound mu·λ_n of the one before (Haslinger 1983, Math. Methods Appl. Sci. 5): a fixed
point, and a contraction where mu is small.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness import Friction, Vector
from harness.mechanics import NO_FRICTION
from problems.contact.bodies import Bodies, ContactSides
from problems.contact.node_to_segment import ContactRows


@dataclass(frozen=True)
class FrictionLaw:
    """The law between two sides: |q| ≤ bound + mu·p, or no friction at all."""

    kind: str = "none"  #: "none", "tresca" or "coulomb"
    bound: float = 0.0  #: of Tresca's, a traction, Pa
    mu: float = 0.0  #: of Coulomb's, the coefficient

    @property
    def acts(self) -> bool:
        """Whether there is friction; with a bound of zero, too."""
        return self.kind != "none"


def law_of(params: Mapping[str, Any]) -> FrictionLaw:
    """Read the keys friction, bound and mu of a case, checked already."""
    kind = str(params["friction"])
    return FrictionLaw(
        kind,
        bound=float(params["bound"]) if kind == "tresca" else 0.0,
        mu=float(params["mu"]) if kind == "coulomb" else 0.0,
    )


def friction_of(
    bodies: Bodies | ContactSides,
    rows: ContactRows,
    laws: Sequence[FrictionLaw],
    before: Vector,
    pressed: Vector,
) -> Friction:
    """Take the friction of linearised contact, without dimensions.

    Parameters
    ----------
    laws : one per pair
    before : (n,) displacement where the slip begins
    pressed : (places,) normal force of each slave node, which Coulomb's law bounds
        friction by

    """
    if not rows.row.size:
        return NO_FRICTION
    owner = np.repeat(np.arange(len(laws)), [pair.slave.size for pair in bodies.pairs])
    place = rows.place[rows.row]
    bound, mu = (
        np.array([getattr(law, name) for law in laws])[owner[place]]
        for name in ("bound", "mu")
    )
    cohesion = bound * rows.share[rows.row] / bodies.force
    return Friction(
        T=rows.T, bound=cohesion + mu * pressed[place], start=rows.T @ before,
        row=rows.row, cohesion=cohesion, mu=mu,
    )  # fmt: skip
