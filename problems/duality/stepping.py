"""Load steps with re-linearised contact (the paper's pseudo-time steps, Section 2).

Step k carries the load (k/steps)·f. Its contact rows are linearised at the solution of
step k − 1, and `relin` − 1 more times at its own solution; the emitted QP is the last.
With relin = 1 this is the paper's scheme, of first order in 1/steps.

Contact rows are linearised at displacements of the contact sides: those of a step are
had from its dual solution by one small product, and only displacements that are asked
for are recovered everywhere, by one solve with the factor of K each.

With friction, slip is that of the load step (``quasi-static``: T(u − u_prev), which
depends on the path), or of the whole load at once (``static``: T u). Coulomb's law is
the fixed point of problems with a given bound, g ← mu·λ_n from the solution of the one
before on; each linearisation is settled, and the emitted QP is the last of its last. It
begins from the normal forces of the step before, in the first one without friction.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np

from mortarbench.harness import QP, Friction, Reference, Solution, Vector, kkt_residuals
from mortarbench.problems.contact.balance import check_friction
from mortarbench.problems.contact.bodies import Bodies
from mortarbench.problems.contact.friction import (
    FrictionLaw,
    forces_at_nodes,
    friction_of,
    iterate_of,
    settled,
)
from mortarbench.problems.contact.node_to_segment import ContactRows
from mortarbench.problems.duality.dualisation import (
    Transformed,
    bounded,
    dual_bounds,
    dualise,
)
from mortarbench.problems.fem.inverse import GeneralisedInverse
from mortarbench.problems.fem.mesh import Nodes

Linearise = Callable[[Vector], ContactRows]  #: displacement (n,) in m → rows
Transform = Callable[[QP, GeneralisedInverse, Vector, Friction], Transformed]


#: residual that a reference solve may leave: the next step is linearised there
REFERENCE = 1e-6


@dataclass(frozen=True, eq=False)
class ContactProblem:
    """A linearised contact problem, with its solution once that is asked for."""

    primal: QP  #: (1) of the paper
    friction: Friction
    place: Nodes  #: (m,) slave node of each contact row, see `ContactRows`
    dual: Callable[[], Transformed]  #: of these rows, whatever the bounds of friction
    solution: Callable[[], Solution]  #: of the dual with the bounds of this friction

    @cached_property
    def on_sides(self) -> Vector:
        """Displacement u (n,), right on the contact sides."""
        return self.dual().touched(self.solution())

    @cached_property
    def answer(self) -> Solution:
        """Solution of the primal problem."""
        return self.dual().recover(self.solution())

    @property
    def normal(self) -> Vector:
        """Multipliers λ_n (m,) of the contact rows; those of friction follow them."""
        m, k = self.place.size, self.friction.bound.size
        return self.solution().x[-m - k :][:m]


class State(NamedTuple):
    """Where a load step begins."""

    u: Vector  #: (n,) displacement, right on the contact sides
    pressed: Vector  #: (places,) normal force of each slave node


@dataclass(frozen=True, eq=False)
class LoadPath:
    """The load steps of one analysis; what was solved once is remembered.

    Raises
    ------
    ArithmeticError
        When a reference solve is not accurate.
    InputError
        When a fixed point of Coulomb's law does not settle, has less iterates, or comes
        to bounds that hold no equilibrium.

    """

    bodies: Bodies
    linearise: Linearise
    #: K⁺ that `transform` needs; called when the first problem is to be solved
    factorise: Callable[[], GeneralisedInverse]
    reference: Reference
    steps: int
    relin: int = 1
    transform: Transform = dual_bounds
    laws: tuple[FrictionLaw, ...] = ()  #: of each pair; none for no friction at all
    quasi_static: bool = True  #: whether slip is that of the step
    #: normal force of each slave node that the very first bound of Coulomb's law is of
    pressed: float = 0.0
    begin: State | None = None  #: where the first step begins; none: at rest
    #: 1, 2, …
    _steps: list[list[ContactProblem]] = field(default_factory=list, init=False)

    @cached_property
    def inverse(self) -> GeneralisedInverse:
        """K⁺, factorised at the first use."""
        return self.factorise()

    def primal(self, k: int) -> QP:
        """Emit the QP of step k (1 … steps), as last linearised, without friction."""
        return self.problem(k).primal

    def problem(self, k: int, iterate: int = 0) -> ContactProblem:
        """Pose step k (1 … steps), as last linearised.

        iterate : which problem of the fixed point of Coulomb's law, 1, 2, …; 0: the
            last one
        """
        while len(self._steps) < k:
            self._steps.append(self._posed(len(self._steps) + 1))
        return iterate_of(self._steps[k - 1], iterate, k)

    def iterates(self, k: int) -> int:
        """Count the problems of the fixed point of step k; 1 without Coulomb's law."""
        self.problem(k)
        return len(self._steps[k - 1])

    def state(self, k: int) -> State:
        """Return what step k leaves to the next one; for k = 0 what it begins from."""
        if k:
            last = self.problem(k)
            return State(last.on_sides, self._pressed(last))
        if self.begin is not None:
            return self.begin
        rest = np.zeros(self.bodies.mesh.dofs)
        return State(rest, np.full(self._places, self.pressed))

    def answer(self, k: int) -> Solution:
        """Return the solution of the primal problem of step k (1 … steps)."""
        return self.problem(k).answer

    def solution(self, k: int) -> Vector:
        """Return the non-dimensional displacement (n,) after step k; zero for k = 0."""
        return self.answer(k).x if k else np.zeros(self.bodies.mesh.dofs)

    def _posed(self, k: int) -> list[ContactProblem]:
        """Pose step k from the one before: the problems of its last fixed point."""
        u, pressed = self.state(k - 1)
        before = u if self.quasi_static else np.zeros_like(u)
        for _ in range(self.relin - 1):
            *_, last = self._fixed_point(u, k, before, pressed)
            u, pressed = last.on_sides, self._pressed(last)
        return self._fixed_point(u, k, before, pressed)

    def _fixed_point(
        self, u: Vector, k: int, before: Vector, pressed: Vector
    ) -> list[ContactProblem]:
        """Pose the problem linearised at u; by Coulomb's law, until its bound settles.

        before : (n,) displacement where the slip begins
        pressed : (places,) normal forces that the first bound is of
        """
        rows = self.linearise(u * self.bodies.length)
        primal = primal_qp(self.bodies, rows, k / self.steps)
        coulomb = any(law.mu for law in self.laws)
        first = friction_of(self.bodies, rows, self.laws, before, pressed)

        @cache
        def dual() -> Transformed:
            free = self._free * (k / self.steps)
            return self.transform(primal, self.inverse, free, first)

        def posed(friction: Friction) -> ContactProblem:
            @cache
            def solution() -> Solution:
                return self._solve(bounded(dual().qp, friction), k / self.steps)

            return ContactProblem(primal, friction, rows.place, dual, solution)

        if not coulomb:
            return [posed(first)]
        found = list[ContactProblem]()

        def normal(friction: Friction) -> Vector:
            found.append(posed(friction))
            return found[-1].normal

        frictions = settled(first, normal, k)
        return [
            replace(problem, friction=friction)
            for problem, friction in zip(found, frictions, strict=True)
        ]

    @property
    def _places(self) -> int:
        return sum(pair.slave.size for pair in self.bodies.pairs)

    def _pressed(self, problem: ContactProblem) -> Vector:
        """Return the normal force (places,) of each slave node; zero without a row."""
        return forces_at_nodes(problem.normal, problem.place, self._places)

    def _solve(self, dual: QP, load_factor: float) -> Solution:
        s = self.reference(dual)
        if not (worst := kkt_residuals(dual, s).worst) <= REFERENCE:
            raise ArithmeticError(
                f"the reference solve at load factor {load_factor:g} left a residual "
                f"of {worst:.1e}, more than {REFERENCE:g}"
            )
        return s

    @cached_property
    def _free(self) -> Vector:
        """K⁺f: the full load without contact."""
        return self.inverse(self.bodies.f)


def single_load(
    bodies: Bodies,
    linearise: Linearise,
    laws: tuple[FrictionLaw, ...],
    *,
    factorise: Callable[[], GeneralisedInverse],
    reference: Reference,
    steps: int = 1,
    iterate: int = 0,
) -> tuple[QP, Friction]:
    """Pose the first load step of bodies that contact alone may hold.

    As friction may have to hold them, Coulomb's fixed point begins at bounds that let
    it: each node is taken to be pressed by the whole load.

    factorise : K with its rigid modes; called where Coulomb's law needs solutions
    steps, iterate : as of `LoadPath`

    Raises
    ------
    InputError
        When friction cannot hold the load.

    """
    if any(law.mu for law in laws):
        path = LoadPath(
            bodies, linearise, factorise, reference, steps,
            transform=dualise, laws=laws, pressed=float(np.abs(bodies.f).sum()),
        )  # fmt: skip
        problem = path.problem(1, iterate)
        return problem.primal, problem.friction
    at_rest = np.zeros(bodies.mesh.dofs)
    rows = linearise(at_rest)
    pressed = np.zeros(sum(pair.slave.size for pair in bodies.pairs))
    friction = friction_of(bodies, rows, laws, at_rest, pressed)
    check_friction(bodies, rows.B, friction, 1, 1 / steps)
    return primal_qp(bodies, rows, 1 / steps), friction


def primal_qp(bodies: Bodies, rows: ContactRows, load_factor: float = 1.0) -> QP:
    """Emit  min ½uᵀKu − fᵀu,  B_D u = 0,  B_M u ≤ c_M  without dimensions; (1)."""
    n = bodies.mesh.dofs
    return QP(
        P=bodies.K, q=-load_factor * bodies.f,
        A=bodies.B_D, b=np.zeros(bodies.B_D.shape[0]),
        G=rows.B, h=rows.c / bodies.length,
        lb=np.full(n, -np.inf), ub=np.full(n, np.inf),
    )  # fmt: skip
