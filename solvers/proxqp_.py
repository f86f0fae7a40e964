"""ProxQP, a proximal augmented Lagrangian method.

Reference: A. Bambade et al., PROX-QP: yet another quadratic programming solver for
robotics and beyond, Robotics: Science and Systems (2022).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import eye_array, vstack

from harness import QP, Solution, Status, Vector
from solvers.conversion import (
    NEGLIGIBLE,
    csc,
    dense,
    needs_matrices,
    on_present_bounds,
    positive,
)

CLAIMS = {
    "PROXQP_SOLVED": Status.SOLVED,
    "PROXQP_MAX_ITER_REACHED": Status.ITERATION_LIMIT,
    "PROXQP_PRIMAL_INFEASIBLE": Status.INFEASIBLE,
    "PROXQP_DUAL_INFEASIBLE": Status.INFEASIBLE,
    "PROXQP_SOLVED_CLOSEST_PRIMAL_FEASIBLE": Status.INFEASIBLE,
}  #: anything else is FAILED
CERTIFICATE = 1e-8  #: tolerance of an infeasibility certificate


@dataclass(frozen=True)
class ProxQP:
    """https://simple-robotics.github.io/proxsuite.

    ProxQP stops when the max norms of the primal and dual residuals are below
    eps_abs + eps_rel·(their largest term), hence eps_rel = tol and a negligible
    eps_abs. The test of the duality gap, off by default, is on. No test of ProxQP looks
    at the sign of the multipliers, and its default first guess, which takes every row
    as an equality, often passes them all with negative ones (primal forms, tol ≥ 1e-4).
    Starting from zero makes that rare, if not impossible, and takes fewer iterations.

    Certificates of infeasibility are tested in absolute terms: at the default 1e-4
    ProxQP calls feasible QPs infeasible whose multipliers are of that size. At 1e-8 it
    does not, but ends at the iteration limit where others find a certificate.
    """

    backend: Literal["auto", "dense", "sparse"] = "auto"  #: auto: as P is stored
    max_iter: int = 10_000

    def __post_init__(self) -> None:
        positive(max_iter=self.max_iter)
        if self.backend not in ("auto", "dense", "sparse"):
            raise ValueError(
                f"backend = {self.backend!r}; expected 'auto', 'dense' or 'sparse'"
            )

    def declines(self, qp: QP) -> str | None:
        return needs_matrices(qp)

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        from proxsuite import proxqp

        as_dense = isinstance(qp.P, np.ndarray)
        if self.backend != "auto":
            as_dense = self.backend == "dense"
        solver = (_dense if as_dense else _sparse)(proxqp, qp)
        settings = solver.settings
        settings.eps_abs, settings.eps_rel = NEGLIGIBLE, tol
        settings.check_duality_gap = True
        settings.eps_duality_gap_abs, settings.eps_duality_gap_rel = NEGLIGIBLE, tol
        settings.eps_primal_inf = settings.eps_dual_inf = CERTIFICATE
        settings.initial_guess = proxqp.NO_INITIAL_GUESS
        settings.max_iter = self.max_iter

        def solve() -> Solution:
            solver.solve()
            r = solver.results
            status = CLAIMS.get(r.info.status.name, Status.FAILED)
            if status is Status.INFEASIBLE:
                return Solution.without_point(qp, status, r.info.status.name)
            z, z_box = np.split(np.array(r.z), [qp.h.size])
            return Solution(
                status=status,
                x=np.array(r.x), y=np.array(r.y), z=z, z_box=_full(qp, z_box),
                iterations=r.info.iter,
                counts={"iter_ext": r.info.iter_ext, "mu_updates": r.info.mu_updates},
                message=r.info.status.name,
            )  # fmt: skip

        return solve


def _dense(proxqp: Any, qp: QP) -> Any:
    """Set up the dense backend, which knows bounds."""
    boxed = bool(_boxed(qp).any())
    solver = proxqp.dense.QP(qp.q.size, qp.b.size, qp.h.size, boxed)
    box = {"l_box": qp.lb, "u_box": qp.ub} if boxed else {}
    solver.init(
        dense(qp.P), qp.q, dense(qp.A), qp.b,
        dense(qp.G), np.full(qp.h.size, -np.inf), qp.h, **box,
    )  # fmt: skip
    return solver


def _sparse(proxqp: Any, qp: QP) -> Any:
    """Set up the sparse backend, where bounds are rows of the identity."""
    boxed = _boxed(qp)
    eye = eye_array(qp.q.size, format="csr")[boxed]
    rows = csc(vstack([csc(qp.G), eye]))
    solver = proxqp.sparse.QP(qp.q.size, qp.b.size, rows.shape[0])
    solver.init(
        csc(qp.P), qp.q, csc(qp.A), qp.b, rows,
        np.concatenate([np.full(qp.h.size, -np.inf), qp.lb[boxed]]),
        np.concatenate([qp.h, qp.ub[boxed]]),
    )  # fmt: skip
    return solver


def _boxed(qp: QP) -> NDArray[np.bool_]:
    return np.isfinite(qp.lb) | np.isfinite(qp.ub)


def _full(qp: QP, z_box: Vector) -> Vector:
    """Spread multipliers of the bounded variables, or of all (n,), over all."""
    if z_box.size < qp.q.size:
        some, z_box = z_box, np.zeros(qp.q.size)
        z_box[_boxed(qp)] = some
    return on_present_bounds(qp, z_box)
