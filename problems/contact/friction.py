"""Friction laws, their discretisation, and the fixed-point iteration for Coulomb's law.

The tangential traction q is bounded. Where the sides slip, q opposes the slip and
attains its bound; where |q| is smaller, the sides stick:

    |q| ≤ bound + mu·p

with the pressure p, where mu = 0 under Tresca's law and bound = 0 under Coulomb's. The
force λ_t of a discrete row satisfies  |λ_t| ≤ g = bound·∫N_j + mu·λ_n,  where ∫N_j is
the length (in 3D, the area) of the slave side assigned to the node of the row, and λ_n
is the multiplier of the contact row of this node.

Coulomb's law does not derive from a potential. It is solved by fixed-point iteration
over problems with Tresca's law, each with the bound g = mu·λ_n from the solution of its
predecessor (Haslinger 1983, Math. Methods Appl. Sci. 5). The iteration is a contraction
for small mu.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from mortarbench.harness import Friction, InputError, Vector
from mortarbench.harness.mechanics import NO_FRICTION
from mortarbench.problems.contact.bodies import UnassembledBodies
from mortarbench.problems.contact.rows import ContactRows
from mortarbench.problems.keys import LAW_PARAMETERS, LAWS, physical

T = TypeVar("T")

#: the fixed-point iteration has converged if `Friction.residual` is at most this value
FIXED_POINT_TOLERANCE = 1e-10
#: number of Tresca problems after which the fixed-point iteration is abandoned
MAX_ITERATES = 1000
#: the iteration is abandoned after this many Tresca problems without a new smallest
#: residual
MAX_STAGNATION = 30


@dataclass(frozen=True)
class FrictionLaw:
    """Friction law |q| ≤ bound + mu·p between two sides; the default has no friction.

    >>> FrictionLaw("coulomb", mu=0.3).acts
    True
    """

    kind: str = "none"  #: "none", "tresca" or "coulomb"
    bound: float = 0.0  #: bound of Tresca's law on the traction, Pa
    mu: float = 0.0  #: coefficient of Coulomb's law

    def __post_init__(self) -> None:
        """Check the name of the law and its parameter."""
        if self.kind not in LAWS:
            names = " or ".join(map(repr, LAWS))
            raise InputError(f"friction {self.kind!r} is unknown; expected {names}")
        if key := LAWS[self.kind]:
            where = f"friction {self.kind}: {key}"
            if (value := physical(where, getattr(self, key))) < 0:
                expected = LAW_PARAMETERS[key]
                raise InputError(f"{where} = {value:g}; expected {expected}")

    @property
    def acts(self) -> bool:
        """True for a law other than "none", even with a bound of zero."""
        return self.kind != "none"


def law_of(friction: str, bound: float, mu: float) -> FrictionLaw:
    """Return the law from the values of the keys of the same names.

    Parameters of other laws are ignored.
    """
    return FrictionLaw(
        friction,
        bound=bound if friction == "tresca" else 0.0,
        mu=mu if friction == "coulomb" else 0.0,
    )


def friction_of(
    bodies: UnassembledBodies,
    rows: ContactRows,
    laws: Sequence[FrictionLaw],
    slip_origin: Vector,
    normal_forces: Vector,
) -> Friction:
    """Return the discrete friction of linearised contact, non-dimensional.

    Parameters
    ----------
    laws : friction law of each pair
    slip_origin : (n,) displacement from which slip is measured
    normal_forces : (places,) normal force of each slave node, which determines the
        bound of Coulomb's law

    """
    if not rows.row.size:
        return NO_FRICTION
    owner = np.repeat(
        np.arange(len(laws)), [pair.slave_nodes.size for pair in bodies.pairs]
    )
    bound, mu = (
        np.array([getattr(law, name) for law in laws])[owner[rows.place]]
        for name in ("bound", "mu")
    )
    cohesion = rows.of_rows(bound * rows.share) / bodies.force
    mu = rows.of_rows(mu * rows.share) / rows.of_rows(rows.share)
    pressing = rows.of_rows(normal_forces[rows.place])
    cohesion, mu, pressing = (v[rows.row] for v in (cohesion, mu, pressing))
    return Friction(
        T=rows.T,
        bound=cohesion + mu * pressing,
        start=rows.T @ slip_origin,
        row=rows.row,
        cohesion=cohesion,
        mu=mu,
    )


def coulomb_fixed_point(
    first: Friction, normal: Callable[[Friction], Vector], step: int
) -> list[Friction]:
    """Solve Coulomb's law by fixed-point iteration; return a `Friction` per iterate.

    Parameters
    ----------
    first : friction with the initial bound
    normal : function that solves the Tresca problem for the bounds of its argument and
        returns the multipliers λ_n (m,) of the contact rows
    step : number of the load step, for messages

    Raises
    ------
    InputError
        If the iteration does not converge.

    """
    iterates, residuals, friction = list[Friction](), list[float](), first
    while len(iterates) < MAX_ITERATES:
        forces = normal(friction)
        residuals.append(friction.residual(forces))
        if residuals[-1] <= FIXED_POINT_TOLERANCE:
            return [*iterates, friction]
        iterates.append(friction)
        if len(iterates) - int(np.argmin(residuals)) > MAX_STAGNATION:
            break
        friction = replace(friction, bound=friction.demanded(forces))  # g ← mu·λ_n
    raise InputError(
        f"Coulomb's law does not converge in load step {step}: after {len(iterates)} "
        f"Tresca problems, ‖g − mu·λ_n‖/‖g‖ is {residuals[-1]:.1e}, and was "
        f"{min(residuals):.1e} at best; expected a smaller mu, or friction=tresca"
    )
