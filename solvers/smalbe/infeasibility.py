"""Proof that no point within the bounds meets the equality rows."""

from __future__ import annotations

import numpy as np

from mortarbench.harness import Vector
from mortarbench.solvers.smalbe.rows import Rows

#: Radius that replaces infinite bounds, relative to ‖x̃‖ + ‖ν‖; the proof holds for
#: points within it.
SEARCH_RADIUS = 1e6
PRODUCT_ROUNDING = 1e-12  #: rounding of a sum of products, relative to its terms


def infeasible(rows: Rows, bounds: tuple[Vector, Vector], nu: Vector) -> bool:
    """Return True if ν proves that no point of the box satisfies Cν' = 0.

    By Farkas' lemma: with r = CᵀCν, each such ν' has rᵀν' = 0, so that none exists if
    the minimum of rᵀν' over the box is positive. Infinite bounds are replaced by
    SEARCH_RADIUS.
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
