"""Description of a contact problem, returned by its family, before assembly.

From this description, `problems.duality.monolithic` derives the QPs of undivided
bodies, and `problems.duality.decomposed` those of decomposed bodies on one or several
processes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import QP, Friction, Solution, Vector
from mortarbench.problems.contact.bodies import UnassembledBodies
from mortarbench.problems.contact.friction import FrictionLaw
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.rows import ContactRows
from mortarbench.problems.contact.stepping import Stage
from mortarbench.problems.fem.mesh import Nodes

#: function that linearises contact at a displacement (n,) in m
Linearise: TypeAlias = Callable[[Vector], ContactRows]


class InterfaceState(NamedTuple):
    """Data and solution of a contact problem."""

    bodies: UnassembledBodies
    primal: QP  #: only the diagonal of P is used, and only with friction
    solution: Solution
    rows: ContactRows  #: contact rows of `primal`
    friction: Friction


class ContactSolution(NamedTuple):
    """Solution of a contact problem."""

    sides: InterfaceState
    #: number of Tresca problems solved for Coulomb's law; 1 for other laws
    problems: int

    def at(self, component: Nodes) -> Vector:
        """Return the nondimensional displacement at global components (k,)."""
        return np.asarray(self.sides.solution.x[component])


@dataclass(frozen=True, eq=False, kw_only=True)
class ContactProblem:
    """Elastic bodies with their contact law and load stages."""

    bodies: UnassembledBodies
    stages: tuple[Stage, ...]
    #: function of the bodies (or their contact sides) and the friction laws of their
    #: pairs; it returns a function that maps a displacement in m to contact rows
    linearise: Callable[[UnassembledBodies, Sequence[FrictionLaw]], Linearise]
    #: normal force per slave node for the first friction bound of Coulomb's law
    initial_force: float = 0.0
    #: function that evaluates quantities beyond those common to all elastic bodies
    results: Callable[[ContactSolution], Mapping[str, Any]] = lambda _: {}
    #: (k, 3) with the columns x in m, exact pressure and exact shear in Pa on the slave
    #: side; None if unknown
    exact: NDArray[np.float64] | None = None


class Choice(NamedTuple):
    """Selection of one QP of a contact problem."""

    step: int = 1  #: number of the load step, from 1
    size: int = 0  #: argument of `subdivided`; 0 for undivided bodies
    glue: str = "orthonormal"  #: one of `problems.feti.subdomains.GLUE`


def keyed_linearisation(
    contact: str, basis: str, *, undeformed: bool = False
) -> Callable[[UnassembledBodies, Sequence[FrictionLaw]], Linearise]:
    """Return the linearisation that the keys `contact` and `basis` select.

    undeformed : linearise at the undeformed state, whatever the displacement
    """

    def linearise(bodies: UnassembledBodies, laws: Sequence[FrictionLaw]) -> Linearise:
        rows = linearisation(bodies, contact, basis, laws)
        return (lambda u: rows(np.zeros_like(u))) if undeformed else rows

    return linearise
