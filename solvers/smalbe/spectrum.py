"""The upper end of the spectrum of a symmetric positive semidefinite operator."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh_tridiagonal, eigvalsh_tridiagonal

from mortarbench.harness import Vector

FEW = 5  #: steps after which a flat spectrum shows
FLAT = 10.0  #: ratio of Ritz values of one size


class Ritz(NamedTuple):
    """Ritz pairs, in descending order of their values."""

    values: Vector  #: (k,)
    residuals: Vector  #: (k,) ‖Hv − θv‖: an eigenvalue lies that near to θ
    #: (k, n) orthonormal rows; (0, n) where the compiled process found no first pair
    vectors: NDArray[np.float64]
    at_start: float  #: vᵀHv/‖v‖² of the start vector

    @property
    def norm(self) -> float:
        """θ₁ and its residual: an upper bound for the eigenvalue that θ₁ approaches."""
        return float(self.values[0] + self.residuals[0])


@lru_cache(maxsize=8)
def random_start(n: int) -> Vector:
    """Draw the same vector (n,) every time: no answer may depend on luck."""
    start = np.random.default_rng(19640229).standard_normal(n)
    start.flags.writeable = False
    return start


def size(v: Vector) -> int:
    """Count the components of a vector; of one over ranks, those of all."""
    return int((np.zeros_like(v) + 1).sum())


def lanczos(H: Callable[[Vector], Vector], start: Vector, steps: int) -> Ritz:
    """Run `steps` Lanczos steps, one product each, fully reorthogonalised.

    What three terms leave is of the size of the next vector, so that one pass over all
    vectors makes it orthogonal to them to rounding. The residual of the pair (θ, Vᵀs)
    is |β s_k| with the last off-diagonal entry β. A start vector from an invariant
    subspace keeps the process there. It ends after FEW steps where all Ritz values are
    of one size: conjugate gradients need few steps there, and no model.
    """
    basis = np.zeros((min(steps, size(start)), start.size))
    diagonal: list[float] = []
    off: list[float] = []
    v, beta = start, float(np.linalg.norm(start))
    for k in range(len(basis) if beta else 0):
        basis[k] = v / beta
        v = H(basis[k])
        diagonal.append(float(basis[k] @ v))
        v = v - diagonal[-1] * basis[k]
        if k:
            v = v - beta * basis[k - 1]
        v = v - basis[: k + 1].T @ (basis[: k + 1] @ v)
        beta = float(np.linalg.norm(v))
        off.append(beta)
        if beta <= 1e-12 * max(map(abs, diagonal)):
            break
        if k + 1 == FEW:
            values = eigvalsh_tridiagonal(np.array(diagonal), np.array(off[:-1]))
            if values[0] >= values[-1] / FLAT:
                break
    if not diagonal:
        return Ritz(np.zeros(1), np.zeros(1), np.zeros((1, start.size)), 0.0)
    theta, S = eigh_tridiagonal(np.array(diagonal), np.array(off[:-1]))
    vectors = S.T @ basis[: len(theta)]
    residuals = off[-1] * np.abs(S[-1, ::-1])
    return Ritz(theta[::-1], residuals, vectors[::-1], diagonal[0])


def power_method(H: Callable[[Vector], Vector], n: int) -> float:
    """Estimate ‖H‖ as PERMON does: from ones, to 1e-4, at most 50 products.

    The Rayleigh quotient stays below ‖H‖; there is no safety factor.
    """
    v = np.full(n, 1 / np.sqrt(n))
    estimate = 0.0
    for _ in range(50):
        Hv = H(v)
        before, estimate = estimate, float(v @ Hv)
        size = float(np.linalg.norm(Hv))
        if size == 0 or abs(estimate - before) < 1e-4 * abs(estimate):
            break
        v = Hv / size
    return estimate
