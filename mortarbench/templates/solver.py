"""Template for a QP solver: replace `iterates` with your method or a library call.

    mortarbench test-solver NAME --plugin NAME.py
    mortarbench solve beam-ring/Nr=4/Nh=3/dual --solver NAME --plugin NAME.py

A solver receives the QP

    minimise ½xᵀPx + qᵀx   subject to   Ax = b,  Gx ≤ h,  lb ≤ x ≤ ub,

in which absent constraints have no rows and absent bounds are ±inf. It returns x and
multipliers y, z and z_box with

    Px + q + Aᵀy + Gᵀz + z_box = 0,   z ≥ 0,

where z_box ≤ 0 at active lower bounds, z_box ≥ 0 at active upper bounds and z_box = 0
otherwise. The harness verifies every answer independently.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from mortarbench.harness import (
    QP,
    Solution,
    Status,
    Vector,
    needs_matrices,
)


@dataclass(frozen=True)
class Solver:
    """Dense interior-point method with Mehrotra's predictor-corrector steps."""

    max_iter: int = 100  #: each field is an option of the solver: --option max_iter=50

    def __post_init__(self) -> None:
        if self.max_iter < 1:
            raise ValueError(f"max_iter = {self.max_iter}; expected at least 1")

    def declines(self, qp: QP) -> str | None:
        """Return the reason why this solver cannot solve `qp`, or None if it can."""
        if reason := needs_matrices(qp):  # P may be an operator without a matrix
            return reason
        return "takes at most 2000 variables" if qp.q.size > 2000 else None

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        """Convert the QP; return a function that solves it. Both steps are timed."""
        P, A, G = (
            M if isinstance(M, np.ndarray) else M.toarray() for M in (qp.P, qp.A, qp.G)
        )
        # write Gx ≤ h and the finite bounds as one system Cx ≤ d
        up, low, eye = np.isfinite(qp.ub), np.isfinite(qp.lb), np.eye(qp.q.size)
        C = np.vstack([G, eye[up], -eye[low]])
        d = np.concatenate([qp.h, qp.ub[up], -qp.lb[low]])

        def answer(status: Status, x: Vector, y: Vector, z: Vector, k: int) -> Solution:
            z_rows, z_ub, z_lb = np.split(z, [qp.h.size, qp.h.size + up.sum()])
            z_box = np.zeros(qp.q.size)
            z_box[up] += z_ub
            z_box[low] -= z_lb
            return Solution(
                status=status,
                x=x,
                y=y,
                z=z_rows,
                z_box=z_box,
                iterations=k,
                message=""
                if status is Status.SOLVED
                else f"not converged after {k} iterations",
            )

        def solve() -> Solution:
            try:
                for k, point in enumerate(iterates(P, qp.q, A, qp.b, C, d)):
                    if relative_residual(P, qp.q, A, qp.b, C, d, *point) <= tol:
                        return answer(Status.SOLVED, *point, k)
                    if k == self.max_iter:
                        break
            except (ArithmeticError, np.linalg.LinAlgError) as e:
                message = f"the iterates diverge ({e}); the QP may have no solution"
                return Solution.without_point(qp, Status.FAILED, message)
            return answer(Status.ITERATION_LIMIT, *point, k)

        return solve


def iterates(
    P: Vector, q: Vector, A: Vector, b: Vector, C: Vector, d: Vector
) -> Iterator[tuple[Vector, Vector, Vector]]:
    """Yield the iterates x, y, z for the constraints Ax = b and Cx + s = d, s ≥ 0.

    Here s are slack variables, and y and z the multipliers of the two constraints.
    Reference: J. Nocedal, S. J. Wright, Numerical Optimization (2006), algorithm 16.4.
    """
    p = d.size
    x, y = solve_kkt(P, A, C, np.ones(p), C.T @ d - q, b)
    gap = d - C @ x
    # The initial slacks and multipliers have the magnitude of the data, so that the
    # starting point scales with the units.
    s = np.maximum(gap, np.abs(gap).max(initial=0.0) or 1.0)
    z = np.full(p, np.abs(q).max(initial=0.0) or 1.0)

    def newton(r_z: Vector) -> tuple[Vector, Vector, Vector, Vector]:
        """Return the Newton step dx, dy, ds, dz, for which z ds + s dz = −r_z."""
        r_x, r_y, r_s = P @ x + q + A.T @ y + C.T @ z, A @ x - b, C @ x + s - d
        dx, dy = solve_kkt(P, A, C, z / s, C.T @ ((r_z - z * r_s) / s) - r_x, -r_y)
        ds = -r_s - C @ dx
        return dx, dy, ds, -(r_z + z * ds) / s

    while True:
        yield x, y, z
        dx, dy, ds, dz = newton(s * z)
        step = 1.0
        if p:
            step = min(1.0, max_step(s, ds), max_step(z, dz))
            sigma = ((s + step * ds) @ (z + step * dz) / (s @ z)) ** 3
            dx, dy, ds, dz = newton(s * z + ds * dz - sigma * (s @ z) / p)
            step = min(1.0, 0.995 * max_step(s, ds), 0.995 * max_step(z, dz))
        x, y, s, z = x + step * dx, y + step * dy, s + step * ds, z + step * dz


def relative_residual(
    P: Vector, q: Vector, A: Vector, b: Vector, C: Vector, d: Vector, *point: Vector
) -> float:
    """Return the largest residual of the KKT conditions, relative to its terms."""
    x, y, z = point
    Px, forces = P @ x, A.T @ y + C.T @ z
    energies = x @ Px, q @ x, b @ y + d @ z
    left = np.concatenate([A @ x - b, np.maximum(C @ x - d, 0)])

    def relative(error: float, *terms: Vector) -> float:
        size = max(float(np.abs(v).max(initial=0.0)) for v in terms)
        return error / size if error else 0.0

    return max(
        relative(np.abs(left).max(initial=0.0), A @ x, b, C @ x, d),
        relative(np.abs(Px + q + forces).max(), Px, q),
        relative(abs(float(sum(energies))), *map(np.atleast_1d, energies[:2])),
    )


def solve_kkt(
    P: Vector, A: Vector, C: Vector, weights: Vector, right: Vector, b: Vector
) -> tuple[Vector, Vector]:
    """Solve (P + Cᵀ diag(weights) C) x + Aᵀy = right, Ax = b, with regularisation."""
    m, n = A.shape
    K = np.block([[P + C.T @ (weights[:, None] * C), A.T], [A, np.zeros((m, m))]])
    size = np.abs(P).max(initial=0.0) or 1.0
    K += 1e-12 * np.diag(np.append(np.full(n, size), np.full(m, -1 / size)))
    x, y = np.split(np.linalg.solve(K, np.append(right, b)), [n])
    return x, y


def max_step(v: Vector, dv: Vector) -> float:
    """Return the longest step, at most 100, with v + step·dv ≥ 0."""
    return float((-v[dv < 0] / dv[dv < 0]).min(initial=100.0))


SOLVERS = {"NAME": Solver()}
