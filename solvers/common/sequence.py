"""Sequences of QPs with updates of solver objects and with warm starts."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mortarbench.harness import QP, Matrix, Solution
from mortarbench.solvers.common.conversion import same_cones


class Session(NamedTuple):
    """Operations on a library's solver object that was set up for one QP."""

    solve: Callable[[], Solution]
    #: replaces the vectors of the QP if `only_vectors_differ`; None if every QP needs a
    #: new session
    update: Callable[[QP], None] | None = None
    #: sets the starting point of the next solve; None if the library does not accept a
    #: starting point
    start: Callable[[Solution], None] | None = None


def chain(
    begin: Callable[[QP, float], Session], tol: float
) -> Callable[[QP], Callable[[], Solution]]:
    """Return the `prepare` function for a sequence of QPs with the tolerance `tol`.

    If the session has `update` and only vectors differ from the previous QP, the
    session is updated, and a library that supports warm starts continues from its last
    point. Otherwise `begin` creates a new session. The new session starts from the last
    point if the library accepts a starting point, and if the sizes, the bounded
    variables and the conic rows match.
    """
    session: Session | None = None
    session_qp: QP
    last: tuple[QP, Solution] | None = None

    def prepare(qp: QP) -> Callable[[], Solution]:
        nonlocal session, session_qp
        if (
            session is not None
            and session.update is not None
            and only_vectors_differ(session_qp, qp)
        ):
            session.update(qp)
        else:
            session = begin(qp, tol)
            if last is not None and session.start is not None and _fits(*last, qp):
                session.start(last[1])
        session_qp = qp
        solve_session = session.solve

        def solve() -> Solution:
            nonlocal last
            solution = solve_session()
            last = qp, solution
            return solution

        return solve

    return prepare


def only_vectors_differ(one: QP, other: QP) -> bool:
    """Return True if two QPs have equal matrices and bounds on the same variables.

    Lower and upper bounds are compared separately, and the matrices must be stored in
    the same way (dense or sparse). Discs and cones may differ only in the right-hand
    sides of their conic rows.
    """
    matrices = ((one.P, other.P), (one.A, other.A), (one.G, other.G))
    bounds = ((one.lb, other.lb), (one.ub, other.ub))
    return (
        all(_equal(*pair) for pair in matrices)
        and all(np.array_equal(np.isfinite(a), np.isfinite(b)) for a, b in bounds)
        and same_cones(one, other)
    )


def _equal(M: Matrix, N: Matrix) -> bool:
    if M.shape != N.shape or isinstance(M, np.ndarray) != isinstance(N, np.ndarray):
        return False
    if isinstance(M, np.ndarray):
        return np.array_equal(M, N)
    return bool((M != N).nnz == 0)


def _fits(earlier: QP, s: Solution, qp: QP) -> bool:
    """Return True if the point `s` of `earlier` can be a starting point for `qp`."""
    # if different variables are bounded in the two QPs, the rows and multipliers of the
    # two conic forms do not correspond
    return (
        s.mismatch(qp) is None
        and all(np.isfinite(v).all() for v in (s.x, s.y, s.z, s.z_box))
        and np.array_equal(np.isfinite(earlier.lb), np.isfinite(qp.lb))
        and np.array_equal(np.isfinite(earlier.ub), np.isfinite(qp.ub))
        and same_cones(earlier, qp)
    )
