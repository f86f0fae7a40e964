"""A run of SMALBE on a QP: transformation, solution, recovery and check."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import QP, Matrix, Solution, Status, Vector
from mortarbench.solvers.common.stopping import relative_residual
from mortarbench.solvers.smalbe import compiled
from mortarbench.solvers.smalbe.elimination import Eliminated, eliminate_free
from mortarbench.solvers.smalbe.extension import checked
from mortarbench.solvers.smalbe.infeasibility import infeasible
from mortarbench.solvers.smalbe.options import Options
from mortarbench.solvers.smalbe.preconditioner import (
    incomplete_factor,
    preconditioned_operator,
    resolved_preconditioner,
    sparsity_of,
    structural_preconditioner,
)
from mortarbench.solvers.smalbe.projected import (
    Iterate,
    OuterIteration,
    Projected,
    Spectrum,
    by_lanczos,
    projected_problem,
    unchanged,
)
from mortarbench.solvers.smalbe.rows import Rows
from mortarbench.solvers.smalbe.spectrum import random_start

STEPS = {
    "c": "cg",
    "b": "beyond",
    "e": "expansion",
    "f": "fallback",
    "p": "proportioning",
    "n": "newton",
}
EPS = float(np.finfo(float).eps)
TINY = float(np.finfo(float).tiny)
#: smallest limit on Lanczos steps, unless the option `lanczos_steps` is smaller
MIN_LANCZOS_STEPS = 5
#: default penalty ρ. Because the models contain ρQ exactly, a large ρ costs no
#: products. With 1e4, two or three outer iterations usually suffice
RHO = 1e4
#: default penalty ρ if P provides a preconditioner. Each multiplier step restarts CG,
#: so fewer outer iterations save time for decomposed bodies with thousands of rows.
#: With 1e4, `test_products_do_not_grow_with_the_mesh` fails; with the largest ρ that
#: rounding permits, 4.5e8 at 1e-6, `cube-wall/n=40/feti=8/dual` takes 45 products
#: instead of 35
PRECONDITIONED_RHO = 1e6
#: default penalty ρ with discs. Spectral steps do not use the model, and a larger ρ
#: would worsen the conditioning of H
RHO_ON_DISCS = 1.0
#: number of consecutive tightenings that may fail to reduce the residuals by a tenth
MAX_IDLE_TIGHTENINGS = 3


class Carry(NamedTuple):
    """Data that a problem of a sequence passes to the next problem."""

    A: Matrix
    b: Vector
    rows: Rows  #: of A and b
    spectrum: Spectrum
    solution: Solution

    def rows_of(self, qp: QP) -> Rows | None:
        """Return the rows if they are also those of `qp`, otherwise None."""
        if not qp.b.size or not np.array_equal(self.b, qp.b):
            return None
        return self.rows if unchanged(self.A, qp.A) else None


class Residuals(NamedTuple):
    """Relative KKT residuals of a point (`compiled.relative_residuals`)."""

    gradient: float  #: larger of the errors of stationarity and of the gap
    rows: float = 0.0
    force: float = 0.0  #: scale of forces; 0 if unknown
    energy: float = 0.0  #: scale of energies; 0 if unknown


#: function that returns the solution, and data for the next QP if it is solved
Solve = Callable[[], tuple[Solution, Carry | None]]
#: observer called after each step with its letter, x and g
Note = Callable[[str, Vector, Vector], None]


class _Task(NamedTuple):
    qp: QP
    problem: Projected
    options: Options
    rho: float  #: penalty ρ
    loop: OuterLoop
    history: History | None
    carry: Carry | None


def prepared(
    qp: QP,
    tol: float,
    options: Options,
    carry: Carry | None,
    *,
    eliminates: bool = True,
) -> Solve:
    """Prepare a run: project the QP and estimate the spectrum.

    eliminates : True to eliminate free variables first if there are discs and P is
        dense. This takes 0.03 of the time on `hertz-sphere` with n = 8 and 0.9 of the
        time in the geometric mean of 72 problems with discs
    """
    if len(qp.sets) > 1:
        options = _on_discs(qp, options)
        plain = options.preconditioner == "none" and not options.is_extended
        if eliminates and plain and (small := eliminate_free(qp)) is not None:
            inner = prepared(small.qp, tol, options, carry)
            return partial(_solve_without_free, qp, tol, options, small, inner)
    rho = options.rho or (PRECONDITIONED_RHO if preconditioned_operator(qp) else RHO)
    history = History() if options.history else None
    if carry is not None and carry.solution.x.size != qp.q.size:
        carry = None
    steps = _lanczos_steps(options, qp)
    problem = _projected(qp, options, steps, carry)
    if not problem.rows.consistent:
        message = "the equality rows contradict each other"
        nowhere = Solution.without_point(qp, Status.INFEASIBLE, message)
        return lambda: (nowhere, None)
    loop = outer_loop(problem, qp, options, history)
    task = _Task(qp, problem, options, rho, loop, history, carry)
    return lambda: _solve_to_tolerance(task, tol)


def _solve_without_free(
    qp: QP, tol: float, options: Options, small: Eliminated, inner: Solve
) -> tuple[Solution, Carry | None]:
    """Solve the QP without its free variables, and recover their values.

    If the recovered point does not solve `qp`, the whole QP is solved. This happens if
    rows of discs depend exactly on the rows of free variables: the reduced P then
    consists of rounding errors along these rows, and large discs permit large motions
    along them. The counts include both attempts, and factorised columns as products.
    """
    s, left = inner()
    spent = {"P_products": s.counts.get("P_products", 0) + small.columns + 1}
    spent["factorised_columns"], iterations = small.columns, s.iterations or 0
    if s.status is Status.SOLVED:
        s = small.recover(s)
    if s.status is not Status.SOLVED or not relative_residual(qp, s, tol) <= tol:
        s, left = prepared(qp, tol, options, None, eliminates=False)()
        spent["P_products"] += s.counts.get("P_products", 0)
        iterations += s.iterations or 0
    return replace(s, iterations=iterations, counts={**s.counts, **spent}), left


def _on_discs(qp: QP, options: Options) -> Options:
    """Replace options that are not valid for QPs with discs.

    The model of H can be minimised only over boxes.
    """
    kind = resolved_preconditioner(qp, options.preconditioner)
    return replace(
        options,
        rho=options.rho or RHO_ON_DISCS,
        expansion="spectral",
        preconditioner="none" if kind in ("model", "sparse") else kind,
    )


def _projected(qp: QP, options: Options, steps: int, carry: Carry | None) -> Projected:
    """Homogenise, project and normalise the QP; estimate the spectrum.

    steps : largest number of steps of the Lanczos process
    """
    P = sparsity_of(qp)
    kind = resolved_preconditioner(qp, options.preconditioner, P)
    if P is not None and kind == "incomplete" and not options.is_extended:
        norm, factor = incomplete_factor(qp, P)
        problem = projected_problem(qp, lambda _F, _C: Spectrum(norm, None))
        problem.factor = factor
        return problem
    find = partial(_estimated_spectrum, options, steps, carry)
    if options.expansion == "spectral" and qp.q.any():
        # q is closer to the first eigenvector than a random vector is; without rows, no
        # step depends on the norm
        find = partial(by_lanczos, steps=steps if qp.b.size else 1, start=qp.q)
    return projected_problem(qp, find, carry and carry.rows_of(qp))


def _estimated_spectrum(
    options: Options,
    steps: int,
    carry: Carry | None,
    F: compiled.Product,
    C: compiled.Rows,
) -> Spectrum:
    """Estimate the spectrum of 𝒫F𝒫, or reuse the previous problem's spectrum.

    The previous spectrum is reused if the Rayleigh quotient of the Lanczos start
    vector, which is the same for all problems, has changed by less than a factor of
    two. The reuse is permitted only with model steps, because model steps detect and
    correct a wrong model.
    """
    if carry is not None and options.expansion == "model":
        previous = carry.spectrum.ritz
        quotient = compiled.lanczos(F, C, random_start(C.n), 1)[3]
        if previous and 0.5 * previous.at_start < quotient < 2 * previous.at_start:
            return carry.spectrum
    return by_lanczos(F, C, steps=steps)


def _lanczos_steps(options: Options, qp: QP) -> int:
    """Return the maximum number of Lanczos steps for this problem.

    For few unknowns, more steps would cost as much as CG. Few steps also suffice if P
    provides a preconditioner, because the spectrum of decomposed bodies is flat and
    only the norm is used. Without equality rows, fewer steps are enough: for 73 to 85
    unknowns, CG takes about ten products, and steps beyond the seventh or eighth save
    no more products than they cost. Seven steps for all sizes would save up to a fifth
    of the products on dense duals with bounds only, but would require up to 1.9 times
    as many products on dense matrices whose spectrum decays slowly. A sequence reuses
    the spectrum, so that more steps are worthwhile: with n/10 instead of n/6 steps, the
    24 problems of greco/n=32/dual-bounds take 170 products instead of 152.
    """
    few = qp.q.size // (6 if qp.b.size else 10)
    if preconditioned_operator(qp) or options.expansion == "spectral":
        few = 0
    return min(options.lanczos_steps, max(MIN_LANCZOS_STEPS, few))


def _start(task: _Task, tol: float) -> Iterate:
    """Return the starting point: zero, or the solution of the previous problem.

    A component that was pushed to a bound starts at the same bound, even if the value
    of this bound has changed: slipping nodes usually continue to slip when the friction
    bound changes. At a solution, ‖𝒫F𝒫‖μ = −Cz.
    """
    problem, carry = task.problem, task.carry
    # rounding of ρQν in the gradient is below tol
    rho = min(task.rho, max(1.0, tol / (10 * EPS)))
    if carry is None:
        x, mu = np.zeros(problem.F.n), np.zeros(len(problem.rows.C))
    else:
        x, z = carry.solution.x, carry.solution.z_box
        mu = -(problem.rows.C @ z) / problem.spectrum.norm
        if problem.discs:  # their multipliers belong to no bound
            z = np.where(np.isinf(task.qp.lb) & np.isinf(task.qp.ub), 0.0, z)
        x = np.where(z, np.copysign(np.inf, z), x)
    return task.loop.first(x, mu, M=task.options.M, rho=rho)


@dataclass(eq=False)
class OuterLoop:
    """The outer loop of SMALBE on a projected problem."""

    solver: compiled.SMALBE
    problem: Projected
    options: Options
    #: k, right-hand side → observer of the steps of outer iteration k; None if no
    #: history is recorded
    watch: Callable[[int, Vector], Note] | None

    def first(self, x: Vector, mu: Vector, *, M: float, rho: float) -> Iterate:
        """Return the first iterate: x, projected onto the set, and the multipliers μ.

        The call takes one product, or no product for x = 0.
        """
        return Iterate(*self.solver.begin(x, mu, rho), mu, M, rho)

    def solve(self, tol: float, at: Iterate, aim: float = 0.0) -> Iterate:
        """Continue the outer loop from `at` to the tolerance `tol`.

        aim : largest estimate of the relative KKT residual at the end; 0 for `tol`
        """
        problem = self.problem
        nu, g, mu, M, rho, done, status = self.solver.solve(
            self.options,
            tol,
            at,
            partial(infeasible, problem.rows, problem.hull),
            self.watch,
            aim,
        )
        outer = (*at.outer, *[OuterIteration(*one) for one in done])
        return Iterate(nu, g, mu, M, rho, outer, status)

    def updated(self, at: Iterate) -> Iterate:
        """Return the iterate after the update of the multipliers."""
        C = self.problem.rows.C
        change = at.rho * (C @ at.nu)
        return at._replace(mu=at.mu + change, g=at.g + C.T @ change)


def outer_loop(
    problem: Projected, qp: QP, options: Options, history: History | None = None
) -> OuterLoop:
    """Prepare the outer loop with the preconditioner and step rule of the options."""
    # not used with user-defined preconditioners or step rules
    if problem.factor is not None:
        solver = compiled.SMALBE(problem, options, False)
    else:
        own = options.preconditioner_for(qp)
        kind = resolved_preconditioner(qp, options.preconditioner)
        if own is None:
            M = structural_preconditioner(qp, kind, problem.F)
        else:
            M = checked(own)
        rule = options.step_rule_for(qp)
        solver = compiled.SMALBE(problem, options, kind != "none", M, rule)
    watch = (
        partial(history.watch, problem, solver.face_and_gradients) if history else None
    )
    return OuterLoop(solver, problem, options, watch)


def _solve_to_tolerance(task: _Task, tol: float) -> tuple[Solution, Carry | None]:
    """Tighten the outer loop until the KKT residual of the original QP is ≤ tol."""
    options, at = task.options, _start(task, tol)
    tighter, aim, best, waited = 1.0, 0.0, np.inf, 0
    while True:
        at = task.loop.solve(tighter * tol, at, aim)
        if at.status is Status.INFEASIBLE:
            message = "no point within the bounds satisfies the equality rows"
            return Solution.without_point(task.qp, at.status, message), None
        if at.status is Status.FAILED:
            message = "the iterates diverged"
            return Solution.without_point(task.qp, at.status, message), None
        point, Fx = _point(task, at)
        residuals = _residuals(task, point, Fx, tol)
        worst = max(residuals.gradient, residuals.rows)
        if worst <= tol:
            qp, problem = task.qp, task.problem
            return point, Carry(qp.A, qp.b, problem.rows, problem.spectrum, point)
        waited = 0 if worst < 0.9 * best else waited + 1
        best = min(best, worst)
        if at.status is not Status.SOLVED or waited == MAX_IDLE_TIGHTENINGS:
            break
        is_off_rows = residuals.rows > tol or waited > 0
        if is_off_rows:
            # by 0.01 if the last tightening had little effect: multipliers may converge
            # so slowly that one outer iteration meets a slightly smaller tolerance
            tighter *= 0.01 if waited else min(0.5, max(0.01, tol / residuals.rows))
            at = task.loop.updated(at)
        at, aim = _tightened(task, at, residuals, tol, stuck=waited > 0)
    message = f"stagnated at residual {worst:.1e}: rounding, or the cost is unbounded"
    if len(at.steps) + len(at.outer) >= options.max_steps:
        message = "step limit"
    point = replace(point, status=Status.ITERATION_LIMIT, message=message)
    return point, None


def _tightened(
    task: _Task, at: Iterate, residuals: Residuals, tol: float, *, stuck: bool
) -> tuple[Iterate, float]:
    """Return where the inner run continues after a failed test, and its next aim.

    CG is not restarted. If the residual is much larger than its estimate, the gradient
    contains errors of its updates and is recomputed.

    stuck : True if the estimate fell and the residual did not; the next run then ends
        when ‖g^P‖ is a hundred times smaller
    """
    gradient, _, force, energy = residuals
    estimate = task.loop.solver.estimate(at, force, energy)
    if stuck or gradient > 2 * estimate:
        x = task.problem.rows.x_tilde + at.nu
        fresh = task.loop.first(x, at.mu, M=at.M, rho=at.rho)
        at = at._replace(nu=fresh.nu, g=fresh.g)
        estimate = task.loop.solver.estimate(at, force, energy)
    aim = min(estimate, tol * estimate / max(gradient, TINY))
    return at, TINY if stuck else max(0.95 * aim, TINY)


def _point(task: _Task, at: Iterate) -> tuple[Solution, Vector]:
    """Recover the solution, and Fx."""
    qp, problem = task.qp, task.problem
    mu, rho, box = at.mu, at.rho, qp.box
    x, a, z_box, Fx = task.loop.solver.point(at.nu, mu, rho, box.lower, box.upper)
    problem.F.count += bool(problem.discs)  # `_residuals` takes another product
    letters = at.steps
    counts = {"P_products": problem.F.count, **problem.counts, "outer": len(at.outer)}
    counts |= {name: letters.count(k) for k, name in STEPS.items() if k in letters}
    solution = Solution(
        status=Status.SOLVED,
        x=x,
        y=problem.rows.multipliers(a),
        z=np.zeros(0),
        z_box=z_box,
        iterations=len(letters),
        counts=counts,
        message="converged",
        history=task.history.columns if task.history else {},
    )
    return solution, Fx


def _residuals(task: _Task, point: Solution, Fx: Vector, tol: float) -> Residuals:
    """Return the relative KKT residuals of the original QP."""
    qp, G, diagonal = task.qp, task.problem.rows.G, task.problem.diagonal
    if task.problem.discs:
        return Residuals(relative_residual(qp, point, tol))
    return Residuals(*compiled.relative_residuals(qp, point, tol, Fx, diagonal, G))


COLUMNS = (
    "step",  # letter of the step, see `STEPS`
    "outer",  # index k of the outer iteration
    "products",  # number of products with F so far
    "free_gradient",  # ‖φ‖
    "chopped_gradient",  # ‖β‖
    "infeasibility",  # ‖Cν‖/‖x̃‖; for x̃ = 0, ‖Cν‖/‖ν‖
    "active",  # number of components at bounds or on the boundary of a disc
    # number of active components with a lower and an upper bound; omitted if no
    # component has both
    "two_sided",
    "cost",  # value of the augmented Lagrangian
    "seconds",  # time since the start of `prepare`
)


@dataclass(frozen=True, eq=False)
class History:
    """History of a run: one row per step, with entries in the order of `COLUMNS`.

    Gradients and costs refer to the normalised problem.
    """

    began: float = field(default_factory=perf_counter)
    rows: list[tuple[Any, ...]] = field(default_factory=list)

    def watch(
        self,
        problem: Projected,
        parts: Callable[[Vector, Vector], tuple[Vector, Vector, Vector]],
        outer: int,
        rhs: Vector,
    ) -> Note:
        """Return the observer of the steps of an inner run with right-hand side `rhs`.

        parts : x, g → mask of the face, gradients φ and β
        """
        C, x_tilde = problem.rows.C, problem.rows.x_tilde
        size = float(np.linalg.norm(x_tilde))
        lower, upper = problem.hull
        between = np.isfinite(lower) & np.isfinite(upper) & (lower < upper)
        boxes = bool(between.any())

        def note(letter: str, x: Vector, g: Vector) -> None:
            error = np.linalg.norm(C @ x) if len(C) else 0.0
            free, phi, beta = parts(x, g)
            active = free == 0
            self.rows.append(
                (
                    letter,
                    outer,
                    problem.F.count,
                    np.linalg.norm(phi),
                    np.linalg.norm(beta),
                    error / (size or np.linalg.norm(x) or 1.0),
                    np.count_nonzero(active),
                    np.count_nonzero(between & active) if boxes else None,
                    0.5 * x @ (g - rhs),
                    perf_counter() - self.began,
                )
            )

        return note

    @property
    def columns(self) -> dict[str, NDArray[Any]]:
        """Columns of the history as arrays of equal length."""
        columns = zip(*self.rows, strict=True) if self.rows else ((),) * len(COLUMNS)
        return {
            k: np.array(v)
            for k, v in zip(COLUMNS, columns, strict=True)
            if k != "two_sided" or any(count is not None for count in v)
        }
