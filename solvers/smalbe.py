"""SMALBE: semimonotonic augmented Lagrangians for bounds and equalities.

Minimises ½xᵀFx − dᵀx subject to Gx = e and l ≤ x ≤ u (Dostál 2009, the paper's
reference [3], Chapter 6; equation (2) of the paper).

1. C: orthonormal rows that span those of G; e is transformed with them.
2. Homogenise: x = x̃ + ν with x̃ = Cᵀe, so that Cν = 0 and l − x̃ ≤ ν ≤ u − x̃.
3. Project with Q = CᵀC, 𝒫 = I − Q, and normalise by ‖𝒫F𝒫‖ (Lanczos):
   H = 𝒫F𝒫/‖𝒫F𝒫‖ + ρQ,   b = 𝒫(d − Fx̃)/‖𝒫F𝒫‖.

Then, for k = 0, 1, …:

4. MPRGP on ½νᵀHν − (b − Cᵀμ)ᵀν until ‖g^P‖ < min(M‖Cν‖, η‖b‖).
5. μ ← μ + ρCν; the gradient grows by ρQν, no product is needed.
6. If the Lagrangian L(ν, μ) = ½νᵀHν − bᵀν + μᵀCν grew by less than ρ/2·‖Cν‖²: M ← βM.

until ‖g^P‖ ≤ tol‖b‖ and ‖Cν‖ ≤ tol‖x̃‖. Without equalities one run of MPRGP is left.

Two safeguards: where two outer iterations in a row did not halve ‖Cν‖, ρ ← 10ρ; and if
then no feasible step lessens ½‖Cν‖² although Cν ≠ 0, no feasible point exists.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from harness import QP, Solution, Status, Vector, kkt_residuals
from solvers.conversion import positive
from solvers.mprgp import Minimum, mprgp, split
from solvers.projected import Projected, projected_problem

STEPS = {"c": "cg", "e": "expansion", "f": "fallback", "p": "proportioning"}
CLAIM = 5.0  #: claimed solved: the KKT residuals are within this times the tolerance


@dataclass(frozen=True)
class SMALBE:
    """In-house SMALBE with MPRGP for bounds and equalities; needs only products with P.

    `tol` bounds ‖g^P‖/‖b‖ and ‖Gx − e‖/‖x̃‖ of the projected problem. A point is claimed
    solved only if its KKT residuals on the original problem are within 5·tol as well.
    """

    rho: float = 3.0  #: penalty ρ, relative to ‖𝒫F𝒫‖
    M: float = 1.0  #: precision of the inner runs at the start, relative to ‖𝒫F𝒫‖
    beta: float = 0.5  #: factor of M where the Lagrangian grew too little
    eta: float = 0.1  #: largest ‖g^P‖/‖b‖ at which an inner run may end
    Gamma: float = 1.0  #: proportioning constant Γ of MPRGP
    lanczos_steps: int = 10  #: products spent on ‖𝒫F𝒫‖
    max_steps: int = 20_000  #: of MPRGP and outer iterations, in total

    def __post_init__(self) -> None:
        positive(
            rho=self.rho, M=self.M, eta=self.eta, Gamma=self.Gamma,
            lanczos_steps=self.lanczos_steps, max_steps=self.max_steps,
        )  # fmt: skip
        if not 0 < self.beta < 1:
            raise ValueError(f"beta = {self.beta}; expected a number between 0 and 1")

    def declines(self, qp: QP) -> str | None:
        if qp.h.size:
            return "takes bounds and equality rows; dualise inequality rows first"
        return None

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        problem = projected_problem(qp, self.lanczos_steps)
        if not problem.rows.consistent:
            message = "the equality rows contradict each other"
            return lambda: Solution.without_point(qp, Status.INFEASIBLE, message)
        return lambda: _certified(qp, problem, self, tol)


class Outer(NamedTuple):
    """One outer iteration, as it ended."""

    trace: str  #: the steps of its inner run
    M: float  #: with which that ran
    infeasibility: float  #: ‖Cν‖
    lagrangian: float  #: L(ν, μ) after the update of μ


class Iterate(NamedTuple):
    """The state of the outer loop."""

    nu: Vector  #: (n,)
    g: Vector  #: Hν − b + Cᵀμ
    mu: Vector  #: (r,) multipliers of Cν = 0, relative to ‖𝒫F𝒫‖
    M: float
    rho: float
    outer: tuple[Outer, ...] = ()
    status: Status = Status.ITERATION_LIMIT

    @property
    def steps(self) -> str:
        """All inner steps so far, one letter each."""
        return "".join(o.trace for o in self.outer)

    @property
    def stalled(self) -> bool:
        """Whether neither of the last two outer iterations halved ‖Cν‖."""
        errors = [o.infeasibility for o in self.outer[-3:]]
        return len(errors) == 3 and errors[2] > errors[1] / 2 > errors[0] / 4


def first_iterate(problem: Projected, options: SMALBE) -> Iterate:
    """Start from x = 0, moved into the bounds; one product."""
    nu = np.clip(-problem.rows.x_tilde, *problem.bounds)
    g = problem.H(nu, options.rho) - problem.b
    return Iterate(nu, g, np.zeros(len(problem.rows.C)), options.M, options.rho)


def smalbe(problem: Projected, options: SMALBE, tol: float, at: Iterate) -> Iterate:
    """Run the outer loop, steps 4 to 6, on from `at`."""
    C, b = problem.rows.C, problem.b
    b_size, x_size = _norm(b) or _norm(at.g), _norm(problem.rows.x_tilde)
    left = options.max_steps - len(at.steps) - len(at.outer)
    lagrangian = -np.inf

    def small(nu: Vector, projected: float) -> bool:
        feasible = _norm(C @ nu) <= tol * (x_size or _norm(nu))
        return projected <= tol * b_size and feasible

    def precise(nu: Vector, projected: float) -> bool:
        inner = projected < min(at.M * _norm(C @ nu), options.eta * b_size)
        return inner or small(nu, projected)

    while True:
        run = mprgp(
            partial(problem.H, rho=at.rho), b - C.T @ at.mu, problem.bounds,
            (at.nu, at.g), alpha=problem.step(at.rho), stop=precise,
            Gamma=options.Gamma, max_steps=max(left, 0),
        )  # fmt: skip
        left -= len(run.trace) + 1
        at = _updated(problem, options, at, run, lagrangian)
        lagrangian = at.outer[-1].lagrangian
        if small(at.nu, run.projected_norm):
            return at._replace(status=Status.SOLVED)
        if not run.stopped or left < 0:
            return at
        if at.stalled:
            if _infeasible(problem, at.nu):
                return at._replace(status=Status.INFEASIBLE)
            at = _with_penalty(problem, at, 10 * at.rho)


def _updated(
    problem: Projected, options: SMALBE, at: Iterate, run: Minimum, lagrangian: float
) -> Iterate:
    """Do steps 5 and 6 after an inner run."""
    C, rho = problem.rows.C, at.rho
    Cnu = C @ run.x
    mu = at.mu + rho * Cnu
    g = run.g + rho * (C.T @ Cnu)
    grown = float(0.5 * run.x @ (g - problem.b + C.T @ mu))
    enough = grown >= lagrangian + rho / 2 * (Cnu @ Cnu)
    done = Outer(run.trace, at.M, _norm(Cnu), grown)
    M = at.M if enough else options.beta * at.M
    return Iterate(run.x, g, mu, M, rho, (*at.outer, done))


def _infeasible(problem: Projected, nu: Vector) -> bool:
    """Whether ν minimises ½‖Cν‖² over the bounds, though Cν ≠ 0."""
    Cnu = problem.rows.C @ nu
    downhill = split(nu, problem.rows.C.T @ Cnu, *problem.bounds, 1.0)
    size = _norm(problem.rows.x_tilde) + _norm(nu)
    return _norm(Cnu) > 1e-9 * size and downhill.projected_norm <= 1e-12 * _norm(Cnu)


def _with_penalty(problem: Projected, at: Iterate, rho: float) -> Iterate:
    """Change ρ; the gradient follows without a product."""
    Qnu = problem.rows.C.T @ (problem.rows.C @ at.nu)
    return at._replace(rho=rho, g=at.g + (rho - at.rho) * Qnu)


def _certified(qp: QP, problem: Projected, options: SMALBE, tol: float) -> Solution:
    """Tighten the tolerance until the original problem's KKT residuals agree."""
    at = first_iterate(problem, options)
    for tighter in (1.0, 0.1, 0.01):
        at = smalbe(problem, options, tighter * tol, at)
        if at.status is Status.INFEASIBLE:
            message = "no point within the bounds meets the equality rows"
            return Solution.without_point(qp, at.status, message)
        problem.counts["P_products"] += 1  # of the residuals that follow
        point = _point(qp, problem, at)
        if kkt_residuals(qp, point).worst <= CLAIM * tol:
            return point
        if at.status is not Status.SOLVED:
            break
    message = "step limit, unbounded cost, or no further progress in rounding"
    return replace(point, status=Status.ITERATION_LIMIT, message=message)


def _point(qp: QP, problem: Projected, at: Iterate) -> Solution:
    """Return to the original problem, with multipliers of its rows and bounds.

    Fx − d + Cᵀa is the gradient of the projected problem for a = ‖𝒫F𝒫‖μ − C(Fx − d), up
    to rounding and ‖Cν‖; a least-squares correction on the free components, where it
    must vanish, removes what is left.
    """
    C, y_of = problem.rows.C, problem.rows.multipliers
    at_lower, at_upper = at.nu <= problem.bounds[0], at.nu >= problem.bounds[1]
    x = np.where(
        at_lower, qp.lb, np.where(at_upper, qp.ub, problem.rows.x_tilde + at.nu)
    )
    x = np.clip(x, qp.lb, qp.ub)  # l − x̃ + x̃ may differ from l in the last bit
    r = problem.F(x) + qp.q
    free = ~(at_lower | at_upper)
    a = problem.norm * at.mu - C @ r
    a -= np.linalg.lstsq(C.T[free], (r + C.T @ a)[free])[0]
    r = r + C.T @ a
    z_box = np.where(at_lower, -np.maximum(r, 0), 0.0)
    z_box += np.where(at_upper, -np.minimum(r, 0), 0.0)
    steps = Counter(STEPS[letter] for letter in at.steps)
    return Solution(
        status=Status.SOLVED, x=x, y=y_of(a), z=np.zeros(0), z_box=z_box,
        iterations=len(at.steps),
        counts={**problem.counts, "outer": len(at.outer), **steps},
        message="converged",
    )  # fmt: skip


def _norm(v: Vector) -> float:
    return float(np.linalg.norm(v))
