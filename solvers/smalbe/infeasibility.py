"""Proof that no point within the bounds satisfies the equality rows."""

from __future__ import annotations

import numpy as np

from mortarbench.harness import Vector
from mortarbench.solvers.smalbe.rows import Rows

#: finite value that replaces infinite bounds, relative to ‖x̃‖ + ‖ν‖; the proof applies
#: only to points within these finite bounds
SEARCH_RADIUS = 1e6
#: rounding of a sum of products, relative to the size of the terms
PRODUCT_ROUNDING = 1e-12


def infeasible(rows: Rows, bounds: tuple[Vector, Vector], nu: Vector) -> bool:
    """Return True if ν proves that no point ν' of the box satisfies Cν' = 0.

    With r = CᵀCν, every ν' with Cν' = 0 satisfies rᵀν' = 0. If the minimum of rᵀν' over
    the box is positive, the box therefore contains no ν' with Cν' = 0 (Farkas' lemma).
    Infinite bounds are replaced by finite bounds (`SEARCH_RADIUS`).
    """
    lower, upper = bounds
    Cnu = rows.C @ nu
    r = rows.C.T @ Cnu
    size = float(np.linalg.norm(rows.x_tilde)) + float(np.linalg.norm(nu))
    far = SEARCH_RADIUS * size
    ends = np.where(r > 0, lower, upper)
    box = np.where(np.isinf(ends), np.copysign(far, ends), ends)
    terms = float(np.linalg.norm(Cnu)) * size + float(np.abs(r * nu).sum())
    return float(r @ box) > PRODUCT_ROUNDING / rows.least_pivot * terms
