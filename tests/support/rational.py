"""Linear algebra in rational arithmetic, without rounding."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np


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


def rational(v: Any) -> Any:
    """Convert an array of doubles to an array of exactly equal fractions."""
    exact = np.empty(v.shape, dtype=object)
    exact.ravel()[:] = [Fraction(float(value)) for value in v.ravel()]
    return exact
