"""Incomplete Cholesky factorisation on the pattern of a matrix, in textbook form."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Vector

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def incomplete_inverse(P: Array, free: Mask, keep: float) -> Array:
    """Return M⁻¹ (n, n) for M ≈ P_FF, with zero rows and columns off the free set."""
    face = np.ix_(free, free)
    L, D = incomplete_cholesky(P[face], keep)
    inverse = np.zeros_like(P)
    inverse[face] = np.linalg.inv((L * D) @ L.T)
    return inverse


def incomplete_cholesky(A: Array, keep: float) -> tuple[Array, Vector]:
    """Factorise A ≈ LDLᵀ (n, n), where L has the pattern of A; return L and D.

    Fill-in outside the pattern is multiplied by `keep` and added to the diagonal
    entries of its row and its column.
    """
    n = len(A)
    S, L, D = A.astype(float).copy(), np.eye(n), np.zeros(n)
    for j in range(n):
        D[j] = S[j, j]
        later = [i for i in range(j + 1, n) if A[i, j] != 0]
        for i in later:
            L[i, j] = S[i, j] / D[j]
        for i in later:
            for k in later:
                fill = L[i, j] * S[k, j]
                if i == k or A[i, k] != 0:
                    S[i, k] -= fill
                else:
                    S[i, i] -= keep * fill
    return L, D
