"""What two ranks of MPI gain on one solve, against two independent copies of it.

    mpiexec -n 2 .venv/bin/python -m mpi4py benchmarks/ranks.py [CASE] [REPEATS]

Products are bound by memory, which the CPUs of a machine share: two copies of a job on
two CPUs do not do twice as much as one either. So the speed-up of a solve on all ranks
is shown beside what so many copies, each on a rank of its own, reach together. Rounds
of all three ways are interleaved in one job, on one QP; medians are printed, with the
least and the largest, and what each rank spent on the parts of a solve, in all three
ways. Measurements during which other processes used the CPUs are left out, and how many
were kept is printed (Linux). Nothing is asserted: machines differ.
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
OTHERS = 0.04  #: of a CPU, that others may take of a measurement


def together(comm: MPI.Comm) -> None:
    """Wait for all ranks, without keeping a CPU busy."""
    request = comm.Ibarrier()
    while not request.Test():
        time.sleep(1e-3)


def busy():
    """CPU seconds that this machine has spent on anything since it started."""
    with open("/proc/stat") as stat:
        spent = [int(ticks) for ticks in stat.readline().split()[1:9]]
    return (sum(spent) - sum(spent[3:5])) / os.sysconf("SC_CLK_TCK")  # without idle


def undisturbed(world, act):
    """Have every rank do something; None where other processes took CPU time."""
    together(world)
    others, start = busy() - time.process_time(), time.perf_counter()
    before = time.process_time()
    found = act()
    together(world)
    ours = world.allreduce(time.process_time() - before)
    passed = time.perf_counter() - start
    others = busy() - (others + before) - ours
    return found if world.bcast(others / passed) < OTHERS else None


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
    parts = dict(ranks.seconds)
    parts["vectors"] = end - ready - sum(parts.values())
    return {"prepare": ready - start, "solve": end - ready} | parts | ranks.counts


def main(name: str = CASE, repeats: str = "5") -> None:
    """Print the table."""
    world, alone = MPI.COMM_WORLD, MPI.COMM_SELF
    cpus = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cpus[world.rank % len(cpus)]})  # as ranks of a run
    qp = mb.build(name).qp
    ways = {
        "alone": lambda: timed(qp, alone) if world.rank == 0 else {},
        "copies": lambda: timed(qp, alone),
        "ranks": lambda: timed(qp, world),
    }
    found: dict[str, list[list[dict[str, float]]]] = {way: [] for way in ways}
    rounds = int(repeats) + 1
    for round_ in range(rounds):
        for way, act in ways.items():
            one = undisturbed(world, act)
            if round_ and one is not None:  # the first one warms up
                found[way].append(world.allgather(one))
    if world.rank:
        return
    print(f"{name}: {qp.q.size} multipliers, {world.size} ranks")
    kept = ", ".join(f"{way} {len(found[way])}" for way in found)
    print(f"  undisturbed, of {rounds - 1} rounds: {kept}")
    if not all(found.values()):
        return
    for phase in ("prepare", "solve"):
        slowest = {
            way: [max(rank.get(phase, 0.0) for rank in one) for one in each]
            for way, each in found.items()
        }
        for way, times in slowest.items():
            print(
                f"  {phase:8} {way:7} {median(times):8.3f} s"
                f" [{min(times):.3f}, {max(times):.3f}]"
            )
        one, copies, ranks = map(median, slowest.values())
        speed, most = one / ranks, world.size * one / copies
        print(
            f"  {phase:8} speed-up {speed:.2f}, of {most:.2f} that copies reach: "
            f"{speed / most:.2f}"
        )
    for part in list(found["ranks"][0][0])[2:]:
        each = "; ".join(
            f"{way} " + ", ".join(
                f"{median(one[rank][part] for one in of_way):.3g}"
                for rank in range(world.size) if part in of_way[0][rank]
            )
            for way, of_way in found.items()
        )  # fmt: skip
        print(f"  solve, {part:10} {each}")


if __name__ == "__main__":
    main(*sys.argv[1:])
