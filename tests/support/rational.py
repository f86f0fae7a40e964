"""Linear algebra in rational arithmetic, without rounding."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
from scipy.sparse import csr_array


def solutions(M: Any, b: Any) -> Callable[[Any], Any] | None:
    """Solve Mx = b by Gauss-Jordan elimination; return None if no solution exists.

    M, b : arrays of fractions

    Returns
    -------
    a function that maps a guess (n,) to the solution (n,) that agrees with the guess in
    all unknowns without a pivot

    """
    rows, pivots = np.column_stack([M, b]), list[int]()
    for column in range(M.shape[1]):
        at = len(pivots)
        below = np.flatnonzero(rows[at:, column] != 0)
        if not below.size:
            continue
        rows[[at, at + below[0]]] = rows[[at + below[0], at]]
        rows[at] = rows[at] / rows[at, column]
        for i in np.flatnonzero(rows[:, column] != 0):
            if i != at:
                rows[i] = rows[i] - rows[i, column] * rows[at]
        pivots.append(column)
    if (rows[len(pivots) :, -1] != 0).any():
        return None
    free = np.setdiff1d(np.arange(M.shape[1]), pivots)
    solved = rows[: len(pivots)]

    def solution(guess: Any) -> Any:
        x = guess.copy()
        x[pivots] = solved[:, -1] - solved[:, free] @ guess[free]
        return x

    return solution


def nonnegative_solution(M: Any, b: Any) -> Any | None:
    """Return w ≥ 0 with Mw = b by the simplex method, or None if no such w exists.

    Phase one of the method minimises the sum of artificial variables, one per row.
    Bland's rule (1977) selects the first column with a negative cost and, among the
    binding rows, the row whose basic variable has the lowest index. With this rule, no
    basis recurs, and the method terminates even if steps are degenerate.

    M, b : arrays of fractions
    """
    rows = np.column_stack([M, b])
    rows = np.where(rows[:, -1:] < 0, -rows, rows)
    n = M.shape[1]
    basis = n + np.arange(len(rows))
    cost = -rows.sum(axis=0)
    while (gains := np.flatnonzero(cost[:-1] < 0)).size:
        column = gains[0]
        binding = np.flatnonzero(rows[:, column] > 0)
        ratios = rows[binding, -1] / rows[binding, column]
        at = min(binding[ratios == ratios.min()], key=lambda i: basis[i])
        rows[at] = rows[at] / rows[at, column]
        basis[at] = column
        for i in np.flatnonzero(rows[:, column] != 0):
            if i != at:
                rows[i] = rows[i] - rows[i, column] * rows[at]
        cost = cost - cost[column] * rows[at]
    if cost[-1] != 0:
        return None
    w = np.full(n, Fraction(0), dtype=object)
    w[basis[basis < n]] = rows[basis < n, -1]
    return w


def rational(v: Any) -> Any:
    """Convert an array of doubles to an array of exactly equal fractions."""
    exact = np.empty(v.shape, dtype=object)
    exact.ravel()[:] = [Fraction(float(value)) for value in v.ravel()]
    return exact


def rational_product(M: csr_array, w: Any) -> Any:
    """Evaluate Mᵀw (n,) for doubles M (k, n) and fractions w (k,)."""
    total = np.full(M.shape[1], Fraction(0), dtype=object)
    at = M.tocoo()
    for i, j, a in zip(at.row.tolist(), at.col.tolist(), at.data.tolist(), strict=True):
        if w[i]:
            total[j] += Fraction(a) * w[i]
    return total
