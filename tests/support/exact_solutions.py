"""Solutions of stored contact problems in integers, and errors in the energy norm.

A number is an integer times 2^−BITS, so that data and sums are exact, and products are
truncated at 2^−BITS. The KKT equations for a guessed set of closed rows are solved by
elimination in extended precision. Exact residuals refine the solution until it changes
by less than 2^−FINE. Then the signs of all multipliers, gaps and slips are checked.
Only the guess of the closed rows uses the code under test, and the check detects a
wrong guess.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from math import isqrt, ldexp
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from mortarbench.harness import Case, Mechanics, Solution, Status
from mortarbench.harness.mechanics import Exact, Extended, Real
from mortarbench.harness.verify.admissible import closing
from mortarbench.harness.verify.certificate import Certificate, proof, suggested
from mortarbench.harness.verify.substructured import Split
from mortarbench.solvers.reference.solve import reference_solution

BITS = 500  #: number of bits after the binary point
FINE = 330  #: number of correct bits after refinement, relative to the largest unknown
#: States of a row: multiplier at its lower bound, row closed, or at its upper bound
LOWER, CLOSED, UPPER = -1, 0, 1
Integers = NDArray[np.object_]
States = NDArray[np.int64]  # (m,) state of each row


def integers(v: Any) -> Integers:
    """Return v (double or extended precision) times 2^BITS, truncated to integers."""
    v = np.asarray(v)
    high = v.astype(np.float64)
    low = (v - high).astype(np.float64)
    found = np.empty(v.shape, dtype=object)
    flat = found.reshape(-1)
    for k, (a, b) in enumerate(zip(high.ravel(), low.ravel(), strict=True)):
        flat[k] = _integer(a) + _integer(b)
    return found


def _integer(a: float) -> int:
    top, bottom = float(a).as_integer_ratio()
    return (top << BITS) // bottom


def _float(x: int, bits: int = BITS) -> float:
    """Return x·2^−bits, rounded."""
    drop = max(x.bit_length() - 64, 0)
    return ldexp(float(x >> drop), drop - bits)


class Rows:
    """A sparse matrix of doubles, for exact products with integers."""

    def __init__(self, M: Any) -> None:
        M = M.tocsr().copy()
        M.eliminate_zeros()
        self._start, self._at = M.indptr, M.indices
        self._entries = integers(M.data)

    def __matmul__(self, x: Integers) -> Integers:
        """Return M x, rounded down to multiples of 2^−BITS."""
        terms = self._entries * x[self._at]
        sums = np.zeros(len(self._start) - 1, dtype=object)
        for i, (a, b) in enumerate(zip(self._start[:-1], self._start[1:], strict=True)):
            sums[i] = sum(terms[a:b]) >> BITS
        return sums


class UnsettledError(Exception):
    """Failure to find an exact solution of the stored problem."""


@dataclass(frozen=True, eq=False)
class ExactSolution:
    """The solution of an undivided problem with the stored K, f, B and c."""

    mechanics: Mechanics
    u: Integers  #: (n,)
    multipliers: Integers  #: (m,)

    @cached_property
    def _K(self) -> Rows:
        return Rows(self.mechanics.primal.P)

    @cached_property
    def _R(self) -> tuple[Integers, list[list[Fraction]]]:
        """Rigid motions (n, r), and the inverse of RᵀR."""
        R = integers(np.asarray(self.mechanics.motions.all.toarray()))
        gram = [[Fraction(sum(a * b)) for b in R.T] for a in R.T]
        return R, _inverse(gram)

    def without_motion(self, v: Integers) -> Integers:
        """Return v (n,) without its rigid motions."""
        R, inverse = self._R
        along = [Fraction(sum(r * v)) for r in R.T]
        for r, row in zip(R.T, inverse, strict=True):
            alpha = sum(a * b for a, b in zip(row, along, strict=True))
            v = v - ((r * round(alpha * 2**BITS)) >> BITS)
        return v

    def length(self, v: Integers) -> float:
        """Return the energy norm √(vᵀKv) of v (n,) without its rigid motion."""
        v = self.without_motion(v)
        square = int(sum(v * (self._K @ v)))  # at scale 2^−2BITS
        return _float(isqrt(max(square, 0)))

    def error(self, u: Any) -> float:
        """Return ‖u − u*‖ for u (n,) in double or extended precision."""
        return self.length(integers(u) - self.u)

    @cached_property
    def norm(self) -> float:
        """Energy norm ‖u*‖."""
        return self.length(self.u)

    def answer(self) -> Solution:
        """Return u and λ in double precision, in the form of `Mechanics.to_primal`."""
        m = self.mechanics
        u, lam = (np.array([_float(x) for x in v]) for v in (self.u, self.multipliers))
        contact = m.primal.h.size
        z = np.zeros(contact + m.friction.bound.size)
        z[:contact], z[contact:][m.friction.bound > 0] = lam[:contact], lam[contact:]
        none = np.zeros(0)
        return Solution(status=Status.SOLVED, x=u, y=none, z=z, z_box=0 * u)

    def exceeded(self, found: Certificate, s: Solution, u: Any) -> tuple[float, float]:
        """Return the larger relative error of û (n,) and s, and its ratio to the bound.

        The bound on the relative error may be infinite while the bound on the absolute
        error is finite.
        """
        error = max(self.error(s.x), self.error(u))
        within = min(found.error, found.bound * self.norm)
        return error / self.norm, error / within if error else 0.0


def refined_point(case: Case) -> tuple[Certificate, States]:
    """Return the solution in extended precision, with its bound, and the row states."""
    assert case.mechanics is not None
    mechanics = case.mechanics.whole
    exact, s = mechanics.exact, mechanics.to_primal(reference_solution(case.qp))
    lam = mechanics.multipliers(s).astype(Real)
    lam, closed = suggested(exact, s.x.astype(Real), exact.forces.project(lam))
    states = np.where(closed, CLOSED, np.where(lam > 0, UPPER, LOWER))
    R, close = mechanics.motions.constrained, closing(mechanics, closed)
    elastic, alpha = 0 * exact.f, np.zeros(R.shape[1], dtype=Real)
    for _ in range(10):
        pull = exact.f - exact.B.T @ lam
        for _ in range(3):
            r = pull - mechanics.motions.KR @ alpha - mechanics.stiffness @ elastic
            r[exact.fixed] = 0
            elastic = elastic + mechanics.apply_inverse(mechanics.motions.without(r))
        u = elastic + R @ alpha
        force = R.T @ pull - mechanics.motions.KR.T @ u
        excess = (exact.B @ u - exact.c)[closed]
        mu, further = close(excess.astype(np.float64), force.astype(np.float64))
        lam[closed] += mu
        alpha = alpha + further
    return proof(Split(mechanics), u, u, lam, closed), states


def exact_solution(case: Case) -> ExactSolution:
    """Solve the stored problem; fix rigid motions that closed rows do not prevent.

    Raises
    ------
    UnsettledError
        If twelve exchanges do not yield closed rows that satisfy all conditions, or the
        refinement does not converge.

    """
    near, states = refined_point(case)
    assert case.mechanics is not None
    mechanics = case.mechanics.whole
    pinned = near.u
    for _ in range(12):
        u, lam = _given(mechanics, states, pinned)
        wrong = _exchanged(mechanics, states, u, lam)
        if (wrong == states).all():
            return ExactSolution(mechanics, u, lam)
        states = wrong
    raise UnsettledError("closed rows do not settle")


def _given(
    mechanics: Mechanics, states: States, pinned: Any
) -> tuple[Integers, Integers]:
    """Solve for u and λ with equality on the closed rows."""
    exact, primal = mechanics.exact, mechanics.primal
    K, B = primal.P.toarray(), mechanics.rows.toarray()
    lower, upper = _limits(exact)
    free, closed = np.setdiff1d(np.arange(len(K)), exact.fixed), states == CLOSED
    lam = np.where(states == LOWER, lower, np.where(states == UPPER, upper, 0))
    rows = B[closed][:, free]
    kernel = mechanics.motions.all.toarray().astype(np.float64)[free]
    loose = _loose(rows, kernel)
    rows = np.vstack([rows, loose.T])
    A = np.block(
        [[K[np.ix_(free, free)], rows.T], [rows, np.zeros(2 * rows.shape[:1])]]
    )
    slip = integers(lam)
    force = integers(-primal.q) - Rows(mechanics.rows.T) @ slip
    at = integers(loose.T @ pinned[free].astype(np.float64))
    right = np.concatenate([force[free], integers(exact.c[closed]), at])
    x = _solve(A, right)
    u = np.zeros(len(K), dtype=object)
    u[free] = x[: free.size]
    slip[closed] = x[free.size :][: closed.sum()]
    return u, slip


def _exchanged(
    mechanics: Mechanics, states: States, u: Integers, lam: Integers
) -> States:
    """Return the states after an exchange of the rows that violate a condition.

    Values below about 2^(60 − FINE) times the largest number count as zero.
    """
    exact = mechanics.exact
    v = Rows(mechanics.rows) @ u - integers(exact.c)
    zero_v = max(abs(x) for x in u) >> (FINE - 60) if u.size else 0
    zero = max((abs(x) for x in lam), default=0) >> (FINE - 60)
    bounded = ~exact.contact
    least, most = _limits(exact)
    lower, upper = integers(least), np.zeros(lam.size, dtype=object)
    upper[bounded] = integers(most[bounded])
    found = states.copy()
    for i, state in enumerate(states):
        if state == CLOSED:
            if lam[i] < lower[i] - zero:
                found[i] = LOWER
            elif bounded[i] and lam[i] > upper[i] + zero:
                found[i] = UPPER
        elif (state == LOWER and v[i] > zero_v) or (state == UPPER and v[i] < -zero_v):
            found[i] = CLOSED
    return found


def _limits(exact: Exact) -> tuple[Any, Any]:
    """Return the bounds (m,) of the multipliers, each with all others zero."""
    discs, upper = exact.forces.discs, np.full(exact.c.size, np.inf)
    upper[discs.index] = discs.radius[:, None]
    return np.where(exact.contact, 0, -upper), upper


def _solve(A: NDArray[np.float64], b: Integers) -> Integers:
    """Solve Ax = b (n,) with FINE correct bits."""
    scale, scaled = np.ones(len(b)), A.copy()
    for _ in range(20):
        by = 2.0 ** np.round(0.5 * np.log2(np.abs(scaled).max(axis=1)))
        scale, scaled = scale / by, scaled / by[:, None] / by
    factor, order = _eliminated(scaled.astype(Real))
    exact, x = Rows(csr_array(A)), np.zeros(len(b), dtype=object)
    for _ in range(120):
        r = b - exact @ x
        largest = max(abs(v) for v in r)
        if not largest:
            break
        unit = largest.bit_length()
        left = np.array([_float(v, unit) for v in r]).astype(Real) * scale
        step = _substituted(factor, left[order]) * scale
        whole = np.array([
            _integer(float(s)) >> (BITS - unit) if unit < BITS
            else _integer(float(s)) << (unit - BITS) for s in step
        ], dtype=object)  # fmt: skip
        x = x + whole
        if max(abs(v) for v in whole) <= max(abs(v) for v in x) >> FINE:
            return x
    raise UnsettledError("refinement does not converge")


def _loose(rows: NDArray[np.float64], R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rigid motions (range of R) that lie in the kernel of the rows."""
    _, sizes, turn = np.linalg.svd(rows @ R)
    count = int((sizes > 1e-9 * sizes.max(initial=0.0)).sum())
    return np.asarray(R @ turn[count:].T)


def _eliminated(A: Extended) -> tuple[Extended, NDArray[np.int64]]:
    order = np.arange(len(A))
    for k in range(len(A)):
        pivot = k + int(np.abs(A[k:, k]).argmax())
        A[[k, pivot]], order[[k, pivot]] = A[[pivot, k]], order[[pivot, k]]
        A[k + 1 :, k] /= A[k, k]
        A[k + 1 :, k + 1 :] -= np.outer(A[k + 1 :, k], A[k, k + 1 :])
    return A, order


def _substituted(factor: Extended, b: Extended) -> Extended:
    x = b.copy()
    for k in range(len(x)):
        x[k + 1 :] -= factor[k + 1 :, k] * x[k]
    for k in reversed(range(len(x))):
        x[k] /= factor[k, k]
        x[:k] -= factor[:k, k] * x[k]
    return x


def _inverse(M: list[list[Fraction]]) -> list[list[Fraction]]:
    """Invert a small matrix (r, r)."""
    r = len(M)
    rows = [row + [Fraction(int(i == j)) for j in range(r)] for i, row in enumerate(M)]
    for k in range(r):
        rows[k] = [x / rows[k][k] for x in rows[k]]
        for i in range(r):
            if i != k:
                rows[i] = [
                    a - rows[i][k] * b for a, b in zip(rows[i], rows[k], strict=True)
                ]
    return [row[r:] for row in rows]
