"""Reference solutions of contact problems, with certified error bounds.

An injected reference solver, which is not under test, solves the dual QP of the contact
and friction rows, unless this QP is too large (`_identified`). The solution of this QP
identifies the closed rows, which hold with equality: contacts that touch and friction
that sticks. `harness.verify.active_set_refinement` then computes the solution in
extended precision, and `harness.verify.certificate` bounds the error of this solution.
"""

from __future__ import annotations

import numpy as np

from mortarbench.harness.mechanics import Mechanics, Real
from mortarbench.harness.plugin import Reference
from mortarbench.harness.qp import QP, no_rows
from mortarbench.harness.verify.active_set_refinement import (
    ActiveSet,
    States,
    exchanged,
    predicted,
    unconstrained_guess,
)
from mortarbench.harness.verify.admissible import MAX_DENSE_ROWS
from mortarbench.harness.verify.certificate import (
    Certificate,
    UncertifiableError,
    proof,
)
from mortarbench.harness.verify.substructured import Split


class UnsolvedError(Exception):
    """Failure of the reference solve; the message is the reason."""


def reference_point(
    mechanics: Mechanics, solve: Reference
) -> tuple[Certificate, States]:
    """Solve the elastic problem of a case; return a certified solution and its states.

    The states (m,) of the rows are closed, or that the multiplier is at a bound.

    solve : solves the dual QP, min ½λᵀFλ − dᵀλ subject to RᵀBᵀλ = Rᵀf, λ ≥ 0 for
        contact and ‖λ‖ ≤ g for friction

    Raises
    ------
    UnsolvedError
        If no admissible pair is found, or `solve` fails.

    """
    mechanics = mechanics.whole
    u, lam, active = exchanged(mechanics, _identified(mechanics, solve))
    try:
        found = proof(Split(mechanics), u, u, lam, active.closed)
    except UncertifiableError as e:
        raise UnsolvedError(
            f"the reference solve found no admissible pair: {e}"
        ) from None
    return found, active.states


def _identified(mechanics: Mechanics, solve: Reference) -> ActiveSet:
    """Guess the states of the rows from the solution of the dual QP.

    The guess follows from the displacement without contact if there are no rows, or if
    supports fix all bodies and there are too many rows for a dense matrix.
    """
    inverse = mechanics.inverse
    R, exact = (
        mechanics.motions.constrained.toarray().astype(np.float64),
        mechanics.exact,
    )
    f, B = exact.f.astype(np.float64), mechanics.rows
    m = exact.c.size
    if not m or (m > MAX_DENSE_ROWS and not R.shape[1]):
        return unconstrained_guess(mechanics)
    qp = QP(
        P=inverse.congruence(B),
        q=exact.c.astype(np.float64) - B @ inverse(f),
        A=np.ascontiguousarray((B @ R).T) if R.shape[1] else no_rows(m),
        b=R.T @ f,
        G=no_rows(m),
        h=np.zeros(0),
        sets=exact.forces.sets,
    )
    try:
        s = solve(qp)
    except (ArithmeticError, ValueError, np.linalg.LinAlgError) as e:
        raise UnsolvedError(f"the reference solve failed: {e}") from None
    softness = np.maximum(qp.P.diagonal(), 0)
    return predicted(exact.forces, s.x.astype(Real), softness, s.z_box)
