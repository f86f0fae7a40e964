"""The outer loop of SMALBE: multipliers of the equality rows, and inner tolerances.

Minimises ½νᵀHν − bᵀν subject to Cν = 0 and bounds, H = 𝒫F𝒫/‖𝒫F𝒫‖ + ρQ with
Q = CᵀC, 𝒫 = I − Q and orthonormal rows C (Dostál 2009, the paper's reference [3],
Algorithm 6.1; `tests.support.textbook.projected` sets up the problem). For k = 0, 1, …:

1. MPRGP on ½νᵀHν − (b − Cᵀμ)ᵀν until ‖g^P‖ < min(M‖Cν‖, η‖b‖).
2. If the Lagrangian L(ν, μ) = ½νᵀHν − bᵀν + μᵀCν grew by less than ρ/2·‖Cν‖² since the
   previous k: M ← βM, and ρ ← ρ·growth.
3. μ ← μ + ρCν; the gradient grows by ρQν, which needs no product with F. H does not
   change, so that the CG directions can be reused on an unchanged face.

until ‖g^P‖ ≤ tol‖b‖, ‖Cν‖ ≤ tol‖x̃‖ and, in the original rows, ‖Gν‖ ≤ tol‖e‖. (If b is
zero, the gradient at the start replaces it; if e is zero, Cν is compared with ν.)
The error in the energy norm is also estimated from the gradient
(`Projected.energy_error`), because ‖b‖ may be dominated by the gap of supports, which
is large compared with the contact. The number of products may increase by at most a
quarter for this purpose, since rounding can prevent an accurate energy if stiffnesses
differ widely.

There are two safeguards. If two successive outer iterations do not halve ‖Cν‖, then
ρ ← 10ρ up to MOST_RHO or, if ‖Cν‖ is small enough and only the gradient is too large,
M ← M/10. In addition, CᵀCν is tested as a certificate of infeasibility.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from mortarbench.harness import Status, Vector
from mortarbench.solvers.smalbe.infeasibility import infeasible
from mortarbench.solvers.smalbe.projected import OuterIteration
from tests.support.textbook.model import BoxModel
from tests.support.textbook.mprgp import (
    Directions,
    Face,
    Minimum,
    Point,
    Precondition,
    Rules,
    Watch,
    mprgp,
)
from tests.support.textbook.projected import Projected
from tests.support.textbook.rows import met as are_met
from tests.support.textbook.rows import violation

FOR_ENERGY = 1.25  #: largest factor on the number of products for an accurate energy
MOST_RHO = 1e10  #: largest ρ; for larger values, rounding in ρQν dominates


@dataclass(frozen=True)
class Constants:
    """The constants of the outer loop, relative to ‖𝒫F𝒫‖."""

    M: float
    beta: float
    eta: float
    rho_growth: float
    max_steps: int
    energy: float = 0.0  #: largest estimate of energy error/tol; 0: no requirement


@dataclass(frozen=True, eq=False)
class InnerSolver:
    """Settings of the solver of inner problems, for each ρ."""

    rules: Rules
    model: Callable[[float], BoxModel]
    precondition: Callable[[float], Precondition | None]
    watch: Callable[[int, Vector], Watch] | None = None
    """Return the observer of outer iteration k with the given right-hand side."""


class Iterate(NamedTuple):
    """The state of the outer loop."""

    nu: Vector  #: (n,)
    g: Vector  #: Hν − b + Cᵀμ
    mu: Vector  #: (r,) multipliers of Cν = 0, relative to ‖𝒫F𝒫‖
    M: float
    rho: float
    outer: tuple[OuterIteration, ...] = ()
    status: Status = Status.ITERATION_LIMIT
    directions: Directions | None = None  #: CG directions for this ρ on the last face

    @property
    def steps(self) -> str:
        """All inner steps so far, one letter each."""
        return "".join([o.trace for o in self.outer])

    @property
    def stalled(self) -> bool:
        """True if neither of the last two outer iterations halved ‖Cν‖."""
        errors = [o.infeasibility for o in self.outer[-3:]]
        return len(errors) == 3 and errors[2] > errors[1] / 2 > errors[0] / 4


def first_iterate(
    problem: Projected, x: Vector, mu: Vector, *, M: float, rho: float
) -> Iterate:
    """Return the iterate at x, projected onto the bounds, and μ.

    This needs one product with F, except for x = 0, where 𝒫ν = −𝒫x̃ = 0 and Hν = ρQν.
    """
    C, x_tilde = problem.rows.C, problem.rows.x_tilde
    nu = np.clip(x - x_tilde, *problem.bounds)
    Hnu = problem.H(nu, rho) if (nu + x_tilde).any() else rho * (C.T @ (C @ nu))
    return Iterate(nu, Hnu - problem.b + C.T @ mu, mu, M, rho)


def smalbe(
    problem: Projected,
    constants: Constants,
    inner: InnerSolver,
    tol: float,
    at: Iterate,
) -> Iterate:
    """Continue the outer loop from `at`."""
    C, b = problem.rows.C, problem.b
    b_size = _norm(b) or _norm(at.g)
    left = constants.max_steps - len(at.steps) - len(at.outer)
    lagrangian = -np.inf
    small = _accuracy(problem, tol, b_size, constants.energy)

    def precise(here: Point, face: Face) -> bool:
        size, coarse = face.projected_norm, constants.eta * b_size
        if len(C) and size < coarse and size < at.M * violation(problem.rows, here.x):
            return True
        return small(here, face)

    while True:
        rhs = b - C.T @ at.mu
        run = mprgp(
            partial(problem.H, rho=at.rho), rhs, problem.bounds, (at.nu, at.g),
            B=inner.model(at.rho), stop=precise, rules=inner.rules,
            precondition=inner.precondition(at.rho),
            watch=inner.watch and inner.watch(len(at.outer), rhs),
            max_steps=max(left, 0), directions=at.directions,
        )  # fmt: skip
        left -= len(run.trace) + 1
        at = _updated(problem, constants, at, run, lagrangian)
        lagrangian = at.outer[-1].lagrangian
        if small(Point(run.x, run.g), run.face):
            return at._replace(status=Status.SOLVED)
        if (not run.stopped or at.stalled) and infeasible(
            problem.rows, problem.bounds, at.nu
        ):
            return at._replace(status=Status.INFEASIBLE)
        if not run.stopped or left < 0:
            return at
        if at.stalled:
            stricter = _after_stall(
                problem, at, met=are_met(problem.rows, at.nu, tol, b_size)
            )
            if stricter is None:
                return at
            at = stricter


def _accuracy(
    problem: Projected, tol: float, b_size: float, energy: float
) -> Callable[[Point, Face], bool]:
    """Return the stopping criterion of the outer loop."""
    most = 0  # limit of products, set when all criteria except the energy are met

    def reached(here: Point, face: Face) -> bool:
        nonlocal most
        if face.projected_norm > tol * b_size:
            return False
        if not are_met(problem.rows, here.x, tol, b_size):
            return False
        spent = problem.F.count
        most = most or int(FOR_ENERGY * spent)
        if energy == 0 or spent >= most:
            return True
        error = problem.energy_error(here.x, face.phi + face.beta)
        return error <= energy * tol

    return reached


def _after_stall(problem: Projected, at: Iterate, *, met: bool) -> Iterate | None:
    """Increase ρ or, if the rows are `met`, tighten the gradient."""
    if met:
        return at._replace(M=at.M / 10)
    if at.rho >= MOST_RHO:
        return None
    return _with_penalty(problem, at, min(10 * at.rho, MOST_RHO))


def _updated(
    problem: Projected,
    constants: Constants,
    at: Iterate,
    run: Minimum,
    before: float,
) -> Iterate:
    """Update M, ρ and μ (steps 2 and 3); `before` is the previous Lagrangian."""
    C, rho = problem.rows.C, at.rho
    Cnu = C @ run.x
    lagrangian = float(0.5 * run.x @ (run.g - problem.b + C.T @ at.mu))
    enough = lagrangian >= before + rho / 2 * (Cnu @ Cnu)
    done = OuterIteration(run.trace, at.M, rho, _norm(Cnu), lagrangian)
    new = at._replace(
        nu=run.x,
        g=run.g + rho * (C.T @ Cnu),
        mu=at.mu + rho * Cnu,
        M=at.M if enough else constants.beta * at.M,
        outer=(*at.outer, done),
        directions=run.directions,
    )
    if enough or constants.rho_growth == 1:
        return new
    return _with_penalty(problem, new, constants.rho_growth * rho)


def _with_penalty(problem: Projected, at: Iterate, rho: float) -> Iterate:
    """Return the iterate with another ρ; its gradient needs no product."""
    Qnu = problem.rows.C.T @ (problem.rows.C @ at.nu)
    return at._replace(rho=rho, g=at.g + (rho - at.rho) * Qnu, directions=None)


def _norm(v: Vector) -> float:
    return float(np.linalg.norm(v))
