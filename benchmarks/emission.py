"""What ranks hold and take when each emits its own share of a QP, and one process.

    mpiexec -n 2 .venv/bin/python -m mpi4py benchmarks/emission.py [CASE]
    .venv/bin/python benchmarks/emission.py whole [CASE]

Prints, after each stage, the peak of the resident memory of a rank beyond its imports,
the largest and the mean of all ranks, and the seconds of the slowest. `whole` builds
the case in one process, with everything that certifies and draws an answer. Nothing is
asserted: machines differ.
"""

import sys
import time

from mortarbench.harness.names import parse
from mortarbench.harness.verify.measure import memory_mib
from mortarbench.problems import PROBLEMS

CASE = "beam-ring/Nr=224/Nh=128/steps=1/feti=16/dual"
TOL = 1e-6


def whole(name: str = CASE) -> None:
    """Build the case in this process."""
    import mortarbench as mb
    from mortarbench.problems.models import (
        beam_ring,  # its imports are none of the case's memory
    )

    del beam_ring
    before, start = memory_mib("VmHWM"), time.perf_counter()
    qp = mb.build(name).qp
    seconds, peak = time.perf_counter() - start, memory_mib("VmHWM") - before
    print(f"{name}: {qp.q.size} multipliers, one process")
    print(f"  build    {seconds:7.2f} s   peak {peak:7.1f} MiB")


def emitted(name: str = CASE) -> None:
    """Emit, prepare and solve on all ranks."""
    from mpi4py import MPI

    from mortarbench.harness.distributed.vectors import Ranks
    from mortarbench.problems.feti import distributed_dual
    from mortarbench.problems.models import beam_ring, membranes, patch, plate
    from mortarbench.solvers.reference.over_ranks import reference_over_ranks
    from mortarbench.solvers.smalbe.solver import SMALBE

    del distributed_dual, beam_ring, membranes, patch, plate
    ranks, case = Ranks(MPI.COMM_WORLD), parse(name, PROBLEMS)
    before = memory_mib("VmHWM")

    def told(stage, start):
        mine = time.perf_counter() - start, memory_mib("VmHWM") - before
        times, peaks = zip(*ranks.comm.allgather(mine), strict=True)
        if ranks.rank == 0:
            mean = sum(peaks) / len(peaks)
            print(
                f"  {stage:8} {max(times):7.2f} s   peak {max(peaks):7.1f} MiB, "
                f"mean {mean:.1f}, largest/mean {max(peaks) / mean:.3f}"
            )

    ranks.comm.Barrier()
    start = time.perf_counter()
    emit = case.family.emission(case.form, case.params)
    if emit is None:
        raise SystemExit(f"{name}: ranks cannot emit it")
    made = emit(ranks, reference_over_ranks)
    if ranks.rank == 0:
        print(f"{name}: {made.variables} multipliers, {ranks.size} ranks")
    told("emit", start)
    start = time.perf_counter()
    run = SMALBE().prepare(made.share().qp, TOL)
    told("prepare", start)
    start = time.perf_counter()
    run()
    told("solve", start)


if __name__ == "__main__":
    if sys.argv[1:2] == ["whole"]:
        whole(*sys.argv[2:])
    else:
        emitted(*sys.argv[1:])
