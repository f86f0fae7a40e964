"""What tests/problems/feti/test_emission.py runs on several ranks; prints JSON.

Run as ``mpiexec -n N python -m mpi4py emitted_on_ranks.py CASE…``. The shares that
ranks emit are put together here, and compared with the QP that one process emits.
"""

import json
import sys

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_array

import mortarbench as mb
from harness.distributed.vectors import Ranks
from problems.feti.emission import OwnSubdomains, subdomains_of
from solvers.reference.over_ranks import reference_over_ranks


def compared(name, ranks):
    """Tell how far the shares are from the QP of one process, part by part."""
    case = mb.build(name)
    made = case.id.family.emission("dual", case.params)(ranks, reference_over_ranks)
    problem = case.id.family.in_subdomains(case.params)
    share, qp = made.share().qp, case.qp
    whole, rows = qp.P.build(), share.P.halo.rows
    own = rows[share.P.halo.own]

    mine = OwnSubdomains(problem, ranks, subdomains_of(problem, ranks.size))
    number = mine.number
    columns = np.concatenate(
        [np.arange(*whole.domains.start[[s, s + 1]]) for s in number]
    )
    B, x = share.P.local.B.tocoo(), np.random.default_rng(3).standard_normal(qp.q.size)
    told = {
        "B": (rows[B.row], columns[B.col], B.data),
        "own": own,
        **{key: np.asarray(getattr(share, key)) for key in ("q", "lb", "ub")},
        "A": share.A.part, "b": share.b,
        "Fx": np.asarray(share.P @ x[own]),
        "component": mine.component,
    }  # fmt: skip
    everyone = ranks.comm.gather(told)
    if everyone is None:
        return None

    def joined(key, size):
        found = np.full(size, np.nan)
        for one in everyone:
            found[one["own"]] = one[key]
        return found

    row, column, value = map(
        np.concatenate, zip(*(e["B"] for e in everyone), strict=True)
    )
    B_whole = csr_array((value, (row, column)), shape=whole.B.shape)
    m, A = qp.q.size, csr_array(qp.A)
    return {
        "sizes": [[made.variables, made.equality_rows], [m, qp.b.size]],
        "owners": np.bincount(np.concatenate([e["own"] for e in everyone])).tolist(),
        "entries": [int(column.size), int(whole.B.nnz)],
        "torn": sum(e["component"].size for e in everyone) - int(whole.B.shape[1]),
        "bounds": [
            _bounds_off(joined(key, m), getattr(qp, key)) for key in ("lb", "ub")
        ],
        "errors": {
            "B": float(abs(B_whole - whole.B).max() / abs(whole.B).max()),
            "q": _off(joined("q", m), qp.q),
            "Fx": _off(joined("Fx", m), whole(x)),
            "A": max(_largest(e["A"] - A[:, e["own"]]) for e in everyone)
            / max(_largest(A), 1e-300),
            "b": max(_off(e["b"], qp.b) for e in everyone),
        },
    }


def _largest(M):
    """Return the largest size of an entry; 0 where no subdomain floats."""
    return float(abs(M).max()) if M.shape[0] else 0.0


def _off(found, known):
    largest = np.abs(known).max(initial=0.0)
    return float(np.abs(found - known).max(initial=0.0) / max(largest, 1e-300))


def _bounds_off(found, known):
    """Compare what is finite; infinite if that is not the same of both."""
    finite = np.isfinite(known)
    if not np.array_equal(found[~finite], known[~finite]):
        return float("inf")
    return _off(found[finite], known[finite]) if finite.any() else 0.0


def main():
    ranks = Ranks(MPI.COMM_WORLD)
    found = {name: compared(name, ranks) for name in sys.argv[1:]}
    if ranks.rank == 0:
        print(json.dumps(found))


if __name__ == "__main__":
    main()
