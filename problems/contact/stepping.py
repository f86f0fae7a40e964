"""Load steps with re-linearised contact, and Coulomb's law in each (paper, Section 2).

A load step begins where the one before has ended. Its contact rows are linearised at
that solution, and `relin` − 1 more times at its own; each linearisation is a `Stage`,
and its QP is posed by whoever holds the bodies: one process undivided ones
(`problems.duality.monolithic`), ranks their subdomains (`problems.duality.decomposed`).
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
from mortarbench.problems.contact.friction import FrictionLaw, iterate_of, settled
from mortarbench.problems.fem.mesh import Nodes


class Forces(NamedTuple):
    """Forces at single components, without dimensions; zero at all others."""

    component: Nodes  #: (k,) each once
    value: Vector  #: (k,)


class State(NamedTuple):
    """The state that a stage begins at, by displacements as its problem takes them."""

    u: Vector  #: (w,) where contact is linearised
    before: Vector  #: (w,) where the slip begins
    #: (places,) normal force of each slave node, which Coulomb's law begins from
    pressed: Vector


def same(left: State) -> State:
    """Begin where the stage before has ended, the slip where that began."""
    return left


def slip_anew(left: State) -> State:
    """Begin where the stage before has ended, the slip there, too."""
    return left._replace(before=left.u)


def with_normal_forces(
    begin: Callable[[State], State], force: float
) -> Callable[[State], State]:
    """Start Coulomb's law of each stage from the same normal force at every slave node.

    The normal forces of the previous stage bound friction by what the previous load
    needed. Where friction alone supports a body, that bound cannot balance a larger
    load, and the first problem of the fixed point would have no solution.
    """

    def begin_with(left: State) -> State:
        state = begin(left)
        return state._replace(pressed=np.full_like(state.pressed, force))

    return begin_with


@dataclass(frozen=True, eq=False, kw_only=True)
class Stage:
    """One linearisation of a load step."""

    step: int  #: of the load, 1, 2, …
    part: float  #: of the forces that acts
    forces: Forces
    fixed: Nodes  #: components that supports hold at zero
    laws: tuple[FrictionLaw, ...] = ()  #: of each pair; none for no friction at all
    begin: Callable[[State], State] = same  #: where, of what the stage before left


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
            begin=slip_anew if quasi_static and not i else same,
        )
        for k in range(1, steps + 1) for i in range(relin)
    )  # fmt: skip


class Posed(Protocol):
    """A linearised contact problem, and its dual with any bound of the friction."""

    @property
    def friction(self) -> Friction:
        """That of its rows, with the first bound."""

    def solve(self, friction: Friction, start: Solution | None = None) -> Solution:
        """Solve the dual with the bound of a friction.

        start : solution with another bound
        """

    def normal(self, s: Solution) -> Vector:
        """Return the multipliers λ_n (m,) of the contact rows."""

    def left(self, s: Solution) -> tuple[Vector, Vector]:
        """Return u (w,) and the normal forces (places,) that a solution has."""


P = TypeVar("P", bound=Posed)


class Problem(NamedTuple, Generic[P]):
    """A problem of a stage, with the bound of its friction."""

    posed: P
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
    pose: Callable[[Stage, State], P]
    rest: State  #: where the first stage begins
    _done: list[tuple[State, list[Problem[P]]]] = field(
        default_factory=list, init=False
    )

    def problem(self, step: int, iterate: int = 0) -> Problem[P]:
        """Pose a load step (1, 2, …), as last linearised.

        iterate : which problem of the fixed point of Coulomb's law, 1, 2, …; 0: the
            last one
        """
        return iterate_of(self.problems(self.last_of(step)), iterate, step)

    def iterates(self, step: int) -> int:
        """Count the problems of the fixed point of a step; 1 without Coulomb's law."""
        return len(self.problems(self.last_of(step)))

    def last_of(self, step: int) -> int:
        """Return the number of the last stage of a load step, from 0 on."""
        return max(i for i, stage in enumerate(self.stages) if stage.step == step)

    def problems(self, i: int) -> list[Problem[P]]:
        """Pose stage i (0, 1, …): the problems of its fixed point."""
        while len(self._done) <= i:
            stage = self.stages[len(self._done)]
            state = stage.begin(self._left())
            posed = self.pose(stage, state)
            self._done.append((state, _fixed_point(posed, stage)))
        return self._done[i][1]

    def _left(self) -> State:
        """Return what the last stage that was posed leaves to the next one."""
        if not self._done:
            return self.rest
        begun, (*_, last) = self._done[-1]
        u, pressed = last.posed.left(last.solution())
        return State(u, begun.before, pressed)


def _fixed_point(posed: P, stage: Stage) -> list[Problem[P]]:
    """Settle Coulomb's law; without it, the problem is the only one."""
    if not any(law.mu for law in stage.laws):
        first = posed.friction
        return [Problem(posed, first, cache(lambda: posed.solve(first)))]
    found = list[Solution]()

    def normal(friction: Friction) -> Vector:
        found.append(posed.solve(friction, found[-1] if found else None))
        return posed.normal(found[-1])

    def known(s: Solution) -> Callable[[], Solution]:
        return lambda: s

    frictions = settled(posed.friction, normal, stage.step)
    return [
        Problem(posed, friction, known(s))
        for friction, s in zip(frictions, found, strict=True)
    ]


def forces_of(f: Vector) -> Forces:
    """List the components of a load (n,) that are not zero."""
    component = np.flatnonzero(f)
    return Forces(component, f[component])
