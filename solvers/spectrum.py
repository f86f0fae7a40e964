"""Norm of a symmetric operator from a short Lanczos process."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg import eigh_tridiagonal

from harness import Vector


def norm_estimate(H: Callable[[Vector], Vector], n: int, steps: int) -> float:
    """Estimate ‖H‖ of a symmetric positive semidefinite H (n, n), from above.

    The largest Ritz value θ after `steps` products bounds ‖H‖ from below; θ plus the
    residual norm of its Ritz vector is an upper bound for the eigenvalue it converges
    to, and with a random start, all but surely, for ‖H‖. Full reorthogonalisation:
    there are few vectors.
    """
    v = np.random.default_rng(19640229).standard_normal(n)
    basis = np.zeros((min(steps, n), n))
    diagonal: list[float] = []
    off: list[float] = []
    beta = float(np.linalg.norm(v))
    for k in range(len(basis)):
        basis[k] = v / beta
        v = H(basis[k])
        diagonal.append(float(basis[k] @ v))
        for _ in range(2):
            v = v - basis[: k + 1].T @ (basis[: k + 1] @ v)
        beta = float(np.linalg.norm(v))
        off.append(beta)
        if beta <= 1e-12 * max(map(abs, diagonal)):
            break
    theta, S = eigh_tridiagonal(np.array(diagonal), np.array(off[:-1]))
    return float(theta[-1] + off[-1] * abs(S[-1, -1]))
