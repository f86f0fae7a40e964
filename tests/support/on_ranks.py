"""What tests/harness/processes/test_ranks.py runs on several ranks; prints JSON.

Run as ``mpiexec -n N python -m mpi4py on_ranks.py CASE…``.
"""

import json
import sys

import numpy as np
from mpi4py import MPI

import mortarbench as mb
from harness.distributed.vectors import DistributedVector, Ranks, distributed
from solvers.smalbe.solver import SMALBE
from solvers.smalbe.spectrum import lanczos

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
    """Reduce vectors whose values are known to all, and ask for what is refused."""
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


def operator(name, ranks):
    """Compare products with F, its rows and its preconditioners with one process's."""
    qp = mb.build(name).made.qp
    whole = qp.P.build()
    share = whole.share(qp, ranks)
    P, x = share.qp.P, np.random.default_rng(1).standard_normal(qp.q.size)
    own = P.halo.rows[P.halo.own]
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
    solved = share.whole(SMALBE().prepare(share.qp, TOL)())
    everywhere = ranks.comm.gather((worst, own.size, P.local.parts))
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
    ranks = Ranks(MPI.COMM_WORLD)
    found = {"vectors": vectors(ranks)}
    for name in sys.argv[1:]:
        found[name] = operator(name, ranks)
    if ranks.rank == 0:
        print(json.dumps(found, default=float))


if __name__ == "__main__":
    main()
