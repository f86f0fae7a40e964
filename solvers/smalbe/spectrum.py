"""The upper end of the spectrum of a symmetric positive semidefinite operator."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Vector


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
