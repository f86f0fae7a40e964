"""Memory and time of a QP assembled on MPI ranks, compared with one process.

    mpiexec -n 2 .venv/bin/python -m mpi4py benchmarks/emission.py [CASE]
    .venv/bin/python benchmarks/emission.py whole [CASE]

Each rank assembles its share of the QP. After each stage, the script prints the peak of
resident memory beyond the memory of imports (largest and mean over the ranks) and the
time of the slowest rank. With `whole`, the case is built in one process, including the
data for certificates and pictures. The script asserts no results, because machines
differ.
"""

import sys
import time

from mortarbench.harness.names import parse
from mortarbench.harness.verify.measure import memory_mib
from mortarbench.problems import PROBLEMS

CASE = "beam-ring/Nr=224/Nh=128/steps=1/feti=16/dual"
TOL = 1e-6


def whole(name: str = CASE) -> None:
    """Build a case in this process; print its time and peak memory."""
    import mortarbench as mb
    from mortarbench.problems.models import beam_ring

    del beam_ring  # imported so that the import is not part of the measured memory
    before, start = memory_mib("VmHWM"), time.perf_counter()
    qp = mb.build(name).qp
    seconds, peak = time.perf_counter() - start, memory_mib("VmHWM") - before
    print(f"{name}: {qp.q.size} multipliers, one process")
    print(f"  build    {seconds:7.2f} s   peak {peak:7.1f} MiB")


def distributed(name: str = CASE) -> None:
    """Assemble, prepare and solve a case on all ranks; print times and peak memory."""
    from mpi4py import MPI

    from mortarbench.harness.distributed.vectors import Ranks
    from mortarbench.problems.feti import distributed_dual
    from mortarbench.problems.models import beam_ring, membranes, patch, plate
    from mortarbench.solvers.reference.operators import reference_of_operator
    from mortarbench.solvers.smalbe.solver import SMALBE

    del distributed_dual, beam_ring, membranes, patch, plate
    ranks, case = Ranks(MPI.COMM_WORLD), parse(name, PROBLEMS)
    before = memory_mib("VmHWM")

    def print_stage(stage, start):
        local = time.perf_counter() - start, memory_mib("VmHWM") - before
        times, peaks = zip(*ranks.comm.allgather(local), strict=True)
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
        raise SystemExit(f"{name}: ranks cannot assemble this case")
    share_source = emit(ranks, reference_of_operator)
    if ranks.rank == 0:
        print(f"{name}: {share_source.variables} multipliers, {ranks.size} ranks")
    print_stage("emit", start)
    start = time.perf_counter()
    run = SMALBE().prepare(share_source.share().qp, TOL)
    print_stage("prepare", start)
    start = time.perf_counter()
    run()
    print_stage("solve", start)


if __name__ == "__main__":
    if sys.argv[1:2] == ["whole"]:
        whole(*sys.argv[2:])
    else:
        distributed(*sys.argv[1:])
