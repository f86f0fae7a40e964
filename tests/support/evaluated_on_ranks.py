"""Evaluation of answers on several ranks, compared with one process.

See programs_on_ranks.py.
"""

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
from mortarbench.solvers.reference.operators import reference_of_operator
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe.solver import SMALBE

#: (tolerance, factor of the multipliers); the factor makes the last answer wrong by 1 %
WRONG = ((1e-4, 1.0), (1e-6, 1.0), (1e-6, 1.01))


def evaluated(name, ranks):
    """Evaluate answers on all ranks; rank 0 also returns the answers."""
    case_id = parse(name, PROBLEMS)
    emit = case_id.family.emission(case_id.form, case_id.params)
    emitted = emit(ranks, reference_of_operator)
    digest = emitted.digest()
    alone = emit(Ranks(MPI.COMM_SELF), reference_of_operator).digest()
    found, solved = [], {}
    for tol, wrong in WRONG:
        share = emitted.share()
        if tol not in solved:
            solved[tol] = SMALBE().prepare(share.qp, tol)()
        s = replace(solved[tol], x=wrong * solved[tol].x)
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


def results(ranks, *names):
    """Evaluate answers to cases; only rank 0 returns the evaluations."""
    found = {name: evaluated(name, ranks) for name in names}
    if ranks.rank == 0:
        return {name: [*beside_one_process(name, f)] for name, f in found.items()}
    return None
