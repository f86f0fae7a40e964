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
   mostly the last.
2. Block principal pivoting (Júdice and Pires 1994, Comput. Oper. Res. 21). After ten
   changes of the active set that did not lessen the number of wrong constraints, only
   the last wrong one changes, until that number is below its least (Murty's rule),
   which ends since the systems of 1. are those of a strictly convex problem.
3. Certificates: `solvers.certificate`, asked for the last move of (x_k, y_k, z_k).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import diags_array
from sksparse.cholmod import CholmodNotPositiveDefiniteError

from harness import QP, Matrix, Solution, Status, Vector, kkt_residuals
from solvers.certificate import contradicts, descends
from solvers.conversion import csc, dense, needs_matrices, positive
from solvers.face import Faces, Solve, faces

DELTA = 1e-9  #: δᵢ/Pᵢᵢ
KAPPA = 1e4  #: ρ·aD⁻¹aᵀ
MOST_KAPPA = 1e10
PATIENCE = 10  #: changes of the active set that need not lessen what is wrong
NO_PROGRESS = 10  #: moves of the centre that need not lessen the residuals
LEAST_SLACK = 1e-13  #: errors of signs and bounds below this are rounding
NOT_POSITIVE = (np.linalg.LinAlgError, CholmodNotPositiveDefiniteError)
CLAIM = 5.0  #: claimed solved: the KKT residuals are within this times the tolerance


class Active(NamedTuple):
    """Which constraints are taken for equalities."""

    side: NDArray[np.int8]  #: (n,) −1 at lb, 1 at ub, 0 free
    rows: NDArray[np.bool_]  #: (p,) of G


class Point(NamedTuple):
    """A point with the multipliers of its rows."""

    x: Vector
    y: Vector
    z: Vector


class Carry(NamedTuple):
    """Where a run starts."""

    active: Active
    centre: Point


@dataclass(frozen=True, eq=False)
class _Problem:
    qp: QP
    A: Matrix
    G: Matrix
    D: Vector  #: (n,) size of the curvature of each variable
    rho: Vector  #: (m,) of A
    sigma: Vector  #: (p,) of G
    faces: Faces
    counts: Counter[str]

    def gradient(self, at: Point, centre: Point) -> Vector:
        """P x + δ(x − x_k) + q + Aᵀy + Gᵀz."""
        self.counts["P_products"] += 1
        force = self.qp.P @ at.x + self.A.T @ at.y + self.G.T @ at.z
        return np.asarray(force + self.qp.q + DELTA * self.D * (at.x - centre.x))


@dataclass(frozen=True)
class PDAS:
    """In-house primal-dual active set method, by Cholesky factors of the faces.

    `tol` bounds the KKT residuals as the harness measures them, on the QP as given; up
    to 5·tol is claimed solved where rounding ends progress. Iterations are linear
    solves; counted are factorisations (those of faces, plus one where unbounded
    variables are condensed), changes of single constraints, one-at-a-time exchanges,
    moves of the proximal centre and products with P.

    It starts from the nearest point to zero in the box, that is without contact.
    """

    max_iter: int = 5_000

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
            problem = _problem(qp, Counter())
        except NOT_POSITIVE:
            return lambda: (indefinite, None)

        def run() -> tuple[Solution, Carry | None]:
            try:
                return _proximal(problem, tol, _start(qp, carry), self.max_iter)
            except NOT_POSITIVE:
                return indefinite, None

        return run


def _problem(qp: QP, counts: Counter[str], kappa: float = KAPPA) -> _Problem:
    store = dense if isinstance(qp.P, np.ndarray) else csc
    P, A, G = store(qp.P), store(qp.A), store(qp.G)
    D = np.array(P.diagonal())
    usual = D[D > 0].mean() if (D > 0).any() else np.abs(qp.q).max(initial=0.0) or 1.0
    D = np.where(D > 1e-12 * usual, D, usual)
    rho, sigma = kappa / _norms(A, D) ** 2, kappa / _norms(G, D) ** 2
    M = P + (A.T * rho) @ A if store is dense else P + A.T @ diags_array(rho) @ A
    M += np.diag(DELTA * D) if store is dense else diags_array(DELTA * D)
    unbounded = np.isinf(qp.lb) & np.isinf(qp.ub)
    if store is dense and unbounded.any() and not qp.h.size:
        counts["factorisations"] += 1
    return _Problem(qp, A, G, D, rho, sigma, faces(M, G, sigma, unbounded), counts)


def _norms(M: Matrix, D: Vector) -> Vector:
    """Return √(a D⁻¹aᵀ) of each row a, 1 of a zero row."""
    squares = np.asarray((M * M if isinstance(M, np.ndarray) else M.power(2)) @ (1 / D))
    return np.asarray(np.sqrt(np.where(squares > 0, squares, 1.0)))


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
    problem: _Problem, tol: float, start: Carry, max_iter: int
) -> tuple[Solution, Carry | None]:
    """Move the centre until the KKT residuals are small."""
    qp, counts = problem.qp, problem.counts
    active, centre, solve = start.active, start.centre, None
    slack, best, waited, kappa = 0.01 * tol, np.inf, 0, KAPPA
    while waited < NO_PROGRESS:
        run = _settled(problem, (active, solve), centre, slack, max_iter)
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
            kappa, solve = 100 * kappa, None
            problem = _problem(qp, counts, kappa)
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


class _Run(NamedTuple):
    """The end of the inner iterations."""

    active: Active
    solve: Solve
    at: Point
    gradient: Vector
    settled: bool  #: False at the iteration limit


def _settled(
    problem: _Problem,
    start: tuple[Active, Solve | None],
    centre: Point,
    slack: float,
    max_iter: int,
) -> _Run:
    """Change the active set until nothing is wrong with it (steps 1 and 2)."""
    active, solve = start
    fewest, patience = np.inf, PATIENCE
    while True:
        if solve is None:
            problem.counts["factorisations"] += 1
            solve = problem.faces(active.side == 0, active.rows)
        at, g, trial = _newton(problem, active, centre, solve)
        problem.counts["solves"] += 1
        new = _predicted(
            problem, active, Point(at.x, g, trial), max(slack, LEAST_SLACK)
        )
        changed = np.flatnonzero(
            np.concatenate([new.side != active.side, new.rows != active.rows])
        )
        if not changed.size or problem.counts["solves"] >= max_iter:
            return _Run(active, solve, at, g, not changed.size)
        better = changed.size < fewest
        patience = PATIENCE if better else patience - 1
        fewest = min(fewest, changed.size)
        if patience < 0:
            problem.counts["exchanges"] += 1
            new, changed = _exchanged(active, new, changed[-1]), changed[-1:]
        problem.counts["set_changes"] += changed.size
        active, solve = new, None


def _newton(
    problem: _Problem, active: Active, centre: Point, solve: Solve
) -> tuple[Point, Vector, Vector]:
    """Solve in the face; also return the gradient and z_k + σ(Gx − h) of all rows."""
    qp = problem.qp

    def evaluate(x: Vector) -> tuple[Point, Vector, Vector]:
        trial = centre.z + problem.sigma * (problem.G @ x - qp.h)
        y = centre.y + problem.rho * (problem.A @ x - qp.b)
        at = Point(x, y, np.where(active.rows, trial, 0.0))
        return at, problem.gradient(at, centre), trial

    x = np.where(active.side < 0, qp.lb, np.where(active.side > 0, qp.ub, centre.x))
    _, g, _ = evaluate(x)
    return evaluate(x - solve(g))


def _predicted(problem: _Problem, active: Active, at: Point, slack: float) -> Active:
    """Drop what has a multiplier of the wrong sign, add what is violated.

    at : x, the gradient without the multipliers of bounds, and the trial multipliers of
    all inequality rows; errors are measured in the unit √energy of √D·x
    """
    qp, size = problem.qp, np.sqrt(problem.D)
    x_scale = slack * np.abs(size * np.clip(at.x, qp.lb, qp.ub)).max(initial=0.0)
    scale = max(x_scale, slack * np.abs(qp.q / size).max(initial=0.0))
    below = size * (qp.lb - at.x) > x_scale
    above = size * (at.x - qp.ub) > x_scale
    pull = at.y / size
    side = active.side
    release = ((side < 0) & (pull < -scale)) | ((side > 0) & (pull > scale))
    new = np.where(release & (qp.lb < qp.ub), 0, side)
    new = np.where(side == 0, 1 * above - 1 * below, new).astype(np.int8)
    push = at.z * _norms(problem.G, problem.D)
    rows = np.where(active.rows, push >= -scale, push > scale)
    return Active(new, rows)


def _exchanged(active: Active, new: Active, index: int) -> Active:
    """Change one constraint only."""
    side, rows = active.side.copy(), active.rows.copy()
    if index < side.size:
        side[index] = new.side[index]
    else:
        rows[index - side.size] = new.rows[index - side.size]
    return Active(side, rows)


def _point(problem: _Problem, run: _Run, centre: Point) -> Solution:
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
