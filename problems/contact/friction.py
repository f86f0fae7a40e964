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

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from mortarbench.harness import Friction, InputError, Vector
from mortarbench.harness.errors import PastEndError
from mortarbench.harness.mechanics import NO_FRICTION
from mortarbench.problems.contact.bodies import ContactSides, UnassembledBodies
from mortarbench.problems.contact.node_to_segment import ContactRows
from mortarbench.problems.fem.mesh import Nodes

T = TypeVar("T")

FIXED_POINT_TOLERANCE = 1e-10  #: ‖g − mu·λ_n‖/‖g‖ at the end of a fixed point
MAX_ITERATES = 1000  #: Tresca problems of a fixed point
MAX_STAGNATION = 30  #: of them that need not come nearer to it


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
    bodies: UnassembledBodies | ContactSides,
    rows: ContactRows,
    laws: Sequence[FrictionLaw],
    slip_origin: Vector,
    normal_forces: Vector,
) -> Friction:
    """Take the friction of linearised contact, without dimensions.

    Parameters
    ----------
    laws : one per pair
    slip_origin : (n,) displacement where the slip begins
    normal_forces : (places,) normal force of each slave node, which Coulomb's law
        bounds friction by

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
        T=rows.T, bound=cohesion + mu * normal_forces[place],
        start=rows.T @ slip_origin, row=rows.row, cohesion=cohesion, mu=mu,
    )  # fmt: skip


def coulomb_fixed_point(
    first: Friction, normal: Callable[[Friction], Vector], step: int
) -> list[Friction]:
    """Settle Coulomb's law: the friction of each problem of its fixed point.

    All but the last say how far they are from it, `Friction.unsettled`.

    Parameters
    ----------
    first : with the bound that it begins from
    normal : solves the problem with the bound of a friction, and returns the
        multipliers λ_n (m,) of the contact rows
    step : number of the load step, which refusals name

    Raises
    ------
    InputError
        When the bounds do not settle, or hold no equilibrium: `normal` raises
        ArithmeticError.

    """
    found, residuals, friction = list[Friction](), list[float](), first
    while len(found) < MAX_ITERATES:
        try:
            forces = normal(friction)
        except ArithmeticError as e:
            raise InputError(
                f"load step {step}: no equilibrium was found with the "
                f"{len(found) + 1}. bound of Coulomb's law: friction cannot hold the "
                f"load; expected supports or friction that hold the bodies: {e}"
            ) from None
        residuals.append(friction.residual(forces))
        if residuals[-1] <= FIXED_POINT_TOLERANCE:
            return [*found, friction]
        found.append(replace(friction, unsettled=residuals[-1]))
        if len(found) - int(np.argmin(residuals)) > MAX_STAGNATION:
            break
        friction = replace(friction, bound=friction.demanded(forces))
    raise InputError(
        f"the friction of load step {step} does not settle: after {len(found)} Tresca "
        f"problems ‖g − mu·λ_n‖/‖g‖ is {residuals[-1]:.1e}, and was "
        f"{min(residuals):.1e} at best; expected a smaller mu, or friction=tresca"
    )


def select_iterate(problems: Sequence[T], iterate: int, step: int) -> T:
    """Choose a problem of the fixed point of a load step: 1, 2, …; 0 is the last.

    Raises
    ------
    PastEndError
        When there are fewer.

    """
    if iterate > len(problems):
        raise PastEndError(
            f"iterate={iterate}: the fixed point of step {step} has {len(problems)} "
            "problems; expected at most that, or 0 for the last"
        )
    return problems[iterate - 1]


def forces_at_nodes(normal: Vector, place: Nodes, places: int) -> Vector:
    """Return the normal force (places,) of each slave node; zero without a row.

    Parameters
    ----------
    normal : (m,) multipliers of the contact rows
    place : (m,) slave node of each, see `ContactRows`

    """
    force = np.zeros(places)
    force[place] = np.maximum(normal, 0.0)
    return force
