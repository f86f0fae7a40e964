"""Parameters of the cost model on this machine, and its predictions for ranks.

`python -m benchmarks.scaling_model` prints the tables of docs/scaling-model.md that
depend on the machine, in Markdown. The case is `cube-wall/n=32/feti=4`, with 512
congruent subdomains and 107 811 dofs in total. Each time is the smallest time of many
calls, because other programs can only lengthen a call. If there are more ranks than
CPUs, messages wait for their receivers, and the times of product and projection are not
printed.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from time import perf_counter

import numpy as np
from mpi4py import MPI
from scipy.linalg.blas import dgemm, dspmv

import mortarbench as mb
from mortarbench.harness.distributed.network import network
from mortarbench.harness.distributed.vectors import Ranks
from mortarbench.problems.experiments.scaling_model import (
    REDUCTIONS,
    Distribution,
    Machine,
    Prediction,
    predict,
)
from mortarbench.problems.feti.blocks import BlockDiagonal
from mortarbench.solvers.smalbe.rows import equality_rows
from mortarbench.solvers.smalbe.solver import SMALBE

#: subdomains per side of the cube, elements per side of a subdomain (H/h), tolerance
SIDE, CELLS, TOL = 8, 4, 1e-6
RANKS, CLUSTERS = (1, 2, 4), (1, 2, 4)
CALLS = 60
LOCAL, DISTINCT = "local products, s", "local products of distinct blocks, s"
PRODUCT, COARSE = "product and projection, s", "coarse unknowns"
SENT, MESSAGES = "bytes per product", "messages per product"
APPLICATIONS, REDUCED = "applications", "reductions per application"


@dataclass(frozen=True, kw_only=True)
class Row:
    """Measurements for one number of ranks and one cluster size, with predictions."""

    ranks: int
    cluster: int  #: number of subdomains per side of a cluster
    measured: dict[str, float]  #: measurements by name of the quantity
    machine: dict[str, float]  #: measured speeds by field of `Machine`

    @property
    def run(self) -> Distribution:
        """Distribution of the subdomains in the measurement."""
        return Distribution(
            cores=self.ranks, per_core=SIDE**3 / self.ranks, cells=CELLS,
            cluster=self.cluster, congruent=True,
        )  # fmt: skip

    @property
    def model(self) -> Prediction:
        """Prediction with machine speeds measured on the same ranks shortly before."""
        return predict(self.run, Machine(**self.machine))


def smallest(work: Callable[[], object]) -> float:
    """Return the smallest time of many calls, on the slowest rank, in s."""
    times = []
    for _ in range(CALLS):
        start = perf_counter()
        work()
        times.append(perf_counter() - start)
    slowest: float = MPI.COMM_WORLD.allreduce(min(times), MPI.MAX)
    return slowest


def speeds() -> Machine:
    """Measure the speeds of a core and of messages between ranks.

    Memory bandwidth is measured by the product of a packed triangular matrix of 64 MiB
    with a vector. The floating-point rate is measured by the product of the matrix of a
    subdomain with 64 vectors, as for 64 congruent subdomains.
    """
    n, m = 4096, Distribution(cores=1, cells=CELLS).block
    packed, x = np.ones(n * (n + 1) // 2), np.ones(n)
    block, columns = np.ones((m, m), order="F"), np.ones((m, 64), order="F")
    bandwidth = packed.nbytes / smallest(lambda: dspmv(n, 1.0, packed, x))
    rate = 2.0 * m * m * 64 / smallest(lambda: dgemm(1.0, block, columns))
    between = network(MPI.COMM_WORLD)
    return Machine(
        bandwidth=bandwidth, rate=rate, node_bandwidth=bandwidth,
        latency=between["message_seconds"],
        seconds_per_byte=between["seconds_per_byte"],
    )  # fmt: skip


def distinct() -> float:
    """Return the time in s of a local product in which no subdomains share a block."""
    n = Distribution(cores=1, cells=CELLS).block
    count = SIDE**3 // MPI.COMM_WORLD.size
    triangles = [np.ones(n * (n + 1) // 2) for _ in range(count)]
    blocks, x = BlockDiagonal(triangles, [n] * count, [1] * count), np.ones(n * count)
    return smallest(lambda: blocks(x))


def measured(cluster: int) -> dict[str, float]:
    """Return counts and times of a product and a projection, and counts of a solve.

    cluster : subdomains per side of a cluster
    """
    world = MPI.COMM_WORLD
    joined = "" if cluster == 1 else f"/cluster={cluster}"
    qp = mb.build(f"cube-wall/n={SIDE * CELLS}/feti={CELLS}{joined}/dual").qp
    ranks = Ranks(world)
    share = qp.P.build().share(qp, ranks).qp
    blocks, x = share.P.local.inverse_map, np.ones(share.q.size)
    X = np.ones(blocks.shape[1])
    rows = equality_rows(share.A, share.b, np.isfinite(np.asarray(share.lb)))
    local = smallest(lambda: blocks(X))
    together = smallest(lambda: rows.project(share.P @ x))
    ranks.clear()
    share.P @ x
    product = dict(ranks.counts)
    solve = SMALBE().prepare(share, TOL)
    ranks.clear()
    counts = solve().counts
    qp.P.forget()
    return {
        LOCAL: local, PRODUCT: together, COARSE: qp.A.shape[0],
        SENT: world.allreduce(product["bytes"], MPI.MAX),
        MESSAGES: world.allreduce(product["messages"], MPI.MAX),
        APPLICATIONS: counts["P_products"] + counts["preconditioner_applies"],
        # An application sends as many messages as a product, so the number of messages
        # determines the number of applications. A single rank sends no messages.
        REDUCED: ranks.counts["reductions"] * product["messages"]
        / max(ranks.counts["messages"], 1),
    }  # fmt: skip


def on_ranks() -> None:
    """Print the measurements on these ranks as JSON, one line per cluster size."""
    world = MPI.COMM_WORLD
    cpus = sorted(os.sched_getaffinity(0))
    # as in a run, each rank uses a separate CPU
    os.sched_setaffinity(0, {cpus[world.rank % len(cpus)]})
    machine, different = speeds(), distinct()
    for cluster in CLUSTERS:
        results = {DISTINCT: different, **measured(cluster)}
        if world.rank == 0:
            row = Row(ranks=world.size, cluster=cluster, measured=results,
                      machine=asdict(machine))  # fmt: skip
            print(json.dumps(asdict(row)), flush=True)


Column = tuple[str, Callable[[Row], str]]


def digits(x: float) -> str:
    """Format a number with three significant digits, or without decimals if ≥ 100."""
    return f"{x:.0f}" if x >= 100 else f"{x:.3g}"


def number(head: str, name: str, unit: float = 1.0) -> Column:
    """Return a column of measurements divided by `unit`, with "–" if not meaningful."""
    return head, lambda r: digits(r.measured[name] / unit) if shows(r, name) else "–"


def model(name: str, of: Callable[[Row], float], unit: float = 1.0) -> Column:
    """Return a column of predictions with their deviations from measurements.

    name : measured quantity
    of : function that returns the prediction
    unit : divisor of the predictions
    """

    def cell(r: Row) -> str:
        value, prediction = r.measured[name], of(r)
        if not shows(r, name):
            return "–"
        if not value:
            return digits(prediction / unit)
        off = f"{100 * (prediction / value - 1):+.0f}".replace("-", "−")
        return f"{digits(prediction / unit)} ({off} %)"

    return "model", cell


def shows(r: Row, name: str) -> bool:
    """Return True if a measurement is meaningful on this number of ranks."""
    if name == REDUCED:
        return r.ranks > 1
    return name != PRODUCT or r.ranks <= len(os.sched_getaffinity(0))


def table(rows: list[Row], *columns: Column) -> None:
    """Print a table in Markdown; the first column is the number of ranks."""
    every = (("ranks", lambda r: str(r.ranks)), *columns)
    print("\n| " + " | ".join(head for head, _ in every) + " |")
    print("|" + " --: |" * len(every))
    for row in rows:
        print("| " + " | ".join(cell(row) for _, cell in every) + " |")


def main() -> None:
    """Measure on all `RANKS`, and print the tables."""
    rows = []
    for n in RANKS:
        command = ["mpiexec", "-n", str(n), sys.executable, "-m",
                   "benchmarks.scaling_model", "rank"]  # fmt: skip
        # ranks with several threads each would compete for the CPUs
        one_thread = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        lines = subprocess.run(
            command, check=True, stdout=subprocess.PIPE, text=True, env=one_thread
        )
        rows += [Row(**json.loads(line)) for line in lines.stdout.splitlines()]
    alone = {r.cluster: r.measured[APPLICATIONS] for r in rows if r.ranks == 1}
    cluster: Column = ("$m$", lambda r: str(r.cluster))
    growth: Column = (
        "relative to $m = 1$, $\\sqrt m$",
        lambda r: f"{r.measured[APPLICATIONS] / alone[1]:.2f}, {r.model.steps:.2f}",
    )
    table(
        rows, cluster,
        number("coarse unknowns", COARSE), model(COARSE, lambda r: r.run.coarse),
        number("applications", APPLICATIONS), growth,
        number("messages", MESSAGES),
        model(MESSAGES, lambda r: 2 * r.run.neighbours),
        number("sent, kB", SENT, 1e3), model(SENT, lambda r: r.model.sent, 1e3),
        number("reductions", REDUCED), model(REDUCED, lambda _: REDUCTIONS),
    )  # fmt: skip
    table(
        rows, cluster,
        number("local, ms", LOCAL, 1e-3),
        model(LOCAL, lambda r: r.model.local + r.model.joints, 1e-3),
        number("product and projection, ms", PRODUCT, 1e-3),
        model(PRODUCT, lambda r: r.model.seconds, 1e-3),
    )  # fmt: skip
    different = [r for r in rows if r.cluster == 1]
    table(
        different,
        ("GB/s", lambda r: f"{r.machine['bandwidth'] / 1e9:.1f}"),
        ("Gflop/s", lambda r: f"{r.machine['rate'] / 1e9:.1f}"),
        ("message, µs", lambda r: f"{1e6 * r.machine['latency']:.1f}"),
        ("ns/B", lambda r: f"{1e9 * r.machine['seconds_per_byte']:.2f}"),
        number("distinct blocks, ms", DISTINCT, 1e-3),
        model(
            DISTINCT,
            lambda r: predict(
                replace(r.run, congruent=False), Machine(**r.machine)
            ).local,
            1e-3,
        ),
    )  # fmt: skip


if __name__ == "__main__":
    if len(sys.argv) == 1:
        main()
    else:
        on_ranks()
