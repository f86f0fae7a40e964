"""ProxQP, a proximal augmented Lagrangian method.

Reference: A. Bambade et al., PROX-QP: yet another quadratic programming solver for
robotics and beyond, Robotics: Science and Systems (2022).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from mortarbench.harness import (
    QP,
    About,
    Solution,
    Status,
    Vector,
    needs_matrices,
)
from mortarbench.solvers.common.adapter import SequenceAdapter, concluded
from mortarbench.solvers.common.conversion import (
    NEGLIGIBLE,
    check_choice,
    csc,
    dense,
    from_two_sided,
    has_bound,
    needs_dense,
    on_present_bounds,
    resolve_backend,
    two_sided,
)
from mortarbench.solvers.common.sequence import Session

CLAIMS = {
    "PROXQP_SOLVED": Status.SOLVED,
    "PROXQP_MAX_ITER_REACHED": Status.ITERATION_LIMIT,
    "PROXQP_PRIMAL_INFEASIBLE": Status.INFEASIBLE,
    "PROXQP_DUAL_INFEASIBLE": Status.UNBOUNDED,
    "PROXQP_SOLVED_CLOSEST_PRIMAL_FEASIBLE": Status.INFEASIBLE,
}  #: all other statuses count as FAILED
CERTIFICATE = 1e-8  #: tolerance of an infeasibility certificate


@dataclass(frozen=True)
class ProxQP(SequenceAdapter):
    """https://simple-robotics.github.io/proxsuite.

    ProxQP stops when the max norms of the primal and dual residuals are each below
    eps_abs + eps_rel·(their largest term). Therefore eps_rel = tol and eps_abs is
    negligible. The adapter enables the test of the duality gap, which is off by
    default. The default starting point of ProxQP solves the QP with every row as an
    equality. This point often passes all tests with negative multipliers (primal forms,
    tol ≥ 1e-4). The adapter starts from zero; negative multipliers then become rare,
    and ProxQP needs fewer iterations.

    ProxQP tests certificates of infeasibility in absolute terms. With the default
    tolerance of 1e-4, it claims that feasible QPs with multipliers of this size are
    infeasible. The adapter sets 1e-8, which avoids these claims, but some infeasible
    QPs then end at the iteration limit.
    """

    backend: Literal["auto", "dense", "sparse"] = "auto"  #: auto: dense if P is dense
    max_iter: int = 10_000

    about: ClassVar[About] = About(
        title="ProxQP",
        method="proximal augmented Lagrangian",
        licence="BSD-2-Clause",
        package="proxsuite",
        linear_solver="its own LDLᵀ, dense or sparse, updated when the active set "
        "changes",
        phases="equilibration, and symbolic analysis in the sparse backend "
        "(preparing); factorisation and iterations (solving)",
        sequence="`update` replaces vectors and keeps the equilibration; starts from "
        "the last point",
        limits=(
            "ProxQP does not test the signs of multipliers.",
            "At tol 1e-3, claimed points have residuals of 1e-2 to 2e-2 on duals with "
            "friction (greco/dual-bounds, beam-ring/steps=1/friction=tresca/bound=1e8/"
            "dual). At tol 1e-6 and 1e-9, all answers are verified.",
            "ProxQP has no time limit and does not release Python's GIL, so a solve "
            "can only be stopped by killing its process.",
        ),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("backend", self.backend, ("auto", "dense", "sparse"))

    def declines(self, qp: QP) -> str | None:
        as_dense = resolve_backend(self.backend, qp) == "dense"
        return needs_dense(qp, 4) if as_dense else needs_matrices(qp)

    def library(self) -> Any:
        from proxsuite import proxqp

        return proxqp.Settings()

    def _begin(self, qp: QP, tol: float) -> Session:
        from proxsuite import proxqp

        backend = resolve_backend(self.backend, qp)
        form = _Dense(qp) if backend == "dense" else _Sparse(qp)
        solver = form.new_solver(proxqp)
        settings = solver.settings
        self.tune(
            settings,
            eps_abs=NEGLIGIBLE,
            eps_duality_gap_abs=NEGLIGIBLE,
            eps_rel=tol,
            eps_duality_gap_rel=tol,
            check_duality_gap=True,
            compute_timings=True,
            eps_primal_inf=CERTIFICATE,
            eps_dual_inf=CERTIFICATE,
            initial_guess=proxqp.NO_INITIAL_GUESS,
            max_iter=self.max_iter,
        )
        form.initialise(solver)
        starts: list[Solution] = []

        def solve() -> Solution:
            if starts:
                settings.initial_guess = proxqp.WARM_START
                s = starts.pop()
                solver.solve(s.x, s.y, form.inequality_multipliers(s))
            else:
                solver.solve()
            r = solver.results
            return concluded(
                qp,
                CLAIMS.get(r.info.status.name, Status.FAILED),
                r.info.status.name,
                dict(y=np.array(r.y), **form.multipliers(np.array(r.z))),
                x=np.array(r.x),
                iterations=r.info.iter,
                counts={"iter_ext": r.info.iter_ext, "mu_updates": r.info.mu_updates},
                reported={
                    "linear_solver": f"{backend} ldl, updated",
                    "solve_seconds": r.info.solve_time / 1e6,
                },
            )

        def update(new: QP) -> None:
            settings.initial_guess = proxqp.WARM_START_WITH_PREVIOUS_RESULT
            solver.update(g=new.q, b=new.b, **form.sides(new))

        # `solve` of the dense backend takes x, y and z, but no multipliers of bounds
        takes_no_start = isinstance(form, _Dense) and form.has_box
        return Session(solve, update, None if takes_no_start else starts.append)


class _Dense:
    """Dense backend with bounds; the multipliers of bounds follow those of G rows."""

    def __init__(self, qp: QP) -> None:
        self.qp, self.has_box = qp, bool(has_bound(qp).any())

    def new_solver(self, proxqp: Any) -> Any:
        qp = self.qp
        return proxqp.dense.QP(qp.q.size, qp.b.size, qp.h.size, self.has_box)

    def initialise(self, solver: Any) -> None:
        qp = self.qp
        P, A, G = dense(qp.P), dense(qp.A), dense(qp.G)
        solver.init(P, qp.q, A, qp.b, G, **self.sides(qp))

    def sides(self, qp: QP) -> dict[str, Vector]:
        box = {"l_box": qp.lb, "u_box": qp.ub} if self.has_box else {}
        return {"l": np.full(qp.h.size, -np.inf), "u": qp.h, **box}

    def multipliers(self, v: Vector) -> dict[str, Any]:
        z, z_box = np.split(v, [self.qp.h.size])
        z_box = z_box if self.has_box else np.zeros(self.qp.q.size)
        return {"z": z, "z_box": on_present_bounds(self.qp, z_box)}

    def inequality_multipliers(self, s: Solution) -> Vector:
        return np.concatenate([s.z, s.z_box]) if self.has_box else s.z


class _Sparse:
    """Sparse backend, in which bounds become rows of the identity."""

    def __init__(self, qp: QP) -> None:
        self.qp = qp

    def new_solver(self, proxqp: Any) -> Any:
        self.rows = csc(two_sided(self.qp)[0][self.qp.b.size :])
        return proxqp.sparse.QP(self.qp.q.size, self.qp.b.size, self.rows.shape[0])

    def initialise(self, solver: Any) -> None:
        qp = self.qp
        solver.init(csc(qp.P), qp.q, csc(qp.A), qp.b, self.rows, **self.sides(qp))

    def sides(self, qp: QP) -> dict[str, Vector]:
        _, low, high = two_sided(qp)
        return {"l": low[qp.b.size :], "u": high[qp.b.size :]}

    def multipliers(self, v: Vector) -> dict[str, Any]:
        parts = from_two_sided(self.qp, np.concatenate([np.zeros(self.qp.b.size), v]))
        return {"z": parts["z"], "z_box": parts["z_box"]}

    def inequality_multipliers(self, s: Solution) -> Vector:
        return np.concatenate([s.z, s.z_box[has_bound(self.qp)]])


DENSE = ProxQP(backend="dense")
SPARSE = ProxQP(backend="sparse")
