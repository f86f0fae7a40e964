"""Feasibility of small QPs in rational arithmetic, and nearly infeasible QPs."""

from fractions import Fraction

import numpy as np

from mortarbench.harness import QP


def is_feasible(qp, relaxed=0):
    """Return True if the rows and bounds of a QP are feasible.

    Phase one of the simplex method with Bland's rule minimises the sum of artificial
    variables, with x = x⁺ − x⁻ and a slack for each inequality. All entries of the
    tableau are fractions.

    relaxed : relative relaxation of right-hand sides and bounds
    """
    n = qp.q.size
    A, G = (
        np.asarray(M.todense() if hasattr(M, "todense") else M) for M in (qp.A, qp.G)
    )
    lower, upper = np.isfinite(qp.lb), np.isfinite(qp.ub)
    above = np.vstack([G, np.eye(n)[upper], -np.eye(n)[lower]])
    rhs = np.concatenate([qp.b, qp.h, qp.ub[upper], -qp.lb[lower]])
    rows = np.vstack([A, above])
    if relaxed:
        rows, rhs = np.vstack([rows, -A]), np.concatenate([rhs, -qp.b])
    slack = np.eye(len(rows))[:, 0 if relaxed else len(A) :]
    exact = [
        [Fraction(float(v)) for v in line]
        for line in np.hstack([rows, -rows, slack, rhs[:, None]])
    ]
    for line in exact:
        line[-1] += Fraction(relaxed) * abs(line[-1])
    exact = [line if line[-1] >= 0 else [-v for v in line] for line in exact]
    width = len(exact[0]) - 1
    basis = list(range(width, width + len(rows)))
    cost = [-sum(line[j] for line in exact) for j in range(width + 1)]
    while True:
        entering = next((j for j in range(width) if cost[j] < 0), None)
        if entering is None:
            return cost[-1] == 0
        ratios = [
            (line[-1] / line[entering], basis[i], i)
            for i, line in enumerate(exact) if line[entering] > 0
        ]  # fmt: skip
        _, _, at = min(ratios)
        pivot = [v / exact[at][entering] for v in exact[at]]
        exact[at], basis[at] = pivot, entering
        for i, line in enumerate(exact):
            if i != at and line[entering]:
                exact[i] = [
                    v - line[entering] * p for v, p in zip(line, pivot, strict=True)
                ]
        cost = [v - cost[entering] * p for v, p in zip(cost, pivot, strict=True)]


def nearly_contradicting(rng):
    """Draw infeasible or nearly infeasible rows and bounds of up to six variables.

    Rows have integer or real entries or are linear combinations of other rows. The
    right-hand side is chosen such that a planted certificate is violated or satisfied
    by a gap, which is small in most cases. Rows and variables are scaled by powers of
    ten, single entries are disturbed in their last bits, and bounds are absent, active,
    close or huge.
    """
    n, m, p = rng.integers(1, 7), rng.integers(0, 4), rng.integers(1, 6)
    draw = rng.choice([
        lambda shape: rng.integers(-3, 4, shape).astype(float),
        lambda shape: rng.standard_normal(shape),
        lambda shape: rng.integers(-1, 2, shape) * 10.0 ** rng.integers(-3, 4, shape),
    ])  # fmt: skip
    M = draw((m + p, n))
    y = np.concatenate([rng.integers(-2, 3, m), rng.integers(0, 3, p)]).astype(float)
    free = rng.random() < 0.6
    if free and m + p > 1 and y[-1] > 0:  # the last row cancels the others
        M[-1] = -(y[:-1] @ M[:-1]) / y[-1]
    x = rng.integers(-3, 4, n).astype(float) * 10.0 ** rng.choice([0, 0, 3, 8])
    rhs = M @ x
    gap = rng.choice([0, 1e-15, 1e-12, 1e-8, 1e-4, 1]) * rng.choice([-1, 1])
    rhs[-1] += gap * max(np.abs(rhs[-1]), np.abs(M[-1]) @ np.abs(x), 1e-300)
    if rng.random() < 0.3:
        M[rng.integers(m + p), rng.integers(n)] *= 1 + rng.choice([-1, 1]) * 2.0**-52
    lb, ub = np.full(n, -np.inf), np.full(n, np.inf)
    for bound, sign in ((lb, -1), (ub, 1)):
        kind = rng.integers(0, 5, n)
        bound[kind == 1] = x[kind == 1]
        bound[kind == 2] = (x + sign)[kind == 2]
        bound[kind == 3] = sign * 1e12
        if free:
            bound[rng.random(n) < 0.7] = sign * np.inf
    row = 10.0 ** rng.choice([0, 0, -8, 8], m + p)
    column = (
        10.0 ** rng.choice([0, 0, 0, -8, 8, 4], n) if rng.random() < 0.4 else np.ones(n)
    )
    M, rhs = row[:, None] * M * column, row * rhs
    lb, ub = np.minimum(lb / column, ub / column), np.maximum(lb / column, ub / column)
    return QP(
        P=np.eye(n), q=np.ones(n), A=M[:m], b=rhs[:m], G=M[m:], h=rhs[m:], lb=lb, ub=ub,
    )  # fmt: skip
