"""Sequences of QPs: what a solver carries from one to the next."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mortarbench.harness import QP, Matrix, Solution


class Session(NamedTuple):
    """A solver that holds one QP, through the calls that its library offers."""

    solve: Callable[[], Solution]
    #: take over the vectors of a QP with the same matrices and the same bounds present
    update: Callable[[QP], None]
    #: start the next solve from the point of an earlier QP of the same shape
    start: Callable[[Solution], None] | None = None
    #: solve to another tolerance from now on
    tighten: Callable[[float], None] | None = None


def in_sequence(
    begin: Callable[[QP], Session],
) -> Callable[[QP], Callable[[], Solution]]:
    """Make the `prepare` of a chain, whose one tolerance `begin` knows."""
    prepare = tightening(lambda qp, tol: begin(qp))
    return lambda qp: prepare(qp, 0.0)


def tightening(
    begin: Callable[[QP, float], Session],
) -> Callable[[QP, float], Callable[[], Solution]]:
    """Make the `prepare` of a sequence: update where only vectors changed, or rebuild.

    After a rebuild the last point is where the new session starts, if it has one of
    the right shape. (A session that was updated starts where it ended, if its library
    can.) A session that takes no other tolerance is rebuilt for it.
    """
    held: Session | None = None
    last: tuple[QP, Solution] | None = None
    of: tuple[QP, float] | None = None

    def prepare(qp: QP, tol: float) -> Callable[[], Solution]:
        nonlocal held, of
        if held is not None and of is not None and _goes_on(held, *of, qp, tol):
            held.update(qp)
            if held.tighten is not None:
                held.tighten(tol)
        else:
            held = begin(qp, tol)
            if last is not None and held.start is not None and _fits(*last, qp):
                held.start(last[1])
        of = qp, tol
        session = held

        def solve() -> Solution:
            nonlocal last
            solution = session.solve()
            last = qp, solution
            return solution

        return solve

    return prepare


def _goes_on(held: Session, of: QP, at: float, qp: QP, tol: float) -> bool:
    """Whether a session that holds `of` to the tolerance `at` can take the next QP."""
    return (at == tol or held.tighten is not None) and only_vectors_differ(of, qp)


def only_vectors_differ(one: QP, other: QP) -> bool:
    """Whether two QPs have the same matrices, and bounds at the same places."""
    matrices = ((one.P, other.P), (one.A, other.A), (one.G, other.G))
    bounds = ((one.lb, other.lb), (one.ub, other.ub))
    return all(_equal(*pair) for pair in matrices) and all(
        np.array_equal(np.isfinite(a), np.isfinite(b)) for a, b in bounds
    )


def _equal(M: Matrix, N: Matrix) -> bool:
    if M.shape != N.shape or isinstance(M, np.ndarray) != isinstance(N, np.ndarray):
        return False
    if isinstance(M, np.ndarray):
        return np.array_equal(M, N)
    return bool((M != N).nnz == 0)


def _fits(earlier: QP, s: Solution, qp: QP) -> bool:
    """Whether a point is finite and has the shape of `qp`, bounds included."""
    return (
        s.mismatch(qp) is None
        and all(np.isfinite(v).all() for v in (s.x, s.y, s.z, s.z_box))
        and np.array_equal(np.isfinite(earlier.lb), np.isfinite(qp.lb))
        and np.array_equal(np.isfinite(earlier.ub), np.isfinite(qp.ub))
    )
