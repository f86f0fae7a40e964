"""Small QPs, and points as solutions with verdicts."""

import numpy as np

from mortarbench.harness import QP, Solution, Status
from mortarbench.harness.verify.kkt import kkt_residuals, verdict


def at(x, y=(), z=(), z_box=None):
    """Return a claim of success at x with multipliers; z_box is zero by default."""
    x, y, z = (np.array(v, dtype=float) for v in (x, y, z))
    z_box = np.zeros(x.size) if z_box is None else np.array(z_box, dtype=float)
    return Solution(status=Status.SOLVED, x=x, y=y, z=z, z_box=z_box)


def judge(qp, s, tol=1e-8):
    """Return the verdict on a claim of success."""
    return verdict(Status.SOLVED, kkt_residuals(qp, s), tol)


def floating_dual(seed, n=30, r=3):
    """Draw the dual of a floating body: F of rank n − 2, λ ≥ 0 on the second half, and
    r rows Gλ = e.
    """
    rng = np.random.default_rng(seed)
    W = rng.standard_normal((n, n - 2))
    G, x = rng.standard_normal((r, n)), np.abs(rng.standard_normal(n))
    lb = np.where(np.arange(n) < n // 2, -np.inf, 0.0)
    return QP.from_arrays(W @ W.T / n, rng.standard_normal(n), A=G, b=G @ x, lb=lb)
