"""Upper end of the spectrum of a symmetric positive semidefinite operator."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Vector


class Ritz(NamedTuple):
    """Ritz pairs, in descending order of their values."""

    values: Vector  #: (k,)
    #: (k,) ‖Hv − θv‖, an upper bound on the distance of θ from the nearest eigenvalue
    residuals: Vector
    #: (k, n) orthonormal rows; (0, n) if the first pair has not converged
    vectors: NDArray[np.float64]
    at_start: float  #: Rayleigh quotient of the start vector

    @property
    def norm(self) -> float:
        """Largest Ritz value plus its residual, used as an estimate of ‖H‖."""
        return float(self.values.item(0) + self.residuals.item(0))


@lru_cache(maxsize=8)
def random_start(n: int) -> Vector:
    """Return a random vector (n,) that depends only on n."""
    start = np.random.default_rng(19640229).standard_normal(n)
    start.flags.writeable = False
    return start
