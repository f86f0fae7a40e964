"""Load steps of undivided bodies in contact, with one factor of K per set of supports.

Contact rows are linearised at the displacements of the contact sides. These
displacements are computed from the dual solution of the previous step by a product with
a small matrix. Displacements of all other nodes are recovered on demand, by one solve
with the factor of K per step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache

import numpy as np

from mortarbench.harness import QP, Friction, Reference, Solution, Vector
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems.contact.balance import check_friction
from mortarbench.problems.contact.bodies import (
    Bodies,
    slave_places,
)
from mortarbench.problems.contact.friction import FrictionLaw, friction_of
from mortarbench.problems.contact.rows import ContactRows, without_fixed
from mortarbench.problems.contact.stepping import Iterate, LoadPath, Stage, State
from mortarbench.problems.duality.dualisation import (
    Transformed,
    dual_bounds,
    with_friction_bound,
)
from mortarbench.problems.duality.problem import ContactProblem, Linearise
from mortarbench.problems.fem.inverse import GeneralisedInverse
from mortarbench.problems.fem.mesh import Nodes

Transform = Callable[[QP, GeneralisedInverse, Vector, Friction], Transformed]

#: largest admissible KKT residual of a reference solution; it must be small, because
#: contact in the next step is linearised at this solution
MAX_REFERENCE_RESIDUAL = 1e-6


@dataclass(frozen=True, eq=False)
class MonolithicLinearisation:
    """A linearised contact problem of undivided bodies; see `LinearisedProblem`."""

    bodies: Bodies  #: bodies with the load and the supports of the stage
    primal: QP  #: QP of equation (1) of the paper
    friction: Friction
    rows: ContactRows  #: contact rows of `primal`, m
    #: function that returns the dual with the initial friction bounds, which `solve`
    #: replaces
    dual: Callable[[], Transformed]
    reference: Reference
    part: float  #: load factor

    def solve(self, friction: Friction, start: Solution | None = None) -> Solution:
        """Solve the dual with the bounds of `friction`.

        Raises
        ------
        ArithmeticError
            If the KKT residual of the solution exceeds `MAX_REFERENCE_RESIDUAL`.

        """
        qp = with_friction_bound(self.dual().qp, friction)
        s = self.reference(qp)
        if not (worst := kkt_residuals(qp, s).worst) <= MAX_REFERENCE_RESIDUAL:
            raise ArithmeticError(
                f"the reference solve at load factor {self.part:g} left a residual "
                f"of {worst:.1e}, more than {MAX_REFERENCE_RESIDUAL:g}"
            )
        return s

    def normal_multipliers(self, s: Solution) -> Vector:
        """Return the multipliers λ_n (m,) of the contact rows."""
        m, k = self.primal.h.size, self.friction.bound.size
        return s.x[-m - k :][:m]

    def end_state(self, s: Solution) -> tuple[Vector, Vector]:
        """Return u (n,) and the normal forces (places,) of all slave nodes.

        Only the entries of u on the contact sides are valid.
        """
        # negative multipliers of inexact solutions would be negative friction bounds
        normal = np.maximum(self.normal_multipliers(s), 0.0)
        forces = self.rows.at_places(normal, slave_places(self.bodies.pairs))
        return self.dual().interface_displacement(s), forces


MonolithicPath = LoadPath[MonolithicLinearisation]


def recovered(chosen: Iterate[MonolithicLinearisation]) -> Solution:
    """Return the solution of the primal problem of an iterate."""
    return chosen.problem.dual().recover(chosen.solution())


@lru_cache(maxsize=4)
def monolithic_path(problem: ContactProblem, reference: Reference) -> MonolithicPath:
    """Return the load path of a contact problem on undivided bodies.

    Only the contact rows are dualised. In 3D, the dense matrix of the dual could have
    several times as many rows if the support rows were included.
    """
    bodies = problem.bodies.assembled

    def factorise(fixed: Nodes) -> GeneralisedInverse:
        if fixed is bodies.fixed:
            return bodies.clamped if bodies.is_supported else bodies.supported
        return replace(bodies, fixed=fixed).supported

    return load_path(
        bodies,
        problem.stages,
        lambda laws: problem.linearise(bodies, laws),
        factorise,
        reference,
        dual_bounds,
        problem.initial_force,
    )


def load_path(
    bodies: Bodies,
    stages: Sequence[Stage],
    linearise: Callable[[tuple[FrictionLaw, ...]], Linearise],
    factorise: Callable[[Nodes], GeneralisedInverse],
    reference: Reference,
    transform: Transform = dual_bounds,
    initial_force: float = 0.0,
) -> MonolithicPath:
    """Return the load path of assembled bodies.

    Parameters
    ----------
    linearise : function that maps the friction laws of the pairs to the linearisation
        of contact
    factorise : function that maps the fixed components of a stage to the generalised
        inverse K⁺ that `transform` requires; called once for each set of supports
    initial_force : normal force per slave node at the start of the fixed-point
        iteration for Coulomb's law

    """
    # displacements without contact are stored, because stages may share their load and
    # supports
    bodies_by_stage = dict[tuple[int, int], Bodies]()
    inverses = dict[int, GeneralisedInverse]()
    free = dict[tuple[int, int], Vector]()

    def inverse(stage: Stage) -> GeneralisedInverse:
        if id(stage.fixed) not in inverses:
            inverses[id(stage.fixed)] = factorise(stage.fixed)
        return inverses[id(stage.fixed)]

    def bodies_of(stage: Stage) -> Bodies:
        names = id(stage.load), id(stage.fixed)
        if names not in bodies_by_stage:
            of_stage = replace(bodies, f=stage.load, fixed=stage.fixed)
            bodies_by_stage[names] = of_stage
        return bodies_by_stage[names]

    def pose(stage: Stage, at: State) -> MonolithicLinearisation:
        rows = without_fixed(linearise(stage.laws)(at.u * bodies.length), stage.fixed)
        loaded, load = bodies_of(stage), (id(stage.load), id(stage.fixed))
        primal = primal_qp(loaded, rows, stage.part)
        first = friction_of(loaded, rows, stage.laws, at.slip_origin, at.normal_forces)
        if first.bound.size and not any(law.mu for law in stage.laws):
            check_friction(loaded, rows.B, first, stage.step, stage.part)

        @cache
        def dual() -> Transformed:
            if load not in free:
                lift = np.zeros_like(loaded.f) if loaded.lift is None else loaded.lift
                free[load] = lift + inverse(stage)(loaded.f - loaded.K @ lift)
            return transform(primal, inverse(stage), free[load] * stage.part, first)

        return MonolithicLinearisation(
            loaded, primal, first, rows, dual, reference, stage.part
        )

    zero, places = np.zeros(bodies.mesh.dofs), slave_places(bodies.pairs)
    return LoadPath(stages, pose, State(zero, zero, np.full(places, initial_force)))


def primal_qp(bodies: Bodies, rows: ContactRows, load_factor: float = 1.0) -> QP:
    """Return the nondimensional primal QP, equation (1) of the paper.

    The QP minimises ½uᵀKu − fᵀu subject to B_D u = B_D w and B_M u ≤ c_M, where f and w
    are the load and the prescribed displacements of `bodies` times `load_factor`.
    """
    m = bodies.B_D.shape[0]
    return QP(
        P=bodies.K,
        q=-load_factor * bodies.f,
        A=bodies.B_D,
        b=np.zeros(m)
        if bodies.lift is None
        else bodies.B_D @ bodies.lift * load_factor,
        G=rows.B,
        h=rows.c / bodies.length,
    )
