"""What two ranks of MPI gain on one solve, against two independent copies of it.

    mpiexec -n 2 .venv/bin/python -m mpi4py benchmarks/ranks.py [CASE] [REPEATS]

Products are bound by memory, which the CPUs of a machine share: two copies of a job on
two CPUs do not do twice as much as one either. So the speed-up of a solve on all ranks
is shown beside what so many copies, each on a rank of its own, reach together. Rounds
of all three ways are interleaved in one job, on one QP; medians are printed, with the
least and the largest, and of the last solve on all ranks what each of them spent on its
parts. Nothing is asserted: machines differ.
"""

import os
import sys
import time
from statistics import median

from mpi4py import MPI

import mortarbench as mb
from harness.distributed.vectors import Ranks
from solvers.smalbe.solver import SMALBE

CASE = "beam-ring/Nr=224/Nh=128/steps=1/feti=32/dual"
TOL = 1e-6


def together(comm: MPI.Comm) -> None:
    """Wait for all ranks, without keeping a CPU busy."""
    request = comm.Ibarrier()
    while not request.Test():
        time.sleep(1e-3)


def timed(qp, comm):
    """Prepare and solve on the ranks of `comm`: seconds of both, and of the parts."""
    ranks = Ranks(comm)
    share = qp.P.build().share(qp, ranks)
    comm.Barrier()
    start = time.perf_counter()
    run = SMALBE().prepare(share.qp, TOL)
    comm.Barrier()
    ready = time.perf_counter()
    ranks.clear()
    run()
    comm.Barrier()
    end = time.perf_counter()
    qp.P.forget()
    return (ready - start, end - ready), dict(ranks.seconds) | ranks.counts


def main(name: str = CASE, repeats: str = "5") -> None:
    """Print the table."""
    world, alone = MPI.COMM_WORLD, MPI.COMM_SELF
    cpus = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cpus[world.rank % len(cpus)]})  # as ranks of a run
    qp = mb.build(name).qp
    found: dict[str, list[tuple[float, ...]]] = {"alone": [], "copies": [], "ranks": []}
    for round_ in range(int(repeats) + 1):
        together(world)
        one, _ = timed(qp, alone) if world.rank == 0 else ((0.0, 0.0), {})
        together(world)
        copies, _ = timed(qp, alone)
        together(world)
        all_, parts = timed(qp, world)
        slowest = [world.allreduce(seconds, MPI.MAX) for seconds in copies]
        if round_:  # the first one warms up
            for way, times in zip(found, (one, slowest, all_), strict=True):
                found[way].append(tuple(times))
    of_each = world.gather(parts)
    if of_each is None:
        return
    print(f"{name}: {qp.q.size} multipliers, {world.size} ranks")
    for i, phase in enumerate(("prepare", "solve")):
        columns = {way: [t[i] for t in times] for way, times in found.items()}
        for way, times in columns.items():
            print(
                f"  {phase:8} {way:7} {median(times):8.3f} s"
                f" [{min(times):.3f}, {max(times):.3f}]"
            )
        one, copies, ranks = map(median, columns.values())
        speed, most = one / ranks, world.size * one / copies
        print(
            f"  {phase:8} speed-up {speed:.2f}, of {most:.2f} that copies reach: "
            f"{speed / most:.2f}"
        )
    for part in of_each[0]:
        each = ", ".join(f"{one[part]:.3g}" for one in of_each)
        print(f"  solve, {part:10} by rank: {each}")


if __name__ == "__main__":
    main(*sys.argv[1:])
