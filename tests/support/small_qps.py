"""Points of small QPs as solutions, and their verdicts."""

import numpy as np

from mortarbench.harness import Solution, Status
from mortarbench.harness.verify.kkt import kkt_residuals, verdict


def at(x, y=(), z=(), z_box=None):
    """Return a claim of success at x with multipliers; z_box is zero by default."""
    x, y, z = (np.array(v, dtype=float) for v in (x, y, z))
    z_box = np.zeros(x.size) if z_box is None else np.array(z_box, dtype=float)
    return Solution(status=Status.SOLVED, x=x, y=y, z=z, z_box=z_box)


def judge(qp, s, tol=1e-8):
    """Return the verdict on a claim of success."""
    return verdict(Status.SOLVED, kkt_residuals(qp, s), tol)
