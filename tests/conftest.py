"""Shared generators of QPs whose solution is known by construction."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.sparse import csr_array

from harness import QP, Solution, Status

#: m equality and p inequality rows, which bounds, rank of P
PLANTED_SHAPES = {
    "bounds": dict(upper=False),
    "box": dict(),
    "free": dict(m=4, p=6, lower=False, upper=False),
    "equalities": dict(m=5, lower=False, upper=False),
    "inequalities": dict(p=8, lower=False, upper=False),
    "some bounds": dict(m=3, some=True, upper=False),
    "everything": dict(m=5, p=8, some=True),
    "singular": dict(m=3, p=4, rank=12),
}


@pytest.fixture
def planted() -> Callable[..., tuple[QP, Solution]]:
    """Factory: draw x*, multipliers and an active set; solve stationarity for q.

    ``planted(shape, seed=…, dense=False, n=20)`` gives a QP and a KKT point of it. It
    has matrices of order one, active constraints of every kind that the shape names
    and, but for "singular", one minimiser.
    """

    def draw(shape, *, seed=271828, dense=False, n=20):
        rng = np.random.default_rng(seed)
        return _plant(rng, n, np.asarray if dense else csr_array, PLANTED_SHAPES[shape])

    return draw


def _plant(rng, n, store, shape):
    m, p, rank = (shape.get(k, v) for k, v in (("m", 0), ("p", 0), ("rank", n)))
    lower, upper = shape.get("lower", True), shape.get("upper", True)
    M = rng.standard_normal((n, rank))
    P = M @ M.T / rank + (0.1 * np.eye(n) if rank == n else 0.0)
    A, G = rng.standard_normal((m, n)), rng.standard_normal((p, n))
    x = rng.standard_normal(n)
    y = rng.standard_normal(m)
    z = np.where(np.arange(p) % 2 == 0, 0.5 + rng.exponential(size=p), 0.0)
    # of four variables one is at its lower, one at its upper bound, two are inside
    at_lb = lower & (np.arange(n) % 4 == 0)
    at_ub = upper & (np.arange(n) % 4 == 1)
    bounded = np.arange(n) % 4 < 2 if shape.get("some") else np.full(n, True)
    z_box = (0.5 + rng.exponential(size=n)) * (at_ub * 1.0 - at_lb)
    qp = QP(
        P=store(P), q=-(P @ x + A.T @ y + G.T @ z + z_box),
        A=store(A), b=A @ x,
        G=store(G), h=G @ x + np.where(z > 0, 0.0, 1.0),
        lb=np.where(lower & bounded, np.where(at_lb, x, x - 1), -np.inf),
        ub=np.where(upper & bounded, np.where(at_ub, x, x + 1), np.inf),
    )  # fmt: skip
    return qp, Solution(status=Status.SOLVED, x=x, y=y, z=z, z_box=z_box)
