"""Primal-dual active sets: semismooth Newton for bounds and rows.

The standard method of the mortar literature (Hintermüller, Ito and Kunisch 2003, SIAM
J. Optim. 13; Hüeber and Wohlmuth 2005; the paper's reference [2]). Given which bounds
and inequality rows are active, a linear system gives x and the multipliers; then

    active ← active with the right sign of the multiplier, or violated

until nothing changes. Three things make it safe where that is not enough:

1. Proximal method of multipliers (Rockafellar 1976). The linear systems are those of

       ½xᵀPx + qᵀx + ½Σδᵢ(x − x_k)ᵢ²,  y = y_k + ρ(Ax − b),  z = z_k + ρ(Gx − h) on
       active rows,

   so that every face can be solved: a singular P, repeated rows, more active rows than
   free components. (x_k, y_k, z_k) moves to the solution whenever the active set has
   settled; the factor of that face serves for the next solve. δᵢ = 1e-9·Pᵢᵢ is small
   and ρ = 1e4/(a D⁻¹aᵀ), D = diag P, large, hence the first settled active set is
   mostly the last. ρ grows where the residuals fall too slowly: a row that only stiff
   variables are left to meet needs more.
2. Block principal pivoting (Júdice and Pires 1994, Comput. Oper. Res. 21). After ten
   changes of the active set that did not lessen the number of wrong constraints, only
   the last wrong one changes, until that number is below its least (Murty's rule),
   which ends since the systems of 1. are those of a strictly convex problem.
3. Certificates: `solvers.baselines.infeasibility_certificate`, asked for the last move
   of (x_k, y_k, z_k).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np
from sksparse.cholmod import CholmodNotPositiveDefiniteError

from mortarbench.harness import (
    QP,
    About,
    Solution,
    Status,
    Vector,
    kkt_residuals,
    needs_matrices,
)
from mortarbench.solvers.baselines.active_set import (
    DELTA,
    KAPPA,
    Active,
    Point,
    Problem,
    Run,
    penalised,
    settled,
)
from mortarbench.solvers.baselines.infeasibility_certificate import (
    contradicts,
    descends,
)
from mortarbench.solvers.common.conversion import positive

STIFFER = 100.0  #: factor of ρ where the residuals fall too slowly
MOST_KAPPA = 1e10  #: ρ·aD⁻¹aᵀ up to which it is used
NO_PROGRESS = 10  #: moves of the centre that need not lessen the residuals
NOT_POSITIVE = (np.linalg.LinAlgError, CholmodNotPositiveDefiniteError)
CLAIM = 5.0  #: claimed solved: the KKT residuals are within this times the tolerance


class Carry(NamedTuple):
    """Where a run starts."""

    active: Active
    centre: Point


@dataclass(frozen=True)
class PDAS:
    """In-house primal-dual active set method, by Cholesky factors of the faces.

    `tol` bounds the KKT residuals as the harness measures them, on the QP as given; up
    to 5·tol is claimed solved where rounding ends progress. Iterations are linear
    solves; counted are factorisations (those of faces, plus one where unbounded
    variables are condensed), changes of single constraints, one-at-a-time exchanges,
    moves of the proximal centre and products with P.

    It starts from the point of the box nearest to zero: with no contact, in the primal
    and in the dual. (On the duals of contact problems the start with all variables free
    took between one solve fewer and seven more.)
    """

    max_iter: int = 5_000

    about: ClassVar[About] = About(
        title="PDAS (ours)", licence="BSD-3-Clause",
        method="primal-dual active set, in a proximal method of multipliers",
        linear_solver="Cholesky of the free block: LAPACK (dense), CHOLMOD (sparse)",
        phases="preparing forms the penalised matrix; solving factorises every face",
        sequence="active set and point",
        limits=(
            "on one-dimensional obstacles the front moves a node a step: 323 solves "
            "for 1000 nodes",
            "sparse faces are analysed anew each time: 97 ms a factor at Nr = 30, Nh = "
            "15 where 60 ms would do",
        ),
    )  # fmt: skip

    def __post_init__(self) -> None:
        positive(max_iter=self.max_iter)

    def declines(self, qp: QP) -> str | None:
        return needs_matrices(qp)

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        run = self._prepared(qp, tol, None)
        return lambda: run()[0]

    def chain(self, tol: float) -> Callable[[QP], Callable[[], Solution]]:
        """Begin a sequence: each starts from the last active set and point."""
        carry: Carry | None = None

        def prepare(qp: QP) -> Callable[[], Solution]:
            run = self._prepared(qp, tol, carry)

            def solve() -> Solution:
                nonlocal carry
                solution, carry = run()
                return solution

            return solve

        return prepare

    def _prepared(
        self, qp: QP, tol: float, carry: Carry | None
    ) -> Callable[[], tuple[Solution, Carry | None]]:
        message = "P is not positive semidefinite"
        indefinite = Solution.without_point(qp, Status.FAILED, message)
        try:
            problem = penalised(qp, Counter())
        except NOT_POSITIVE:
            return lambda: (indefinite, None)

        def run() -> tuple[Solution, Carry | None]:
            try:
                return _proximal(problem, tol, _start(qp, carry), self.max_iter)
            except NOT_POSITIVE:
                return indefinite, None

        return run


def _start(qp: QP, carry: Carry | None) -> Carry:
    """Take over the last active set where it fits, else that of no contact."""
    if carry is not None and [v.size for v in carry.centre] == [
        qp.q.size, qp.b.size, qp.h.size,
    ]:  # fmt: skip
        side, centre = carry.active.side, carry.centre
        side = np.where((side < 0) & np.isinf(qp.lb), 0, side)
        side = np.where((side > 0) & np.isinf(qp.ub), 0, side)
        rows = carry.active.rows
    else:
        centre = Point(np.clip(0 * qp.q, qp.lb, qp.ub), 0 * qp.b, 0 * qp.h)
        side = 1 * (centre.x >= qp.ub) - 1 * (centre.x <= qp.lb)
        rows = np.zeros(qp.h.size, dtype=bool)
    side = np.where(qp.lb == qp.ub, -1, side).astype(np.int8)
    return Carry(Active(side, rows), centre)


def _proximal(
    problem: Problem, tol: float, start: Carry, max_iter: int
) -> tuple[Solution, Carry | None]:
    """Move the centre until the KKT residuals are small."""
    qp, counts = problem.qp, problem.counts
    active, centre, solve = start.active, start.centre, None
    slack, best, waited, kappa = 0.01 * tol, np.inf, 0, KAPPA
    while waited < NO_PROGRESS:
        run = settled(problem, (active, solve), centre, slack, max_iter)
        active, solve = run.active, run.solve
        counts["centres"] += 1
        point = _point(problem, run, centre)
        worst = kkt_residuals(qp, point).worst
        if worst <= tol:
            break
        moves = [new - old for new, old in zip(run.at, centre, strict=True)]
        if run.settled and (message := _no_solution(qp, *moves)):
            return Solution.without_point(qp, Status.INFEASIBLE, message), None
        if not run.settled:
            break
        waited = 0 if worst < best / 2 else waited + 1
        if waited and waited % 2 == 0 and kappa < MOST_KAPPA:
            kappa, solve = STIFFER * kappa, None
            problem = penalised(qp, counts, kappa)
        centre, best, slack = run.at, min(best, worst), slack / 10
    if worst <= CLAIM * tol:
        return point, Carry(active, Point(point.x, point.y, point.z))
    message = "no further progress in rounding" if run.settled else "step limit"
    return replace(point, status=Status.ITERATION_LIMIT, message=message), None


def _no_solution(qp: QP, x: Vector, y: Vector, z: Vector) -> str | None:
    """Say why there is none, if a move of the centre proves it."""
    if contradicts(qp, y, z):
        return "no point meets all constraints"
    return "the cost falls without end" if descends(qp, x) else None


def _point(problem: Problem, run: Run, centre: Point) -> Solution:
    """Hand back the point, with multipliers of the bounds that are active."""
    counts, (x, y, z) = problem.counts, run.at
    force = DELTA * problem.D * (x - centre.x) - run.gradient
    z = np.maximum(z, 0)
    z_box = np.where(run.active.side < 0, np.minimum(force, 0), 0.0)
    z_box = np.where(run.active.side > 0, np.maximum(force, 0), z_box)
    fixed = problem.qp.lb == problem.qp.ub
    z_box = np.where(fixed, force, z_box)
    counts["P_products"] += 1  # of the residuals that follow
    named = {k: v for k, v in counts.items() if k != "solves"}
    return Solution(
        status=Status.SOLVED, x=x, y=y, z=z, z_box=z_box,
        iterations=counts["solves"], counts=named, message="converged",
    )  # fmt: skip
