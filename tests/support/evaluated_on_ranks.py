"""Program that tests/harness/verify/test_over_ranks.py runs on several ranks.

Run as ``mpiexec -n N python -m mpi4py evaluated_on_ranks.py CASE…``. The program prints
JSON.
"""

import json
import sys
import time
from dataclasses import replace

import numpy as np
from mpi4py import MPI

from mortarbench.harness import certify
from mortarbench.harness.distributed.vectors import Ranks
from mortarbench.harness.names import parse
from mortarbench.harness.verify.certificate import UncertifiableError
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.harness.verify.verdicts import evaluated_by_ranks, plain
from mortarbench.problems import PROBLEMS
from mortarbench.solvers.reference.over_ranks import reference_over_ranks
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe.solver import SMALBE

#: (tolerance, factor of the multipliers); the factor makes the last answer wrong by 1 %
WRONG = ((1e-4, 1.0), (1e-6, 1.0), (1e-6, 1.01))


def evaluated(name, ranks):
    """Evaluate answers on all ranks; rank 0 also returns the answers."""
    case_id = parse(name, PROBLEMS)
    emit = case_id.family.emission(case_id.form, case_id.params)
    emitted = emit(ranks, reference_over_ranks)
    digest = emitted.digest()
    alone = emit(Ranks(MPI.COMM_SELF), reference_over_ranks).digest()
    found = []
    for tol, wrong in WRONG:
        share = emitted.share()
        s = SMALBE().prepare(share.qp, tol)()
        s = replace(s, x=wrong * s.x)
        by_ranks = evaluated_by_ranks(emitted, s, ranks)
        bounds = by_ranks["bounds"] or {}
        same = ranks.comm.allgather(bounds.get("energy_bound"))
        told = {
            "by_ranks": by_ranks, "same": len(set(same)) == 1,
            "digests": [digest, alone], "sizes": emitted.sizes,
        }  # fmt: skip
        found.append((told, share.whole(s)))
    return found


def beside_one_process(name, found):
    """Yield the results for each answer, with its evaluation by a single process."""
    case = parse(name, PROBLEMS).build(reference_solution)
    for told, whole in found:
        one = {"objective": case.qp.objective(whole.x)}
        one |= kkt_residuals(case.qp, whole)._asdict()
        try:
            certificate = certify(case.mechanics, case.mechanics.to_primal(whole))
            bound, parts = certificate.bound, certificate.parts
        except UncertifiableError:
            bound, parts = np.nan, {}
        by_one = {
            "values": one, "bound": bound, "parts": parts,
            "quantities": plain(case.quantities(whole)),
        }  # fmt: skip
        yield told | {"by_one": by_one, "sizes": [told["sizes"], case.qp.sizes]}


def main():
    ranks = Ranks(MPI.COMM_WORLD)
    found = {name: evaluated(name, ranks) for name in sys.argv[1:]}
    if ranks.rank == 0:
        compared = {name: [*beside_one_process(name, f)] for name, f in found.items()}
        print(json.dumps(compared, default=float))
    done = ranks.comm.Ibarrier()
    while not done.Test():  # sleep while waiting, since MPI would use CPU time
        time.sleep(0.01)


if __name__ == "__main__":
    main()
