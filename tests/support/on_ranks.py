"""Program that tests/harness/processes/test_ranks.py runs on several ranks.

Run as ``mpiexec -n N python -m mpi4py on_ranks.py CASE…``. The program prints JSON.
"""

import json
import sys
from functools import partial

import numpy as np
from scipy.sparse import csc_array

import mortarbench as mb
from mortarbench.harness.distributed import factor
from mortarbench.harness.distributed.factor import (
    DependentRowsError,
    local_factor,
    touched_rows,
)
from mortarbench.harness.distributed.vectors import (
    DistributedVector,
    Ranks,
    distributed,
)
from mortarbench.solvers.smalbe.driver import outer_loop
from mortarbench.solvers.smalbe.projected import by_lanczos, projected_problem
from mortarbench.solvers.smalbe.solver import SMALBE
from tests.support.textbook.projected import lanczos

TOL = 1e-8
REFUSED = {
    "sort": np.sort,
    "median": np.median,
    "mean": lambda v: v.mean(),
    "argmin": lambda v: v.argmin(),
    "cumsum": lambda v: v.cumsum(),
    "stack": lambda v: np.stack([v, v]),
    "prod": lambda v: v.prod(),
    "add.at": lambda v: np.add.at(v, [0], 1.0),
}


def vectors(ranks):
    """Compare reductions of vectors with known values, and test refused operations."""
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((2, 101))
    C = rng.standard_normal((3, 101))
    ends = np.linspace(0, 101, ranks.size + 1).astype(int)
    own = slice(ends[ranks.rank], ends[ranks.rank + 1])
    v, w = distributed(a[own], ranks), distributed(b[own], ranks)
    positive = v > 0
    few = np.array_split(np.arange(1.0, 6.0), ranks.size)[ranks.rank]
    ritz = lanczos(
        lambda x: distributed(few * x, ranks), distributed(np.ones_like(few), ranks), 9
    )
    pairs = {
        "dot": (v @ w, a @ b),
        "method": (v.dot(w), a @ b),
        "norm": (np.linalg.norm(v), np.linalg.norm(a)),
        "sum": ((2 * v + w).sum(), (2 * a + b).sum()),
        "min": (v[positive].min(initial=np.inf), a[a > 0].min()),
        "max": (v.max(), a.max()),
        "any": ((v > a.max() - 1e-12).any(), True),
        "all": ((v > 0).all(), False),
        "count": (np.count_nonzero(positive), np.count_nonzero(a > 0)),
        "matrix": (np.abs(C[:, own] @ v - C @ a).max(), 0.0),
        "where": (np.where(positive, v, 0.0).sum(), a[a > 0].sum()),
        "least Ritz value": (ritz.values[-1], 1.0),
        "largest Ritz value": (ritz.values[0], 5.0),
        "clip": (np.clip(v, -1, 1).sum(), np.clip(a, -1, 1).sum()),
    }
    answered = []
    for name, ask in REFUSED.items():
        try:
            ask(v)
        except TypeError:
            continue
        answered.append(name)
    kept = all(
        type(x) is DistributedVector
        for x in (v + w, np.where(positive, v, 0.0), np.clip(v, -1, 1), v[positive])
    )
    return {"pairs": pairs, "answered": answered, "kept": kept}


def refined_solution(M, t):
    """Solve M y = t, with residuals in extended precision."""
    y = np.linalg.solve(M, t).astype(np.longdouble)
    for _ in range(3):
        r = t - M.astype(np.longdouble) @ y
        y += np.linalg.solve(M, r.astype(float))
    return y.astype(float)


def factors(ranks):
    """Factorise a sum of known matrices, and a matrix that is singular on rank 0 only.

    Row i of G has columns on rank i mod P of the P ranks and, if i is divisible by 3,
    also on the next rank.
    """
    rng, r, size = np.random.default_rng(3), 24, ranks.size
    i = np.arange(r)
    here = [
        (i % size == p) | ((i % 3 == 0) & ((i + 1) % size == p)) for p in range(size)
    ]
    G = [rng.standard_normal((r, 40)) * mine[:, None] / 6 for mine in here]
    t, s = rng.standard_normal((2, r))
    rows = touched_rows(np.flatnonzero(here[ranks.rank]), ranks)
    k = rows.rows
    part = csc_array((G[ranks.rank] @ G[ranks.rank].T)[np.ix_(k, k)])
    local = local_factor(part, rows, (k % 2 == 0) & ~rows.is_shared)
    border = [np.isin(i, b)[:, None] for b in ranks.comm.allgather(k[local.border])]
    held = [g[:, ::5] * on for g, on in zip(G, border, strict=True)]
    own = held[ranks.rank][k[local.border]]
    A, less = (sum(g @ g.T for g in parts) for parts in (G, held))
    errors = []
    full = local.completed()
    for whole, M in ((full, A), (full.shifted(0.5, own @ own.T), 1.5 * A - less)):
        a, b = (whole.forward(rows.additive(v[k])) for v in (t, s))
        y = refined_solution(M, t)
        errors += [
            np.abs(whole(rows.additive(t[k])) - y[k]).max(),
            np.abs(whole.backward(a) - y[k]).max(),
            abs(a @ b - s @ y),
            abs(rows.additive(s[k]) @ whole.backward(a) - s @ y),
            abs(a @ a - t @ y),
        ]
    bad = part.toarray()
    if ranks.rank == 0:
        row = np.flatnonzero(~rows.is_shared)[0]
        bad[row], bad[:, row] = 0, 0
    try:
        local_factor(csc_array(bad), rows)
        refused = False
    except DependentRowsError:
        refused = True
    return ranks.comm.gather((max(map(float, errors)), refused, rows.shared.tolist()))


def projected(qp, most):
    """Project and solve in a face, with `factor.MAX_FILL` = `most`."""
    kept, factor.MAX_FILL = factor.MAX_FILL, most
    problem = projected_problem(qp, partial(by_lanczos, steps=3))
    factor.MAX_FILL = kept
    rows, loop = problem.rows, outer_loop(problem, qp, SMALBE(preconditioner="model"))
    v = qp.q + rows.x_tilde
    free = np.isinf(qp.lb) | (v > 0)
    z = loop.solver.precondition(free, v, 100.0)
    return np.asarray(rows.project(v) + z + rows.C.T @ rows.fitted(free, v))


def operator(name, ranks):
    """Compare F, its rows and its preconditioners with the results of one process."""
    qp = mb.build(name).family_case.qp
    whole = qp.P.build()
    share = whole.share(qp, ranks)
    P, x = share.qp.P, np.random.default_rng(1).standard_normal(qp.q.size)
    own = P.halo.rows[P.halo.owned]
    errors = {
        "product": (P @ x[own], whole(x)[own]),
        "diagonal": (P.diagonal(), whole.diagonal()[own]),
        "rows": (share.qp.A @ distributed(x[own], ranks), qp.A @ x),
    }
    for kind in ("lumped", "dirichlet"):
        for scaling in ("multiplicity", "stiffness"):
            mine = P.preconditioner(kind, scaling)(x[own])
            errors[kind, scaling] = mine, whole.preconditioner(kind, scaling)(x)[own]
    worst = {
        str(k): float(np.abs(np.asarray(a) - b).max() / np.abs(b).max())
        for k, (a, b) in errors.items()
    }
    by_rank, alike = projected(share.qp, factor.MAX_FILL), projected(share.qp, 0)
    worst["coarse"] = float(np.abs(by_rank - alike).max() / np.abs(alike).max())
    solved = share.whole(SMALBE().prepare(share.qp, TOL)())
    everywhere = ranks.comm.gather((worst, own.size, P.local.domains.class_of.size))
    if solved is None:
        return None
    alone = SMALBE().prepare(qp, TOL)()
    lb, at = qp.lb, np.isfinite(qp.lb)
    return {
        "errors": [one[0] for one in everywhere],
        "rows": [one[1] for one in everywhere],
        "subdomains": [one[2] for one in everywhere],
        "size": qp.q.size,
        "status": [solved.status, alone.status],
        "steps": [solved.iterations, alone.iterations],
        "difference": float(np.abs(solved.x - alone.x).max() / np.abs(alone.x).max()),
        "same_active": bool(
            ((solved.x[at] <= lb[at]) == (alone.x[at] <= lb[at])).all()
        ),
    }


def main():
    from mpi4py import MPI  # imported here, because ranks as threads do not need it

    ranks = Ranks(MPI.COMM_WORLD)
    found = {"vectors": vectors(ranks), "factors": factors(ranks)}
    for name in sys.argv[1:]:
        found[name] = operator(name, ranks)
    if ranks.rank == 0:
        print(json.dumps(found, default=float))


if __name__ == "__main__":
    main()
