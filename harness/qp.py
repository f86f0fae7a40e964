"""The convex quadratic program that every solver in this repository is handed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, issparse

Vector = NDArray[np.float64]
NEEDS_MATRICES = "needs explicit matrices"
Matrix = Any  #: (r, c) ndarray, scipy.sparse array, or (P only) LinearOperator


@dataclass(frozen=True, eq=False, kw_only=True)
class Structure:
    """What P = B K⁺ Bᵀ, the matrix of a dual, came from; in the dual's units."""

    K: Matrix  #: (N, N) sparse stiffness, positive semidefinite
    B: Matrix  #: (n, N) sparse constraint rows
    fixed: NDArray[np.int64]  #: components that K⁺ leaves at zero


@dataclass(frozen=True, eq=False, kw_only=True)
class QP:
    """A convex quadratic program.

    ::

        minimise    ½ xᵀP x + qᵀx
        subject to  A x = b          multiplier y
                    G x ≤ h          multiplier z ≥ 0
                    lb ≤ x ≤ ub      multiplier z_box, ≤ 0 at lb and ≥ 0 at ub

    so that at a solution  P x + q + Aᵀy + Gᵀz + z_box = 0  (qpsolvers' convention).

    Absent constraints have zero rows, absent bounds are ±inf; nothing is None. All
    arrays are made read-only: a solver that scales its input in place fails loudly.

    Raises
    ------
    ValueError
        When shapes disagree, bounds cross, or a vector holds NaN (or inf where none
        may be); the message gives what was got and what was expected.

    """

    P: Matrix  #: (n, n) symmetric positive semidefinite
    q: Vector  #: (n,)
    A: Matrix  #: (m, n)
    b: Vector  #: (m,)
    G: Matrix  #: (p, n)
    h: Vector  #: (p,)
    lb: Vector  #: (n,) may hold -inf
    ub: Vector  #: (n,) may hold +inf
    structure: Structure | None = None  #: what a solver may use and none must need

    def __post_init__(self) -> None:
        n, m, p = self.q.size, self.b.size, self.h.size
        expected = {
            "P": (n, n), "q": (n,), "A": (m, n), "b": (m,),
            "G": (p, n), "h": (p,), "lb": (n,), "ub": (n,),
        }  # fmt: skip
        for name, shape in expected.items():
            got = getattr(self, name).shape
            if got != shape:
                raise ValueError(f"QP.{name} has shape {got}, expected {shape}")
        for name in ("q", "b", "h"):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"QP.{name} holds NaN or inf, expected finite numbers")
        if not (self.lb < np.inf).all() or not (self.ub > -np.inf).all():
            raise ValueError("QP bounds hold NaN, lb = +inf or ub = -inf")
        if (self.lb > self.ub).any():
            raise ValueError("QP bounds cross: lb > ub in some component")
        for name in expected:
            _freeze(getattr(self, name))

    @property
    def is_explicit(self) -> bool:
        """Whether P is a matrix (dense or sparse), not an operator."""
        return isinstance(self.P, np.ndarray) or issparse(self.P)

    def diagonal(self) -> Vector | None:
        """Give Pᵢᵢ (n,); None where P is an operator that does not tell it."""
        if self.is_explicit:
            return np.asarray(self.P.diagonal(), dtype=float)
        if not hasattr(self.P, "diagonal"):
            return None
        told: Vector | None = self.P.diagonal()
        return told

    @property
    def sizes(self) -> dict[str, int]:
        """Variables, equality rows, inequality rows, finite bounds."""
        bounds = np.isfinite(self.lb).sum() + np.isfinite(self.ub).sum()
        return {
            "variables": self.q.size,
            "equalities": self.b.size,
            "inequalities": self.h.size,
            "bounds": int(bounds),
        }

    def objective(self, x: Vector) -> float:
        """Evaluate ½ xᵀP x + qᵀx."""
        return float(0.5 * x @ (self.P @ x) + self.q @ x)


def no_rows(n: int) -> Matrix:
    """Make the (0, n) matrix of an absent constraint block."""
    return csr_array((0, n))


def needs_matrices(qp: QP) -> str | None:
    """Give the reason to decline a `qp` whose P is an operator, else None.

    For `declines` of a solver that reads entries of P, and does not only multiply. A
    run that hears this reason multiplies a small P out, on the clock, and asks again.
    """
    return None if qp.is_explicit else NEEDS_MATRICES


def _freeze(M: Matrix) -> None:
    """Forbid writing to the buffers of a dense or sparse matrix."""
    buffers = [M] if isinstance(M, np.ndarray) else [getattr(M, "data", None)]
    for buffer in buffers:
        if isinstance(buffer, np.ndarray):
            buffer.flags.writeable = False
