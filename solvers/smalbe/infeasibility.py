"""Proof that no point within the bounds meets the equality rows."""

from __future__ import annotations

import numpy as np

from mortarbench.harness import Vector
from mortarbench.solvers.smalbe.rows import Rows

REACH = 1e6  #: how far to look for feasible points where there is no bound
NOISE = 1e-12  #: what rounding may leave in sums of products


def infeasible(rows: Rows, bounds: tuple[Vector, Vector], nu: Vector) -> bool:
    """Return whether no ν' within the bounds and REACH times its size has Cν' = 0.

    By Farkas: with r = CᵀCν, such a ν' has rᵀν' = 0, so none exists where the minimum
    of rᵀν' over the box is positive.
    """
    lower, upper = bounds
    Cnu = rows.C @ nu
    r = rows.C.T @ Cnu
    size = float(np.linalg.norm(rows.x_tilde)) + float(np.linalg.norm(nu))
    far = REACH * size
    ends = np.where(r > 0, lower, upper)
    box = np.where(np.isinf(ends), np.copysign(far, ends), ends)
    terms = float(np.linalg.norm(Cnu)) * size + float(np.abs(r * nu).sum())
    return float(r @ box) > NOISE / rows.least_pivot * terms
