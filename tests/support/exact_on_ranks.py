"""Certify disturbed exact solutions on several ranks, and print the results as JSON.

Run as ``mpiexec -n N python -m mpi4py exact_on_ranks.py COUNT CASE…``. The first rank
builds the undivided problem and solves it exactly.
"""

import json
import sys

import numpy as np
from mpi4py import MPI

from mortarbench.harness.distributed.vectors import Ranks
from mortarbench.harness.mechanics import Real
from mortarbench.harness.verify.over_ranks import certify_over_ranks
from tests.support.disturbed import disturbed
from tests.support.exact_solutions import exact_solution
from tests.support.fooled_on_ranks import problem_and_build, problem_of

ROUNDED = 1 + 1e-9
SHARP = (1e-7, 0.1)


def certified(name, count, ranks):
    """Return faults, and ratios of bound to error for errors within `SHARP`.

    Both lists are empty on ranks other than the first.
    """
    problem, build = problem_and_build(f"{name}/dual")
    mechanics = build().mechanics if ranks.rank == 0 else None
    exact = exact_solution(mechanics) if ranks.rank == 0 else None
    own = problem_of(problem, ranks)
    rng, faults, sharp = np.random.default_rng(sum(map(ord, name))), [], []
    for i in range(count):
        told = None
        if ranks.rank == 0:
            s = disturbed(exact.answer(), i, rng, mechanics)
            told = s.x, mechanics.multipliers(s)
        x, multipliers = ranks.comm.bcast(told)
        found = certify_over_ranks(own, x[own.components], multipliers)
        parts = ranks.comm.gather((own.components, found.u))
        if parts is None:
            continue
        u = np.empty(x.size, dtype=Real)
        for components, part in parts:
            u[components] = part
        error, ratio = exact.exceeded(found, s, u)
        if ratio > ROUNDED:
            faults.append(f"{i}: error {error:.6e}, bound {found.bound:.6e}")
        if SHARP[0] < error < SHARP[1]:
            sharp.append(1 / ratio)
    return faults, sharp


def main():
    ranks, count = Ranks(MPI.COMM_WORLD), int(sys.argv[1])
    found = {name: certified(name, count, ranks) for name in sys.argv[2:]}
    if ranks.rank == 0:
        print(json.dumps(found))


if __name__ == "__main__":
    main()
