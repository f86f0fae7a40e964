"""Inner iterations of `pdas`: semismooth Newton for a fixed proximal centre."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import diags_array

from mortarbench.harness import QP, Matrix, Vector
from mortarbench.solvers.baselines.face import Faces, Solve, factoriser
from mortarbench.solvers.common.conversion import csc, dense
from mortarbench.solvers.common.stopping import curvatures

#: δᵢ/Dᵢ: weight δᵢ of the proximal term of xᵢ, relative to the curvature Dᵢ = Pᵢᵢ; a
#: typical curvature replaces a negligible Pᵢᵢ, see `penalise`
DELTA = 1e-9
#: ρ·aD⁻¹aᵀ: penalty ρ of a row a of A or G, relative to 1/(aD⁻¹aᵀ), an estimate of the
#: curvature of the objective along a
KAPPA = 1e4
#: Largest number of consecutive changes of the active set that do not reduce the number
#: of wrong constraints. Afterwards, constraints are exchanged one at a time until this
#: number falls below its minimum.
PATIENCE = 10
#: relative errors of multiplier signs and of bounds below this value count as rounding
#: errors
SIGN_ROUNDING = 1e-13


class Active(NamedTuple):
    """Active set: the constraints that are equations in the Newton system."""

    side: NDArray[np.int8]  #: (n,) −1 at lb, 1 at ub, 0 free
    rows: NDArray[np.bool_]  #: (p,) active rows of G


class Point(NamedTuple):
    """Point with the multipliers of the equality and inequality rows."""

    x: Vector
    y: Vector
    z: Vector


class Run(NamedTuple):
    """Result of the inner iterations, with the solution operator of the final face."""

    active: Active
    solve: Solve  #: solution operator of the face of `active`
    at: Point
    gradient: Vector  #: gradient of the proximal Lagrangian at `at` (n,)
    settled: bool  #: True if the active set no longer changes, False at the step limit


@dataclass(frozen=True, eq=False)
class Problem:
    """QP with proximal weights, penalties and a function that factorises faces."""

    qp: QP
    A: Matrix
    G: Matrix
    D: Vector  #: (n,) diagonal of P; a typical curvature replaces negligible entries
    rho: Vector  #: (m,) weights of the rows of A
    sigma: Vector  #: (p,) weights of the rows of G
    faces: Faces
    counts: Counter[str]

    def gradient(self, at: Point, centre: Point) -> Vector:
        """Return Px + δ(x − x_k) + q + Aᵀy + Gᵀz with the proximal centre x_k."""
        self.counts["P_products"] += 1
        force = self.qp.P @ at.x + self.A.T @ at.y + self.G.T @ at.z
        return np.asarray(force + self.qp.q + DELTA * self.D * (at.x - centre.x))


def penalise(qp: QP, counts: Counter[str], kappa: float = KAPPA) -> Problem:
    """Return the problem with row weights κ/(a D⁻¹aᵀ).

    If P is dense and there are no inequality rows, `factoriser` also factorises the
    block of the components that are free on every face.

    Raises
    ------
    numpy.linalg.LinAlgError
        If this factorisation breaks down because P is not positive semidefinite. For
        such a P, a later factorisation of a face may raise the same error, or
        sksparse.cholmod.CholmodNotPositiveDefiniteError if P is sparse.

    """
    store = dense if isinstance(qp.P, np.ndarray) else csc
    P, A, G = store(qp.P), store(qp.A), store(qp.G)
    D = curvatures(qp)
    rho, sigma = kappa / row_norms(A, D) ** 2, kappa / row_norms(G, D) ** 2
    M = P + (A.T * rho) @ A if store is dense else P + A.T @ diags_array(rho) @ A
    M += np.diag(DELTA * D) if store is dense else diags_array(DELTA * D)
    unbounded = np.isinf(qp.lb) & np.isinf(qp.ub)
    if store is dense and unbounded.any() and not qp.h.size:
        counts["factorisations"] += 1
    faces = factoriser(M, G, sigma, unbounded)
    return Problem(qp, A, G, D, rho, sigma, faces, counts)


def row_norms(M: Matrix, D: Vector) -> Vector:
    """Return √(a D⁻¹aᵀ) for each row a of M; 1 for a zero row."""
    squares = np.asarray((M * M if isinstance(M, np.ndarray) else M.power(2)) @ (1 / D))
    return np.asarray(np.sqrt(np.where(squares > 0, squares, 1.0)))


def solve_subproblem(
    problem: Problem,
    start: tuple[Active, Solve | None],
    centre: Point,
    slack: float,
    max_iter: int,
) -> Run:
    """Update the active set until it no longer changes (extensions 1 and 2 of `pdas`).

    start : active set, and the solution operator of its face, or None if this face has
        not been factorised
    slack : largest accepted relative errors of multiplier signs and of bounds
    """
    active, solve = start
    fewest, patience = np.inf, PATIENCE
    while True:
        if solve is None:
            problem.counts["factorisations"] += 1
            solve = problem.faces(active.side == 0, active.rows)
        at, g, trial = _newton(problem, active, centre, solve)
        problem.counts["solves"] += 1
        new = _predict(
            problem, active, Point(at.x, g, trial), max(slack, SIGN_ROUNDING)
        )
        changed = np.flatnonzero(
            np.concatenate([new.side != active.side, new.rows != active.rows])
        )
        if not changed.size or problem.counts["solves"] >= max_iter:
            return Run(active, solve, at, g, not changed.size)
        better = changed.size < fewest
        patience = PATIENCE if better else patience - 1
        fewest = min(fewest, changed.size)
        if patience < 0:
            problem.counts["exchanges"] += 1
            new, changed = _exchange(active, new, changed[-1]), changed[-1:]
        problem.counts["set_changes"] += changed.size
        active, solve = new, None


def _newton(
    problem: Problem, active: Active, centre: Point, solve: Solve
) -> tuple[Point, Vector, Vector]:
    """Take a Newton step on a face; return the point, gradient and z_k + σ(Gx − h)."""
    qp = problem.qp

    def evaluate(x: Vector) -> tuple[Point, Vector, Vector]:
        trial = centre.z + problem.sigma * (problem.G @ x - qp.h)
        y = centre.y + problem.rho * (problem.A @ x - qp.b)
        at = Point(x, y, np.where(active.rows, trial, 0.0))
        return at, problem.gradient(at, centre), trial

    x = np.where(active.side < 0, qp.lb, np.where(active.side > 0, qp.ub, centre.x))
    _, g, _ = evaluate(x)
    return evaluate(x - solve(g))


def _predict(problem: Problem, active: Active, at: Point, slack: float) -> Active:
    """Predict the active set from violated constraints and multiplier signs.

    Violations of bounds are measured in √D·x, whose unit is √energy. Therefore the
    result does not depend on the units of the variables.

    at : x (n,); the field `y` contains the gradient without the multipliers of bounds,
        and the field `z` contains the trial multipliers of all inequality rows
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
    push = at.z * row_norms(problem.G, problem.D)
    rows = np.where(active.rows, push >= -scale, push > scale)
    return Active(new, rows)


def _exchange(active: Active, new: Active, index: int) -> Active:
    """Return `active` with the state of a single constraint taken from `new`.

    index : i for the bounds of variable i < n, or n + i for row i of G
    """
    side, rows = active.side.copy(), active.rows.copy()
    if index < side.size:
        side[index] = new.side[index]
    else:
        rows[index - side.size] = new.rows[index - side.size]
    return Active(side, rows)
