"""Speed-up of a solve on MPI ranks.

    mpiexec -n 2 .venv/bin/python -m mpi4py benchmarks/ranks.py [CASE] [REPEATS]

The same QP is solved `alone` on one rank and by all `ranks` together. The rounds of
these measurements alternate. The script prints medians with minimum and maximum, and
the times of each rank for the phases of a solve. Measurements that other processes
disturbed by more than `MAX_DISTURBANCE` are dropped, and the number of remaining
measurements is printed. The script requires Linux. It asserts no results, because
machines differ.
"""

import os
import sys
import time
from statistics import median

from mpi4py import MPI

import mortarbench as mb
from mortarbench.harness.distributed.vectors import Ranks
from mortarbench.solvers.smalbe.solver import SMALBE

CASE = "beam-ring/Nr=224/Nh=128/steps=1/feti=32/dual"
TOL = 1e-6
#: largest CPU time of other processes during a measurement, relative to its wall time
MAX_DISTURBANCE = 0.04


def together(comm: MPI.Comm) -> None:
    """Wait until all ranks arrive, without keeping a CPU busy."""
    request = comm.Ibarrier()
    while not request.Test():
        time.sleep(1e-3)


def busy():
    """Return the CPU seconds of all processes since the machine was started."""
    with open("/proc/stat") as stat:
        spent = [int(ticks) for ticks in stat.readline().split()[1:9]]
    # columns 3 and 4 are the times in which a CPU was idle or waited for input
    return (sum(spent) - sum(spent[3:5])) / os.sysconf("SC_CLK_TCK")


def undisturbed(world, act):
    """Call `act` on every rank, and return the local result.

    Return None if other processes used more CPU time than `MAX_DISTURBANCE` allows.
    """
    together(world)
    others, start = busy() - time.process_time(), time.perf_counter()
    before = time.process_time()
    result = act()
    together(world)
    ours = world.allreduce(time.process_time() - before)
    elapsed = time.perf_counter() - start
    others = busy() - (others + before) - ours
    return result if world.bcast(others / elapsed) < MAX_DISTURBANCE else None


def timed(qp, comm):
    """Prepare and solve on the ranks of `comm`.

    Return the times in s of preparing, solving and the phases of the solve, and counts
    of operations.
    """
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
    parts = dict(ranks.seconds)
    parts["vectors"] = end - ready - sum(parts.values())
    return {"prepare": ready - start, "solve": end - ready} | parts | ranks.counts


def main(name: str = CASE, repeats: str = "5") -> None:
    """Measure, and print the table."""
    world, alone = MPI.COMM_WORLD, MPI.COMM_SELF
    cpus = sorted(os.sched_getaffinity(0))
    # as in a run, each rank uses a separate CPU
    os.sched_setaffinity(0, {cpus[world.rank % len(cpus)]})
    qp = mb.build(name).qp
    ways = {
        "alone": lambda: timed(qp, alone) if world.rank == 0 else {},
        "ranks": lambda: timed(qp, world),
    }
    results: dict[str, list[list[dict[str, float]]]] = {way: [] for way in ways}
    rounds = int(repeats) + 1
    for round_ in range(rounds):
        for way, act in ways.items():
            one = undisturbed(world, act)
            if round_ and one is not None:  # the first round is a warm-up
                results[way].append(world.allgather(one))
    if world.rank:
        return
    print(f"{name}: {qp.q.size} multipliers, {world.size} ranks")
    counts = ", ".join(f"{way} {len(results[way])}" for way in results)
    print(f"  undisturbed, of {rounds - 1} rounds: {counts}")
    if not all(results.values()):
        return
    for phase in ("prepare", "solve"):
        slowest = {
            way: [max(rank.get(phase, 0.0) for rank in one) for one in each]
            for way, each in results.items()
        }
        for way, times in slowest.items():
            print(
                f"  {phase:8} {way:7} {median(times):8.3f} s"
                f" [{min(times):.3f}, {max(times):.3f}]"
            )
        one, ranks = map(median, slowest.values())
        print(f"  {phase:8} speed-up {one / ranks:.2f}")
    for part in list(results["ranks"][0][0])[2:]:
        each = "; ".join(
            f"{way} " + ", ".join(
                f"{median(one[rank][part] for one in of_way):.3g}"
                for rank in range(world.size) if part in of_way[0][rank]
            )
            for way, of_way in results.items()
        )  # fmt: skip
        print(f"  solve, {part:10} {each}")


if __name__ == "__main__":
    main(*sys.argv[1:])
