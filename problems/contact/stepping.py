"""Load steps with re-linearised contact (paper, Section 2) and Coulomb's law.

A load step starts from the solution of its predecessor. Contact is linearised at that
solution, and `relin` − 1 more times at the solution of the preceding linearisation;
each linearisation is a `Stage`. The QP of a stage is that of undivided bodies on one
process (`problems.duality.monolithic`), or of subdomains, on one process or several
(`problems.duality.decomposed`). The paper uses `relin` = 1, a scheme of first order in
1/steps.

With friction, slip is measured from the solution of the preceding load step
(``quasi-static``: T(u − u_prev), which depends on the path) or from the undeformed
state (``static``: T u). Each stage solves Coulomb's law by the fixed-point iteration
g ← mu·λ_n, starting from the normal forces of the preceding stage.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from mortarbench.harness import Friction, InputError, Solution, Vector
from mortarbench.problems.contact.friction import (
    FrictionLaw,
    coulomb_fixed_point,
)
from mortarbench.problems.fem.mesh import Nodes


class State(NamedTuple):
    """Initial state of a stage, with w displacement components."""

    u: Vector  #: (w,) displacement at which contact is linearised
    slip_origin: Vector  #: (w,) displacement from which slip is measured
    #: (places,) normal force of each slave node, for the first bound of Coulomb's law
    normal_forces: Vector


def continue_slip(end: State) -> State:
    """Return the final state of the preceding stage, with unchanged slip origin."""
    return end


def restart_slip(end: State) -> State:
    """Return the final state of the preceding stage, with its u as slip origin."""
    return end._replace(slip_origin=end.u)


def with_normal_forces(
    begin: Callable[[State], State], force: float
) -> Callable[[State], State]:
    """Return `begin` with the normal force of every slave node replaced by `force`.

    The normal forces of the preceding stage limit friction to the forces required by
    the preceding load. If a body is supported by friction alone, this bound cannot
    balance a larger load, and the first problem of the fixed-point iteration for
    Coulomb's law would have no solution.
    """

    def begin_with(end: State) -> State:
        state = begin(end)
        return state._replace(normal_forces=np.full_like(state.normal_forces, force))

    return begin_with


@dataclass(frozen=True, eq=False, kw_only=True)
class Stage:
    """One linearisation of a load step."""

    step: int  #: number of the load step, 1, 2, …
    part: float  #: load factor: the fraction of `load` that acts
    load: Vector  #: (n,) full load, nondimensional
    fixed: Nodes  #: components fixed by supports
    laws: tuple[FrictionLaw, ...] = ()  #: law of each pair; empty without friction
    #: map from the final state of the preceding stage to the initial state of this one
    begin: Callable[[State], State] = continue_slip


def load_steps(
    steps: int,
    relin: int,
    load: Vector,
    fixed: Nodes,
    laws: tuple[FrictionLaw, ...] = (),
    *,
    quasi_static: bool = True,
) -> tuple[Stage, ...]:
    """Return the stages of a load that grows in equal steps, `relin` stages per step.

    quasi_static : True to measure slip from the end of the preceding load step, False
        to measure slip from the undeformed state
    """
    return tuple(
        Stage(
            step=k,
            part=k / steps,
            load=load,
            fixed=fixed,
            laws=laws,
            # relinearisations of a step keep its slip origin
            begin=restart_slip if quasi_static and not i else continue_slip,
        )
        for k in range(1, steps + 1)
        for i in range(relin)
    )


def normal_first(
    normal: Vector,
    both: Vector,
    fixed: Nodes,
    symmetric: Nodes,
    law: FrictionLaw,
    begin: Callable[[State], State] = restart_slip,
) -> tuple[Stage, Stage]:
    """Return the stages of a tangential force that acts after the normal force.

    The first stage has no friction, and further supports, without which the bodies
    could slide or roll.

    Parameters
    ----------
    normal, both : (n,) loads of the two stages, nondimensional
    symmetric : components that are fixed in the first stage only, without reactions
    law : friction law of the single pair in the second stage
    begin : initial state of the second stage; by default, slip is measured from the end
        of the first stage

    """
    return (
        Stage(step=1, part=1.0, load=normal, fixed=np.append(fixed, symmetric)),
        Stage(step=1, part=1.0, load=both, fixed=fixed, laws=(law,), begin=begin),
    )


class LinearisedProblem(Protocol):
    """A linearised contact problem; its dual can be solved for any friction bounds."""

    @property
    def friction(self) -> Friction:
        """Discrete friction with the initial bound."""

    def solve(self, friction: Friction, start: Solution | None = None) -> Solution:
        """Solve the dual with the bound of `friction`.

        start : solution for another bound, which may serve as initial guess
        """

    def normal_multipliers(self, s: Solution) -> Vector:
        """Return the multipliers λ_n (m,) of the contact rows."""

    def end_state(self, s: Solution) -> tuple[Vector, Vector]:
        """Return u (w,) and the normal forces (places,) of all slave nodes."""


P = TypeVar("P", bound=LinearisedProblem)


class Iterate(NamedTuple, Generic[P]):
    """Fixed-point iterate of a stage: linearised problem and friction bound."""

    problem: P
    friction: Friction  #: friction with the bound of this iterate
    #: function that returns the dual solution, which is computed only once
    solution: Callable[[], Solution]


@dataclass(frozen=True, eq=False)
class LoadPath(Generic[P]):
    """Load path: the stages of one analysis, each solved once and on demand.

    Raises
    ------
    ArithmeticError
        If a reference solution without friction is not accurate enough.
    InputError
        If the fixed-point iteration for Coulomb's law does not converge, or no
        equilibrium was found for a friction bound.

    """

    stages: Sequence[Stage]
    linearise: Callable[[Stage, State], P]
    initial: State  #: initial state of the first stage
    _history: list[tuple[State, list[Iterate[P]]]] = field(
        default_factory=list, init=False
    )

    def problem(self, step: int) -> Iterate[P]:
        """Return the last iterate at the end of a load step (1, 2, …)."""
        return self.problems(self.last_of(step))[-1]

    def iterates(self, step: int) -> int:
        """Return the number of iterates of a load step; 1 without Coulomb's law."""
        return len(self.problems(self.last_of(step)))

    def before(self, step: int, chosen: Iterate[P]) -> int:
        """Return the number of problems that precede an iterate of a load step."""
        last = self.last_of(step)
        index = self.problems(last).index(chosen)
        return sum(len(self.problems(i)) for i in range(last)) + index

    def last_of(self, step: int) -> int:
        """Return the index (0, 1, …) of the last stage of a load step."""
        return max(i for i, stage in enumerate(self.stages) if stage.step == step)

    def problems(self, i: int) -> list[Iterate[P]]:
        """Return the iterates of stage i (0, 1, …), after solving preceding stages."""
        while len(self._history) <= i:
            stage = self.stages[len(self._history)]
            state = stage.begin(self._end_state())
            linearised = self.linearise(stage, state)
            self._history.append((state, _fixed_point(linearised, stage)))
        return self._history[i][1]

    def _end_state(self) -> State:
        """Return the state at the end of the last stage solved so far."""
        if not self._history:
            return self.initial
        begin, (*_, last) = self._history[-1]
        u, normal_forces = last.problem.end_state(last.solution())
        return State(u, begin.slip_origin, normal_forces)


def _fixed_point(linearised: P, stage: Stage) -> list[Iterate[P]]:
    """Return the iterates for Coulomb's law, or the single iterate of other laws."""

    def solve(friction: Friction, start: Solution | None = None) -> Solution:
        try:
            return linearised.solve(friction, start)
        except ArithmeticError as e:
            if not friction.bound.size:
                raise
            raise InputError(
                f"load step {stage.step}: no equilibrium was found ({e}): friction "
                "cannot hold the load; expected additional supports, or a larger bound "
                "or mu"
            ) from None

    if not any(law.mu for law in stage.laws):
        first = linearised.friction
        return [Iterate(linearised, first, cache(lambda: solve(first)))]
    solutions = list[Solution]()

    def normal(friction: Friction) -> Vector:
        # bounds change little between iterates, so start from the last solution
        start = solutions[-1] if solutions else None
        solutions.append(solve(friction, start))
        return linearised.normal_multipliers(solutions[-1])

    def constant(s: Solution) -> Callable[[], Solution]:
        return lambda: s

    frictions = coulomb_fixed_point(linearised.friction, normal, stage.step)
    return [
        Iterate(linearised, friction, constant(s))
        for friction, s in zip(frictions, solutions, strict=True)
    ]
