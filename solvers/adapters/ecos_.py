"""ECOS, an interior-point method for second-order cone programs.

Reference: A. Domahidi, E. Chu, S. Boyd, ECOS: an SOCP solver for embedded systems,
European Control Conference (2013) 3071-3076.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from scipy.sparse import block_array, csc_matrix

from mortarbench.harness import NO_SOLUTION, QP, About, Solution, Status, Vector
from mortarbench.solvers.common.conversion import (
    CONIC_SETS,
    ConicForm,
    check_positive,
    csc,
    dense,
    needs_dense,
    to_cone,
)
from mortarbench.solvers.common.stopping import relative_residual

CLAIMS = {
    0: Status.SOLVED,
    1: Status.INFEASIBLE,
    2: Status.UNBOUNDED,
    -1: Status.ITERATION_LIMIT,
}  #: claim for each exit flag; all other exit flags count as FAILED
PRIMAL = 1  #: exit flag with a certificate of infeasibility
#: eigenvalues of P that are at most this fraction of the largest one count as zero
RANK_TOLERANCE = 1e-14
#: Units of the corrections, relative to ‖x‖∞, four per decade. The adapter tries the
#: units in this order until the residual is at most tol, because the best unit depends
#: on the QP: ECOS breaks down near the optimum, at a residual that varies by two orders
#: of magnitude between neighbouring units.
CORRECTION_SIZES = tuple(10.0 ** -np.linspace(1, 4, 13))
#: largest KKT residual of a point that is reported as solved, relative to tol
CLAIM_FACTOR = 10.0


@dataclass(frozen=True)
class ECOS:
    """https://github.com/embotech/ecos.

    The adapter replaces ½xᵀPx = ½‖Lᵀx‖² by a second-order cone, and computes L from the
    eigenvalues and eigenvectors of P. A gap of tol permits errors of √tol in x. If a
    KKT residual exceeds tol, the adapter therefore calls ECOS again for corrections of
    x.
    """

    max_iter: int = 200

    accepts: ClassVar[tuple[type, ...]] = CONIC_SETS
    about: ClassVar[About] = About(
        title="ECOS",
        method="interior point",
        licence="GPL-3.0-only",
        package="ecos",
        linear_solver="sparse LDLᵀ, bundled, one factorisation per iteration",
        phases="eigenvalues of P (preparing); everything else (solving)",
        limits=("ECOS fails at tolerances below 1e-8.",),
    )

    def __post_init__(self) -> None:
        check_positive(max_iter=self.max_iter)

    def declines(self, qp: QP) -> str | None:
        return needs_dense(qp, 4)

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        import ecos

        form, P = to_cone(qp), dense(qp.P)
        values, vectors = np.linalg.eigh(P)
        has_curvature = values > RANK_TOLERANCE * values.max(initial=0.0)
        vectors, roots = vectors[:, has_curvature], np.sqrt(values[has_curvature])
        free = vectors.T @ qp.q / roots
        energy = 0.5 * (free @ free) or 1.0
        size = float(np.abs(vectors @ (free / roots)).max(initial=0.0)) or 1.0
        options = dict(
            feastol=tol, abstol=tol, reltol=tol, max_iters=self.max_iter, verbose=False
        )
        root = (vectors * roots).T / np.sqrt(energy)

        def correct(x: Vector, sigma: float) -> tuple[dict[str, Any], Vector, Vector]:
            """Compute a correction e; return the result, x + σe and row multipliers."""
            factor = energy * (sigma / size) ** 2
            cost = (P @ x + qp.q) * sigma / factor
            answer = _solve(
                ecos.solve,
                form,
                cost,
                root * size,
                (form.rhs - form.rows @ x) / sigma,
                options,
            )
            v = np.concatenate(
                [answer["y"], answer["z"][: form.rhs.size - form.equalities]]
            )
            return answer, x + sigma * answer["x"][:-1], v * factor / sigma

        def solve() -> Solution:
            answer, x, v = correct(np.zeros(qp.q.size), size)
            info = answer["info"]
            status = CLAIMS.get(info["exitFlag"], Status.FAILED)
            message, iterations = info["infostring"], info["iter"]
            if status in NO_SOLUTION:
                is_primal = info["exitFlag"] == PRIMAL
                ray = form.multipliers(v) if is_primal else {}
                return Solution.without_point(qp, status, message, **ray)
            best = Solution(status=status, x=x, **form.multipliers(v))
            largest, least = (
                np.abs(x).max(initial=0.0),
                relative_residual(qp, best, tol),
            )
            for relative in CORRECTION_SIZES if status is Status.SOLVED else ():
                if least <= tol or not largest:
                    break
                again, *refined = correct(x, relative * largest)
                iterations += again["info"]["iter"]
                point = replace(best, x=refined[0], **form.multipliers(refined[1]))
                if (residual := relative_residual(qp, point, tol)) < least:
                    best, x, least = point, refined[0], residual
            if status is Status.SOLVED and not least <= CLAIM_FACTOR * tol:
                status, message = Status.FAILED, "reduced accuracy"
            return replace(
                best,
                status=status,
                iterations=iterations,
                message=message,
                reported={"linear_solver": "ldl"},
            )

        return solve


def _solve(
    ecos: Callable[..., dict[str, Any]],
    form: ConicForm,
    cost: Vector,
    root: Vector,
    rhs: Vector,
    options: dict[str, Any],
) -> dict[str, Any]:
    """Minimise ½‖root·e‖² + costᵀe with ECOS, subject to rhs − Re in the cones.

    The constraint ½‖root·e‖² ≤ t is written as ‖(√2·root·e, t − 1)‖ ≤ t + 1.
    """
    m, n = form.equalities, cost.size
    t = csc_matrix(([-1.0, -1.0], ([0, 1], [0, 0])), shape=(2, 1))
    rows = csc(
        block_array([[form.rows[m:], None], [None, t], [csc(-np.sqrt(2) * root), None]])
    )
    equal = csc(block_array([[form.rows[:m], csc_matrix((m, 1))]])) if m else None
    answer = ecos(
        np.append(cost, 1.0),
        rows,
        np.concatenate([rhs[m:], [1.0, -1.0], np.zeros(len(root))]),
        dict(l=form.inequalities, q=[*form.cones.tolist(), 2 + len(root)]),
        equal,
        rhs[:m] if m else None,
        **options,
    )
    assert answer["x"].size == n + 1
    answer["y"] = answer["y"] if m else np.zeros(0)
    return answer
