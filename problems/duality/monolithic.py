"""Undivided bodies in contact: the QP of a load step, with one factor of K for all.

Contact rows are linearised at displacements of the contact sides: those of a step are
had from its dual solution by one small product, and only displacements that are asked
for are recovered everywhere, by one solve with the factor of K each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache

import numpy as np

from mortarbench.harness import QP, Friction, Reference, Solution, Vector, kkt_residuals
from mortarbench.problems.contact.balance import check_friction
from mortarbench.problems.contact.bodies import Bodies, factorise_floating, support_rows
from mortarbench.problems.contact.friction import (
    FrictionLaw,
    forces_at_nodes,
    friction_of,
)
from mortarbench.problems.contact.node_to_segment import ContactRows
from mortarbench.problems.contact.stepping import (
    LoadPath,
    Stage,
    State,
    forces_of,
    load_steps,
)
from mortarbench.problems.duality.dualisation import (
    Transformed,
    dual_bounds,
    dualise,
    with_friction_bound,
)
from mortarbench.problems.duality.problem import ContactProblem, Linearise
from mortarbench.problems.fem.inverse import GeneralisedInverse
from mortarbench.problems.fem.mesh import Nodes

Transform = Callable[[QP, GeneralisedInverse, Vector, Friction], Transformed]

#: residual that a reference solve may leave: the next step is linearised there
MAX_REFERENCE_RESIDUAL = 1e-6


@dataclass(frozen=True, eq=False)
class MonolithicLinearisation:
    """A linearised contact problem of undivided bodies; see `LinearisedProblem`."""

    bodies: Bodies  #: with the load and the supports of its stage
    primal: QP  #: (1) of the paper
    friction: Friction
    place: Nodes  #: (m,) slave node of each contact row, see `ContactRows`
    dual: Callable[[], Transformed]  #: of these rows, whatever the bounds of friction
    reference: Reference
    part: float  #: of the load

    def solve(self, friction: Friction, start: Solution | None = None) -> Solution:
        """Solve the dual with the bound of a friction."""
        qp = with_friction_bound(self.dual().qp, friction)
        s = self.reference(qp)
        if not (worst := kkt_residuals(qp, s).worst) <= MAX_REFERENCE_RESIDUAL:
            raise ArithmeticError(
                f"the reference solve at load factor {self.part:g} left a residual "
                f"of {worst:.1e}, more than {MAX_REFERENCE_RESIDUAL:g}"
            )
        return s

    def normal_multipliers(self, s: Solution) -> Vector:
        """Return the multipliers λ_n (m,) of the contact rows; friction's follow."""
        m, k = self.place.size, self.friction.bound.size
        return s.x[-m - k :][:m]

    def end_state(self, s: Solution) -> tuple[Vector, Vector]:
        """Return u (n,), right on the contact sides, and the normal forces."""
        places = sum(pair.slave.size for pair in self.bodies.pairs)
        forces = forces_at_nodes(self.normal_multipliers(s), self.place, places)
        return self.dual().interface_displacement(s), forces


@dataclass(frozen=True, eq=False)
class MonolithicPath(LoadPath[MonolithicLinearisation]):
    """The load steps of undivided bodies."""

    _answers: dict[int, Solution] = field(default_factory=dict, init=False)

    def primal(self, k: int) -> QP:
        """Emit the QP of step k (1, 2, …), as last linearised, without friction."""
        return self.problem(k).problem.primal

    def answer(self, k: int) -> Solution:
        """Return the solution of the primal problem of step k (1, 2, …)."""
        if k not in self._answers:
            last = self.problem(k)
            self._answers[k] = last.problem.dual().recover(last.solution())
        return self._answers[k]

    def solution(self, k: int) -> Vector:
        """Return the non-dimensional displacement (n,) after step k; zero for k = 0."""
        return self.answer(k).x if k else self.initial.u


def load_path(
    bodies: Bodies,
    linearise: Linearise,
    factorise: Callable[[], GeneralisedInverse],
    reference: Reference,
    steps: int,
    relin: int = 1,
    *,
    transform: Transform = dual_bounds,
    laws: tuple[FrictionLaw, ...] = (),
    quasi_static: bool = True,
    pressed: float = 0.0,
) -> MonolithicPath:
    """Prepare the load steps of assembled bodies, linearised by the laws' own rows.

    Parameters
    ----------
    factorise : K⁺ that `transform` needs, when the first problem is to be solved
    laws : of each pair; none for no friction at all
    pressed : normal force of each slave node that Coulomb's law begins from

    """
    stages = load_steps(
        steps, relin, forces_of(bodies.f), bodies.B_D.indices, laws,
        quasi_static=quasi_static,
    )  # fmt: skip
    return _path(
        bodies, stages, lambda _: linearise, factorise, reference, transform, pressed
    )


@lru_cache(maxsize=4)
def monolithic_path(problem: ContactProblem, reference: Reference) -> MonolithicPath:
    """Prepare the load steps of a contact problem on undivided bodies.

    Where supports hold all bodies, contact rows alone are dualised.
    """
    of, stages = problem.bodies, problem.stages
    held = np.unique(np.concatenate([stage.fixed for stage in stages]))
    bodies = of.assembled

    def factor() -> GeneralisedInverse:
        if held.size == of.fixed.size:
            return of.floating
        return factorise_floating(replace(bodies, B_D=support_rows(bodies.mesh, held)))

    is_supported = of.is_supported and all(stage.fixed is of.fixed for stage in stages)
    return _path(
        bodies, stages, lambda laws: problem.linearise(bodies, laws),
        (lambda: of.clamped) if is_supported else factor, reference,
        dual_bounds if is_supported else dualise, problem.pressed,
    )  # fmt: skip


def _path(
    bodies: Bodies,
    stages: Sequence[Stage],
    linearise: Callable[[tuple[FrictionLaw, ...]], Linearise],
    factorise: Callable[[], GeneralisedInverse],
    reference: Reference,
    transform: Transform,
    pressed: float,
) -> MonolithicPath:
    inverse = cache(factorise)
    # loads and supports may act in several stages; K⁺f is that of a whole load
    known, free = dict[tuple[int, int], Bodies](), dict[int, Vector]()

    def under(stage: Stage) -> Bodies:
        names = id(stage.forces), id(stage.fixed)
        if names not in known:
            f = np.zeros(bodies.mesh.dofs)
            f[stage.forces.component] = stage.forces.value
            held = support_rows(bodies.mesh, stage.fixed)
            known[names] = replace(bodies, f=f, B_D=held)
        return known[names]

    def pose(stage: Stage, at: State) -> MonolithicLinearisation:
        rows = linearise(stage.laws)(at.u * bodies.length)
        own, load = under(stage), id(stage.forces)
        primal = primal_qp(own, rows, stage.part)
        first = friction_of(own, rows, stage.laws, at.slip_origin, at.normal_forces)
        if first.bound.size and not any(law.mu for law in stage.laws):
            check_friction(own, rows.B, first, stage.step, stage.part)

        @cache
        def dual() -> Transformed:
            if load not in free:
                free[load] = inverse()(own.f)
            return transform(primal, inverse(), free[load] * stage.part, first)

        return MonolithicLinearisation(
            own, primal, first, rows.place, dual, reference, stage.part
        )

    places = sum(pair.slave.size for pair in bodies.pairs)
    nothing = np.zeros(bodies.mesh.dofs)
    return MonolithicPath(
        stages, pose, State(nothing, nothing, np.full(places, pressed))
    )


def primal_qp(bodies: Bodies, rows: ContactRows, load_factor: float = 1.0) -> QP:
    """Emit  min ½uᵀKu − fᵀu,  B_D u = 0,  B_M u ≤ c_M  without dimensions; (1)."""
    n = bodies.mesh.dofs
    return QP(
        P=bodies.K, q=-load_factor * bodies.f,
        A=bodies.B_D, b=np.zeros(bodies.B_D.shape[0]),
        G=rows.B, h=rows.c / bodies.length,
        lb=np.full(n, -np.inf), ub=np.full(n, np.inf),
    )  # fmt: skip
