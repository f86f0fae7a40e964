"""SCS, an operator-splitting method for conic programs.

Reference: B. O'Donoghue, Operator splitting for a homogeneous embedding of the linear
complementarity problem, SIAM J. Optim. 31 (2021) 1999-2023.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.sparse import triu

from mortarbench.harness import QP, About, Solution, Status, needs_matrices
from mortarbench.solvers.common.adapter import SequenceAdapter, concluded
from mortarbench.solvers.common.conversion import (
    CONIC_SETS,
    NEGLIGIBLE,
    check_choice,
    csc,
    to_cone,
)
from mortarbench.solvers.common.sequence import Session

CLAIMS = {
    1: Status.SOLVED,
    2: Status.ITERATION_LIMIT,  # inaccurate solution at the iteration limit
    -1: Status.UNBOUNDED,
    -2: Status.INFEASIBLE,
}  #: all other statuses count as FAILED
CERTIFICATE = 1e-9  #: tolerance of a certificate of infeasibility


@dataclass(frozen=True)
class SCS(SequenceAdapter):
    """https://www.cvxgrp.org/scs.

    SCS stops when the max norms of the primal and dual residuals and the duality gap
    are each below eps_abs + eps_rel·(their largest term). Therefore eps_rel = tol and
    eps_abs is negligible. SCS evaluates the test every 25 iterations. Discs and
    cones become second-order cones.
    """

    linear_solver: str = "auto"  #: "auto" (MKL Pardiso on Linux), "mkl" or "qdldl"
    max_iter: int = 1_000_000

    accepts: ClassVar[tuple[type, ...]] = CONIC_SETS
    about: ClassVar[About] = About(
        title="SCS",
        method="operator splitting (homogeneous embedding, Anderson acceleration)",
        licence="MIT; bundles Intel MKL",
        package="scs",
        linear_solver="bundled MKL Pardiso or QDLDL, one factorisation per change of "
        "scale",
        phases="equilibration and factorisation (preparing); iterations (solving)",
        sequence="`update` replaces vectors and keeps the factors; starts from the "
        "last point",
        limits=("SCS needs a constraint, because it rejects an empty cone.",),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("linear_solver", self.linear_solver, ("auto", "mkl", "qdldl"))
        if self.settings:  # SCS does not list its settings, but refuses unknown ones
            with suppress(ImportError):
                import scs

                data = dict(A=csc([[1.0]]), b=np.ones(1), c=np.ones(1))
                scs.SCS(data, {"l": 1}, **{"verbose": False, **self.settings})

    def declines(self, qp: QP) -> str | None:
        rows = ("equalities", "inequalities", "bounds")
        if len(qp.sets) == 1 and not any(qp.sizes[k] for k in rows):
            return "needs a constraint, because SCS rejects an empty cone"
        return needs_matrices(qp)

    def _begin(self, qp: QP, tol: float) -> Session:
        import scs

        form = to_cone(qp)
        solver = scs.SCS(
            dict(P=csc(triu(csc(qp.P))), A=form.rows, b=form.rhs, c=qp.q.copy()),
            dict(z=form.equalities, l=form.inequalities, q=form.cones.tolist()),
            linear_solver=scs.LinearSolver(self.linear_solver),
            **self.tuned(
                eps_abs=NEGLIGIBLE,
                eps_rel=tol,
                eps_infeas=CERTIFICATE,
                max_iters=self.max_iter,
                verbose=False,
            ),
        )
        starts: list[Solution] = []

        def solve() -> Solution:
            point = starts.pop() if starts else None
            x, y, s = form.point(point) if point else (None, None, None)
            r = solver.solve(warm_start=True, x=x, y=y, s=s)
            info = r["info"]
            return concluded(
                qp,
                CLAIMS.get(info["status_val"], Status.FAILED),
                info["status"],
                form.multipliers(r["y"]),
                x=r["x"],
                iterations=info["iter"],
                counts={
                    "scale_updates": info["scale_updates"],
                    "accelerated_steps": info["accepted_accel_steps"],
                },
                reported={
                    "linear_solver": info["lin_sys_solver"],
                    "setup_seconds": info["setup_time"] / 1000,
                    "solve_seconds": info["solve_time"] / 1000,
                },
            )

        def update(new: QP) -> None:
            solver.update(b=to_cone(new).rhs, c=new.q.copy())

        return Session(solve, update, starts.append)


QDLDL = SCS(linear_solver="qdldl")
