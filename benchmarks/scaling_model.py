"""Parameters of the cost model on this machine, and its form against 1, 2 and 4 ranks.

`python -m benchmarks.scaling_model` prints the table of docs/scaling-model.md that
depends on the machine. All times are the smallest of many calls, because other programs
on the machine only lengthen them. More ranks than CPUs share these; messages then wait
for their receivers, so only the local part is meaningful.
"""

import os
import subprocess
import sys
from collections.abc import Callable
from time import perf_counter

import numpy as np
from mpi4py import MPI
from scipy.linalg.blas import dgemm, dspmv

import mortarbench as mb
from mortarbench.harness.distributed.network import network
from mortarbench.harness.distributed.vectors import Ranks
from mortarbench.problems.experiments.scaling_model import (
    Distribution,
    Machine,
    predict,
)

CASE, SUBDOMAINS, CELLS = "cube-wall/n=32/feti=8/dual", 64, 8
RANKS = (1, 2, 4)
CALLS = 60


def smallest(work: Callable[[], object]) -> float:
    """Return the smallest time of many calls, s."""
    times = []
    for _ in range(CALLS):
        start = perf_counter()
        work()
        times.append(perf_counter() - start)
    return min(times)


def measured() -> Machine:
    """Return the speeds of a core and of messages between ranks.

    One triangle of 64 MiB passes through memory; the block of a subdomain multiplies
    the vectors of 32 congruent ones.
    """
    n, m = 4096, Distribution(cores=1, cells=CELLS).block
    packed, x = np.ones(n * (n + 1) // 2), np.ones(n)
    block, columns = np.ones((m, m), order="F"), np.ones((m, 32), order="F")
    bandwidth = packed.nbytes / smallest(lambda: dspmv(n, 1.0, packed, x))
    rate = 2.0 * m * m * 32 / smallest(lambda: dgemm(1.0, block, columns))
    speeds = network(MPI.COMM_WORLD)
    return Machine(
        bandwidth=bandwidth, rate=rate, node_bandwidth=bandwidth,
        latency=speeds["message_seconds"], seconds_per_byte=speeds["seconds_per_byte"],
    )  # fmt: skip


def main() -> None:
    """Print a row of the table; without MPI, start this module on all `RANKS`."""
    if len(sys.argv) == 1:
        print("ranks | block products, ms | model | sent, kB | model | GB/s, Gflop/s")
        for n in RANKS:
            command = ["mpiexec", "-n", str(n), sys.executable, "-m",
                       "benchmarks.scaling_model", "rank"]  # fmt: skip
            subprocess.run(command, check=True)
        return
    world = MPI.COMM_WORLD
    cpus = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cpus[world.rank % len(cpus)]})  # as for ranks of a run
    machine = measured()
    ranks = Ranks(world)
    qp = mb.build(CASE).qp
    share = qp.P.build().share(qp, ranks).qp
    x, times = np.ones(share.q.size), []
    for _ in range(CALLS):
        ranks.clear()
        share.P @ x
        times.append(ranks.seconds["products"])
    local = world.reduce(min(times), MPI.MAX)
    sent = world.reduce(ranks.counts["bytes"], MPI.MAX)
    if world.rank == 0:
        shared = Distribution(
            cores=world.size, per_core=SUBDOMAINS / world.size, cells=CELLS,
            congruent=True,
        )  # fmt: skip
        model = predict(shared, machine)
        print(
            f"{world.size} | {1e3 * local:.1f} | {1e3 * model.local:.1f} | "
            f"{sent / 1e3:.1f} | {model.sent / 1e3:.1f} | "
            f"{machine.bandwidth / 1e9:.1f}, {machine.rate / 1e9:.1f}; message "
            f"{1e6 * machine.latency:.1f} µs, {1e9 * machine.seconds_per_byte:.2f} ns/B"
        )


if __name__ == "__main__":
    main()
