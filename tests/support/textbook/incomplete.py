"""Incomplete Cholesky factorisation on the pattern of a matrix, as it is written."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Vector

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def order_of_elimination(P: Array) -> NDArray[np.intp]:
    """Return the order (n,): from both ends to the middle, if entries reach so little.

    Each end has half of the components. There is one end only where an entry is farther
    than n/4 from the diagonal.
    """
    n = len(P)
    i, j = np.nonzero(P)
    reach = np.abs(i - j).max(initial=0)
    half = n // 2 if n >= 4 * reach and n > 1 else n
    return np.r_[np.arange(half), np.arange(half, n)[::-1]]


def incomplete_inverse(P: Array, free: Mask, keep: float) -> Array:
    """Return M⁻¹ (n, n) of M ≈ P_FF, zero where a row or column is not free."""
    order = order_of_elimination(P)
    order = order[free[order]]
    L, D = incomplete_cholesky(P[np.ix_(order, order)], keep)
    inverse = np.zeros_like(P)
    inverse[np.ix_(order, order)] = np.linalg.inv((L * D) @ L.T)
    return inverse


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
