"""QPs that mislead residuals, with solution and optimal value known exactly.

All numbers are dyadic, with few enough digits that the planted point satisfies the KKT
conditions of the QP as stored without any rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.qp import QP, Matrix, Vector
from harness.solution import Solution, Status

KINDS = (
    "columns", "rows", "far bounds", "redundant", "parallel", "singular", "cancelled",
    "tiny curvature", "big-M", "duplicates", "fixed", "free direction", "no cost",
)  #: what `hard` combines  # fmt: skip


@dataclass(frozen=True, eq=False)
class Planted:
    """A QP, a KKT point of it, and its optimal value."""

    qp: QP
    solution: Solution
    value: float


def hard(kinds: frozenset[str], seed: int) -> Planted:
    """Plant a QP of all the given kinds; 3 to 7 variables, at most 8 rows.

    columns, rows : scaled by up to 2^±26, about 1e±8
    far bounds : of 1e12, on every variable that has none
    redundant : rows that never bind, with entries from 1e-12 to 1e12
    parallel : an inequality row 2^-20 beside another one, both tight
    singular : P of half the rank
    cancelled : f* is 0, 2^-20 or 2^-36 where its terms are about 1
    tiny curvature : P times 2^-30
    big-M : a bound is held by a multiplier of 1e9
    duplicates : a variable twice, so that only the sum is determined
    fixed : a variable with equal bounds
    free direction : two variables that cost nothing, and only their difference matters
    no cost : q = 0, and the solution is nearest to the origin
    """
    rng = np.random.default_rng([seed, *sorted(KINDS.index(k) for k in kinds)])
    n, m, p = int(rng.integers(2, 6)), int(rng.integers(0, 3)), int(rng.integers(0, 4))
    M = rng.integers(-3, 4, (n, max(1, n // 2) if "singular" in kinds else n))
    P = M @ M.T + (0.0 if "singular" in kinds else 1.0) * np.eye(n)
    A = rng.integers(-3, 4, (m, n)).astype(float)
    G = rng.integers(-3, 4, (p, n)).astype(float)
    x = rng.integers(-16, 17, n) / 4.0
    y, z = rng.integers(-16, 17, m) / 4.0, rng.integers(1, 17, p) / 4.0
    slack = np.where(rng.random(p) < 0.5, rng.integers(1, 9, p) / 2.0, 0)
    z[slack > 0] = 0
    where = rng.integers(-1, 2, n)  # at lb, between, at ub
    z_box = where * rng.integers(1, 17, n) / 4.0
    near = rng.integers(1, 9, n) / 2.0
    has = rng.random((2, n)) < 0.5
    lb = np.where(where < 0, x, np.where(has[0], x - near, -np.inf))
    ub = np.where(where > 0, x, np.where(has[1], x + near, np.inf))
    if "tiny curvature" in kinds:
        P = P * 2.0**-30
    if "parallel" in kinds and p:
        near_row = G[0] + 2.0**-20 * rng.integers(-3, 4, n)
        G, slack = np.vstack([G, near_row]), np.append(slack, 0.0)
        z = np.append(z, rng.integers(0, 5) / 4.0)
    if "fixed" in kinds:
        lb[0] = ub[0] = x[0]
        z_box[0] = rng.integers(-16, 17) / 4.0
    if "big-M" in kinds:
        lb[-1], ub[-1], z_box[-1] = x[-1], np.inf, -1e9
        if rng.random() < 0.5:
            x[-1] = lb[-1] = 0.0
    if "duplicates" in kinds:
        P, A, G = _twice(_twice(P, 1), 0), _twice(A, 1), _twice(G, 1)
        x, where = np.append(x, 1.0), np.append(where, 0)
        x[0] -= 1.0
        lb, ub = (np.append(np.where(np.arange(v.size) == 0, s * np.inf, v), s * np.inf)
                  for v, s in ((lb, -1), (ub, 1)))  # fmt: skip
        z_box = np.append(np.where(np.arange(z_box.size) == 0, 0, z_box), 0.0)
    if "free direction" in kinds:
        t, k = rng.integers(-8, 9) / 2.0, x.size
        P = np.pad(P, (0, 2))
        link = np.zeros((2, k + 2))
        link[0, 0], link[:, k], link[:, k + 1] = 1, 1, -1
        A = np.vstack([np.pad(A, ((0, 0), (0, 2))), link])
        G, x = np.pad(G, ((0, 0), (0, 2))), np.concatenate([x, [t, t]])
        y = np.append(y, [1.0, -1.0])
        lb, ub = np.append(lb, [-np.inf] * 2), np.append(ub, [np.inf] * 2)
        z_box = np.append(z_box, [0.0, 0.0])
    if "redundant" in kinds:
        size = np.ldexp(1.0, rng.integers(-40, 41, 2))
        more = rng.integers(-3, 4, (2, x.size)) * size[:, None]
        G, z = np.vstack([G, more]), np.append(z, [0.0, 0.0])
        slack = np.append(slack, np.abs(more @ x) + np.maximum(1.0, size))
    if "far bounds" in kinds:
        lb, ub = np.where(np.isinf(lb), -1e12, lb), np.where(np.isinf(ub), 1e12, ub)
    b, h = A @ x, G @ x + slack
    if "no cost" in kinds:
        A = np.vstack([A, P @ x])
        y, b = np.append(0 * y, -1.0), np.append(b, x @ P @ x)
        z, z_box = 0 * z, 0 * z_box
    q = -(P @ x + A.T @ y + G.T @ z + z_box)
    if "cancelled" in kinds:  # a fixed variable of its own shifts the value
        aim = float(rng.choice([0.0, 2.0**-20, 2.0**-36]))
        shift = aim - (x @ P @ x / 2 + q @ x)
        P, A, G = np.pad(P, (0, 1)), *(np.pad(B, ((0, 0), (0, 1))) for B in (A, G))
        q, x, z_box = np.append(q, shift), np.append(x, 1.0), np.append(z_box, -shift)
        lb, ub = np.append(lb, 1.0), np.append(ub, 1.0)
    D, R, H = (
        np.ldexp(1.0, rng.integers(-26, 27, k) if kind in kinds else np.zeros(k, int))
        for kind, k in (("columns", x.size), ("rows", b.size), ("rows", h.size))
    )
    qp = QP(
        P=D[:, None] * P * D, q=D * q, A=R[:, None] * A * D, b=R * b,
        G=H[:, None] * G * D, h=H * h, lb=lb / D, ub=ub / D,
    )  # fmt: skip
    at = x / D
    s = Solution(status=Status.SOLVED, x=at, y=y / R, z=z / H, z_box=z_box * D)
    exact = at.astype(np.longdouble)
    return Planted(qp, s, float(exact @ (qp.P @ exact) / 2 + qp.q @ exact))


def _twice(M: Matrix, axis: int) -> Vector:
    """Repeat the first row or column at the end."""
    return np.concatenate([M, np.take(M, [0], axis)], axis)
