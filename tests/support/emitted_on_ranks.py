"""Compare distributed QPs with QPs of one process, and print differences as JSON.

Run as ``mpiexec -n N python -m mpi4py emitted_on_ranks.py CASE…``. The local parts of
the QP that the ranks emit are assembled and compared with the QP of one process.
"""

import json
import sys
import time

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_array

from mortarbench.harness.digest import hex_digest
from mortarbench.harness.distributed.vectors import Ranks
from mortarbench.harness.names import parse
from mortarbench.problems import PROBLEMS
from mortarbench.problems.duality.decomposed import decomposed_path
from mortarbench.problems.duality.problem import qp_choice
from mortarbench.problems.families.declared import ContactFamily
from mortarbench.problems.feti.subdomain_classes import SubdomainClass
from mortarbench.problems.feti.subdomains import LocalSubdomains, subdomains_of
from mortarbench.solvers.reference.operators import reference_of_operator
from mortarbench.solvers.reference.solve import reference_solution
from tests.support.decomposed_bodies import parts_of


def probe(n):
    """Return a random vector (n,) for test products."""
    return np.random.default_rng(3).standard_normal(n)


def emitted(name, ranks):
    """Emit the QP on all ranks; gather descriptions of the local parts on rank 0."""
    case = parse(name, PROBLEMS)
    made = case.family.emission("dual", case.params)(ranks, reference_of_operator)
    share = made.share().qp
    rows = share.P.halo.rows
    own = rows[share.P.halo.owned]
    mine = own_subdomains(name, ranks)
    B = share.P.local.B.tocoo()
    Fx, factorised = factorised_in(lambda: share.P @ probe(made.variables)[own])
    return ranks.comm.gather({
        "factorised": factorised,
        "formed": [
            class_digest(group.template, group.touched)
            for group in share.P.local.packed.groups if group.explicit
        ],
        "sizes": [made.variables, made.equality_rows],
        "B": (rows[B.row], B.col, B.data),
        "number": mine.number, "own": own,
        **{key: np.asarray(getattr(share, key)) for key in ("q", "lb", "ub")},
        "A": share.A.part, "b": share.b,
        "discs": [
            (own[i].tolist(), r)
            for one in share.sets[1:]
            for i, r in zip(one.index, np.asarray(one.radius), strict=True)
        ],
        "Fx": np.asarray(Fx),
        "component": mine.component,
    })  # fmt: skip


def own_subdomains(name, ranks):
    """Return the local subdomains of this rank for the problem of a case."""
    case = parse(name, PROBLEMS)
    if isinstance(case.family, ContactFamily):
        problem, choice = (
            case.family.contact_problem(case.params),
            qp_choice("dual", case.params),
        )
        path = decomposed_path(problem, choice, ranks, reference_of_operator)
        return path.problem(choice.step, choice.iterate).problem.dual.subdomains
    problem = parts_of(name)
    return LocalSubdomains(problem, ranks, subdomains_of(problem, ranks.size))


def class_digest(kind, touched):
    """Return a digest of the data that determine the blocks of a subdomain class."""
    return hex_digest((kind.K.data.tobytes(), touched.tobytes()))


def factorised_in(act):
    """Return the result of `act()`, and digests of the classes that it factorises."""
    factor, names = SubdomainClass.border_factor, []

    def recording(kind, touched):
        names.append(class_digest(kind, touched))
        return factor(kind, touched)

    SubdomainClass.border_factor = recording
    try:
        return act(), names
    finally:
        SubdomainClass.border_factor = factor


def compared(name, everyone):
    """Return the differences between the assembled QP and the QP of one process."""
    qp = parse(name, PROBLEMS).build(reference_solution).qp
    whole = qp.P.build()

    def joined(key, size):
        found = np.full(size, np.nan)
        for one in everyone:
            found[one["own"]] = one[key]
        return found

    def columns(number):
        starts = whole.domains.start
        return np.concatenate([np.arange(*starts[[s, s + 1]]) for s in number])

    row, column, value = map(
        np.concatenate,
        zip(
            *(
                (i, columns(e["number"])[j], v)
                for e in everyone
                for i, j, v in [e["B"]]
            ),
            strict=True,
        ),
    )
    B_whole = csr_array((value, (row, column)), shape=whole.B.shape)
    m, A = qp.q.size, csr_array(qp.A)
    return {
        "sizes": [everyone[0]["sizes"], [m, qp.b.size]],
        "owners": np.bincount(np.concatenate([e["own"] for e in everyone])).tolist(),
        "entries": [int(column.size), int(whole.B.nnz)],
        "factorised": [name for e in everyone for name in e["factorised"]],
        "formed": [name for e in everyone for name in e["formed"]],
        "torn": sum(e["component"].size for e in everyone) - int(whole.B.shape[1]),
        "bounds": [
            _bounds_off(joined(key, m), getattr(qp, key)) for key in ("lb", "ub")
        ],
        **_discs(everyone, qp),
        "errors": {
            "B": float(abs(B_whole - whole.B).max() / abs(whole.B).max()),
            "q": _off(joined("q", m), qp.q),
            "Fx": _off(joined("Fx", m), whole(probe(m))),
            "A": max(_largest(e["A"] - A[:, e["own"]]) for e in everyone)
            / max(_largest(A), 1e-300),
            "b": max(_off(e["b"], qp.b) for e in everyone),
        },
    }


def _discs(everyone, qp):
    """Return the components of all discs, and the relative error of their radii."""
    discs = sorted(disc for one in everyone for disc in one["discs"])
    known = sorted(
        (i.tolist(), r)
        for one in qp.sets[1:]
        for i, r in zip(one.index, one.radius, strict=True)
    )
    components = [[index for index, _ in some] for some in (discs, known)]
    radii = (np.array([r for _, r in some]) for some in (discs, known))
    return {"discs": components, "radii": _off(*radii) if discs else 0.0}


def _largest(M):
    """Return the largest absolute entry; 0 if no subdomain is floating."""
    return float(abs(M).max()) if M.shape[0] else 0.0


def _off(found, known):
    largest = np.abs(known).max(initial=0.0)
    return float(np.abs(found - known).max(initial=0.0) / max(largest, 1e-300))


def _bounds_off(found, known):
    """Return the relative error of finite bounds, or inf if infinite bounds differ."""
    finite = np.isfinite(known)
    if not np.array_equal(found[~finite], known[~finite]):
        return float("inf")
    return _off(found[finite], known[finite]) if finite.any() else 0.0


def main():
    ranks = Ranks(MPI.COMM_WORLD)
    shares = {name: emitted(name, ranks) for name in sys.argv[1:]}
    if ranks.rank == 0:
        print(json.dumps({name: compared(name, s) for name, s in shares.items()}))
    done = ranks.comm.Ibarrier()
    while not done.Test():  # sleep while waiting, since MPI would use CPU time
        time.sleep(0.01)


if __name__ == "__main__":
    main()
