"""Program that runs several modules of this folder on the same MPI ranks.

Run as ``mpiexec -n N python -m mpi4py programs_on_ranks.py PROGRAMS``, where PROGRAMS
is a JSON list of [module, argument, …]. The program prints a JSON list of the results
that ``module.results(ranks, argument, …)`` returns on rank 0. Libraries are thus
imported once for all modules.
"""

import json
import sys
import time
from importlib import import_module

from mpi4py import MPI

from mortarbench.harness.distributed.vectors import Ranks


def main():
    ranks = Ranks(MPI.COMM_WORLD)
    found = [
        import_module(f"tests.support.{module}").results(ranks, *arguments)
        for module, *arguments in json.loads(sys.argv[1])
    ]
    if ranks.rank == 0:
        print(json.dumps(found, default=float))
    done = ranks.comm.Ibarrier()
    while not done.Test():  # sleep while waiting, since MPI would use CPU time
        time.sleep(0.01)


if __name__ == "__main__":
    main()
