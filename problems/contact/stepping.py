"""Load steps with re-linearised contact, and Coulomb's law in each (paper, Section 2).

A load step begins where the one before has ended. Its contact rows are linearised at
that solution, and `relin` − 1 more times at its own; each linearisation is a `Stage`,
and its QP is linearised by whoever holds the bodies: one process undivided ones
(`problems.duality.undivided`), ranks their subdomains (`problems.duality.divided`).
With relin = 1 this is the paper's scheme, of first order in 1/steps.

With friction, slip is that of the load step (``quasi-static``: T(u − u_prev), which
depends on the path), or of the whole load at once (``static``: T u). Coulomb's law is
the fixed point of problems with a given bound, g ← mu·λ_n from the solution of the one
before on; each stage is settled. It begins from the normal forces of the stage before.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from mortarbench.harness import Friction, Solution, Vector
from mortarbench.problems.contact.friction import (
    FrictionLaw,
    coulomb_fixed_point,
    select_iterate,
)
from mortarbench.problems.fem.mesh import Nodes


class Forces(NamedTuple):
    """Forces at single components, without dimensions; zero at all others."""

    component: Nodes  #: (k,) each once
    value: Vector  #: (k,)


class State(NamedTuple):
    """The state that a stage begins at, by displacements as its problem takes them."""

    u: Vector  #: (w,) where contact is linearised
    slip_origin: Vector  #: (w,) where the slip begins
    #: (places,) normal force of each slave node, which Coulomb's law begins from
    normal_forces: Vector


def continue_slip(left: State) -> State:
    """Begin where the stage before has ended, the slip where that began."""
    return left


def restart_slip(left: State) -> State:
    """Begin where the stage before has ended, the slip there, too."""
    return left._replace(slip_origin=left.u)


@dataclass(frozen=True, eq=False, kw_only=True)
class Stage:
    """One linearisation of a load step."""

    step: int  #: of the load, 1, 2, …
    part: float  #: of the forces that acts
    forces: Forces
    fixed: Nodes  #: components that supports hold at zero
    laws: tuple[FrictionLaw, ...] = ()  #: of each pair; none for no friction at all
    #: where, of what the stage before left
    begin: Callable[[State], State] = continue_slip


def load_steps(
    steps: int,
    relin: int,
    forces: Forces,
    fixed: Nodes,
    laws: tuple[FrictionLaw, ...] = (),
    *,
    quasi_static: bool = True,
) -> tuple[Stage, ...]:
    """List the stages of a load that grows evenly, each step linearised `relin` times.

    quasi_static : whether slip is that of the step
    """
    return tuple(
        Stage(
            step=k, part=k / steps, forces=forces, fixed=fixed, laws=laws,
            begin=restart_slip if quasi_static and not i else continue_slip,
        )
        for k in range(1, steps + 1) for i in range(relin)
    )  # fmt: skip


class LinearisedProblem(Protocol):
    """A linearised contact problem, and its dual with any bound of the friction."""

    @property
    def friction(self) -> Friction:
        """That of its rows, with the first bound."""

    def solve(self, friction: Friction, start: Solution | None = None) -> Solution:
        """Solve the dual with the bound of a friction.

        start : solution with another bound
        """

    def normal_multipliers(self, s: Solution) -> Vector:
        """Return the multipliers λ_n (m,) of the contact rows."""

    def end_state(self, s: Solution) -> tuple[Vector, Vector]:
        """Return u (w,) and the normal forces (places,) that a solution has."""


P = TypeVar("P", bound=LinearisedProblem)


class Iterate(NamedTuple, Generic[P]):
    """A problem of a stage, with the bound of its friction."""

    problem: P
    friction: Friction
    solution: Callable[[], Solution]  #: of the dual


@dataclass(frozen=True, eq=False)
class LoadPath(Generic[P]):
    """The stages of one analysis; what was solved once is remembered.

    Raises
    ------
    ArithmeticError
        When a solve is not accurate.
    InputError
        When a fixed point of Coulomb's law does not settle, has less iterates, or comes
        to bounds that hold no equilibrium.

    """

    stages: Sequence[Stage]
    linearise: Callable[[Stage, State], P]
    initial: State  #: where the first stage begins
    _history: list[tuple[State, list[Iterate[P]]]] = field(
        default_factory=list, init=False
    )

    def problem(self, step: int, iterate: int = 0) -> Iterate[P]:
        """Pose a load step (1, 2, …), as last linearised.

        iterate : which problem of the fixed point of Coulomb's law, 1, 2, …; 0: the
            last one
        """
        return select_iterate(self.problems(self.last_of(step)), iterate, step)

    def iterates(self, step: int) -> int:
        """Count the problems of the fixed point of a step; 1 without Coulomb's law."""
        return len(self.problems(self.last_of(step)))

    def last_of(self, step: int) -> int:
        """Return the number of the last stage of a load step, from 0 on."""
        return max(i for i, stage in enumerate(self.stages) if stage.step == step)

    def problems(self, i: int) -> list[Iterate[P]]:
        """Pose stage i (0, 1, …): the problems of its fixed point."""
        while len(self._history) <= i:
            stage = self.stages[len(self._history)]
            state = stage.begin(self._end_state())
            linearised = self.linearise(stage, state)
            self._history.append((state, _fixed_point(linearised, stage)))
        return self._history[i][1]

    def _end_state(self) -> State:
        """Return what the last stage that was linearised leaves to the next one."""
        if not self._history:
            return self.initial
        begun, (*_, last) = self._history[-1]
        u, normal_forces = last.problem.end_state(last.solution())
        return State(u, begun.slip_origin, normal_forces)


def _fixed_point(linearised: P, stage: Stage) -> list[Iterate[P]]:
    """Settle Coulomb's law; without it, the problem is the only one."""
    if not any(law.mu for law in stage.laws):
        first = linearised.friction
        return [Iterate(linearised, first, cache(lambda: linearised.solve(first)))]
    found = list[Solution]()

    def normal(friction: Friction) -> Vector:
        found.append(linearised.solve(friction, found[-1] if found else None))
        return linearised.normal_multipliers(found[-1])

    def known(s: Solution) -> Callable[[], Solution]:
        return lambda: s

    frictions = coulomb_fixed_point(linearised.friction, normal, stage.step)
    return [
        Iterate(linearised, friction, known(s))
        for friction, s in zip(frictions, found, strict=True)
    ]


def forces_of(f: Vector) -> Forces:
    """List the components of a load (n,) that are not zero."""
    component = np.flatnonzero(f)
    return Forces(component, f[component])
