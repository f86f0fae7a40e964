"""Incomplete Cholesky factorisation on the pattern of a matrix, as it is written."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Vector

Array = NDArray[np.float64]


def incomplete_cholesky(A: Array, keep: float) -> tuple[Array, Vector]:
    """Factorise A ≈ LDLᵀ (n, n) with L zero where A is; returns L and D.

    What elimination would put elsewhere goes to the diagonal entries of its row and its
    column, times `keep`.
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
